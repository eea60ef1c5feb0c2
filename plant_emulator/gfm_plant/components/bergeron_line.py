"""A line of travelling waves, after Bergeron.

Without losses, v + Z_c i at one end is v - Z_c i at the other a time tau later; i flows into the
line at both. A quarter of R is at each end and half in the middle, as EMT programs have it. With
Z = Z_c + R/4, h = (Z_c - R/4) / Z and the history E of each end k, m the other one:

    i_k = (v_k - E_k) / Z,    a_k = v_k + h Z i_k = (1 + h) v_k - h E_k,
    E_k(t) = (1 + h)/2 a_m(t - tau) + (1 - h)/2 a_k(t - tau)

in the frame that stands still; in the common frame a delay also turns by -omega_b tau. So each end
is a resistor Z to ground beside a current, and no matrix has both. a is kept along every piece as a
parabola, so that E is known a tick ahead; each half of a piece takes the mean of its ends: the
error falls with the square of the length of a piece, and damps.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import numpy as np
import scipy  # loads scipy.interpolate, and so scipy.optimize, when it is first used
from pydantic import Field, PrivateAttr

from gfm_plant.atomics import load_acquire, pause, record_at, store_release, yield_processor
from gfm_plant.circuit import CurrentSource, Element, Shunt
from gfm_plant.components.part import Fed, LinearPart, Matrix, Terminal
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import draw, state
from gfm_runtime.compiled import compiled, inlined

PIECES = 1024
"""Of the past that a record keeps."""
MARKS = 4
"""Ticks whose end a record keeps: one end may be a tick ahead of the other."""
_SPARE = 24  # pieces of these that a tick may repeat
_AT_REST = 64  # pieces of the past of a line at rest
_ROUNDED = 1e-3  # of a tick: what its pieces may lack
_ORDER = 8  # of the Pade approximant of a delay in the linear model


@inlined
def _left(one: Any, k: int, at: float) -> complex:
    """Return the wave that left end k at a time, s, which does not go back."""
    begins, s = one.begins, one.seek[k]
    while s + 1 < one.count[k] and begins[k, (s + 1) % PIECES] <= at:
        s += 1
    one.seek[k], j = s, s % PIECES
    x = (at - begins[k, j]) / one.lasts[k, j]
    a, b, c = one.a[j, k, 0], one.a[j, k, 1], one.a[j, k, 2]
    p, q, r = (1.0 - x) * (1.0 - 2.0 * x), 4.0 * x * (1.0 - x), x * (2.0 * x - 1.0)
    return p * a + q * b + r * c


@compiled
def _arrive(one: Any, t: float, which: int) -> None:
    """Set E of both ends at a time t, s."""
    back = t - one.tau
    start, end = one.turn * _left(one, 0, back), one.turn * _left(one, 1, back)
    one.E[0, which] = 0.5 * ((1.0 + one.h) * end + (1.0 - one.h) * start)
    one.E[1, which] = 0.5 * ((1.0 + one.h) * start + (1.0 - one.h) * end)


@compiled
def _draw(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    half, w = field(n, "half_h")[part], field(now, "w")
    for which in range(3):
        _arrive(one, one.t + which * half, which)
    for k in range(one.first, one.last):
        E_0, E_1, E_2 = one.E[k, 0], one.E[k, 1], one.E[k, 2]
        one.v[k, 0] = w[one.sees[k]]
        draw(
            n, now, c, part, one.source + k - one.first,
            -(E_0 + E_1) * (0.5 * one.G),
            -(E_1 + E_2) * (0.5 * one.G),
        )  # fmt: skip


@compiled
def _middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    for k in range(one.first, one.last):
        one.v[k, 1] = state(n, now, c, one.sees[k])


@compiled
def _leave(one: Any, lasts: float) -> None:
    """Keep what left the ends in a piece of lasts s."""
    for k in range(one.first, one.last):
        j = _begin_piece(one, k, one.t, lasts)
        for which in range(3):
            one.a[j, k, which] = (1.0 + one.h) * one.v[k, which] - one.h * one.E[k, which]
    one.t += lasts


@inlined
def _begin_piece(one: Any, k: int, begins: float, lasts: float) -> int:
    """Begin another piece of what left end k, and return its place."""
    j: int = one.count[k] % PIECES
    one.begins[k, j], one.lasts[k, j] = begins, lasts
    one.count[k] += 1
    return j


@compiled
def _end(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    w = field(now, "w")
    for k in range(one.first, one.last):
        one.v[k, 2] = w[one.sees[k]]
    _leave(one, 2.0 * field(n, "half_h")[part])


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.t_kept = one.t
    for k in range(2):
        one.count_kept[k], one.seek_kept[k] = one.count[k], one.seek[k]


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.t = one.t_kept
    for k in range(2):
        one.count[k], one.seek[k] = one.count_kept[k], one.seek_kept[k]


@compiled
def _meet(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Of an end whose other end is in another part of the plant: after a tick tell that what has
    left here, wait until it has done as many ticks, and take over what has left there."""
    if one.other == 0:
        return
    k, done = one.first, one.done + 1
    one.ends += n.T_s
    if one.t < one.ends - _ROUNDED * n.T_s:  # this part diverged: it sends what it sent
        _stand_still(one, k, one.ends - one.t)
    one.t = one.ends  # both ends keep the same time, whatever their pieces add up to
    m = done % MARKS
    one.marks[m] = one.count[k]
    one.speeds[m, 0], one.speeds[m, 1] = now.omega_g, now.omega_g_to
    one.speeds[m, 2] = now.omega_g_slope
    store_release(one.here + _DONE, done)
    looks = 0
    while load_acquire(one.other + _DONE) < done:
        looks += 1
        if looks > one.spins:
            yield_processor()
        else:
            pause()
    _take_over(now, one, record_at(one.other, one), m)


@compiled
def _stand_still(one: Any, k: int, lasts: float) -> None:
    """Keep a piece of lasts s, in which end k sends what it sent last."""
    before = (one.count[k] - 1) % PIECES
    j = _begin_piece(one, k, one.t, lasts)
    for which in range(3):
        one.a[j, k, which] = one.a[before, k, 2]


@compiled
def _take_over(now: Any, one: Any, other: Any, m: int) -> None:
    """Take over what has left the other end until a mark, and the speed of the frame there."""
    k = other.first
    while one.count[k] < other.marks[m]:
        i = one.count[k] % PIECES
        j = _begin_piece(one, k, other.begins[k, i], other.lasts[k, i])
        for which in range(3):
            one.a[j, k, which] = other.a[j, k, which]
    if one.led != 0:
        now.omega_g, now.omega_g_to = other.speeds[m, 0], other.speeds[m, 1]
        now.omega_g_slope = other.speeds[m, 2]


class BergeronLine(Fed):
    """A line or cable on which waves travel at a constant speed (Bergeron). L and B are those of a
    line as a pi: its characteristic impedance is sqrt(L / B), and its delay is sqrt(L B) over the
    nominal angular frequency. A quarter of R is at each end and half in the middle. The delay must
    be at least the sampling period. It has no breaker, carries no zero sequence and cannot be
    recorded; both of its nodes need a capacitor."""

    title: ClassVar = "Line of travelling waves"
    symbol: ClassVar = "inductor"
    example: ClassVar = {
        "bergeron_lines": {"x": {"start": "bus", "end": "n", "L": 0.1, "B": 0.1}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}, "d": {"node": "n", "Q": 0.1}},
        "loads": {"r": {"node": "n", "P": 0.1}},
    }
    more_states: ClassVar = (
        ("a", "p.u., space vectors", "the waves that left both ends in the last tau"),
    )
    is_voltage: ClassVar = False
    unknowns: ClassVar = 4  # E of both ends
    record: ClassVar = np.dtype(
        [
            ("source", "i8"), ("sees", "i8", (2,)),
            # the ends that are in this part of the plant, see `parted`: from the first one to
            # before the last. Of one end alone its address, and that of the record of the other
            # end, else 0; whether the part there sets the speed of the frame; how often a thread
            # looks at the other one before it yields
            *((name, "i8") for name in ("first", "last", "here", "other", "led", "spins")),
            ("ends", "f8"),  # the last tick, s
            ("tau", "f8"), ("turn", "c16"), ("h", "f8"), ("G", "f8"),  # s; 1 / Z, p.u.
            ("t", "f8"), ("t_kept", "f8"),  # s
            # of both ends the pieces until now; and the one in which what arrives has left
            *((name, "i8", (2,)) for name in ("count", "count_kept", "seek", "seek_kept")),
            # of both at the beginning, in the middle and at the end of a piece
            ("v", "c16", (2, 3)), ("E", "c16", (2, 3)), ("a", "c16", (PIECES, 2, 3)),
            ("begins", "f8", (2, PIECES)), ("lasts", "f8", (2, PIECES)),  # s
            # for the other end, away from what a tick writes: ticks done; of the last of them how
            # many pieces there were then, and omega_g, where it leads, and its slope
            ("done", "i8"), ("marks", "i8", (MARKS,)), ("speeds", "f8", (MARKS, 3)),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "keep": _keep, "drive": _draw, "middle": _middle, "end": _end, "go_back": _go_back,
        "tick": _meet,
    }  # fmt: skip

    start: str = Field(min_length=1, description="node at its start, one with a capacitor")
    end: str = Field(min_length=1, description="node at its end, one with a capacitor")
    L: Positive = Field(description="p.u. of the first converter")
    R: NonNegative = Field(0.0, description="p.u. of the first converter")
    B: Positive = Field(description="charging in all, p.u. of the first converter")
    _ends: tuple[int, ...] = PrivateAttr((0, 1))

    def only(self, k: int) -> Self:
        """Its end k alone, in the part of a plant that has that node."""
        one = self.model_copy()
        one._ends = (k,)
        return one

    @property
    def nodes(self) -> tuple[str, ...]:
        return tuple((self.start, self.end)[k] for k in self._ends)

    @property
    def Z(self) -> float:
        """What each end is to ground, p.u."""
        return math.sqrt(self.L / self.B) + self.R / 4

    @property
    def h(self) -> float:
        """See the equations above."""
        return 1 - self.R / 2 / self.Z

    def delay(self, omega_b: float) -> float:
        """How long a wave takes, s."""
        return math.sqrt(self.L * self.B) / omega_b

    def sources(self, name: str) -> tuple[str, ...]:
        return tuple((name, f"{name}.end")[k] for k in self._ends)

    def elements(self, name: str) -> Sequence[Element]:
        each = [*zip(self.sources(name), self.nodes, strict=True)]
        return (
            *(CurrentSource(source, node, switched=False) for source, node in each),
            *(Shunt(f"{source}.Z", node, self.Z) for source, node in each),
        )

    def terminals(self, name: str) -> Sequence[Terminal]:
        return ()  # not recorded

    def label(self) -> str:
        return f"waves, L {self.L:.3g}, R {self.R:.3g}, B {self.B:.3g} p.u."

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        tau = self.delay(omega_b)
        if tau < T_s * (1 - 1e-9):
            raise ValueError(
                f"{where}: L = {self.L:g}, B = {self.B:g}: a wave takes {tau:.6g} s; allowed is at"
                f" least T_s = {T_s:g} s, a line {T_s / tau:.6g} times as long; take one of"
                " network.lines"
            )
        record["tau"], record["h"], record["G"] = tau, self.h, 1 / self.Z
        record["turn"] = np.exp(-1j * omega_b * tau)
        record["first"], record["last"] = self._ends[0], self._ends[-1] + 1

    def check_pieces(self, name: str, shortest: float, omega_b: float) -> None:
        if (needs := self.delay(omega_b) / shortest) > (most := PIECES - _SPARE):
            raise ValueError(
                f"{name}: its waves take {needs:.0f} pieces of {shortest:.3g} s; allowed are {most}"
            )

    def sees(self, name: str, banks: Mapping[str, str]) -> tuple[str, ...]:
        for node in self.nodes:
            if node not in banks:
                raise ValueError(
                    f"node {node}: {name} ends there, so the node needs a bank of"
                    " network.capacitors"
                )
        return tuple(banks[node] for node in self.nodes)

    def _mixed(self, omega: float, omega_b: float) -> Matrix:
        """E by the waves a at rest at a speed, p.u.: complex, (2, 2)."""
        part = np.array([[1 - self.h, 1 + self.h], [1 + self.h, 1 - self.h]]) / 2
        return np.asarray(part * np.exp(-1j * omega * omega_b * self.delay(omega_b)))

    def steady(self, v: Any, omega: float, omega_b: float, z: Matrix) -> tuple[Any, list[float]]:
        E = z[:2] + 1j * z[2:]
        missing = E - self._mixed(omega, omega_b) @ ((1 + self.h) * v - self.h * E)
        return (E - v) / self.Z, [*missing.real, *missing.imag]

    def settle(self, record: Any, v: Any, omega: float, omega_b: float, z: Matrix) -> Any:
        E = z[:2] + 1j * z[2:] if len(z) else np.zeros(2, complex)
        at = np.arange(-2 * _AT_REST, 1) / (2 * _AT_REST) * float(record["tau"])
        turned = np.exp(1j * omega_b * (omega - 1.0) * at)
        past = np.multiply.outer(turned, (1 + self.h) * np.asarray(v) - self.h * E)
        for which in range(3):
            record["a"][:_AT_REST, :, which] = past[which : len(at) - 2 + which : 2]
        record["begins"][:, :_AT_REST] = at[:-1:2]
        record["lasts"][:, :_AT_REST] = at[2] - at[0]
        record["count"], record["seek"], record["t"] = _AT_REST, 0, 0.0
        record["E"] = E[:, None]
        return -E / self.Z

    def linear(
        self, record: Any, seen: Any, source: Any, slip: float, omega_b: float
    ) -> LinearPart:
        """Each delay as its Pade approximant of the envelope in the frame of the island."""
        tau, h = self.delay(omega_b), self.h
        upper, lower = scipy.interpolate.pade(
            [(-1.0) ** k / math.factorial(k) for k in range(2 * _ORDER)], _ORDER
        )
        poles = lower.roots
        residues = upper(poles) / lower.deriv()(poles)
        enter = np.kron(np.eye(2), np.ones((_ORDER, 1))) / tau
        E = self._mixed(1.0 + slip / omega_b, omega_b) @ np.kron(np.eye(2), residues)
        A = np.diag(np.tile(poles, 2)) / tau - h * enter @ E
        waves = (1 + h) * np.asarray(seen) - h * record["E"][:, 0]
        rest = 1j * np.repeat(waves, _ORDER) / -np.tile(poles, 2)
        return LinearPart(
            _parts(A), _parts((1 + h) * enter), _parts(-E / self.Z),
            np.concatenate([rest.real, rest.imag]), np.zeros((4, 4)),
        )  # fmt: skip


def _parts(M: Any) -> Matrix:
    """A complex matrix as one over real parts, and then imaginary parts."""
    return np.block([[M.real, -M.imag], [M.imag, M.real]])


_DONE: int = dict(BergeronLine.record.fields or {})["done"][1]  # bytes from its beginning
