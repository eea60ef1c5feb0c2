"""The operator of a run: sends commands to a running role and reads its recording."""

from gfm_hil.operator.client import Operator

__all__ = ["Operator"]
