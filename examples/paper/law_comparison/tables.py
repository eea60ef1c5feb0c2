"""The law comparison as tables: in Markdown for a page, and on a terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rich.table import Table

from gfm_design.margins.delays import longest
from gfm_design.model.closed_loop import T_S
from gfm_hil.core.terminal import markdown as table
from gfm_hil.core.terminal import terminal

Row = dict[str, Any]
Column = tuple[str, Callable[[Row], str]]

_NO_BUMP = 0.001  # p.u.
_LIMIT = "…"  # an end where nothing is lost


def ranked(rows: Sequence[Row]) -> list[Row]:
    """By gamma, laws without one last."""
    return sorted(rows, key=lambda r: (r["gamma"] is None, r["gamma"] or 0.0, r["law"]))


def number(value: float | None, digits: int = 3) -> str:
    """To so many significant digits, no exponent; a dash if there is none."""
    if value is None:
        return "–"
    if value == 0.0 or not math.isfinite(value):
        return "0" if value == 0.0 else "∞"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{places}f}".replace("-", "−")


def own(row: Row) -> str:
    """gamma of the law's own gains."""
    gamma = row["before"]["gamma"]
    return "unstable" if gamma is None else number(gamma, 4)


def worst(row: Row) -> Row:
    """The channel with the largest norm."""
    return max(row["channels"], key=lambda c: float(c["norm"]))


def _worst_text(row: Row) -> str:
    if row["gamma"] is None:
        return "–"
    c = worst(row)
    at = c["omega_rad_s"]
    return f"W_{c['i']}{c['j']} at {number(at)} rad/s" if at is not None else f"W_{c['i']}{c['j']}"


def others(row: Row) -> float:
    """The largest norm of the channels that are not pinned."""
    return max(c["norm"] for c in row["channels"] if [c["i"], c["j"]] not in row["fixed"])


def _fixed(row: Row) -> str:
    return ", ".join(f"W_{i}{j}" for i, j in row["fixed"]) or "–"


def _channel(i: int, j: int) -> Column:
    def text(row: Row) -> str:
        return number(
            next((c["norm"] for c in row["channels"] if (c["i"], c["j"]) == (i, j)), None)
        )

    return f"W_{i}{j}", text


def _delay(row: Row) -> str:
    if row["delay_us"] is None:
        return f"> {1e6 * longest(T_S):.0f}"
    at = f" ({number(row['delay_hz'])} Hz)" if row["delay_hz"] is not None else ""
    return f"{number(row['delay_us'])}{at}"


def _damping(row: Row) -> str:
    mode = row["worst"]
    return f"{number(mode['ratio'])} at {number(mode['frequency_hz'])} Hz"


def _factors(name: str) -> Callable[[Row], str]:
    def text(row: Row) -> str:
        if row[name] is None:
            return "–"
        low, high = row[name]
        left = f"× {number(low['factor'], 2)}" if low["limit"] else _LIMIT
        right = f"× {number(high['factor'], 2)}" if high["limit"] else _LIMIT
        return "any" if left == right == _LIMIT else f"{left} … {right}".replace("… …", "…")

    return text


def _bench(kind: str, key: str, digits: int = 3, first: bool = True) -> Callable[[Row], str]:
    """A metric of an experiment; the first column of one that ended early says why it did."""

    def text(row: Row) -> str:
        run: Mapping[str, Any] = row["bench"][kind]
        if run["status"] == "oscillating":
            return "oscillates" if first else "–"
        if run["status"] != "completed":
            why = f"{run['reason'].split(':')[0]} after {number(run['end_s'], 2)} s"
            return why if first else "–"
        return number(run.get(key), digits)

    return text


def _bump(row: Row) -> str:
    run = row["bench"]["switchover"]
    small = run["status"] == "completed" and run["dp"] < _NO_BUMP
    return f"< {_NO_BUMP:g}" if small else _bench("switchover", "dp", 2)(row)


_LAW: Column = ("law", lambda r: str(r["law"]))
_WITH_GAMMA: dict[str, list[Column]] = {
    "law_comparison_gamma": [
        _LAW,
        ("states", lambda r: str(r["order"])),
        ("free", lambda r: str(len(r["free"]))),
        ("γ, own gains", own),
        ("γ, ideal", lambda r: number(r["ideal"]["gamma"], 4)),
        ("γ, late", lambda r: f"**{number(r['gamma'], 4)}**"),
        ("worst channel", _worst_text),
        ("pinned", _fixed),
        ("γ of the others", lambda r: number(others(r), 4)),
        *(_channel(i, j) for i, j in ((1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (4, 1))),
    ],
    "law_comparison_loop": [
        _LAW,
        ("σ [1/s]", lambda r: number(r["sigma"])),
        ("least damping ratio", _damping),
        ("stable up to a delay of [µs]", _delay),
        ("L_g", _factors("L_g")),
        ("R_f, R_g", _factors("R")),
    ],
    "law_comparison_bench": [
        _LAW,
        ("P_ref step: overshoot [%]", _bench("p_ref", "overshoot_pct")),
        ("settling [s]", _bench("p_ref", "settling_s", 2, False)),
        ("one sample late: overshoot [%]", _bench("late", "overshoot_pct")),
        ("ω_g step: nadir of ω_u [Hz]", _bench("frequency", "f_nadir_hz", 5)),
        ("RoCoF [Hz/s]", _bench("frequency", "rocof_hz_s", 3, False)),
        ("peak of p [p.u.]", _bench("frequency", "p_peak", 3, False)),
        ("final p [p.u.]", _bench("frequency", "p_final", 3, False)),
        ("3° jump: peak current [p.u.]", _bench("phase", "i_peak")),
        ("switchover: Δp [p.u.]", _bump),
    ],
}  # fmt: skip
_WITHOUT: list[Column] = [
    _LAW,
    ("states", lambda r: str(r["order"])),
    ("free", lambda r: str(len(r["free"]))),
    ("in the way", lambda r: str(r["reason"])),
]
TABLES = (*_WITH_GAMMA, "law_comparison_unstable")


def markdown(name: str, rows: Sequence[Row]) -> str:
    """One of ``TABLES``."""
    wanted = [r for r in rows if (r["gamma"] is None) == (name == "law_comparison_unstable")]
    columns = _WITH_GAMMA.get(name, _WITHOUT)
    heads = [head.replace("W_", "W") for head, _ in columns]
    lines = [[text(row) for _, text in columns] for row in wanted]
    cells = [[cell.replace("W_", "W").replace("|", "\\|") for cell in line] for line in lines]
    return table(heads, cells) + "\n"


def print_comparison(rows: Sequence[Row], left_out: Mapping[str, str]) -> None:
    """Print the ranking, then the laws that have no place in it, and why."""
    console = terminal(highlight=False)
    columns = ("law", "γ own", "γ ideal", "γ late", "worst channel", "delay µs", "overshoot %")
    ranking = Table(*columns, box=None, pad_edge=False)
    ranking.columns[0].no_wrap = True
    for row in (r for r in rows if r["gamma"] is not None):
        ranking.add_row(
            row["law"],
            own(row),
            number(row["ideal"]["gamma"], 4),
            number(row["gamma"], 4),
            _worst_text(row),
            _delay(row),
            _bench("p_ref", "overshoot_pct")(row),
        )
    console.print(ranking)
    for row in (r for r in rows if r["gamma"] is None):
        console.print(f"{row['law']}: {row['reason']}", soft_wrap=True)
    for name, why in left_out.items():
        console.print(f"{name}: left out, {why}", soft_wrap=True)
