"""What a campaign showed: counts, quantiles of metrics, and the runs to look at first."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gfm_hil.core.errors import UserError, need
from gfm_hil.run.metrics import METRICS
from gfm_hil.studies.campaign.axes import Axis, find_axes
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Record

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

VERDICTS = ("stable", "oscillating", "tripped", "safe", "no-steady-state")
QUANTILES = {"p5": 5, "p50": 50, "p95": 95, "max": 100}
_WORST = 5


@dataclass(frozen=True, repr=False)
class CampaignResult:
    """What a campaign showed.

    Attributes:
        campaign: what was run, with its file.
        records: one a run and law, by run number; the page on campaigns lists their keys.
        folder: where it is; None for a campaign in memory.
        workers: number of processes, or the address of the cluster.
        wall_s: how long the last call took, s.
        axes: of the map.
    """

    campaign: Campaign
    records: list[Record]
    folder: Path | None
    workers: int | str
    wall_s: float
    axes: tuple[Axis, Axis | None]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Counts, quantiles over the stable runs and the worst runs by law, as campaign.json."""
        return summary(self.campaign, self.records)

    def plain(self) -> dict[str, Any]:
        """The content of campaign.json."""
        return {**self.summary, "workers": self.workers, "wall_s": self.wall_s}

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """How many runs of each law were stable, oscillating, tripped and so on."""
        return {law: found["counts"] for law, found in self.summary["laws"].items()}

    def to_pandas(self) -> pandas.DataFrame:
        """One row a run and law: run, law, seed, verdict, status, reason, end_s [s], ripple_pu
        [p.u.], growth_1_s [1/s], the drawn values by their paths, and the metrics of each event
        as ``events.<k>.<metric>``, with the units of their names.

        Raises:
            UserError: pandas is not installed.
        """
        need("pandas", "pandas", "to_pandas", "notebook")
        import pandas

        rows = []
        for record in self.records:
            row = {k: v for k, v in record.items() if k not in ("drawn", "events")}
            row["verdict"] = verdict(record)
            row |= record["drawn"]
            for k, event in enumerate(record["events"]):
                row |= {f"events.{k}.{name}": event[name] for name in METRICS if name in event}
            rows.append(row)
        return pandas.DataFrame(rows)

    def plot(self, x: str | None = None, y: str | None = None) -> list[Axes]:
        """Draw what became of each run over two drawn paths, one panel a law.

        Args:
            x, y: drawn paths, or sums of them (``"a + b"``); those of the file if None.

        Raises:
            UserError: a path that is not drawn; there is no run.
        """
        from matplotlib import pyplot

        from gfm_hil.studies.campaign.figure import fill_map

        axes = find_axes(self.campaign, x, y)
        if not self.records:
            raise UserError("plot: the campaign has no run yet")
        return fill_map(pyplot.figure(), self.campaign, self.records, *axes)

    def write(self, folder: Path) -> None:
        """Write campaign.json and map.png into a folder that is there."""
        if self.records:
            from matplotlib.figure import Figure

            from gfm_hil.studies.campaign.figure import fill_map

            figure = Figure()
            fill_map(figure, self.campaign, self.records, *self.axes)
            figure.savefig(folder / "map.png", dpi=130)
        text = json.dumps(self.plain(), indent=2) + "\n"
        (folder / "campaign.json").write_text(text, "utf-8")

    def __repr__(self) -> str:
        lines = [
            f"  {law}: " + ", ".join(f"{n} {v}" for v, n in found.items() if n)
            for law, found in self.counts.items()
        ]
        title = self.campaign.file.title
        return "\n".join([f"<CampaignResult {title!r}, {len(self.records)} runs", *lines, ">"])


def verdict(record: Record) -> str:
    """The status; a run that completed, and so is at rest at its end, is called stable."""
    return "stable" if record["status"] == "completed" else str(record["status"])


def summary(campaign: Campaign, records: Sequence[Record]) -> dict[str, Any]:
    """campaign.json but for what the command adds: by law counts, quantiles, worst runs.

    Quantiles are over stable runs; a metric that none of them has is left out.
    """
    laws = {}
    for law in campaign.file.laws:
        mine = [r for r in records if r["law"] == law]
        verdicts = [verdict(r) for r in mine]
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
