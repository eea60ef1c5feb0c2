"""The design of a law: its gamma, gains for the least gamma, its margins, and its network."""

from gfm_design.margins.all_margins import Margins, UnstableLoop, loop_margins
from gfm_design.misses.statistics import Misses
from gfm_design.misses.tolerance import LatencyTolerance
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.network import NetworkLoop
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import Weight
from gfm_hil.api.design import Gamma, NotTuned, Tuning, gamma, latency_tolerance, margins, tune
from gfm_hil.api.latency import Measured, measured_misses
from gfm_hil.api.sweeps import GainSweep, StabilityMap, stability_map, sweep
from gfm_hil.studies.bus_scan import BusScan, bus_scan
from gfm_hil.studies.forming_share import FormingShare, forming_shares
from gfm_hil.studies.linear_loop import network_loop

__all__ = [
    "BusScan",
    "ClosedLoop",
    "FormingShare",
    "GainSweep",
    "Gamma",
    "LatencyTolerance",
    "Margins",
    "Measured",
    "Misses",
    "NetworkLoop",
    "NotTuned",
    "StabilityMap",
    "Tuning",
    "Unstable",
    "UnstableLoop",
    "Weight",
    "bus_scan",
    "forming_shares",
    "gamma",
    "latency_tolerance",
    "loop_margins",
    "margins",
    "measured_misses",
    "network_loop",
    "stability_map",
    "sweep",
    "tune",
]
