"""Ticks without a new u that were measured, beside what laws bear."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from gfm_design.margins.all_margins import UnstableLoop
from gfm_design.misses.statistics import Misses
from gfm_design.misses.ticks import MEANWHILE, ticks
from gfm_design.misses.tolerance import WINDOW, LatencyTolerance, Used, light_of
from gfm_design.misses.words import Words
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import target_of
from gfm_hil.recording.run import Run
from gfm_hil.recording.timing import MISS_NEEDS, missed
from gfm_hil.results.table import Cell, Table
from gfm_hil.studies.linear_loop import scenario_loop

_STYLES = {"green": "good", "yellow": "warn", "red": "bad"}
_MOST_STATES = 100  # of a loop, for that sentence; time grows with their cube
_TRIED = 50  # misses in a row at least, for the sentence of a report


def misses_of(run: Run) -> Misses:
    """The misses of a run in real time. Raises UserError: it was in lockstep, or lacks the plant's
    times."""
    if run.summary["mode"] != "realtime":
        raise UserError(f"{run.folder}: was in lockstep, where no tick is missed")
    if not run.timing.keys() >= {*MISS_NEEDS} or not run.ticks:
        raise UserError(f"{run.folder}: timing.npz lacks the plant's times")
    return Misses.of(missed(run.timing, 0, run.ticks))


def in_a_row_words(run: Run) -> str:
    """One sentence: what a run in real time missed, and what its law bears on its plant; empty if
    it was in lockstep, the controller is not ours, or the law has no stable linear loop."""
    if target_of(run.summary["controller"]) is None:
        return ""
    try:
        misses, (loop, label) = misses_of(run), scenario_loop(run.scenario, run.scenario.converter)
        if len(loop.A) > _MOST_STATES or loop.modes()[0].sigma > 0.0:
            return ""
    except (UserError, ArithmeticError, ValueError):
        return ""
    hold, more = run.scenario.late_policy.hold, run.scenario.late_policy.extrapolate
    tried = min(hold, max(_TRIED, 2 * misses.longest))
    each = (Words(ticks(loop, case, more)).first_unstable(tried) for case in MEANWHILE)
    borne = min((word.misses - 1 for word in each if word), default=None)
    if borne is None:
        bears = f"{hold}, as many as the plant holds u for" if tried == hold else f"over {tried}"
    else:
        bears = str(borne)
    share = misses.longest / max(borne or tried, 1)
    light = f"{light_of(share)} by its longest row"
    if not misses.misses:
        return f"{light}: no tick of {misses.ticks} was missed; {label} bears {bears} in a row here"
    return (
        f"{light}: {misses.misses} of {misses.ticks} ticks were missed, {misses.longest} in a row "
        f"at most; {label} bears {bears} in a row here"
    )


def tolerance_table(each: Mapping[str, LatencyTolerance | UnstableLoop]) -> Table:
    """What each law bears, one row a law."""
    heads = (
        "law", "delay µs", "bears in a row: stands still", "steps", "proved in a row",
        f"proved in any {WINDOW}", f"unstable in any {WINDOW}",
    )  # fmt: skip
    rows: list[list[Any]] = []
    for law, found in each.items():
        if isinstance(found, UnstableLoop):
            rows.append([law, Cell("unstable", "dim"), *[None] * (len(heads) - 2)])
            continue
        cases = [found.cases[case] for case in MEANWHILE]
        bears = [("≥ " if case.lost is None else "") + str(case.bears) for case in cases]
        row, window = ([getattr(c, name) for c in cases] for name in ("in_a_row", "in_a_window"))
        proved = (_both([one.most for one in of]) for of in (row, window))
        refuted = _both([one.refuted for one in window])
        rows.append([law, delay_text(found), *bears, *proved, refuted])
    return Table(heads, rows)


def _both(values: list[int | None]) -> str:
    return "/".join("–" if v is None else str(v) for v in values)


def delay_text(found: LatencyTolerance) -> str:
    """The delay margin, µs."""
    us = 1e6 * found.delay.seconds
    return f"{us:.4g}" if math.isfinite(us) else f"> {1e6 * found.looked_at:g}"


def used_table(name: str, misses: Misses, each: Mapping[str, Used]) -> Table:
    """Which share of each tolerance a measurement used, one row a law."""
    heads = "law", "verdict", "delay", "in a row", f"in {WINDOW}", "of ticks", "variance of p"
    rows = []
    for law, used in each.items():
        shares = (_percent(s) for s in (used.delay, used.in_a_row, used.in_a_window, used.share))
        p = used.added.get("p")
        rows.append([law, Cell(used.light, _STYLES[used.light]), *shares, p and f"× {p:.4g}"])
    said = (
        f"{name}: {misses.misses} of {misses.ticks} ticks missed, {misses.longest} in a row at most"
    )
    return Table(heads, rows, title=said, text=2)


def _percent(share: float | None) -> str | None:
    if share is None:
        return None
    return f"{100 * share:.3g} %" if math.isfinite(share) else "∞"


def as_json(found: LatencyTolerance | UnstableLoop) -> dict[str, Any]:
    """What a law bears, as plain data."""
    if isinstance(found, UnstableLoop):
        return {"stable": False, "reason": str(found)}
    cases = {}
    for case, c in found.cases.items():
        proved = {"in_a_row": c.in_a_row, f"in_{WINDOW}": c.in_a_window}
        cases[case] = {
            "bears": c.bears,
            "unstable_word": c.lost and asdict(c.lost),
            **{name: asdict(of) for name, of in proved.items()},
        }
    return {
        "stable": True,
        "delay_us": 1e6 * found.delay.seconds,
        "hold": found.hold,
        "bears": found.bears,
        "proved": found.proved,
        "cases": cases,
    }
