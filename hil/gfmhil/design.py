"""The design of a law: its gamma, gains for the least gamma, and its margins."""

from gfm_design.margins.all_margins import Margins, UnstableLoop
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import Weight
from gfm_hil.studies.design import Gamma, NotTuned, Tuning, gamma, margins, tune

__all__ = [
    "Gamma",
    "Margins",
    "NotTuned",
    "Tuning",
    "Unstable",
    "UnstableLoop",
    "Weight",
    "gamma",
    "margins",
    "tune",
]
