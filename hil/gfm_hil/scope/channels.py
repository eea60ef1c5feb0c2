"""The channels of a scope: recorded columns with names and units, and figures of the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.results.metrics import Rows
from gfm_runtime.signals import Group, Signal, group

Columns = Mapping[str, Rows]  #: of a recording, by name, one row a tick
Values = NDArray[np.float64]

_SYMBOLS = {"omega_u": "f", "omega_g": "f_g"}  # a scope shows frequencies in Hz


@dataclass(frozen=True)
class Channel:
    """One quantity over time.

    Attributes:
        name: in messages between page and server.
        group: y, u, ref, grid, plant or loop.
        symbol, unit, description: for display.
        least: the smallest range of values that fills the height of a plot, in ``unit``.
        needs: columns of the recording from which it is computed.
        of: computes its values from those columns' rows; NaN if there is none.
    """

    name: str
    group: str
    symbol: str
    unit: str
    description: str
    least: float
    needs: tuple[str, ...]
    of: Callable[..., Values]

    def about(self) -> dict[str, Any]:
        """The channel as plain data for the page."""
        content = asdict(self)
        del content["needs"], content["of"]
        return content

    def read(self, columns: Columns, first: int, last: int) -> NDArray[np.float32]:
        """Values of ticks first … last-1; all NaN if the recording lacks a column."""
        if any(name not in columns for name in self.needs):
            return np.full(last - first, np.nan, np.float32)
        return self.of(*(columns[name][first:last] for name in self.needs)).astype(np.float32)


def make_channels(T_s: float, f_b: float) -> tuple[Channel, ...]:
    """All channels of a recording.

    Args:
        T_s: sampling time, s.
        f_b: base frequency, Hz.
    """
    found = [
        *(_of_table(s, "y", f"y_{s.name}", f_b) for s in group("y")),
        *(_of_table(s, "u", f"u_{s.name}", f_b) for s in group("u")),
        *(_of_table(s, "ref", f"ref_{s.name}", f_b) for s in group("ref")),
        *(_of_table(s, "d", f"true_{s.name}", f_b) for s in group("d")),
        Channel(
            "i", "plant", "i", "p.u.", "magnitude of the converter's current", 0.01,
            ("true_i",), _as_is,
        ),
        Channel(
            "delta", "plant", "δ", "°", "angle of the converter against the grid", 0.5,
            ("true_delta",), np.degrees,
        ),
    ]  # fmt: skip
    return (*found, *_loop(T_s))


def _of_table(s: Signal, kind: Group, column: str, f_b: float) -> Channel:
    name = s.name if kind in ("y", "ref") and s.name != "omega_g" else f"{kind}_{s.name}"
    if s.name not in _SYMBOLS:
        return Channel(name, kind, s.name, s.unit, s.description, 0.01, (column,), _as_is)
    symbol = _SYMBOLS[s.name]
    return Channel(name, kind, symbol, "Hz", s.description, 0.02, (column,), lambda pu: pu * f_b)


def _as_is(values: Values) -> Values:
    return values


def _loop(T_s: float) -> tuple[Channel, ...]:
    """Figures of the loop from the plant's clock; -1 in a column: the event did not happen."""
    period = T_s * 1e9

    def slack(scheduled: Values, received: Values) -> Values:
        left = (scheduled + period - received) * 1e-3
        return np.where((scheduled >= 0) & (received >= 0), left, np.nan)

    def round_trip(sent: Values, received: Values) -> Values:
        return np.where((sent >= 0) & (received >= 0), (received - sent) * 1e-3, np.nan)

    def late(scheduled: Values, woke: Values) -> Values:
        return np.where((scheduled >= 0) & (woke >= 0), (woke - scheduled) * 1e-3, np.nan)

    def miss(scheduled: Values, received: Values) -> Values:
        return np.where(scheduled >= 0, (received < 0) * 1.0, np.nan)

    def channel(
        name: str, symbol: str, text: str, unit: str, least: float, of: Any, *needs: str
    ) -> Channel:
        return Channel(
            name, "loop", symbol, unit, text, least, tuple(f"plant_{n}" for n in needs), of
        )

    return (
        channel(
            "slack", "slack", "time left when u had arrived", "µs", 10.0, slack,
            "scheduled", "received",
        ),
        channel(
            "round_trip", "round trip", "from y sent to u received", "µs", 5.0, round_trip,
            "sent", "received",
        ),
        channel(
            "late", "late", "start of the tick after its deadline", "µs", 5.0, late,
            "scheduled", "woke",
        ),
        channel("miss", "miss", "ticks without a fresh u", "", 1.0, miss, "scheduled", "received"),
    )  # fmt: skip
