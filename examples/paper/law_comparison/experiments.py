"""The experiments of the law comparison on the nonlinear bench, each with one disturbance."""

from __future__ import annotations

from typing import Any

import numpy as np

from gfm_hil.engine.inproc import drive
from gfm_hil.scenario import check_scenario
from gfm_hil.studies.campaign.worker import kept, simulate

START = "mimo-gfm"  # the law that the switchover comes from
AT = 0.5  # s
DURATION = 5.0  # s
TRACE_EVERY = 40  # ticks

#: what happens, and how the plant differs from the ideal one
EXPERIMENTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "p_ref": ({"type": "reference", "P_ref": 1.0}, {}),
    "frequency": ({"type": "grid-frequency", "f_hz": 49.9}, {}),
    "phase": ({"type": "grid-phase-jump", "degrees": 3.0}, {}),
    "late": ({"type": "reference", "P_ref": 1.0}, {"delay": {"samples": 1}}),
    "switchover": ({"type": "law"}, {}),
}


def experiment(name: str, law: str) -> dict[str, Any]:
    """Run one.

    Args:
        name: of ``EXPERIMENTS``.
        law: catalogue name or law file.

    Returns:
        status, reason, the metrics of the event (``run.metrics``), i_peak [p.u.], dp (largest
        deviation of p from before the event), bump_pu of a switchover, and trace, p over time
        every ``TRACE_EVERY`` ticks.
    """
    event, plant = EXPERIMENTS[name]
    switched = event["type"] == "law"
    content = {
        "title": f"{law}: {name}",
        "duration": DURATION,
        "law": START if switched else law,
        "link": {"type": "inproc"},
        "references": {"P_ref": 0.5},
        "plant": plant,
        "events": [{"t": AT, **event} | ({"law": law} if switched else {})],
    }
    scenario = check_scenario(content, f"law comparison, {name}")
    summary, columns = drive(simulate(scenario, kept(scenario)))
    p = columns["true_p"]
    out: dict[str, Any] = {"status": summary["status"], "reason": summary["reason"]}
    at = round(AT / scenario.T_s)
    if summary["status"] == "completed":
        out |= {k: v for k, v in summary["events"][0].items() if k not in ("t", "tick", "type")}
        out["i_peak"] = float(np.max(columns["true_i"][at:]))
        out["dp"] = float(np.max(np.abs(p[at:] - p[at - 1])))
    else:
        out["end_s"] = len(p) * scenario.T_s - AT
    out["trace"] = [round(float(v), 5) for v in p[::TRACE_EVERY]]
    return out
