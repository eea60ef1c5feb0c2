"""What an engineer asks of a response, computed from the recorded signals.

All from the plant's true signals. For each event the window runs to the next event (or the end).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    signals: dict[str, NDArray[Any]], start: int, stop: int, T_s: float, f_n: float
) -> dict[str, float | None]:
    """Metrics of the ticks [start, stop) after an event at ``start``.

    Returns:
        p_before, p_peak (the extreme furthest from p_before), p_final, v_min, v_max in p.u.;
        settling_s (2 %), overshoot_pct (of the step); f_nadir_hz, f_peak_hz; rocof_hz_s (largest
        |df/dt| over 100 ms); damping_ratio and oscillation_hz of the dominant oscillation of p.
        None where a quantity has no meaning, as overshoot without a step, or all of them in a
        window of a few ticks.
    """
    p = signals["true_p"][start:stop]
    if len(p) < _FEW:
        return dict.fromkeys(METRICS)
    f = signals["true_omega_u"][start:stop] * f_n
    V = signals["true_V"][start:stop]
    before = float(signals["true_p"][max(start - 1, 0)])
    final = float(np.mean(p[-max(1, len(p) // 20) :]))
    step = final - before
    peak = float(p[np.argmax(np.abs(p - before))])
    stepped = abs(step) >= _NO_STEP
    band = _BAND * abs(step) if stepped else _BAND
    outside = np.flatnonzero(np.abs(p - final) > band)
    settled = 0 if not len(outside) else int(outside[-1]) + 1
    beyond = float(np.max((p - final) * np.sign(step))) if stepped else 0.0
    width = max(1, round(ROCOF_WINDOW / T_s))
    slope = np.abs(f[width:] - f[:-width]) / (width * T_s)
    damping, frequency = dominant_oscillation(p, T_s)
    return {
        "p_before": before,
        "p_peak": peak,
        "p_final": final,
        # an oscillation that is still outside at the end of the window has not settled
        "settling_s": settled * T_s if settled < 0.95 * len(p) else None,
        "overshoot_pct": 100 * max(0.0, beyond) / abs(step) if stepped else None,
        "f_nadir_hz": float(f.min()),
        "f_peak_hz": float(f.max()),
        "rocof_hz_s": float(slope.max()) if len(slope) else None,
        "v_min": float(V.min()),
        "v_max": float(V.max()),
        "damping_ratio": damping,
        "oscillation_hz": frequency,
    }


def dominant_oscillation(p: Vector, T_s: float) -> tuple[float | None, float | None]:
    """Damping ratio and frequency [Hz] of the strongest oscillation in p, by the matrix pencil.

    The signal is thinned to at most 400 samples of the first 2 s. Poles are those of the shifted
    signal subspace (Hua and Sarkar, 1990); each mode's strength is the energy it contributes.
    (None, None) if nothing oscillates by more than 1e-4 p.u.
    """
    window = p[: min(len(p), round(2.0 / T_s))]
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
