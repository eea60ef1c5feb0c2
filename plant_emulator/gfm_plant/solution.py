"""The exact solution of the circuit between two commands, and the DC link and sensors along it.

While a command is held every source is a phasor of constant length that turns at a constant speed
Omega in the common frame. A mode z' = lambda z + b s then goes in a time h to

    z(h) = e^(lambda h) z(0) + b s(0) (e^(j Omega h) - e^(lambda h)) / (j Omega - lambda),

which is exact to rounding, however fast the mode is. The DC links and the sensors see a parabola
through the quantities at the beginning, the middle and the end of a piece of time: Simpson's
rule, whose error falls with the fourth power of the length.

The modes of an unbalanced circuit are driven by the sources and by their mirror images
conj(s) e^(-2 j omega_b t), which are phasors too: they turn at -omega where a source turns at
omega. See `circuit.join_axes`.
"""

import math
from typing import Any

from gfm_plant.joint import joint_circuit
from gfm_plant.layout import CHECK_SIDES, field
from gfm_plant.records import N_OWN
from gfm_plant.sparse import (
    by_series,
    end_states,
    enter_sparse,
    find_nodes,
    middle_state,
    turned,
    voltage_at,
)
from gfm_runtime.by_address import call_records_at
from gfm_runtime.compiled import compiled, inlined


@compiled
def own(k: int) -> int:
    """Return where the states of converter k begin in w. Its source is number k."""
    return N_OWN * k


@compiled
def grid_source(n: Any) -> int:
    """Return the place of the grid's positive sequence; its negative sequence is the next one."""
    return n.n_converters


@compiled
def mirror_at(n: Any, tick: float) -> complex:
    """Return e^(-2 j omega_b t) at a tick, or between two: the mirror image of x is conj(x) times
    that."""
    angle = -2.0 * n.omega_b * n.T_s * tick
    return complex(math.cos(angle), math.sin(angle))


@compiled
def mirror_sources(n: Any, now: Any, tick: float) -> None:
    """Set the unit phasors of the sources' mirror images."""
    if by_series(n, now):
        now.upright = mirror_at(n, -0.5 * tick)
        return
    unit, turn = field(now, "unit"), mirror_at(n, tick)
    for k in range(now.n_s):
        unit[now.n_s + k] = unit[k].conjugate() * turn


@inlined
def drive(n: Any, now: Any, c: int, part: int, k: int, E: complex, omega: float) -> None:
    """Add to the forcing of every mode what source k does to it, in an unbalanced circuit with its
    mirror image, and turn their phasors.

    Args:
        n, now: elements of ``net`` and ``now``, also below.
        c: the circuit in force.
        part: which cut of the period, in which a piece lasts twice its ``half_h``.
        E: the source's voltage over its unit phasor, p.u.
        omega: its speed, p.u.; negative for a negative sequence.
    """
    if _by_terms(n, now):
        _set_source(n, now, part, k, E, omega)
        return
    _drive(n, now, c, part, k, k, E, omega)
    if field(n, "unbalanced")[c]:
        _drive(n, now, c, part, now.n_s + k, k, E.conjugate(), -omega)


@inlined
def _drive(
    n: Any, now: Any, c: int, part: int, k: int, source: int, E: complex, omega: float
) -> None:
    """Drive by the phasor at place k: that of a source, or its mirror image."""
    if field(now, "gain_omega")[part, k] != omega:
        _find_gains(n, now, c, part, k, source, omega)
    gain, forced, turn = field(now, "gain"), field(now, "forced"), field(now, "turn")[part, k]
    s = E * field(now, "unit")[k]
    for m in range(field(n, "n_modes")[c]):
        f = gain[part, k, m] * s
        forced[m, 0] += f
        forced[m, 1] += f * turn
    _turn_on(now, part, k)


@inlined
def _set_source(n: Any, now: Any, part: int, k: int, E: complex, omega: float) -> None:
    """``drive`` of a series: keep the source at the beginning and in the middle of a piece."""
    if field(now, "gain_omega")[part, k] != omega:
        field(now, "gain_omega")[part, k] = omega
        turn = turned(n.omega_b * (omega - 1.0) * field(n, "half_h")[part])
        field(now, "turn")[part, k] = turn
    field(now, "source")[k] = E * field(now, "unit")[k]
    _turn_on(now, part, k)
    field(now, "source_next")[k] = E * field(now, "halfway")[k]
    field(now, "source_speed")[k] = n.omega_b * omega


@compiled
def _turn_on(now: Any, part: int, k: int) -> None:
    """Take the phasor at place k on by a piece."""
    unit, turn = field(now, "unit"), field(now, "turn")[part, k]
    middle = unit[k] * turn
    field(now, "halfway")[k] = middle
    u = middle * turn
    length = 1.5 - 0.5 * (u.real * u.real + u.imag * u.imag)  # takes the rounding out of it
    unit[k] = complex(u.real * length, u.imag * length)


@compiled
def draw(n: Any, now: Any, c: int, part: int, k: int, first: complex, second: complex) -> None:
    """Add to the forcing of every mode what source k does to it, which is held at one value in the
    first half of a piece and at another in the second, in the common frame."""
    if _by_terms(n, now):
        now.held = 1
        field(now, "source")[k], field(now, "source_next")[k] = first, second
        field(now, "source_speed")[k] = n.omega_b
        return
    _draw(n, now, c, part, k, k, 1.0, first, second)
    if field(n, "unbalanced")[c]:
        j = now.n_s + k
        unit = field(now, "unit")[j]
        if field(now, "gain_omega")[part, j] != -1.0:
            _find_gains(n, now, c, part, j, k, -1.0)
        _turn_on(now, part, j)
        middle = field(now, "halfway")[j]
        _draw(n, now, c, part, j, k, -1.0, first.conjugate() * unit, second.conjugate() * middle)


@compiled
def _draw(
    n: Any, now: Any, c: int, part: int, k: int, source: int, omega: float,
    first: complex, second: complex,
) -> None:  # fmt: skip
    """Drive by two values of the source, or the mirror image, at place k."""
    if field(now, "gain_omega")[part, k] != omega:
        _find_gains(n, now, c, part, k, source, omega)
    gain, forced = field(now, "gain"), field(now, "forced")
    for m in range(field(n, "n_modes")[c]):
        forced[m, 0] += gain[part, k, m] * first
        forced[m, 1] += gain[part, k, m] * second


@compiled
def _find_gains(n: Any, now: Any, c: int, part: int, k: int, source: int, omega: float) -> None:
    """Find what the phasor at place k, that of a source or its mirror image, does to each mode in
    half a piece, per unit of its voltage; this stays the same while its speed does, as that of an
    ideal grid."""
    rate, decay, by_source = field(n, "rate"), field(n, "decay"), field(n, "drive")
    image, gain, h = 0 if k == source else 1, field(now, "gain"), field(n, "half_h")[part]
    speed = n.omega_b * (omega - 1.0)
    turn = turned(speed * h)
    for m in range(field(n, "n_modes")[c]):
        d = complex(-rate[c, m].real, speed - rate[c, m].imag)
        size = d.real * d.real + d.imag * d.imag
        if size * h * h > 1e-8:
            per_size = 1.0 / size
            g = (turn - decay[c, part, m]) * d.conjugate()
            g = complex(g.real * per_size, g.imag * per_size)
        else:  # nearly the mode's own frequency: h e^(lambda h) (1 + z/2 + z^2/6), z = d h
            z_r, z_i = d.real * h, d.imag * h
            f_r = 1.0 + z_r / 2.0 + (z_r * z_r - z_i * z_i) / 6.0
            f_i = z_i / 2.0 + z_r * z_i / 3.0
            a = complex(h * decay[c, part, m].real, h * decay[c, part, m].imag)
            g = a * complex(f_r, f_i)
        gain[part, k, m] = g * by_source[c, image, m, source]
    field(now, "turn")[part, k] = turn
    field(now, "gain_omega")[part, k] = omega


@inlined
def _by_terms(n: Any, now: Any) -> bool:
    """Whether a series takes the sources as they are, of a large plant or of a switched bridge."""
    return n.n_units != 0 or by_series(n, now)


@inlined
def half_step(n: Any, now: Any, c: int, part: int, which: int) -> None:
    """Take the modes on by half a piece: ``which`` is 0 for its first half, 1 for its second."""
    if by_series(n, now):
        call_records_at(n.series, n, now, field(n, "half_h")[part], which)
        return
    decay, z, forced = field(n, "decay"), field(now, "z"), field(now, "forced")
    for m in range(field(n, "n_modes")[c]):
        z[m] = decay[c, part, m] * z[m] + forced[m, which]


@inlined
def state(n: Any, now: Any, c: int, i: int) -> complex:
    """Return state i of w in the middle of a piece."""
    if by_series(n, now):
        middle: complex = middle_state(n, now, i)
        return middle
    if n.n_units:  # where w is
        there: complex = field(now, "w")[i]
        return there
    states, z, w = field(n, "states"), field(now, "z"), 0j
    for m in range(field(n, "n_modes")[c]):
        w += states[c, i, m] * z[m]
    return w


@inlined
def read_states(n: Any, now: Any, c: int) -> None:
    """Write all states of w at the end of a piece, or by the modes as they are."""
    if by_series(n, now):
        end_states(n, now)
        return
    states, z, w = field(n, "states"), field(now, "z"), field(now, "w")
    modes = field(n, "n_modes")[c]
    for i in range(n.n_states):  # as `state`, with the arrays looked up once
        found = 0j
        for m in range(modes):
            found += states[c, i, m] * z[m]
        w[i] = found


@inlined
def clear_forced(n: Any, now: Any, c: int) -> None:
    """Begin a piece, in which nothing drives the circuit yet."""
    if by_series(n, now):
        now.held = 0
        field(now, "source")[grid_source(n) + 1] = field(now, "source_next")[grid_source(n) + 1] = (
            0j
        )
        return
    forced = field(now, "forced")
    for m in range(field(n, "n_modes")[c]):
        forced[m, 0] = forced[m, 1] = 0j


@compiled
def node_voltage(n: Any, now: Any, place: int, tick: float) -> complex:
    """Return the voltage of a node at a tick, p.u.; see ``node_w`` in `gfm_plant.layout`."""
    c = circuit(n, now)
    if by_series(n, now):
        if place <= CHECK_SIDES:  # all others follow at the same tick
            if field(n, "unbalanced")[c]:
                now.upright = mirror_at(n, -0.5 * tick)
            find_nodes(n, now)
        found: complex = voltage_at(n, now, place)
        return found
    v = _by(n, now, c, place, 0)
    if field(n, "unbalanced")[c]:
        v += _by(n, now, c, place, 1).conjugate() * (field(n, "node_turn")[c] * mirror_at(n, tick))
    return v


@compiled
def _by(n: Any, now: Any, c: int, place: int, image: int) -> complex:
    """Return the sum of w and the sources, with the factors of a node for them or for their mirror
    images."""
    w, unit, emf = field(now, "w"), field(now, "unit"), field(now, "emf")
    by_w, by_source, v = field(n, "node_w"), field(n, "node_s"), 0j
    for i in range(n.n_states):
        v += by_w[c, place, image, i] * w[i]
    g = grid_source(n)
    by = now.V_g * by_source[c, place, image, g]
    if by != 0.0:
        for k in range(2):  # its two sequences
            v += by * now.sequence[k] * unit[g + k]
    for k in range(g + 2, now.n_s):
        v += by_source[c, place, image, k] * emf[k] * unit[k]
    return v


@compiled
def circuit(n: Any, now: Any) -> int:
    """Return which circuit is in force."""
    if now.joint:
        return joint_circuit(n)
    if n.sparse:
        return 1 + now.contact
    return now.row + (n.n_converters + 1) * now.contact


@compiled
def cut_to(n: Any, now: Any, c: int, h: float, longest: float) -> int:
    """Make the last cut ready for a part of a stretch, in circuit c; returns its place.

    Args:
        n, now, c: as for `drive`.
        h: how long the part is, s.
        longest: that a piece may be, s.
    """
    cut = 2 * n.n_parts
    pieces = max(1, math.ceil(h / longest))
    half = 0.5 * h / pieces
    field(n, "pieces")[cut] = pieces
    rate, decay = field(n, "rate"), field(n, "decay")
    for m in range(field(n, "n_modes")[c]):
        decay[c, cut, m] = turned(rate[c, m].imag * half) * math.exp(rate[c, m].real * half)
    lags_to(n, now, cut, half)
    return cut


@compiled
def lags_to(n: Any, now: Any, cut: int, half: float) -> None:
    """Make the first-order lags of a cut, and the turns of its sources, those of pieces of which a
    half lasts ``half`` s."""
    field(n, "half_h")[cut] = half
    known, lags, weights = field(now, "gain_omega"), field(n, "lag_rate"), field(n, "lag_weights")
    for k in range(now.n_phasors):
        known[cut, k] = math.inf
    for k in range(len(lags)):
        weights[cut, k, 0], f_1, f_2, f_3 = integrals(2.0 * half * lags[k])
        x = 2.0 * half * lags[k]
        weights[cut, k, 1] = x * (f_1 - 3.0 * f_2 + 4.0 * f_3)
        weights[cut, k, 2] = x * (4.0 * f_2 - 8.0 * f_3)
        weights[cut, k, 3] = x * (4.0 * f_3 - f_2)


@compiled
def integrals(x: float) -> tuple[float, float, float, float]:
    """Return e^-x and the integrals over t from 0 to 1 of e^(-x (1 - t)) t^(k - 1) / (k - 1)! for
    k = 1, 2, 3."""
    if x > 1.0:
        whole = math.exp(-x)
        f_1 = (1.0 - whole) / x
        f_2 = (1.0 - f_1) / x
        return whole, f_1, f_2, (0.5 - f_2) / x
    f_3, term = 0.0, 1.0 / 6.0
    for k in range(4, 24):  # of (-x)^n / (n + 3)!
        f_3 += term
        term *= -x / k
    f_2 = 0.5 - x * f_3
    f_1 = 1.0 - x * f_2
    return 1.0 - x * f_1, f_1, f_2, f_3


@compiled
def enter(n: Any, now: Any, tick: float, c: int) -> None:
    """Start the modes of circuit c at a tick, or between two, from w, which is projected onto what
    that circuit can hold."""
    if now.joint and not now.made:
        call_records_at(n.join, n, now, 0.0, 0.0)
    known, modes = field(now, "gain_omega"), field(n, "modes")
    z, w = field(now, "z"), field(now, "w")
    for part in range(len(known)):
        for k in range(now.n_phasors):
            known[part, k] = math.inf
    if by_series(n, now):
        now.upright = mirror_at(n, -0.5 * tick)
        enter_sparse(n, now)
        return
    for m in range(field(n, "n_modes")[c]):
        z[m] = 0j
        for i in range(n.n_states):
            z[m] += modes[c, 0, m, i] * w[i]
    if field(n, "unbalanced")[c]:
        turn = mirror_at(n, tick)
        for m in range(field(n, "n_modes")[c]):
            mirrored = 0j
            for i in range(n.n_states):
                mirrored += modes[c, 1, m, i] * w[i].conjugate()
            z[m] += mirrored * turn
    read_states(n, now, c)
