"""Figures of linear loops and of frequency scans, with matplotlib."""

from gfm_hil.api.plot import (
    attraction_map,
    bode,
    certificate,
    clearing_map,
    clearing_times,
    impedance,
    nyquist,
    participations,
    pole_map,
    root_locus,
    save,
    stability_map,
    step,
)
from gfm_hil.studies.scan_figures import admittance, nfp, nyquist_on_grid, passivity

__all__ = [
    "admittance",
    "attraction_map",
    "bode",
    "certificate",
    "clearing_map",
    "clearing_times",
    "impedance",
    "nfp",
    "nyquist",
    "nyquist_on_grid",
    "participations",
    "passivity",
    "pole_map",
    "root_locus",
    "save",
    "stability_map",
    "step",
]
