"""Figure of docs/protection.md: a real-time run whose link pauses, under both policies.

    docs/_static/figures/late_policy.png

Usage: python docs/protection_figure.py    (ten seconds; two processes a run)
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from _figures.common import FIGURES, GREY

from gfm_hil.run.runner import Run, run_scenario
from gfm_hil.scenario import check_scenario

T_S = 1e-3  # s, so that the pause is what is late here and nothing else
STEP, PAUSE_AT, PAUSE = 60, 64, 0.0125  # ticks, frames, s
SHOWN = range(56, 92)


def run(place: Path, name: str, extrapolate: int, impairment: dict[str, Any] | None) -> Run:
    """A step of P_ref in real time."""
    content = {
        "title": name,
        "mode": "realtime",
        "law": "vsg-2",
        "T_s": T_S,
        "duration": 0.12,
        "late_policy": {"hold": 100, "extrapolate": extrapolate},
        "link": {"type": "shm", "peer_timeout_s": 5.0, "impairment": impairment},
        "events": [{"tick": STEP, "type": "reference", "P_ref": 0.8}],
    }
    return run_scenario(check_scenario(content, name), place / name)


def main() -> None:
    """All of it."""
    pause = {"towards": "plant", "pause_at": PAUSE_AT, "pause": PAUSE}
    figure, axes = plt.subplots(figsize=(7.5, 3.6), layout="constrained")
    ticks = np.array(SHOWN)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name, extrapolate, impairment, (color, marker) in (
            ("no pause", 0, None, (GREY, "o")),
            ("hold", 0, pause, ("C0", "s")),
            ("extrapolate = 6, then hold", 6, pause, ("C1", "^")),
        ):
            found = run(place, name, extrapolate, impairment)
            omega = (found.signals["u_omega_u"][ticks] - 1) * 1e3
            axes.plot(ticks, omega, label=name, color=color, marker=marker, ms=3.5, lw=1)
            if name == "hold":
                with np.load(found.folder / "timing.npz") as file:
                    late = file["plant_received"][ticks] < 0
                for k in ticks[late]:
                    axes.axvspan(k - 0.5, k + 0.5, color="C3", alpha=0.12, lw=0)
            print(name, found.summary["status"], found.summary["misses"], "misses")
    axes.set_xlabel(f"tick of {T_S * 1e3:g} ms (red: no fresh u)")
    axes.set_ylabel(r"$\omega_u - 1$ at the plant, 10$^{-3}$ p.u.")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(FIGURES / "late_policy.png", dpi=150)


if __name__ == "__main__":
    main()
