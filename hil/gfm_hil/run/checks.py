"""The checks of one signal behind the assertions of tests and the clauses of the conformity tests:
each returns None, or what is wrong and where."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import symbol_of, unit_of
from gfm_hil.run.modes import Oscillations

Vector = NDArray[np.float64]

_COLUMNS = ("t", "low", "high")
_TAIL = 0.05  # fraction at the end of a window whose mean is the final value


@dataclass(frozen=True)
class Window:
    """A signal from a step on."""

    name: str  # of the signal
    t: Vector  # time, s, shape (n,)
    x: Vector  # values, shape (n,)
    before: float  # value just before the step
    since: float  # time of the step, s

    def show(self, value: float) -> str:
        """A value with its unit."""
        return f"{value:.4g} {unit_of(self.name)}".rstrip()

    @property
    def symbol(self) -> str:
        """The signal's name in a message."""
        return symbol_of(self.name)


@dataclass(frozen=True)
class Violation:
    """A failed check."""

    text: str  # what is wrong, in a sentence or two
    at: float  # time of the worst point, s
    # t, low, high: the band that the signal should have kept, each of shape (n,); NaN: no limit
    t: Vector
    low: Vector
    high: Vector


def settled_after(w: Window, to: float, tolerance: float) -> float | None:
    """When the signal has come within ``to`` ± ``tolerance`` to stay, s after the step; None if it
    has not at the end of the window."""
    outside = np.flatnonzero(_away(w, to) > tolerance)
    if not len(outside):
        return 0.0
    last = int(outside[-1])
    return None if last >= len(w.t) - 1 else float(w.t[last + 1] - w.since)


def _away(w: Window, to: float) -> Vector:
    return np.nan_to_num(np.abs(w.x - to), nan=np.inf)


def settles(w: Window, to: float, within: float, tolerance: float) -> Violation | None:
    """The signal is within ``to`` ± ``tolerance`` from ``within`` s after the step to the end."""
    begin = w.since + within
    late = w.t >= begin - 1e-9
    if not late.any():
        raise UserError(f"within = {within:g}: the run ends {w.t[-1] - w.since:g} s after the step")
    away = _away(w, to)
    if not (away[late] > tolerance).any():
        return None
    took = settled_after(w, to, tolerance)
    far = late & (away >= (1 - 1e-6) * away[late].max())  # on a plateau the first, not a rounding's
    worst = int(np.argmax(far))
    ending = w.x[-max(1, round(_TAIL * len(w.x))) :]
    how = "it had not at the end of the run" if took is None else f"it took {took:.4g} s"
    text = (
        f"{w.symbol} should settle at {w.show(to)} ± {tolerance:g} within {within:g} s, but {how}: "
        f"after these {within:g} s it was still at {w.show(w.x[worst])} "
        f"(at t = {w.t[worst]:.4f} s); the end of the run lies in "
        f"[{ending.min():.4g}, {ending.max():.4g}]."
    )
    nothing = np.full(len(w.t), np.nan)
    low, high = nothing.copy(), nothing.copy()
    low[late], high[late] = to - tolerance, to + tolerance
    return Violation(text, float(w.t[worst]), w.t, low, high)


def overshoot(w: Window, percent: float, to: float | None) -> Violation | None:
    """The signal exceeds ``to`` (or its final value) by at most ``percent`` of the step."""
    final = float(np.mean(w.x[-max(1, round(_TAIL * len(w.x))) :])) if to is None else to
    step = final - w.before
    if abs(step) < 1e-3:
        raise UserError(f"signal = {w.name!r}: did not step ({w.before:.4g} to {final:.4g})")
    beyond = 100 * (w.x - final) / step
    worst = int(np.argmax(beyond))
    if beyond[worst] <= percent:
        return None
    limit = np.full(len(w.t), final + percent / 100 * step)
    none = np.full(len(w.t), np.nan)
    text = (
        f"{w.symbol} should overshoot its step from {w.before:.4g} to {w.show(final)} by at most "
        f"{percent:g} %, but it went to {w.show(w.x[worst])} at t = {w.t[worst]:.4f} s, "
        f"{beyond[worst]:.3g} %."
    )
    low, high = (none, limit) if step > 0 else (limit, none)
    return Violation(text, float(w.t[worst]), w.t, low, high)


def longest_beyond(w: Window, low: Vector, high: Vector) -> float:
    """The longest time in one piece that the signal is not between ``low`` and ``high``, s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], _beyond(w, low, high) > 0, [0]])))
    lengths = edges[1::2] - edges[::2]
    step = float(w.t[1] - w.t[0]) if len(w.t) > 1 else 0.0
    return float(np.max(lengths, initial=0)) * step


def _beyond(w: Window, low: Vector, high: Vector) -> Vector:
    beyond = np.fmax(np.fmax(low - w.x, w.x - high), 0.0)
    beyond[np.isnan(w.x)] = np.inf
    return beyond


def envelope(w: Window, low: Vector, high: Vector, longest: float = 0.0) -> Violation | None:
    """The signal stays between ``low`` and ``high``, each of shape (n,), but for at most
    ``longest`` s in one piece; NaN: no limit there."""
    beyond = _beyond(w, low, high)
    if not beyond.any() or (longest > 0 and longest_beyond(w, low, high) <= longest + 1e-9):
        return None
    first, worst = int(np.flatnonzero(beyond)[0]), int(np.argmax(beyond))
    side, limit = ("below", low) if w.x[worst] < low[worst] else ("above", high)
    text = (
        f"{w.symbol} should stay within its envelope, but it left it at t = {w.t[first]:.4f} s and "
        f"was {w.show(w.x[worst])} at t = {w.t[worst]:.4f} s, {beyond[worst]:.3g} {side} the limit "
        f"of {limit[worst]:.4g}."
    )
    return Violation(text, float(w.t[worst]), w.t, low, high)


def damped(w: Window, min_ratio: float, found: Oscillations) -> Violation | None:
    """The swing ``found`` in w has at least this damping ratio, and no faster oscillation grows.

    The line's own DC offset, an oscillation at f_n, decays with the line's R/L whatever the law
    does; so a faster oscillation need only not grow.
    """
    slow, fast = found
    if slow is not None and slow.damping < min_ratio:
        ratio, f = slow.damping, slow.hz
    elif fast is not None and fast.damping < 0.0:
        ratio, f = fast.damping, fast.hz
    else:
        return None
    none = np.full(len(w.t), np.nan)
    text = (
        f"{w.symbol} should be damped with a ratio of at least {min_ratio:g}, but its strongest "
        f"oscillation after the step, at {f:.3g} Hz, has {ratio:.3g}"
        + (": it grows." if ratio < 0 else ".")
    )
    return Violation(text, float(w.t[np.argmax(np.abs(w.x - w.x[-1]))]), w.t, none, none)


def read_envelope(path: Path, t: Vector) -> tuple[Vector, Vector]:
    """The limits of a CSV file with the columns t, low, high at the times ``t`` after the step.

    They are interpolated between lines; there is no limit before the first line, after the last
    line, and where a field is empty. Raises UserError: the file does not exist or does not have
    this form.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = list(csv.DictReader(file))
        table = {
            name: np.array([float(line[name] or "nan") for line in lines]) for name in _COLUMNS
        }
    except OSError as problem:
        raise UserError(f"csv = {str(path)!r}: {problem.strerror}") from None
    except (KeyError, TypeError, UnicodeDecodeError, csv.Error):
        raise UserError(f"csv = {str(path)!r}: must have the columns t,low,high") from None
    except ValueError as problem:
        raise UserError(f"csv = {str(path)!r}: {problem}") from None
    if not lines or np.isnan(table["t"]).any() or (np.diff(table["t"]) < 0).any():
        raise UserError(f"csv = {str(path)!r}: its times must be numbers that do not go back")
    low, high = (
        np.interp(t, table["t"], table[name], left=np.nan, right=np.nan) for name in ("low", "high")
    )
    if np.isnan(low).all() and np.isnan(high).all():
        raise UserError(f"csv = {str(path)!r}: has no limit within the {t[-1]:g} s after the step")
    return low, high
