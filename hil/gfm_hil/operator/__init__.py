"""The operator of a run: sends commands to a role that is running, and reads what it records."""

from gfm_hil.operator.client import Operator

__all__ = ["Operator"]
