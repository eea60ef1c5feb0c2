"""The nonlinear bench at one point of the box: a step of P_ref with the rig's imperfections."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from deployable.box import Point
from gfm_design.model.closed_loop import T_S
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import check_scenario

#: what the rig adds to a point: its boards, and the noise of its sensors in p.u.
RIG: dict[str, Any] = {
    "adc": "DS2004",
    "dac": "DS2101",
    "noise_std": {"v_dc": 3e-5, "p": 5e-4, "q": 5e-4, "V": 1e-4},
}
STEP = (0.5, 1.0)  # of P_ref, p.u.
_BEFORE, _AFTER = 5000, 25000  # ticks


@dataclass(frozen=True)
class Stepped:
    """What came of a run.

    Attributes:
        point: the plant.
        ended: why the run ended early, or "".
        overshoot: of p beyond where it settles, as a part of the step; NaN after an early end.
        ripple: how far p still swings beyond that at the end, where only the rounding of the
            boards and the noise move it; a part of the step. The overshoot contains it.
    """

    point: Point
    ended: str
    overshoot: float
    ripple: float


def step_run(point: Point, law: str, inner: str | None = None, seed: int = 1) -> Stepped:
    """Step P_ref from 0.5 to 1 p.u. on a point's plant, whatever its own P_ref is.

    Args:
        point: the plant.
        law: catalogue name or law file.
        inner: inner stage in place of the law's own: a shipped name, a file, or ``none``.
        seed: of the sensors' noise.
    """
    plant = point.plant().model_dump(mode="json", exclude_none=True)
    plant |= {"adc": RIG["adc"], "dac": RIG["dac"]}
    plant["sensors"] |= {"noise_std": RIG["noise_std"]}
    content = {
        "title": str(point),
        "duration": (_BEFORE + _AFTER) * T_S,
        "law": law,
        "inner": inner,
        "seed": seed,
        "references": {"P_ref": STEP[0]},
        "events": [{"tick": _BEFORE, "type": "reference", "P_ref": STEP[1]}],
        "mode": "lockstep",
        "link": {"type": "inproc"},
        "plant": plant,
    }
    run = run_in_memory(check_scenario(content, str(point)))
    if run.status not in ("completed", "oscillating"):  # what still oscillates is in ``ripple``
        why = f"{run.summary['reason']} at {run.summary['duration_s']:.3f} s"
        return Stepped(point, why, np.nan, np.nan)
    p = np.asarray(run.columns["true_p"])[_BEFORE:]
    rest, step = p[-_AFTER // 10 :], STEP[1] - STEP[0]
    settled = rest.mean()
    overshoot, ripple = (float((v - settled) / step) for v in (p.max(), rest.max()))
    return Stepped(point, "", overshoot, ripple)
