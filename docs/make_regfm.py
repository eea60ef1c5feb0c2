"""REGFM_A1 and REGFM_B1 beside the published cases: the table and the figure of docs/regfm.md.

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
DIGITS = (4, 4, 5, 3)  # of P, Q, V, f


def main() -> None:
    figure, panels = pyplot.subplots(7, 2, figsize=(8.5, 13.0), layout="constrained")
    rows = []
    for (model, case), panel in zip(CASES["EVERY"], panels.T.flat, strict=True):
        pscad, psse = (CASES["points"](model, case, by) for by in ("PSCAD", "PSS/E"))
        own = CASES["traces"](model, case, CASES["run"](model, case))
        rows.append(_row(model, case, own, pscad, psse))
        panel.plot(own[:, 0], own[:, 1], "C0", lw=1, label="P, gfmhil through the meter")
        panel.plot(own[:, 0], own[:, 2], "C2", lw=1, label="Q, gfmhil through the meter")
        for k in (1, 2):
            panel.plot(psse[:, 0], psse[:, k], "k+", ms=4, label="PSS/E" if k == 1 else None)
            panel.plot(pscad[:, 0], pscad[:, k], "C3.", ms=5, label="PSCAD" if k == 1 else None)
        panel.set(title=f"{model.upper()}: {case}", xlim=(-0.05, 0.8))
        panel.title.set_size(9)
    panels[0, 0].legend(fontsize=6)
    for panel in panels[-1]:
        panel.set_xlabel("t after the event [s]")
    figure.supylabel("P, Q [p.u.]")
    figure.savefig(FIGURES / "regfm.png", dpi=110)
    heads = ("model", "case", "PSCAD's points", *(f"{name}: ours (PSS/E's)" for name in
             ("P [p.u.]", "Q [p.u.]", "V [p.u.]", "f [Hz]")))  # fmt: skip
    text = markdown(heads, rows) + "\n"
    (TABLES / "regfm.md").write_text(text, encoding="utf-8")


def _row(model: str, case: str, own: Rows, pscad: Rows, psse: Rows) -> tuple[str, ...]:
    window = f"{len(pscad)}, {pscad[0, 0]:.3f}–{pscad[-1, 0]:.3f} s" if len(pscad) else "none read"
    cells = ["–"] * 4
    if len(pscad):
        ours = np.stack(CASES["distances"](own, pscad))
        theirs = np.full((2, 4), np.nan)
        if len(psse):
            theirs = np.stack(CASES["distances"](psse, pscad))
        cells = [
            "–" if np.isnan(o).any() else f"{_pair(o, d)} ({_pair(t, d)})"
            for o, t, d in zip(ours.T, theirs.T, DIGITS, strict=True)
        ]
    return (model.upper(), case, window, *cells)


def _pair(pair: Rows, digits: int) -> str:
    """Largest and RMS distance."""
    return "–" if np.isnan(pair).any() else " / ".join(f"{x:.{digits}f}" for x in pair)


if __name__ == "__main__":
    main()
