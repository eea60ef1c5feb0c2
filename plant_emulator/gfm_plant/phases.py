"""What a processor's pins have to do with: the A/D at the phases, and compare values.

The phases of a space vector x that turns in the common frame are Re(x e^(j omega_b t) a^-n) with
a = e^(j 2 pi/3) and n = 0, 1, 2; in p.u. they are p.u. of a phase's nominal peak value.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.layout import field
from gfm_plant.model import V_DC
from gfm_plant.noise import gaussians
from gfm_plant.records import COMPARE, I_F, I_O, N_PHASES, PlantRecords, V
from gfm_plant.solution import own
from gfm_runtime.compiled import cached, compiled, inlined

_A = np.array([1.0, complex(-0.5, math.sqrt(0.75)), complex(-0.5, -math.sqrt(0.75))])
_SEED = np.uint64(1 << 62)  # tells the noise of the phases from that of `sensors`


@inlined
def frame_turn(plant: PlantRecords, at: float) -> complex:
    """Return e^(j omega_b t) at an instant of the period, s after its beginning: from the common
    frame to the one that stands still."""
    n, now, tick = plant.net[0], plant.now[0], plant.st[0].tick
    if at == n.T_s:
        tick, at = tick + 1, 0.0
    if at == 0.0 and tick == now.frame_tick:
        return now.frame_turn
    angle = n.omega_b * (n.T_s * tick + at)
    turn = complex(math.cos(angle), math.sin(angle))
    if at == 0.0:
        now.frame_turn, now.frame_tick = turn, tick
    return turn


@inlined
def along(x: int, z: complex) -> float:
    return _A[x].real * z.real + _A[x].imag * z.imag


@inlined
def read_phases(plant: PlantRecords, k: int) -> None:
    """Have the counts of converter k's A/D at this tick in ``phase_sums``, in the order of the
    signal table's group ``adc``.

    Several conversions are those since the last tick, see ``convert``; where that has no instants
    between, at the start and in a period that clears a fault, all are at the tick.
    """
    s = plant.st[k]
    if math.isnan(s.phase_sums[0]):
        for m in range(plant.par[k].phase_samples):
            convert(plant, k, m, 0.0)


@inlined
def convert(plant: PlantRecords, k: int, m: int, at: float) -> None:
    """Add conversion m of this period, at an instant s after its beginning, to the counts of
    converter k.

    A sensor's low-pass sees a straight line from conversion to conversion. A channel with skew
    samples earlier, on the same line; with one conversion a period the current of L_f on the slope
    that it has before the tick, where its bridge has a zero vector if it is switched.
    """
    r, s, w = plant.par[k], plant.st[k], field(plant.now[0], "w")
    turn = frame_turn(plant, at)
    i, v, i_o = w[own(k) + I_F] * turn, w[own(k) + V] * turn, w[own(k) + I_O] * turn
    i, i_o = i * r.current, i_o * r.current
    s.phase_true[0] = s.x[V_DC]
    for x in range(3):
        s.phase_true[1 + x], s.phase_true[4 + x] = along(x, i), along(x, v)
        s.phase_true[7 + x] = along(x, i_o)
    if math.isnan(s.phase_seen[0, 0]):
        for j in range(N_PHASES):
            s.phase_seen[0, j] = s.phase_seen[1, j] = s.phase_true[j]
    if r.skewed:
        _find_slopes(plant, k, turn, i, v)
    tick = s.tick * r.phase_samples + m
    for j in range(0, N_PHASES, 2):
        s.phase_random[j], s.phase_random[j + 1] = _noise(r, tick, j)
    if m == 0:
        for j in range(N_PHASES):
            s.phase_sums[j] = 0.0
    for j in range(N_PHASES):
        low = (
            r.phase_weights[0] * s.phase_seen[1, j]
            + r.phase_weights[1] * s.phase_seen[0, j]
            + r.phase_weights[2] * s.phase_true[j]
        )
        s.phase_seen[0, j], s.phase_seen[1, j] = s.phase_true[j], low
        seen = low - r.phase_skew[j] * s.phase_slope[j]
        s.phase_sums[j] += _count(r, j, seen, s.phase_random[j])


@compiled
def _find_slopes(plant: PlantRecords, k: int, turn: complex, i: complex, v: complex) -> None:
    """Find what each channel changes by in a second before a conversion; current of L_f and voltage
    of C_f as they stand, p.u."""
    r, s = plant.par[k], plant.st[k]
    for j in range(N_PHASES):
        change = s.phase_true[j] - s.phase_seen[0, j]
        s.phase_slope[j] = change * r.phase_samples / plant.net[0].T_s
    if r.phase_samples == 1:
        slope = -(v + r.R_f * i) * (r.omega_b / r.L_f)
        if r.levels == 0:
            E = complex(s.E[0], s.E[1]) * field(plant.now[0], "unit")[k] * turn
            slope += E * (r.omega_b / r.L_f)
        for x in range(3):
            s.phase_slope[1 + x] = along(x, slope)


@cached
def convert_nothing(plant: PlantRecords, k: int, rows: NDArray[np.float64]) -> None:
    """Write to rows, (n, 10), what converter k's A/D has read at n ticks before the first one, when
    no current flowed and there was no voltage."""
    r = plant.par[k]
    for i in range(len(rows)):
        for j in range(N_PHASES):
            rows[i, j] = 0.0
            for m in range(r.phase_samples):
                noise = _noise(r, m - (i + 1) * r.phase_samples, j - j % 2)[j % 2]
                rows[i, j] += _count(r, j, 0.0, noise)


@inlined
def _noise(r: Any, tick: int, j: int) -> tuple[float, float]:
    """Return samples of N(0, 1) for an even channel and the next; 0 if neither has noise."""
    if r.phase_noise[j] > 0.0 or r.phase_noise[j + 1] > 0.0:
        return gaussians(r.seed + _SEED, tick, j // 2)
    return 0.0, 0.0


@inlined
def _count(r: Any, j: int, value: float, noise: float) -> float:
    """Return what channel j reads of a value, counts; ``noise`` is a sample of N(0, 1)."""
    value = r.phase_gain[j] * value + r.phase_offset[j] + r.phase_noise[j] * noise
    count = np.floor((value - r.phase_lo[j]) * r.phase_per_lsb[j] + 0.5)
    return min(max(count, 0.0), r.phase_top)


@compiled
def apply_counts(plant: PlantRecords, k: int, frame: complex, lasts: float) -> None:
    """Set the command of an averaged bridge that acts to the mean voltage, which stands still, of
    the compare values that came with it.

    Args:
        frame: the converter's, as a phasor that stands still, when it begins to act.
        lasts: how long it acts, s.
    """
    r, s, n = plant.par[k], plant.st[k], plant.net[0]
    z = 0j
    for x in range(3):
        z += _A[x] * min(max(s.u_now[COMPARE + x], 0.0), 1.0 * r.counts)
    half = 0.5 * n.omega_b * s.u_now[1] * lasts
    frame = frame * complex(math.cos(half), math.sin(half))
    E = z * frame.conjugate() * (r.leg * s.x[V_DC] / r.counts)
    s.u_now[2], s.u_now[3] = E.real, E.imag
