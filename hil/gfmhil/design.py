"""The design of a law: its gamma, gains for the least gamma, its margins, and its network."""

from gfm_design.margins.all_margins import Margins, UnstableLoop
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import Weight
from gfm_hil.studies.design import Gamma, NotTuned, Tuning, gamma, margins, tune
from gfm_hil.studies.network_loop import NetworkLoop, network_loop

__all__ = [
    "Gamma",
    "Margins",
    "NetworkLoop",
    "NotTuned",
    "Tuning",
    "Unstable",
    "UnstableLoop",
    "Weight",
    "gamma",
    "margins",
    "network_loop",
    "tune",
]
