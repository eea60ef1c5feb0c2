"""REGFM_A1 and REGFM_B1 beside the published cases: the table and the figures of docs/regfm.md.

Usage: python docs/make_regfm.py    (about a minute)
"""

from __future__ import annotations

import runpy

import numpy as np
from _figures.common import FIGURES, TABLES
from matplotlib import pyplot
from numpy.typing import NDArray

from gfm_hil.core.terminal import markdown
from gfm_hil.scenario import find_scenario

CASES = runpy.run_path(str(find_scenario("regfm_a1").parent / "published" / "regfm_cases.py"))
Rows = NDArray[np.float64]
HEADS = ("P [p.u.]", "Q [p.u.]", "V [p.u.]", "f [Hz]")
DIGITS = (4, 4, 5, 4)  # of these


def main() -> None:
    rows = []
    for model in CASES["MODELS"]:
        figure, panels = pyplot.subplots(7, 4, figsize=(12.0, 14.0), layout="constrained")
        for case, line in zip(CASES["CASES"], panels, strict=True):
            pscad, psse = (CASES["points"](model, case, by) for by in ("PSCAD", "PSS/E"))
            own = CASES["traces"](model, case, CASES["run"](model, case))
            rows.append(_row(model, case, own, pscad, psse))
            for k, panel in enumerate(line, start=1):
                panel.plot(own[:, 0], own[:, k], "C0", lw=1, label="gfmhil, through the meter")
                panel.plot(psse[:, 0], psse[:, k], "k+", ms=4, label="PSS/E")
                panel.plot(pscad[:, 0], pscad[:, k], "C3.", ms=5, label="PSCAD")
                panel.set_xlim(-0.05, 0.8)
                panel.ticklabel_format(useOffset=False)
            line[0].set_ylabel(case, fontsize=9)
        for panel, name in zip(panels[0], HEADS, strict=True):
            panel.set_title(name, fontsize=10)
        panels[0, 0].legend(fontsize=7)
        figure.supxlabel("t after the event [s]")
        figure.savefig(FIGURES / f"{model}.png", dpi=90)
        pyplot.close(figure)
    heads = ("model", "case", "PSCAD's points", *(f"{name}: ours (PSS/E's)" for name in HEADS))
    (TABLES / "regfm.md").write_text(markdown(heads, rows) + "\n", encoding="utf-8")


def _row(model: str, case: str, own: Rows, pscad: Rows, psse: Rows) -> tuple[str, ...]:
    ours, theirs = (np.stack(CASES["distances"](x, pscad)).T for x in (own, psse))
    cells = (f"{_pair(o, d)} ({_pair(t, d)})" for o, t, d in zip(ours, theirs, DIGITS, strict=True))
    window = f"{len(pscad)}, {pscad[0, 0]:.3f}–{pscad[-1, 0]:.3f} s"
    return (model.upper(), case, window, *cells)


def _pair(pair: Rows, digits: int) -> str:
    """Largest and RMS distance."""
    return "–" if np.isnan(pair).any() else " / ".join(f"{x:.{digits}f}" for x in pair)


if __name__ == "__main__":
    main()
