"""Figures and tables of docs/tuning.md. Writes

    docs/_static/figures/{design,delay}_*.png    the figures
    docs/tables/{tune,delay}_*.md                what commands say, and numbers

Usage: python docs/design_figures.py    (some minutes; the full-order bound needs slycot)
"""

from __future__ import annotations

from _figures import delay_loci, h_infinity, tuning

from gfm_design.tuning.paper import tune_paper


def main() -> None:
    """Everything."""
    h_infinity.weights()
    problem = h_infinity.problem()
    found = tune_paper(problem)
    h_infinity.channels(found)
    h_infinity.bound(found)
    delay_loci.loci()
    delay_loci.damping()
    delay_loci.table()
    tuning.worked_example()
    tuning.couplings()


if __name__ == "__main__":
    main()
