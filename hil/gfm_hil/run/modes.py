"""Damping and frequency of the oscillations in a recorded signal, by the matrix pencil.

The swing, below half the nominal frequency, comes from means over one cycle, in which the line's
DC offset (at the nominal frequency in the dq frame) and its harmonics vanish. The fast mode, above
that, comes from what these means leave. Before a signal is thinned, a filter takes out what the
thinned signal cannot show. All filters are finite sums over ticks inside the window: they scale a
damped exponential but leave its pole where it is, so they add no mode and move none.

Exponentials are what a loop does that is left to itself. So the fit begins where no event of the
scenario acts any more: after the end of a ramp, a course, a sag or a fault.
"""

from bisect import bisect_right
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import Columns
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.run.cycles import cycle_means, cycle_ticks, fast_length, hann, whole_ticks
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.fault import FaultClear
from gfm_hil.scenario.events.grid_frequency import GridFrequency
from gfm_hil.scenario.events.grid_voltage import GridVoltage
from gfm_hil.scenario.events.reference import Reference

Vector = NDArray[np.float64]

LONGEST = 2.0  # s of a window that are looked at
_SAMPLES = 240  # at most, for the pencil of the swing
_FAST_SAMPLES = 240  # at most, for that of the fast mode
_A_PERIOD = 5  # samples, at least, in a period of the fast mode
_TAPS = 20  # of the filter, for each tick of the stride
_LEAST = 1e-4  # p.u.; a smaller amplitude is no swing
_LEAST_FAST = 3e-4  # p.u.; a smaller amplitude is no fast mode
_SHARE = 0.3  # of the energy that a fast mode has at least; noise has no such mode
_HALF = 0.5  # periods, at least, in what is looked at
_RANK = 12  # poles, at most
_FEW = 40  # samples; fewer tell no modes
_GONE = 1e-6
_MOST = 1e100  # p.u.; the squares of more could overflow


class Oscillation(NamedTuple):
    """A damped or growing sinusoid in a recording."""

    damping: float  # ratio; negative if it grows
    hz: float  # frequency, Hz


class Acting(NamedTuple):
    """Until when the events up to one of them act, ticks."""

    since: int  # when the newest of them happened
    held: int  # the end of what is held for a time, as a sag or a fault, or moves
    moved: int  # the end of what moves, as a ramp or a course


def acting(scenario: Scenario, signals: Columns, done: int) -> list[Acting]:
    """Until when the events of a scenario act, one entry for each in their order.

    Args:
        scenario: of the run.
        signals: columns with true_omega_g and true_V_g, p.u.: where a ramp begins.
        done: ticks recorded; later events are left out.
    """
    T_s, f_n = scenario.T_s, nominal_frequency(scenario)
    ends: dict[object, tuple[int, bool]] = {}  # by what moves; a new event there ends the last
    found = []
    for e in scenario.sorted_events():
        k = e.at(T_s)
        if k >= done:
            break
        match e:
            case GridFrequency(rate=float(rate)):
                lasts = abs(e.f_hz - f_n * float(signals["true_omega_g"][k : k + 1][0])) / rate
            case GridVoltage(rate=float(rate)):
                lasts = abs(e.V_g - float(signals["true_V_g"][k : k + 1][0])) / rate
            case _:
                lasts = e.lasts()
        end = k + round(lasts / T_s), getattr(e, "duration", None) is None
        of = [(e.converter, n) for n in e.values()] if isinstance(e, Reference) else [e.type]
        ends.update(dict.fromkeys(["fault"] if isinstance(e, FaultClear) else of, end))
        moved = max((tick for tick, moves in ends.values() if moves), default=0)
        found.append(Acting(k, max(tick for tick, _ in ends.values()), moved))
    return found


def free_from(acts: Sequence[Acting], start: int, stop: int) -> int:
    """From which tick the modes of the ticks [start, stop) are fitted; ``stop`` if from none.

    What is held over all of the window is a step before it, and so leaves the loop to itself; while
    something moves there is no mode to be told.

    Args:
        acts: of the scenario.
    """
    before = bisect_right(acts, start, key=lambda act: act.since)
    if before == 0:
        return start
    _, held, moved = acts[before - 1]
    return max(start, held if held < stop else min(moved, stop))


class Oscillations(NamedTuple):
    """The strongest oscillations in a recording; None where there is none."""

    swing: Oscillation | None  # below f_n/2
    fast: Oscillation | None  # above


def oscillations(x: Vector, T_s: float, f_n: float) -> Oscillations:
    """The strongest oscillations in the first 2 s of x; none if x is not finite there.

    Args:
        x: p.u., shape (ticks,).
        T_s: sampling time, s.
        f_n: nominal frequency, Hz.
    """
    window = x[: round(LONGEST / T_s)]
    if not np.all(np.abs(window) < _MOST):
        return Oscillations(None, None)
    width = cycle_ticks(T_s, f_n)
    slow = _means(window, width)
    rest = _beside(window, slow, width)
    rest = _beside(rest, _means(rest, width), width)  # a swing leaves 1e-4 of itself
    return Oscillations(_swing(slow, T_s, f_n), _fast_mode(rest, T_s, f_n))


def _swing(slow: Vector, T_s: float, f_n: float) -> Oscillation | None:
    """The strongest oscillation below f_n/2, from the means of each cycle."""
    stride = max(1, len(slow) // _SAMPLES)
    thin = _decimate(slow, stride)
    longest = _HALF / max(len(thin) * stride * T_s, T_s)
    return _strongest(thin, stride * T_s, (longest, 0.5 * f_n), _LEAST, 0.0)


def _fast_mode(rest: Vector, T_s: float, f_n: float) -> Oscillation | None:
    """The strongest oscillation above f_n/2, from what the means of each cycle leave; it is sought
    around the largest line of the spectrum."""
    if len(rest) < _FEW:
        return None
    length = fast_length(len(rest))
    spectrum = np.abs(np.fft.rfft(rest * hann(len(rest)), length))
    lines = np.fft.rfftfreq(length, T_s)
    spectrum[lines < 0.5 * f_n] = 0.0
    hertz = max(float(lines[np.argmax(spectrum)]), 0.5 * f_n)
    stride = 1 << max(0, int(np.log2(1.0 / (_A_PERIOD * hertz * T_s))))  # so that filters are few
    ticks = (_FAST_SAMPLES + _TAPS) * stride
    grows = 2 * int(np.argmax(np.abs(rest))) > len(rest)  # then the end shows it best
    thin = _decimate(rest[-ticks:] if grows else rest[:ticks], stride)
    band = (0.5 * f_n, np.inf)
    return _strongest(thin[:_FAST_SAMPLES], stride * T_s, band, _LEAST_FAST, _SHARE)


def _beside(x: Vector, slow: Vector, width: float) -> Vector:
    """What the mean of the cycle around each tick leaves; empty without a whole cycle."""
    middle = (whole_ticks(width) - 1) // 2
    return x[middle : middle + len(slow)] - slow


def _means(x: Vector, width: float) -> Vector:
    return np.concatenate([np.empty(0), *cycle_means(x, 0, len(x), width)])


def _decimate(x: Vector, stride: int) -> Vector:
    """Every ``stride``-th sample of x after a low-pass at 0.8 of their Nyquist frequency.

    The filter is one-sided, its weight on the earliest ticks of each window: what decays within a
    few ticks is still seen.
    """
    if stride == 1 or len(x) <= _TAPS * stride:
        return x
    weights = _filter(stride)
    windows = (len(x) - _TAPS * stride - 1) // stride + 1
    blocks = np.zeros((windows + _TAPS, stride))
    kept = min(blocks.size, len(x))
    blocks.ravel()[:kept] = x[:kept]
    parts = blocks @ weights.T  # of each block, what it adds as the k-th of a window
    return np.asarray(sum(parts[k : k + windows, k] for k in range(_TAPS + 1)))


@cache
def _filter(stride: int) -> Vector:
    """Weights of a window's ticks in order, in rows of ``stride``; zeros fill the last one.

    They are ``minimum_phase(firwin(taps, 0.8 / stride), half=False)`` of ``scipy.signal``, whose
    import takes half a second in every run.
    """
    taps = _TAPS * stride + 1
    n = fast_length(32 * taps)
    steep = np.sinc(0.8 / stride * (np.arange(taps) - (taps - 1) / 2)) * np.hamming(taps)
    size = np.abs(np.fft.fft(steep / steep.sum(), n))
    fold = np.zeros(n)  # the cepstrum of what is one-sided
    fold[0], fold[1 : n // 2], fold[n // 2 : n // 2 + n % 2] = 1.0, 2.0, 1.0
    cepstrum = np.fft.ifft(np.log(size + 1e-7 * size[size > 0].min())).real * fold
    least = np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real[:taps]
    return np.pad(least / least.sum(), (0, stride - 1)).reshape(_TAPS + 1, stride)


def _strongest(
    x: Vector, h: float, band: tuple[float, float], least: float, share: float
) -> Oscillation | None:
    """The mode in a band [Hz] that contributes the most energy to x, sampled every h s; None if its
    amplitude is below ``least`` p.u. or its energy below a ``share`` of that of x,.

    Poles are those of the shifted signal subspace (Hua and Sarkar, 1990).
    """
    if len(x) < _FEW:
        return None
    x = x - np.mean(x[-max(1, len(x) // 10) :])
    if not np.max(np.abs(x)) >= least:
        return None
    hankel = np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(x, len(x) // 3 + 1))
    # the few largest singular values and vectors: far above rounding, so that squares do
    power, modes = np.linalg.eigh(hankel.T @ hankel)
    subspace = modes[:, -_RANK:][:, power[-_RANK:] > 1e-6 * power[-1]]
    z = np.linalg.eigvals(np.linalg.lstsq(subspace[:-1], subspace[1:], rcond=None)[0])
    z = z[np.abs(z) > _GONE]  # of what is over within a sample, as after a trip
    s = np.log(z.astype(complex)) / h
    grows = s.real > 0
    powers = np.vander(np.where(grows, 1 / z, z), len(x), increasing=True).T
    powers[:, grows] = powers[::-1, grows]  # until the end, where such a mode is 1
    grown = np.where(grows, (len(x) - 1) * h * s.real, 0.0)
    largest = np.linalg.lstsq(powers, x.astype(complex), rcond=None)[0]
    energy = np.sum(np.abs(powers * largest) ** 2, axis=0) * h
    amplitude = largest * np.exp(-grown)
    hertz = s.imag / (2 * np.pi)
    enough = (np.abs(amplitude) > least) & (2 * energy > share * np.sum(x**2) * h)  # with its twin
    found = np.flatnonzero((hertz > band[0]) & (hertz < band[1]) & enough)
    if not len(found):
        return None
    k = found[np.argmax(energy[found])]
    return Oscillation(float(-s[k].real / abs(s[k])), float(hertz[k]))
