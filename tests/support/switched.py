"""A switched converter on line and grid, or at a bus with averaged ones, integrated from edge to
edge by SciPy's DOP853.

Nothing of the plant's own solution is in here: the three legs are written out phase by phase, the
currents and voltages as space vectors that stand still, and the integrator finds the zeros of
currents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

AXES = np.exp(2j * np.pi / 3 * np.arange(3))
LOW, DEAD, HIGH = 0, 1, 2


@dataclass
class Reference:
    """One converter; all in p.u. but times.

    Attributes:
        par: record of the plant's parameters, for the elements.
        z: currents of L_f and L_g, voltage of C_f as space vectors that stand still: i, v, i_o;
            then v_dc and the integral of the DC source's control.
        drops: thresholds of switch and diode over V_dcref, and resistances.
        V_g: of the grid, whose angle is 0 at t = 0 and which turns at omega_b.
    """

    par: Any
    z: NDArray[np.complex128]
    T_s: float = 1e-4
    counts: int = 10_000
    dead: float = 0.0
    drops: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    V_g: float = 1.0
    updates: int = 1
    carriers: int = 1
    tick: int = 0
    t: float = 0.0  # since the tick, s
    gates: list[int] = field(default_factory=lambda: [HIGH] * 3)
    levels: list[int] = field(default_factory=lambda: [HIGH] * 3)
    on_at: list[float] = field(default_factory=lambda: [math.inf] * 3)
    zeros: int = 0

    def __post_init__(self) -> None:
        self.per_v = math.sqrt(2 / 3) * 700 / 380  # p.u. of phase voltage in p.u. of v_dc

    # ---- what the firmware does

    def duties(self, E: complex, v_dc: float) -> list[int]:
        """Space-vector modulation by its textbook form: a common third harmonic."""
        phases = (E * AXES.conj()).real / (1.5 * self.per_v) / v_dc
        common = -(phases.max() + phases.min()) / 2
        return [int(min(max(p + common + 0.5, 0.0), 1.0) * self.counts + 0.5) for p in phases]

    def edges(self, E: complex, part: int) -> list[tuple[float, list[int]]]:
        """Instants of a unit of the carrier, s from its beginning, at which commanded levels
        change, and the levels from there on.

        Args:
            E: the command in the middle of the unit, a space vector that stands still.
        """
        count = self.T_s / self.carriers / 2 / self.counts
        on = self.duties(E, self.z[3].real)
        if self.updates == 2:
            down = part % 2 == 1
            times = {(self.counts - c if down else c) for c in on}
        else:
            down, times = False, {t for c in on for t in (c, 2 * self.counts - c)}
        length = 2 * self.counts // self.updates
        found = []
        for at in sorted({0, *times} - {length}):
            place = self.counts - at if down else min(at, 2 * self.counts - at)  # of the carrier
            above = [c > place or (c == place and at > self.counts) or (c == place and down)
                     or c == self.counts for c in on]  # fmt: skip
            found.append((at * count, [HIGH if one else LOW for one in above]))
        return found

    # ---- the legs

    def leg(self, x: int, sign: int) -> float:
        """Voltage of leg x above the lower rail without what resistances drop, p.u. of v_dc; sign
        of its current outwards."""
        V_s, V_d, _, _ = self.drops
        v_dc = self.z[3].real
        if self.gates[x] == LOW:
            return -V_d if sign > 0 else V_s
        if self.gates[x] == HIGH:
            return v_dc - V_s if sign > 0 else v_dc + V_d
        return -V_d if sign > 0 else v_dc + V_d

    def R(self, x: int, sign: int) -> float:
        _, _, R_s, R_d = self.drops
        by_diode = (sign > 0) == (self.gates[x] == LOW) or self.gates[x] == DEAD
        return R_d if by_diode else R_s

    def watched(self, x: int) -> bool:
        return self.gates[x] == DEAD or any(self.drops)

    def slope(
        self, t: float, z: NDArray[np.complex128], u: Any, signs: list[int], open_: list[int]
    ):
        r, (i, v, i_o, v_dc, reg) = self.par, z[:5]
        node, more = self.outside(t, z)
        v_dc, w = v_dc.real, r["omega_b"]
        kept, self.z = self.z, z
        legs = [self.leg(x, signs[x]) for x in range(3)]
        self.z = kept
        currents = (i * AXES.conj()).real
        e = self.per_v * np.dot(legs, AXES)
        drop = 2 / 3 * sum(self.R(x, signs[x]) * currents[x] * AXES[x] for x in range(3))
        di = w / r["L_f"] * (e - v - r["R_f"] * i - drop)
        for x in open_:
            di -= AXES[x] * (di * AXES[x].conj()).real
        if len(open_) > 1:
            di = 0.0
        upper = [
            self.gates[x] == HIGH or (self.gates[x] == DEAD and signs[x] < 0) for x in range(3)
        ]
        i_dc = r["i_u_gain"] * u[0] + r["k_p"] * (1 - v_dc) + reg.real
        drawn = self.per_v * float(np.dot(upper, currents))
        return np.array([
            di,
            w / r["C_f"] * (i - i_o),
            w / r["L_g"] * (v - node - r["R_g"] * i_o),
            w / r["C_dc"] * (i_dc - drawn),
            r["k_i"] * (1 - v_dc),
            *more,
        ])  # fmt: skip

    def outside(self, t: float, z: NDArray[np.complex128]) -> tuple[complex, list[complex]]:
        """The voltage at the end of the line, and the slopes of what is there besides."""
        return self.V_g * self.grid * np.exp(1j * self.par["omega_b"] * t), []

    def settle(self) -> tuple[list[int], list[int]]:
        """Signs of the currents, and the legs that stay without any."""
        currents = (self.z[0] * AXES.conj()).real
        signs = [0 if abs(c) < 1e-11 else int(np.sign(c)) for c in currents]
        none = [x for x in range(3) if signs[x] == 0 and self.watched(x)]
        assert len(none) <= 1, "the reference knows one leg without current"
        for x in none:
            self.zeros += 1
            others = [y for y in range(3) if y != x]
            mean = (
                sum(
                    self.leg(y, signs[y]) - self.R(y, signs[y]) * currents[y] / (1.5 * self.per_v)
                    for y in others
                )
                / 2
            )
            has = mean + (self.z[1] * AXES[x].conj()).real / self.per_v
            if has < self.leg(x, 1):
                signs[x], none = 1, []
            elif has > self.leg(x, -1):
                signs[x], none = -1, []
        return signs, none

    def integrate(
        self, until: float, u: Any, signs: list[int], open_: list[int], events: Any = None
    ):
        return solve_ivp(self.slope, (self.t, until), self.z, "DOP853", rtol=1e-13, atol=1e-15,
                         args=(u, signs, open_), events=events)  # fmt: skip

    def go(self, until: float, u: Any) -> None:
        """Integrate to an instant; dead times end on the way."""
        while self.t < until - 1e-15:
            stop = min(until, *self.on_at)
            if stop > self.t:
                signs, none = self.settle()
                events = []
                for x in range(3):
                    if self.watched(x) and x not in none:

                        def zero(t, z, u, signs, open_, x=x):
                            return (z[0] * AXES[x].conj()).real * signs[x]

                        zero.terminal, zero.direction = True, -1
                        events.append(zero)
                done = self.integrate(stop, u, signs, none, events or None)
                if done.status == 1:
                    self.to_zero(done, u, signs, none)
                    continue
                self.t, self.z = stop, done.y[:, -1]
            for x in range(3):
                if self.on_at[x] <= self.t + 1e-15:
                    self.gates[x], self.on_at[x] = self.levels[x], math.inf

    def to_zero(self, done: Any, u: Any, signs: list[int], none: list[int]) -> None:
        """Go on to the zero that an event has found; its dense output is not as exact as the
        integration itself, so Newton's method takes it there."""
        x = next(k for k, at in enumerate(done.t_events) if len(at))
        x = [k for k in range(3) if self.watched(k) and k not in none][x]
        at = done.t[-1]
        for _ in range(4):
            z = self.integrate(at, u, signs, none).y[:, -1] if at > self.t else self.z
            f = (z[0] * AXES[x].conj()).real
            slope = (self.slope(at, z, u, signs, none)[0] * AXES[x].conj()).real
            at = max(at - f / slope, self.t)
        z[0] -= AXES[x] * (z[0] * AXES[x].conj()).real
        self.t, self.z = at, z

    def period(self, E: complex, u: Any) -> None:
        """Go on by one sampling period under the command u; E is its voltage at the beginning, a
        space vector that stands still."""
        units = self.carriers * self.updates
        self.grid = np.exp(1j * self.par["omega_b"] * self.T_s * self.tick)
        length = self.T_s / units
        for part in range(units):
            first = part * length
            self.go(first, u)
            middle = E * np.exp(1j * self.par["omega_b"] * u[1] * (part + 0.5) * length)
            for at, levels in self.edges(middle, part):
                self.go(first + at, u)
                for x in range(3):
                    if levels[x] != self.levels[x]:
                        self.levels[x] = levels[x]
                        self.gates[x], self.on_at[x] = DEAD, self.t + self.dead
                        if self.dead == 0.0:
                            self.gates[x], self.on_at[x] = levels[x], math.inf
        self.go(self.T_s, u)
        self.tick, self.t = self.tick + 1, 0.0
        self.on_at = [at - self.T_s for at in self.on_at]


@dataclass
class AtABus(Reference):
    """One at a bus with averaged converters, a resistor, a capacitor and a line to the grid.

    Attributes:
        others: records of the averaged converters' parameters.
        E: the voltages of these at t = 0 of tick 0, space vectors that stand still.
        u: their commands, (n, 4).
        conductance, susceptance, L_tie, R_tie: of the load, the capacitor and the line.
        R_fault: between phases a and c at the bus.
        z: besides the voltage of the bus, the current to the grid, and of each other converter i,
            v, i_o, v_dc and the integral of the DC source's control.
    """

    others: Any = ()
    E: Any = ()
    u: Any = ()
    i_besides: complex = 0j  # by what a subclass has at the bus besides
    conductance: float = 0.0
    susceptance: float = 0.0
    L_tie: float = 0.0
    R_tie: float = 0.0
    R_fault: float = math.inf

    def outside(self, t: float, z: NDArray[np.complex128]) -> tuple[complex, list[complex]]:
        w, bus, i_g = self.par["omega_b"], z[5], z[6]
        v_a, _, v_c = (bus * AXES.conj()).real
        leak = 2 / 3 * (v_a - v_c) / self.R_fault * (AXES[0] - AXES[2])
        arrives = self.i_besides + z[2] - i_g - self.conductance * bus - leak
        more = list[complex]()
        for k, r in enumerate(self.others):
            i, v, i_o, v_dc, reg = z[7 + 5 * k : 12 + 5 * k]
            e = self.E[k] * np.exp(1j * w * self.u[k, 1] * (self.T_s * self.tick + t))
            i_dc = r["i_u_gain"] * self.u[k, 0] + r["k_p"] * (1 - v_dc.real) + reg.real
            arrives += i_o
            more += [
                w / r["L_f"] * (e - v - r["R_f"] * i),
                w / r["C_f"] * (i - i_o),
                w / r["L_g"] * (v - bus - r["R_g"] * i_o),
                w / r["C_dc"] * (i_dc - (e * i.conjugate()).real / v_dc.real),
                r["k_i"] * (1 - v_dc.real),
            ]
        grid = super().outside(t, z)[0]
        return bus, [
            w / self.susceptance * arrives, w / self.L_tie * (bus - grid - self.R_tie * i_g), *more
        ]  # fmt: skip


@dataclass
class WithMoving(AtABus):
    """With a load of constant power and a machine at the bus.

    Attributes:
        load, machine: records of their parameters; the machine's voltage is behind X and R.
        z: besides the voltage that the load has measured, the current of the machine, and the
            angle of its voltage, its speed less 1, and the power of its turbine.
    """

    load: Any = None
    machine: Any = None
    X: float = 0.0
    R_m: float = 0.0

    def outside(self, t: float, z: NDArray[np.complex128]) -> tuple[complex, list[complex]]:
        w, one, gen = self.par["omega_b"], self.load, self.machine
        v, i, angle, speed, turbine = z[7 + 5 * len(self.others) :]
        self.i_besides = i - one["S"].conjugate() * v / max(abs(v) ** 2, one["least_v2"])
        bus, more = super().outside(t, z)
        E = gen["E"] * np.exp(1j * angle.real)
        power = (E * i.conjugate()).real / gen["S"]
        return bus, [
            *more,
            1j * w * v + (bus - v) / one["tau"],
            w / self.X * (E - bus - self.R_m * i),
            w * (1 + speed.real),
            (turbine.real - power - gen["D"] * speed.real) / (2 * gen["H"]),
            (gen["P_set"] - speed.real / gen["droop"] - turbine.real) / gen["T_gov"],
        ]


@dataclass
class OnASwingingGrid(Reference):
    """At the end of its line a grid that swings.

    Attributes:
        swings: its parameters by name.
        z: besides, the angle of its voltage, its speed less 1, and the power of its turbines.
    """

    swings: Any = None

    def outside(self, t: float, z: NDArray[np.complex128]) -> tuple[complex, list[complex]]:
        one, (angle, speed, turbine) = self.swings, z[5:].real
        V = self.V_g * np.exp(1j * angle)
        power = (V * z[2].conjugate()).real / one["S"] - one["P_load"]
        return V, [
            self.par["omega_b"] * (1 + speed),
            (turbine + power - one["D"] * speed) / (2 * one["H"]),
            (one["P_set"] - speed / one["droop"] - turbine) / one["T_gov"],
        ]
