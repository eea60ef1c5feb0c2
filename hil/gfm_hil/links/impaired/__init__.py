"""Deliberate faults on any link."""

from gfm_hil.links.impaired.link import ImpairedLink
from gfm_hil.links.impaired.settings import Impairment

__all__ = ["ImpairedLink", "Impairment"]
