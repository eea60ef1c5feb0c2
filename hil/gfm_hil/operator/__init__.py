"""The operator's hand on a run: commands to a side that is running, and a look at what it does."""

from gfm_hil.operator.announced import announced, present
from gfm_hil.operator.client import Operator
from gfm_hil.operator.desk import Desk
from gfm_hil.operator.identity import Identity, address
from gfm_hil.operator.rate import Rate

__all__ = ["Desk", "Identity", "Operator", "Rate", "address", "announced", "present"]
