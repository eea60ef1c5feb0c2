"""What an engineer asks of a response, computed from the recorded signals.

All from the plant's true signals. For each event the window runs to the next event (or the end).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import PIECE, Columns, Rows, pieces

Vector = NDArray[np.float64]


ROCOF_WINDOW = 0.1  # s; df/dt is the slope over this window
METRICS = (
    "p_before", "p_peak", "p_final", "settling_s", "overshoot_pct", "f_nadir_hz", "f_peak_hz",
    "rocof_hz_s", "v_min", "v_max", "damping_ratio", "oscillation_hz",
)  # fmt: skip
_BAND = 0.02  # settling: within 2 % of the step (or 0.02 p.u. where there is no step)
_GONE = 1e-6
_NO_STEP = 0.02  # p.u.; a smaller change of p is no step
_FEW = 20  # samples; a shorter window has no metrics


def event_metrics(
    signals: Columns, start: int, stop: int, T_s: float, f_n: float
) -> dict[str, float | None]:
    """Metrics of the ticks [start, stop) after an event at ``start``.

    Args:
        signals: columns with at least true_p, true_omega_u and true_V, shape (ticks,), p.u.;
            arrays, or columns of a file, which are read piece by piece.
        start, stop: ticks.
        T_s: sampling time, s.
        f_n: nominal frequency, Hz.

    Returns:
        p_before, p_peak (the extreme furthest from p_before), p_final, v_min, v_max in p.u.;
        settling_s (2 %), overshoot_pct (of the step); f_nadir_hz, f_peak_hz; rocof_hz_s (largest
        |df/dt| over 100 ms); damping_ratio and oscillation_hz of the dominant oscillation of p.
        None where a quantity has no meaning, as overshoot without a step, or all of them in a
        window of a few ticks.
    """
    p, f, V = signals["true_p"], signals["true_omega_u"], signals["true_V"]
    length = stop - start
    if length < _FEW:
        return dict.fromkeys(METRICS)
    rest = max(start - 1, 0)
    before = float(p[rest : rest + 1][0])
    tail = max(1, length // 20)
    final = sum(float(np.sum(x)) for x in pieces(p, stop - tail, stop)) / tail
    step = final - before
    peak, least, most = before, math.inf, -math.inf
    for x in pieces(p, start, stop):
        furthest = float(x[np.argmax(np.abs(x - before))])
        peak = furthest if abs(furthest - before) > abs(peak - before) else peak
        least, most = min(least, float(x.min())), max(most, float(x.max()))
    stepped = abs(step) >= _NO_STEP
    settled = _settled(p, start, stop, final, _BAND * abs(step) if stepped else _BAND)
    beyond = (most - final if step > 0 else final - least) if stepped else 0.0
    nadir, top, slope = _frequency(f, start, stop, max(1, round(ROCOF_WINDOW / T_s)))
    voltages = [(float(x.min()), float(x.max())) for x in pieces(V, start, stop)]
    damping, frequency = dominant_oscillation(p[start : min(stop, start + _longest(T_s))], T_s)
    return {
        "p_before": before,
        "p_peak": peak,
        "p_final": final,
        # an oscillation that is still outside at the end of the window has not settled
        "settling_s": settled * T_s if settled < 0.95 * length else None,
        "overshoot_pct": 100 * max(0.0, beyond) / abs(step) if stepped else None,
        "f_nadir_hz": nadir * f_n,
        "f_peak_hz": top * f_n,
        "rocof_hz_s": None if slope is None else slope * f_n / T_s,
        "v_min": min(low for low, _ in voltages),
        "v_max": max(high for _, high in voltages),
        "damping_ratio": damping,
        "oscillation_hz": frequency,
    }


def _settled(p: Rows, start: int, stop: int, final: float, band: float) -> int:
    """Ticks after ``start`` from which on p stays within ``band`` of ``final``, to ``stop``."""
    last = stop
    while last > start:  # from the end, where it is found soon
        first = max(start, last - PIECE)
        outside = np.flatnonzero(np.abs(p[first:last] - final) > band)
        if len(outside):
            return first + int(outside[-1]) + 1 - start
        last = first
    return 0


def _frequency(f: Rows, start: int, stop: int, width: int) -> tuple[float, float, float | None]:
    """Extremes of f, p.u., and its largest slope over ``width`` ticks, p.u. a tick."""
    least, most, slope = math.inf, -math.inf, None
    for first in range(start, stop, PIECE):
        x = f[first : min(first + PIECE + width, stop)]
        least, most = min(least, float(x.min())), max(most, float(x.max()))
        if len(x) > width:
            slope = max(slope or 0.0, float(np.abs(x[width:] - x[:-width]).max()) / width)
    return least, most, slope


def _longest(T_s: float) -> int:
    """Ticks that ``dominant_oscillation`` looks at."""
    return round(2.0 / T_s)


def dominant_oscillation(p: Vector, T_s: float) -> tuple[float | None, float | None]:
    """Damping ratio and frequency [Hz] of the strongest oscillation in p, by the matrix pencil.

    The signal is thinned to at most 400 samples of the first 2 s. Poles are those of the shifted
    signal subspace (Hua and Sarkar, 1990); each mode's strength is the energy it contributes.
    (None, None) if nothing oscillates by more than 1e-4 p.u.
    """
    window = p[: _longest(T_s)]
    stride = max(1, len(window) // 400)
    x = window[::stride] - np.mean(window[-max(1, len(window) // 10) :])
    if len(x) < 40 or np.max(np.abs(x)) < 1e-4:
        return None, None
    columns = len(x) // 3
    hankel = np.lib.stride_tricks.sliding_window_view(x, columns + 1)
    _, weight, modes = np.linalg.svd(hankel, full_matrices=False)
    rank = min(12, int(np.sum(weight > 1e-3 * weight[0])))
    subspace = modes[:rank].T
    z = np.linalg.eigvals(np.linalg.lstsq(subspace[:-1], subspace[1:], rcond=None)[0])
    z = z[np.abs(z) > _GONE]  # of what is over within a sample, as after a trip
    s = np.log(z.astype(complex)) / (stride * T_s)
    powers = np.exp(np.outer(np.arange(len(x)) * stride * T_s, s))
    amplitude = np.linalg.lstsq(powers, x.astype(complex), rcond=None)[0]
    energy = np.sum(np.abs(powers * amplitude) ** 2, axis=0)
    oscillating = (s.imag > 2 * np.pi * 0.1) & (np.abs(amplitude) > 1e-4)
    if not oscillating.any():
        return None, None
    k = np.flatnonzero(oscillating)[np.argmax(energy[oscillating])]
    return float(-s[k].real / abs(s[k])), float(s[k].imag / (2 * np.pi))
