"""What a campaign showed: counts, quantiles of metrics, the runs to look at first, and the axes of
its map: a drawn path, or the sum of several ("a + b")."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError, need
from gfm_hil.run.metrics import METRICS
from gfm_hil.studies.campaign.spec import Campaign, Choice, LogUniform
from gfm_hil.studies.campaign.worker import Record

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes

VERDICTS = ("stable", "oscillating", "tripped", "safe", "no-steady-state")
QUANTILES = {"p5": 5, "p50": 50, "p95": 95, "max": 100}
_WORST = 5


@dataclass(frozen=True)
class Axis:
    """One axis of the figure."""

    name: str  # the path or sum, as given
    label: str  # what is written at the axis
    log: bool = False  # drawn over a logarithm
    # the values where they are not numbers; the axis counts them from 0
    words: tuple[str, ...] = ()
    # how far a value may be shifted aside so that equal ones do not hide each other
    apart: float = 0.0

    def values(self, records: Sequence[Record]) -> NDArray[np.float64]:
        """The value of every record, shape (n,)."""
        if self.words:
            found = [self.words.index(str(r["drawn"][self.name])) for r in records]
            return np.array(found, dtype=float)
        return np.array([self._sum(r["drawn"]) for r in records], dtype=float)

    def text(self, drawn: dict[str, Any]) -> str:
        """The value of one run in words."""
        return str(drawn[self.name]) if self.words else f"{self._sum(drawn):.4g}"

    def _sum(self, drawn: dict[str, Any]) -> float:
        return float(sum(drawn[part.strip()] for part in self.name.split("+")))


def find_axes(campaign: Campaign, x: str | None, y: str | None) -> tuple[Axis, Axis | None]:
    """The axes asked for, those of the file, or the first two drawn; no second if only one is.
    Raises UserError: a path that is not drawn, the same twice, words in a sum."""
    drawn = [d.path for d in campaign.file.draw]
    x = x or campaign.file.figure.x or next(p for p in drawn if p != y)
    y = y or campaign.file.figure.y or next((p for p in drawn if p != x), None)
    if x == y:
        raise UserError(f"--x, --y: both are {x!r}; choose two of {drawn}")
    return _axis(campaign, "--x", x), None if y is None else _axis(campaign, "--y", y)


def _axis(campaign: Campaign, option: str, name: str) -> Axis:
    drawn = {d.path: d for d in campaign.file.draw}
    parts = [part.strip() for part in name.split("+")]
    for part in parts:
        if part not in drawn:
            raise UserError(f"{option} {name!r}: {part!r} is not drawn; drawn are {list(drawn)}")
    mine = [drawn[part] for part in parts]
    label = " + ".join(d.label or d.path for d in mine)
    if len(mine) > 1:
        if any(_words(d) for d in mine):
            raise UserError(f"{option} {name!r}: only numbers have a sum")
        return Axis(name, label)
    only: Any = mine[0]
    if isinstance(only, Choice):
        words = _words(only)
        steps = np.diff(np.arange(len(words)) if words else np.unique(np.array(only.values, float)))
        return Axis(name, label, words=words, apart=0.3 * float(min(steps, default=1.0)))
    return Axis(name, label, log=isinstance(only, LogUniform))


def _words(d: Any) -> tuple[str, ...]:
    if not isinstance(d, Choice):
        return ()
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in d.values):
        return ()
    return tuple(dict.fromkeys(map(str, d.values)))


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
        """Write campaign.json, map.png and report.html into a folder that is there."""
        if self.records:
            from matplotlib.figure import Figure

            from gfm_hil.studies.campaign.figure import fill_map

            figure = Figure()
            fill_map(figure, self.campaign, self.records, *self.axes)
            figure.savefig(folder / "map.png", dpi=130)

            from gfm_hil.studies.campaign.page import write_report

            write_report(self, folder)
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
