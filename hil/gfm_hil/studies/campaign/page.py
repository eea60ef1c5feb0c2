"""report.html of a campaign: its map, which a reader can explore, and its tables."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gfm_hil.results.curves import PackedCurves, Panel
from gfm_hil.results.page import plot_script, write_page
from gfm_hil.results.report import PAGE
from gfm_hil.studies.campaign.figure import LOOKS, spread
from gfm_hil.studies.campaign.result import VERDICTS, Axis, CampaignResult, verdict
from gfm_hil.studies.campaign.tables import counts_table, worst_table

RUN = "run"  # the label of the numbers of the runs, which are values under the pointer only
_MOST = 4000  # runs of a law whose numbers a page holds to the last digit


def write_report(found: CampaignResult, folder: Path) -> None:
    """Write report.html of a campaign with a run."""
    laws, axes = found.summary["laws"], [axis for axis in found.axes if axis]
    write_page(
        folder / PAGE, "campaign.html", title=found.campaign.file.title,
        words=f"{found.summary['done']} runs of {found.campaign.file.scenario},"
        f" seed {found.campaign.file.seed}",
        panels=[*_panels(found)], counts=counts_table(laws),
        worst=[worst_table(law, one["worst"], axes) for law, one in laws.items()],
        curves=PackedCurves(), script=plot_script(),
    )  # fmt: skip


def _panels(found: CampaignResult) -> Iterator[Panel]:
    """The map of each law that has a run: a curve of points a verdict."""
    x, y = found.axes
    for law in found.campaign.file.laws:
        mine = [r for r in found.records if r["law"] == law]
        if not mine:
            continue
        a, runs = spread(x, mine, 1), np.array([r["run"] for r in mine], dtype=float)
        b = runs if y is None else spread(y, mine, 2)
        order, verdicts = np.argsort(a, kind="stable"), np.array([verdict(r) for r in mine])
        there = [name for name in VERDICTS if (verdicts == name).any()]
        curves = {
            name.replace("-", " "): np.where(verdicts == name, b, np.nan)[order] for name in there
        }
        colours = [LOOKS[name][0] for name in there]
        if len(mine) <= _MOST:
            curves[RUN] = runs[order]
            colours.append("#888888")
        log = x.log, y is not None and y.log
        pad = 0.0 if x.log else 0.02 * float(np.ptp(a))
        yield Panel(
            f"{law}: {_words(y) if y else RUN}", a[order], curves,
            (float(a.min()) - pad, float(a.max()) + pad), colours=colours, over=_words(x), log=log,
            dots=True,
        )  # fmt: skip


def _words(axis: Axis) -> str:
    """What is written at an axis, with the meanings of its numbers."""
    meant = ", ".join(f"{k}: {word}" for k, word in enumerate(axis.words))
    return f"{axis.label} ({meant})" if meant else axis.label
