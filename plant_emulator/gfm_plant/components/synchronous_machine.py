"""A synchronous machine of order 6 with its controls: the equations of GENROU.

All of it is in p.u. of the machine's rating and in the frame of its rotor, whose q axis is 90
degrees ahead of its d axis; i flows out of the machine. X'' is that of both axes, so that the
stator is a voltage behind one branch, R and X'', of the circuit that is solved exactly:

    e'' = j omega psi'' + (d psi''/dt) / omega_b,
    psi_d'' =  a_d E_q' + (1 - a_d) psi_kd,    a_d = (X'' - X_l) / (X_d' - X_l),
    psi_q'' = -a_q E_d' + (1 - a_q) psi_kq,    a_q = (X'' - X_l) / (X_q' - X_l),
    T_d0''  d psi_kd/dt = -g_d,    g_d = psi_kd + (X_d' - X_l) i_d - E_q',
    T_q0''  d psi_kq/dt = -g_q,    g_q = psi_kq + (X_q' - X_l) i_q + E_d',
    T_d0'   d E_q'/dt = E_fd - E_q' - (X_d - X_d') (i_d - g_d (X_d' - X'') / (X_d' - X_l)^2)
                        - S psi_d'',
    T_q0'   d E_d'/dt =      - E_d' + (X_q - X_q') (i_q - g_q (X_q' - X'') / (X_q' - X_l)^2)
                        + S psi_q'' (X_q - X_l) / (X_d - X_l).

Its iron saturates by S(|psi''|): S times the flux is a parabola above a flux from which it begins
(`controls.control.parabola`), by S_10 and S_12 at fluxes of 1 and 1.2. X'' does not saturate.

With X_q' = X_q nothing moves E_d', which is 0: the q axis then has one damper, as that of a machine
with salient poles. The iron of one by GENSAL saturates in the d axis alone, by E_q': S(E_q') E_q'
takes the place of S psi_d'', and 0 that of S psi_q''.

Its torque, psi_d'' i_q - psi_q'' i_d, drives the swing equation. The exciter gives E_fd by the size
V of its terminals' voltage, the governor the torque of the turbine and the stabiliser a voltage by
its speed: see `controls`.

Within a tick e'' is held, in the rotor's frame, at its value in the middle of the tick,
extrapolated, and rotor and controls go on by Heun's rule under currents and speed at both ends: the
error falls with the square of T_s. V is the mean over a tick, which e'', R and X'' give, and the
torque of a turbine with a governor its value in the middle, extrapolated.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from gfm_plant.circuit import Branch
from gfm_plant.components.controls import (
    EXCITERS,
    GOVERNORS,
    MOST_NUMBERS,
    OF_EXCITER,
    OF_GOVERNOR,
    OF_STABILISER,
    STABILISERS,
    AnyExciter,
    AnyGovernor,
    AnyStabiliser,
    excite,
    govern,
    stabilise,
)
from gfm_plant.components.controls.control import Control, Shaft, Terminals, parabola
from gfm_plant.components.machine import SPEED, Rotating
from gfm_plant.components.part import LinearPart, Matrix, emf
from gfm_plant.components.swing import (
    KEPT,
    lead,
    pack_swing,
    record_speed,
    slopes,
    swing,
    swing_at_rest,
    swing_matrix,
)
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import drive, state
from gfm_plant.steady_state import NoEquilibrium
from gfm_runtime.compiled import compiled

E_Q, E_D, PSI_KD, PSI_KQ = range(4)
"""The states of the rotor, before those of the controls."""
AVR = 4
GOVERNOR = AVR + OF_EXCITER
PSS = GOVERNOR + OF_GOVERNOR
N_STATES = PSS + OF_STABILISER
ROLES = {"avr": (AVR, EXCITERS), "governor": (GOVERNOR, GOVERNORS), "pss": (PSS, STABILISERS)}
"""Of each control the place of its first state, and its kinds."""
_LAG = 10.0  # shortest time constant, in sampling periods
_NUDGE = 1e-6  # of a derivative by differences


@compiled
def _flux(one: Any, x: Any) -> complex:
    """Return psi'' by the states x, or its d/dt by theirs."""
    return complex(
        one.a_d * x[E_Q] + (1.0 - one.a_d) * x[PSI_KD],
        -one.a_q * x[E_D] + (1.0 - one.a_q) * x[PSI_KQ],
    )


@compiled
def _iron(one: Any, x: Any, psi: complex) -> complex:
    """Return the flux by which the iron saturates, and which its saturation weakens."""
    return complex(x[E_Q], 0.0) if one.by_E_q1 != 0 else psi


@compiled
def _saturation(one: Any, psi: complex) -> float:
    """Return S at a flux of the iron."""
    size = math.sqrt(psi.real * psi.real + psi.imag * psi.imag)
    if size <= one.s_a:
        return 0.0
    S: float = one.s_b * (size - one.s_a) ** 2 / size
    return S


@compiled
def _windings(one: Any, x: Any, E_fd: float, i: complex, iron: complex, S: float, out: Any) -> None:
    """Write d/dt of the rotor's states, 1/s, at a current i, a flux of the iron and its S."""
    g_d = x[PSI_KD] + one.X_dl * i.real - x[E_Q]
    g_q = x[PSI_KQ] + one.X_ql * i.imag + x[E_D]
    out[E_Q] = (E_fd - x[E_Q] - one.X_dd * (i.real - one.k_d * g_d) - S * iron.real) / one.T_d10
    out[E_D] = (-x[E_D] + one.X_qq * (i.imag - one.k_q * g_q) + S * one.s_q * iron.imag) / one.T_q10
    out[PSI_KD], out[PSI_KQ] = -g_d / one.T_d20, -g_q / one.T_q20


@compiled
def _terminals(
    one: Any, x: Any, V: float, w: float, i: complex, psi: complex, iron: complex, S: float
) -> Terminals:
    """Return what the exciter sees, at a flux psi'', a flux of the iron and its S."""
    g_d = x[PSI_KD] + one.X_dl * i.real - x[E_Q]
    I_fd = x[E_Q] + one.X_dd * (i.real - one.k_d * g_d) + S * iron.real  # as in d/dt of E_q'
    v = 1j * (1.0 + w) * psi - complex(one.R, (1.0 + w) * one.X_2) * i
    return Terminals(V, I_fd, v, i)


@compiled
def _shaft(one: Any, w: float, i: complex, psi: complex) -> Shaft:
    """Return what the governor sees, at a flux psi''."""
    torque = psi.real * i.imag - psi.imag * i.real
    return Shaft(w, (1.0 + w) * torque - one.R * (i.real * i.real + i.imag * i.imag))


@compiled
def _rates(one: Any, x: Any, V: float, w: float, i: complex, out: Any) -> float:
    """Write d/dt of the states x, (N_STATES,), 1/s, at a terminal voltage of size V, a speed of
    1 + w and a current i; returns the torque of the turbine, if it has a governor."""
    V_s = stabilise(one.pss, one.pss_p, x, PSS, w, one.pss_set, out)
    psi = _flux(one, x)
    iron = _iron(one, x, psi)
    S = _saturation(one, iron)
    seen = _terminals(one, x, V, w, i, psi, iron, S)
    E_fd = excite(one.avr, one.avr_p, x, AVR, seen, one.avr_set + V_s, out)
    _windings(one, x, E_fd, i, iron, S, out)
    shaft = _shaft(one, w, i, psi)
    turbine: float = govern(one.governor, one.governor_p, x, GOVERNOR, shaft, one.governor_set, out)
    return turbine


@compiled
def _torque(psi: complex, unit: complex, i: complex) -> float:
    """Return the torque of a current i in the common frame, in which the d axis is at ``unit``."""
    own = i * unit.conjugate()
    return psi.real * own.imag - psi.imag * own.real


@compiled
def _drive(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    drive(n, now, c, part, one.source, one.E_middle, one.omega_middle)


@compiled
def _begin(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Take from its energy, by Simpson's rule, as at the end of a piece; keep the current at the
    beginning of a tick, which may be another one than at the end of the last if a breaker moved."""
    if one.begins != 0:
        one.i_begin = field(now, "w")[one.sees] * field(now, "unit")[one.source].conjugate()
        one.begins = 0
    _end(n, now, one, c, part)


@compiled
def _middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    torque = _torque(one.psi_middle, field(now, "halfway")[one.source], state(n, now, c, one.sees))
    one.energy -= 4.0 * field(n, "half_h")[part] / 3.0 * torque


@compiled
def _end(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    torque = _torque(one.psi_middle, field(now, "unit")[one.source], field(now, "w")[one.sees])
    one.energy -= field(n, "half_h")[part] / 3.0 * torque


@compiled
def _tick(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    unit, i = field(now, "unit")[one.source], field(now, "w")[one.sees]
    first = one.i_begin * (1.0 / one.S)
    last = i * unit.conjugate() * (1.0 / one.S)
    v = one.E_middle - complex(one.R, one.omega_middle * one.X_2) * (0.5 * (first + last))
    v -= (last - first) * (one.X_2 / (n.omega_b * n.T_s))
    V = math.sqrt(v.real * v.real + v.imag * v.imag)
    w_first = one.omega - 1.0
    w = swing(one, n.T_s, w_first)
    one.omega = 1.0 + w
    _rates(one, one.x, V, w_first, first, one.rate)
    for k in range(N_STATES):
        one.guess[k] = one.x[k] + n.T_s * one.rate[k]
    _rates(one, one.guess, V, w, last, one.guess_rate)
    for k in range(N_STATES):
        one.x[k] += 0.5 * n.T_s * (one.rate[k] + one.guess_rate[k])
    for k in range(AVR, N_STATES):
        one.x[k] = min(max(one.x[k], one.least[k]), one.most[k])
    turbine = _rates(one, one.x, V, w, last, one.rate)
    if one.governor > 0:
        one.P_turbine = turbine
    psi = _flux(one, one.x)
    one.slope, _ = slopes(one, w, one.P_turbine, -_torque(psi, unit, i) / one.S)
    psi_slope = _flux(one, one.rate)
    bend = (psi_slope - one.psi_slope) * (1.0 / n.T_s)
    one.psi_slope = psi_slope
    one.E = 1j * one.omega * psi + psi_slope * (1.0 / n.omega_b)
    E_slope = 1j * (one.omega * psi_slope + one.slope * psi) + bend * (1.0 / n.omega_b)
    one.E_middle = one.E + 0.5 * n.T_s * E_slope
    one.psi_middle = psi + 0.5 * n.T_s * psi_slope
    one.omega_middle = one.omega + 0.5 * n.T_s * one.slope
    if one.governor > 0:
        one.P_turbine += 0.5 * (turbine - one.turbine)
        one.turbine = turbine
    one.begins = 1
    field(now, "emf")[one.source] = one.E
    lead(now, one)


@compiled
def _at_rest(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    torque = _torque(one.psi_middle, field(now, "unit")[one.source], field(now, "w")[one.sees])
    swing_at_rest(one, one.omega - 1.0, -torque)
    one.turbine = one.P_turbine
    one.slope = 0.0


class SynchronousMachine(Rotating):
    """A synchronous machine with transient and subtransient reactances and its controls: field and
    damper windings of order 6, the subtransient reactance the same in both axes. The defaults are
    those of the machines of Kundur's two areas (Power System Stability and Control, example 12.6),
    without their saturation."""

    title: ClassVar = "Synchronous machine of order 6"
    example: ClassVar = {
        "synchronous_machines": {"x": {"node": "bus", "S": 1.0, "H": 3.0, "P": 0.2, "avr": {}}}
    }
    more_states: ClassVar = (
        *Rotating.more_states,
        ("E_q', E_d', ψ_kd, ψ_kq", "p.u. of its rating", "of field and damper windings"),
        *(
            (f"{name} of {kind.kind()}", unit, meaning)
            for _, kinds in ROLES.values()
            for kind in kinds
            for name, unit, meaning in kind.states
        ),
    )
    unknowns: ClassVar = 4  # its current, p.u. of its rating, and the voltage at its terminals
    record: ClassVar = np.dtype(
        [
            *SPEED,
            # X_dd is X_d - X_d', X_dl is X_d' - X_l, and so for q; k and a as in the equations
            *((name, "f8") for name in ("X_dd", "X_qq", "X_dl", "X_ql", "k_d", "k_q", "a_d")),
            *((name, "f8") for name in ("a_q", "X_2", "R", "T_d10", "T_q10", "T_d20", "T_q20")),
            # saturation: from which flux on, of the parabola, and its share in the q axis
            *((name, "f8") for name in ("s_a", "s_b", "s_q")),
            ("by_E_q1", "i8"),
            # of each control: its kind, 0 if there is none, and its numbers
            *((role, "i8") for role in ROLES),
            *((f"{role}_p", "f8", (MOST_NUMBERS,)) for role in ROLES),
            *((f"{role}_set", "f8") for role in ROLES),  # what is asked; without avr E_fd
            # with a governor, torque of the turbine at the tick; P_turbine is that half a tick on
            ("turbine", "f8"),
            *((x, "f8", (N_STATES,)) for x in ("x", "rate", "guess", "guess_rate")),
            *((x, "f8", (N_STATES,)) for x in ("least", "most")),  # limits of x
            # e'' and psi'' in the rotor's frame, at the tick and in the middle of the one to come
            ("E", "c16"), ("E_middle", "c16"), ("psi_middle", "c16"), ("psi_slope", "c16"),
            ("omega_middle", "f8"),
            ("i_begin", "c16"),  # p.u. of the network, at the beginning of the tick
            ("begins", "i8"),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "at_rest": _at_rest, "begin": _begin, "drive": _drive, "middle": _middle, "end": _end,
        "tick": _tick, "flow": record_speed, **KEPT,
    }  # fmt: skip

    V: Positive = Field(1.0, description="voltage of its node at the start, p.u.")
    X_d: Positive = Field(1.8, description="synchronous reactance X_d, p.u. of its rating")
    X_q: Positive = Field(1.7, description="synchronous reactance X_q, p.u.")
    X_d1: Positive = Field(0.3, description="transient reactance X_d', p.u.")
    X_q1: Positive = Field(0.55, description="transient reactance X_q', p.u.")
    X_2: Positive = Field(0.25, description="subtransient reactance X'' of both axes, p.u.")
    X_l: NonNegative = Field(0.2, description="leakage reactance, p.u.")
    R: NonNegative = Field(0.0025, description="resistance of the stator, p.u.")
    T_d10: Positive = Field(8.0, description="open-circuit transient time constant T_d0', s")
    T_q10: Positive = Field(0.4, description="open-circuit transient time constant T_q0', s")
    T_d20: Positive = Field(0.03, description="open-circuit subtransient time constant T_d0'', s")
    T_q20: Positive = Field(0.05, description="open-circuit subtransient time constant T_q0'', s")
    S_10: NonNegative = Field(0.0, description="saturation S(1.0), at a flux of 1 p.u.")
    S_12: NonNegative = Field(0.0, description="saturation S(1.2), at 1.2 p.u.; 0: none at all")
    saturates_by: Literal["psi_2", "E_q1"] = Field(
        "psi_2", description="psi'', in both axes as of GENROU, or E_q', as of GENSAL"
    )
    avr: AnyExciter | None = Field(
        None, description="voltage regulator with its exciter; E_fd is constant if none"
    )
    governor: AnyGovernor | None = Field(
        None, description="governor with its turbine, in place of droop and T_gov"
    )
    pss: AnyStabiliser | None = Field(None, description="stabiliser; it needs an avr")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for axis in "dq":
            names = "X_l", "X_2", f"X_{axis}1", f"X_{axis}"
            least = 0.0
            for name in names:
                value = getattr(self, name)
                if value < least or (name == f"X_{axis}1" and value <= self.X_l):
                    raise ValueError(
                        f"{name} = {value:g}: must be above that before it in {' <= '.join(names)}"
                    )
                least = value
        return self

    @model_validator(mode="after")
    def _saturates(self) -> Self:
        # from S_12 / 1.2 on, the parabola begins at a flux of 0 or below, and S has no bound there
        most = self.S_12 / 1.2
        if self.S_10 > 0.0 and most <= self.S_10:
            raise ValueError(
                f"S_10 = {self.S_10:g}: must be less than S_12 / 1.2 = {most:g} (S_12 ="
                f" {self.S_12:g}), or the iron would saturate without a flux"
            )
        return self

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if self.pss is not None and self.avr is None:
            raise ValueError("pss: acts on a voltage regulator; give the machine an avr, too")
        for name in ("droop", "T_gov"):
            value = getattr(self, name)
            if self.governor is not None and value != type(self).model_fields[name].default:
                raise ValueError(f"{name} = {value:g}: leave it out, the governor has its own")
        return self

    def _parabola(self) -> tuple[float, float]:
        """From which flux on its iron saturates, and how much."""
        a, b = parabola(1.0, self.S_10, 1.2, self.S_12)
        return (a if b > 0.0 else math.inf), b

    def _controls(self) -> Iterator[tuple[str, int, Control]]:
        """Role and first state of each control that it has."""
        for role, (at, _) in ROLES.items():
            if (one := getattr(self, role)) is not None:
                yield role, at, one

    def elements(self, name: str) -> tuple[Branch]:
        return (Branch(name, emf(name), self.node, self.X_2 / self.S, self.R / self.S),)

    def label(self) -> str:
        kinds = [f", {one.kind()}" for *_, one in self._controls()]
        return f"S {self.S:.4g}, H {self.H:g} s, X'' {self.X_2:.4g}{''.join(kinds)}"

    def asked(self, omega: float) -> float:
        if self.governor is None:
            return super().asked(omega)
        return float(self.P - (omega - 1.0) * (self.governor.per_speed() + self.D))

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        pack_swing(self, record, self.X_2 / self.S, where, T_s, omega_b)
        for name in ("X_2", "R", "T_d10", "T_q10", "T_d20", "T_q20"):
            record[name] = getattr(self, name)
        record["least"], record["most"] = -np.inf, np.inf
        lags = [(name, getattr(self, name)) for name in ("T_d10", "T_q10", "T_d20", "T_q20")]
        for role, at, one in self._controls():
            lags += [(f"{role}.{name}", lag) for name, lag in one.lags().items()]
            record[role] = 1 + ROLES[role][1].index(type(one))
            numbers = one.numbers()
            record[f"{role}_p"][: len(numbers)] = numbers
            for place, ends in one.limits().items():
                record["least"][at + place], record["most"][at + place] = ends
        for name, lag in lags:
            if lag < _LAG * T_s:
                raise ValueError(
                    f"{where}: {name} = {lag:g}: must be >= {_LAG * T_s:g} s at this T_s"
                )
        if self.governor is not None:  # its turbine does not move within a tick
            record["droop"] = record["T_gov"] = np.inf
        for axis in "dq":
            X, X_1 = getattr(self, f"X_{axis}"), getattr(self, f"X_{axis}1")
            record[f"X_{axis}{axis}"], record[f"X_{axis}l"] = X - X_1, X_1 - self.X_l
            record[f"a_{axis}"] = (self.X_2 - self.X_l) / (X_1 - self.X_l)
            record[f"k_{axis}"] = (X_1 - self.X_2) / (X_1 - self.X_l) ** 2
        record["s_a"], record["s_b"] = self._parabola()
        record["s_q"] = (self.X_q - self.X_l) / (self.X_d - self.X_l)
        record["by_E_q1"] = self.saturates_by == "E_q1"
        record["P_set"], record["begins"] = self.P, 1

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        i, terminal = complex(*z[:2]), v - complex(*z[2:])
        torque = ((v + self.R * i) * i.conjugate()).real / omega
        return self.S * i, [
            abs(v) - self.V, torque - self.asked(omega), terminal.real, terminal.imag
        ]  # fmt: skip

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        i, v = complex(*z[:2]), complex(*z[2:])
        iron = SimpleNamespace(**dict(zip(("s_a", "s_b"), self._parabola(), strict=True)))
        S = _saturation.py_func(iron, (v + complex(self.R, omega * self.X_2) * i) / omega)
        S_q = 0.0 if record["by_E_q1"] else S * float(record["s_q"])
        X_q = self.X_q - (self.X_q - self.X_2) * S_q / (1.0 + S_q)
        q_axis = v + complex(self.R, omega * X_q) * i
        unit = -1j * q_axis / abs(q_axis)
        i_d, i_q = (own := i * unit.conjugate()).real, own.imag
        E = (v * unit.conjugate() + self.R * own).imag / omega + self.X_d * i_d
        E_q, E_d = E - (self.X_d - self.X_d1) * i_d, (X_q - self.X_q1) * i_q
        E_fd = E + S * (E - (self.X_d - self.X_2) * i_d)
        if record["by_E_q1"]:
            E_fd = E + _saturation.py_func(iron, complex(E_q, 0.0)) * E_q
        psi_kd = E_q - (self.X_d1 - self.X_l) * i_d
        psi_kq = -E_d - (self.X_q1 - self.X_l) * i_q
        torque = ((v + self.R * i) * i.conjugate()).real / omega + self.D * (omega - 1.0)
        record["x"], record["avr_set"] = 0.0, E_fd
        record["x"][:AVR] = E_q, E_d, psi_kd, psi_kq
        seen: Mapping[str, tuple[float, Any]] = {
            "avr": (E_fd, Terminals(abs(v), E_fd, v * unit.conjugate(), own)),
            "governor": (torque, Shaft(omega - 1.0, (v * i.conjugate()).real)),
            "pss": (0.0, omega - 1.0),
        }
        for role, at, one in self._controls():
            states, record[f"{role}_set"] = one.rest(*seen[role])
            record["x"][at : at + len(states)] = states
            self._check_limits(role, one, states, seen[role][1])
        psi = complex(E_q - (self.X_d1 - self.X_2) * i_d, -E_d - (self.X_q1 - self.X_2) * i_q)
        record["psi_middle"], record["psi_slope"] = psi, 0j
        record["omega"] = record["omega_middle"] = omega
        record["E"] = record["E_middle"] = 1j * omega * psi
        return complex(record["E"]) * unit

    def _check_limits(self, role: str, one: Control, states: Sequence[float], seen: Any) -> None:
        for place, (least, most) in one.limits_at(seen).items():
            if not least < states[place] < most:
                name = one.states[place][0]
                raise NoEquilibrium(
                    f"the machine at {self.node}: its {role}, {one.kind()}, needs {name} ="
                    f" {states[place]:.4g} p.u. at the start; its limits are {least:g} and {most:g}"
                )

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        """By differences of the equations above.

        What the regulator measures has the d/dt of the current in it. The state that stands for it
        here is V_m and what that current brings, so that none is left.
        """
        one = SimpleNamespace(**{name: record[name] for name in record.dtype.names})
        unit = source / complex(one.E)
        own, per_power = swing_matrix(self.H, self.D, self.droop, self.T_gov, 1.0)
        resting = seen * unit.conjugate() / self.S
        terminal = complex(one.E) - complex(self.R, one.omega * self.X_2) * resting
        ahead = terminal * (self.X_2 / (omega_b * abs(terminal)))
        if self.governor is not None:
            own[1] = 0.0
        n = 3 + N_STATES  # angle, speed, power of the turbine without a governor, x

        def moved(nudge: Matrix) -> Matrix:
            """d/dt of the states (n,), and the source (2,), after a nudge of the states and of what
            it sees, (n + 2,)."""
            rotor = unit * np.exp(1j * nudge[0])
            i = (seen + complex(*nudge[n:])) * rotor.conjugate() / self.S
            w, x, rate = one.omega - 1.0 + nudge[1], one.x + nudge[3:n], np.zeros(N_STATES)
            if self.avr is not None:
                x[AVR] -= (ahead.conjugate() * (i - resting)).real / self.avr.T_R
            self._rates(one, x, abs(terminal), w, i, rate)  # only V_m and limits depend on V
            psi = _flux.py_func(one, x)
            E = 1j * (1.0 + w) * psi + _flux.py_func(one, rate) / omega_b
            V = abs(E - complex(self.R, (1.0 + w) * self.X_2) * i)
            turbine = self._rates(one, x, V, w, i, rate)
            change = nudge[2] if self.governor is None else turbine - one.turbine
            torque = _torque.py_func(psi, 1.0, i)
            swung = own @ [nudge[1], change] - np.array([per_power * torque, 0.0])
            at = E * rotor
            return np.array([omega_b * nudge[1], *swung, *rate, at.real, at.imag])

        found = np.stack(
            [(moved(x) - moved(-x)) / (2 * _NUDGE) for x in _NUDGE * np.eye(n + 2)], axis=1
        )
        # without what nothing else moves, as E_d' of salient poles
        kept = [k for k in range(n) if np.delete(found[k], k).any()]
        turn = np.zeros(len(kept))
        turn[0] = 1.0
        A, by_seen = found[np.ix_(kept, kept)], found[kept, n:]
        return LinearPart(A, by_seen, found[n:, kept], turn, found[n:, n:])

    def _rates(self, one: Any, x: Matrix, V: float, w: float, i: complex, out: Matrix) -> float:
        """As the compiled ``_rates``, of these controls."""

        def output(role: str, seen: Any, asked: float) -> float:
            if (control := getattr(self, role)) is None:
                return asked
            numbers, at = getattr(one, f"{role}_p"), ROLES[role][0]
            found: float = type(control).rates.py_func(numbers, x, at, seen, asked, out)
            return found

        V_s = output("pss", w, one.pss_set)
        psi = _flux.py_func(one, x)
        iron = _iron.py_func(one, x, psi)
        S = _saturation.py_func(one, iron)
        seen = _terminals.py_func(one, x, V, w, i, psi, iron, S)
        _windings.py_func(one, x, output("avr", seen, one.avr_set + V_s), i, iron, S, out)
        return output("governor", _shaft.py_func(one, w, i, psi), one.governor_set)
