"""What a campaign showed: counts, quantiles of metrics, and the runs to look at first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gfm_hil.results.metrics import METRICS
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Record

VERDICTS = ("stable", "oscillating", "tripped", "safe", "no-steady-state")
QUANTILES = {"p5": 5, "p50": 50, "p95": 95, "max": 100}
_WORST = 5


def verdict(record: Record, ripple_max: float) -> str:
    """The status, with completed told apart: stable, or still oscillating at the end."""
    if record["status"] != "completed":
        return str(record["status"])
    return "stable" if record["ripple_pu"] <= ripple_max else "oscillating"


def summary(campaign: Campaign, records: Sequence[Record]) -> dict[str, Any]:
    """campaign.json but for what the command adds: by law counts, quantiles, worst runs.

    Quantiles are over stable runs; a metric that none of them has is left out.
    """
    laws = {}
    for law in campaign.file.laws:
        mine = [r for r in records if r["law"] == law]
        verdicts = [verdict(r, campaign.file.ripple_max) for r in mine]
        stable = [r for r, v in zip(mine, verdicts, strict=True) if v == "stable"]
        laws[law] = {
            "runs": len(mine),
            "counts": {v: verdicts.count(v) for v in VERDICTS},
            "events": _events(campaign, stable),
            "worst": _worst(mine, verdicts),
        }
    return {
        "title": campaign.file.title,
        "campaign": campaign.name,
        "scenario": campaign.file.scenario,
        "seed": campaign.file.seed,
        "ripple_max": campaign.file.ripple_max,
        "runs": campaign.file.runs,
        "done": len(records),
        "missing": campaign.file.runs * len(campaign.file.laws) - len(records),
        "laws": laws,
    }


def _events(campaign: Campaign, records: Sequence[Record]) -> list[dict[str, Any]]:
    """Quantiles of every metric, one entry an event."""
    found = []
    for k in range(len(campaign.base["events"])):
        events = [r["events"][k] for r in records if k < len(r["events"])]
        metrics = {}
        for name in METRICS:
            values = [e[name] for e in events if e.get(name) is not None]
            if values:
                marks = np.percentile(values, list(QUANTILES.values()))
                metrics[name] = dict(zip(QUANTILES, map(float, marks), strict=True))
        if events:
            found.append({"type": events[0]["type"], "metrics": metrics})
    return found


def _worst(records: Sequence[Record], verdicts: Sequence[str]) -> list[dict[str, Any]]:
    """First those that ended soonest, then those that swing most, then the largest overshoot."""

    def badness(entry: tuple[Record, str]) -> tuple[float, ...]:
        record, found = entry
        swing = record["ripple_pu"] or 0.0
        overshoot = max((e.get("overshoot_pct") or 0.0 for e in record["events"]), default=0.0)
        order = ("tripped", "safe", "oscillating", "no-steady-state", "stable").index(found)
        return (order, record["end_s"] or 0.0, -swing if found == "oscillating" else -overshoot)

    ranked = sorted(zip(records, verdicts, strict=True), key=badness)[:_WORST]
    return [
        {k: r[k] for k in ("run", "end_s", "reason", "ripple_pu", "growth_1_s", "drawn")}
        | {"verdict": v}
        for r, v in ranked
    ]
