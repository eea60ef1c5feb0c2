"""What an engineer asks of a response, computed from the recorded signals.

All from the plant's true signals. For each event the window runs to the next event (or the end).
Where p settles and how far it overshoots, and what a converter carries, is judged by means over one
cycle of the nominal frequency, as power meters and thermal limits do: a ripple at that
frequency or above leaves them alone. ``cycle`` in a name says so; ``p_peak``, ``i_peak``,
``v_min``, ``v_max`` and ``t90_s`` are of every tick.
"""

import math
from collections.abc import Iterable

import numpy as np

from gfm_hil.recording.columns import PIECE, ColumnLike, Columns, pieces
from gfm_hil.run.cycles import Vector, cycle_means, cycle_ticks, whole_ticks
from gfm_hil.run.modes import LONGEST, oscillations

ROCOF_WINDOW = 0.1  # s; df/dt is the slope over this window
METRICS = (
    "p_before", "p_peak", "p_peak_cycle", "p_final", "t90_s", "settling_s", "overshoot_pct",
    "i_peak", "i_peak_cycle", "f_nadir_hz", "f_peak_hz", "rocof_hz_s", "v_min", "v_max",
    "v_min_cycle", "v_max_cycle", "damping_ratio", "oscillation_hz", "fast_damping_ratio",
    "fast_hz",
)  # fmt: skip
_BAND = 0.02  # settling: within 2 % of the step (or 0.02 p.u. where there is no step)
_NO_STEP = 0.02  # p.u.; a smaller change of p is no step
_FEW = 20  # samples; a shorter window has no metrics


def event_metrics(
    signals: Columns, start: int, stop: int, T_s: float, f_n: float, free: int = 0
) -> dict[str, float | None]:
    """Metrics of the ticks [start, stop) after an event at ``start``.

    Args:
        signals: columns with at least true_p, true_omega_u, true_V and true_i, shape (ticks,),
            p.u.; arrays, or columns of a file, which are read piece by piece.
        start, stop: ticks.
        T_s: sampling time, s.
        f_n: nominal frequency, Hz.
        free: from which tick modes are fitted, if not from ``start`` (``modes.free_from``).

    Returns:
        By the names of ``METRICS``, with the units of their names, p.u. without one:
        p_before, the mean of the last cycle before the event, and p_final, that of the end of the
        window (its last twentieth, at least a cycle); p_peak and p_peak_cycle, the extreme of p
        and of its one-cycle means that is furthest from p_before; t90_s, when p has first done
        90 % of its step, or without a step of its way to p_peak; settling_s (2 %) and
        overshoot_pct (of the step) of the one-cycle means, each at the middle of its cycle; i_peak
        and i_peak_cycle of the magnitude of the bridge's current; f_nadir_hz, f_peak_hz;
        rocof_hz_s (largest abs(df/dt) over ``ROCOF_WINDOW``); v_min, v_max and the extremes of
        the one-cycle means of V; damping_ratio and oscillation_hz of the swing of p (below
        f_n/2), fast_damping_ratio and fast_hz of its strongest oscillation above that
        (``modes``). None where a quantity has no meaning, as overshoot without a step, or all of
        them in a window of a few ticks.
    """
    p, f, V, i = (signals[f"true_{name}"] for name in ("p", "omega_u", "V", "i"))
    length = stop - start
    if length < _FEW:
        return dict.fromkeys(METRICS)
    width = cycle_ticks(T_s, f_n)
    cycle = whole_ticks(width)
    before = _mean(p, max(start - cycle, 0), max(start, 1))
    final = _mean(p, stop - min(length, max(cycle, length // 20)), stop)
    step = final - before
    stepped = abs(step) >= _NO_STEP
    low, high = _extremes(pieces(p, start, stop))
    peak = high if high - before > before - low else low
    way = step if stepped else peak - before
    band = _BAND * abs(step) if stepped else _BAND
    done, settled, slow_low, slow_high = _settling(cycle_means(p, start, stop, width), final, band)
    settled += 0.5 * (width - 1) if settled else 0.0
    # an oscillation that is still outside at the end of the window has not settled
    has_settled = done > 0 and settled < 0.95 * length and settled < done
    beyond = slow_high - final if step > 0 else final - slow_low
    nadir, top, slope = _frequency(f, start, stop, max(1, round(ROCOF_WINDOW / T_s)))
    # a controller of phase voltages commands a frame of constant speed, which is no frequency
    has_law = "law" not in signals or not np.isnan(signals["law"][start : start + 1][0])
    tells = has_law or nadir != top
    v_low, v_high = _extremes(pieces(V, start, stop))
    found: dict[str, float | None] = dict.fromkeys(METRICS)
    found |= {
        "p_before": before,
        "p_peak": peak,
        "p_final": final,
        "t90_s": _crossed(p, start, stop, before, 0.9 * way, T_s) if abs(way) >= _NO_STEP else None,
        "settling_s": settled * T_s if has_settled else None,
        "i_peak": _extremes(pieces(i, start, stop))[1],
        "f_nadir_hz": nadir * f_n if tells else None,
        "f_peak_hz": top * f_n if tells else None,
        "rocof_hz_s": slope * f_n / T_s if slope is not None and tells else None,
        "v_min": v_low,
        "v_max": v_high,
    }
    if done:
        v_slow = _extremes(cycle_means(V, start, stop, width))
        found |= {
            "p_peak_cycle": slow_high if slow_high - before > before - slow_low else slow_low,
            "overshoot_pct": 100 * max(0.0, beyond) / abs(step) if stepped else None,
            "i_peak_cycle": _extremes(cycle_means(i, start, stop, width))[1],
            "v_min_cycle": v_slow[0],
            "v_max_cycle": v_slow[1],
        }
    return found | _oscillations(p, max(start, free), stop, T_s, f_n)


def _settling(
    means: Iterable[Vector], final: float, band: float
) -> tuple[int, float, float, float]:
    """How many means of a cycle there are, after how many they stay within ``final`` ± ``band``,
    and their least and largest value."""
    done, settled, low, high = 0, 0.0, math.inf, -math.inf
    for x in means:
        low, high = min(low, float(x.min())), max(high, float(x.max()))
        outside = np.flatnonzero(np.abs(x - final) > band)
        if len(outside):
            settled = done + int(outside[-1]) + 1.0
        done += len(x)
    return done, settled, low, high


def _oscillations(p: ColumnLike, first: int, stop: int, T_s: float, f_n: float) -> dict[str, float]:
    """Damping and frequency of the swing and of the fast mode of p, of those that there are."""
    x = p[first : max(first, min(stop, first + round(LONGEST / T_s)))]
    slow, fast = oscillations(x, T_s, f_n)
    found: dict[str, float] = {}
    if slow is not None:
        found |= {"damping_ratio": slow.damping, "oscillation_hz": slow.hz}
    if fast is not None:
        found |= {"fast_damping_ratio": fast.damping, "fast_hz": fast.hz}
    return found


def _mean(column: ColumnLike, first: int, last: int) -> float:
    """The mean of a few ticks or many; exact where the column is constant."""
    base = float(column[first : first + 1][0])
    return base + sum(float(np.sum(x - base)) for x in pieces(column, first, last)) / (last - first)


def _extremes(parts: Iterable[Vector]) -> tuple[float, float]:
    """The least and the largest value of all pieces."""
    low, high = math.inf, -math.inf
    for x in parts:
        low, high = min(low, float(x.min())), max(high, float(x.max()))
    return low, high


def _crossed(
    p: ColumnLike, start: int, stop: int, before: float, way: float, T_s: float
) -> float | None:
    """Time after ``start`` at which p first has gone ``way`` from ``before``, s."""
    for k, x in enumerate(pieces(p, start, stop)):
        there = np.flatnonzero((x - before) * math.copysign(1.0, way) >= abs(way))
        if len(there):
            return (k * PIECE + int(there[0])) * T_s
    return None


def _frequency(
    f: ColumnLike, start: int, stop: int, width: int
) -> tuple[float, float, float | None]:
    """Extremes of f, p.u., and its largest slope over ``width`` ticks, p.u. a tick."""
    least, most, slope = math.inf, -math.inf, None
    for first in range(start, stop, PIECE):
        x = f[first : min(first + PIECE + width, stop)]
        least, most = min(least, float(x.min())), max(most, float(x.max()))
        if len(x) > width:
            slope = max(slope or 0.0, float(np.abs(x[width:] - x[:-width]).max()) / width)
    return least, most, slope
