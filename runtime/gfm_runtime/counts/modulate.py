"""From a law's voltage and speed to the compare counts of three legs.

The voltage e of the controller's frame is turned ahead to the middle of the time in which the
counts act, divided by v_dc, and given to the legs by a modulator; what dead time takes is added,
and pulses that are too short are left out or made longer. Then the frame turns on to the next tick.

Sources: Holmes and Lipo, Pulse Width Modulation for Power Converters, 2003, for the modulators;
Choi and Sul, IEEE Trans. Power Electron. 11(5), 1996, for the compensation of dead time.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import Field

from gfm_runtime.compiled import inlined
from gfm_runtime.counts.measure import I_A, turn
from gfm_runtime.errors import LawError
from gfm_runtime.inner.stage import V_DC
from gfm_runtime.signals import N_LEGS, Y_I_D, Y_I_Q
from gfm_runtime.toml_file import TomlTable

MODULATORS = {"space-vector": 0, "sine": 1, "third-harmonic": 2, "discontinuous": 3}
COMPENSATIONS = {"none": 0, "sign": 1, "predicted": 2}
_SPACE_VECTOR, _SINE, _THIRD = 0, 1, 2
_MOST_COUNTS, _LEAST_COUNTS = 65535, 50
_PREDICTED = 2


class Modulate(TomlTable):
    """The modulator of the firmware, and its timer."""

    kind: Literal["space-vector", "sine", "third-harmonic", "discontinuous"] = Field(
        "space-vector", description="what is added to all three legs"
    )
    over: Literal["cut", "scale"] = Field(
        "cut",
        description="beyond what v_dc gives: cut each leg, up to six steps, or scale the voltage "
        "and keep its angle",
    )
    timer_hz: float = Field(200e6, gt=0, le=1e12, description="clock that the carrier counts")
    carriers: Literal[1, 2] = Field(1, description="periods of the carrier in a sampling time")
    advance: float = Field(
        1.5,
        ge=0,
        le=6,
        description="sampling times from the sample to the middle of the time in which the counts "
        "act: the loop's delay and a half",
    )
    v_dc: Literal["measured", "nominal"] = Field(
        "measured", description="what the voltage is divided by"
    )
    V_ratio: float = Field(
        700.0 / 380.0, gt=0, le=100, description="V_dcref over the line-to-line RMS voltage V_n"
    )
    dead_time_s: float = Field(0.0, ge=0, description="that the legs have, s")
    compensate: Literal["none", "sign", "predicted"] = Field(
        "none",
        description="dead time, by the sign of the currents as sampled, or as they will be when "
        "the counts act, at each edge with its ripple",
    )
    L_f: float = Field(
        0.0174, gt=0, le=100, description="the converter's filter inductor, p.u., for the ripple"
    )
    band: float = Field(
        0.05, gt=0, le=10, description="within which the compensation goes with the current, p.u."
    )
    min_pulse_s: float = Field(
        0.0, ge=0, description="shorter pulses are left out or made as long, whichever is nearer, s"
    )

    def top(self, T_s: float) -> int:
        """Counts in half a period of the carrier, for a sampling time of T_s [s].

        Raises:
            LawError: what does not fit the timer or the period, one line each.
        """
        period = T_s / self.carriers
        counts = self.timer_hz * period / 2
        if abs(counts - round(counts)) > 1e-6 * max(counts, 1.0):
            raise LawError(
                "modulate.timer_hz",
                f"{self.timer_hz:g}: must be a multiple of {2 / period:g} Hz, so that half a "
                "period of the carrier is a whole number of counts",
            )
        if not _LEAST_COUNTS <= counts <= _MOST_COUNTS:
            what = "too coarse" if counts < _LEAST_COUNTS else "more than 16 bits hold"
            low, high = (n * 2 / period for n in (_LEAST_COUNTS, _MOST_COUNTS))
            raise LawError(
                "modulate.timer_hz",
                f"{self.timer_hz:g}: {what}, {counts:g} counts in half a period of the carrier; "
                f"must be {low:g} to {high:g} Hz",
            )
        for name, most, of in (("dead_time_s", period / 2, "half a"), ("min_pulse_s", period, "a")):
            if not (value := getattr(self, name)) < most:
                raise LawError(
                    f"modulate.{name}",
                    f"{value:g}: must be less than {most:g} s, {of} period of the carrier",
                )
        return round(counts)

    def constants(self, T_s: float, omega_b: float) -> dict[str, Any]:
        """The constants in ``law_dtype``, by name.

        Args:
            T_s: sampling time, s.
            omega_b: base frequency of the converter, rad/s.

        Raises:
            LawError: as ``top``.
        """
        top, period = self.top(T_s), T_s / self.carriers
        return {
            "modulator": MODULATORS[self.kind],
            "scales": int(self.over == "scale"),
            "compensate": COMPENSATIONS[self.compensate],
            "turn": omega_b * T_s,
            "turn_ahead": omega_b * T_s * self.advance,
            "per_leg": 1 / (1.5 * math.sqrt(2 / 3) * self.V_ratio),
            "feed": int(self.v_dc == "measured"),
            "top": float(top),
            "dead": self.dead_time_s / period,
            "half_dead": self.dead_time_s / period / 2,
            "ripple": omega_b / self.L_f * period / 2 * 1.5 * math.sqrt(2 / 3) * self.V_ratio,
            "per_band": 1 / self.band,
            "least": round(self.min_pulse_s / 2 * self.timer_hz) / top,
        }


@inlined
def modulate(law, state):
    """Compare counts of this tick, each and a half: state.compare; and the frame's next angle.
    Until the end they are shares of the period.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``, after ``measure`` and the outputs
            of law and stage.
    """
    along, across = turn(law, law.turn_ahead * state.omega)
    cosine = state.angle[0] * along - state.angle[1] * across
    sine = state.angle[0] * across + state.angle[1] * along
    scale = law.per_leg
    if law.feed != 0:
        v_dc = max(state.m[V_DC], law.least_v)
        scale = law.per_leg / v_dc
    _to_legs(law, state, state.e_now[0] * scale, state.e_now[1] * scale, cosine, sine)
    for x in range(N_LEGS):
        state.compare[x] = state.legs[x]
    _add_common(law, state)
    if law.compensate != 0 and law.dead > 0:
        if law.compensate == _PREDICTED:
            _to_legs(law, state, state.sensed[Y_I_D], state.sensed[Y_I_Q], cosine, sine)
            _find_ripple(law, state)
        for x in range(N_LEGS):
            _add_dead_time(law, state, x)
    for x in range(N_LEGS):
        state.compare[x] = _pulse(law, state.compare[x]) * law.top + law.half
    _go_on(law, state)


@inlined
def _to_legs(law, state, d, q, cosine, sine):
    """What a vector of the turned frame has along the axes of the legs: state.legs."""
    alpha, beta = d * cosine - q * sine, d * sine + q * cosine
    along, across = law.half * alpha, law.half_root_3 * beta
    state.legs[0], state.legs[1], state.legs[2] = alpha, across - along, -across - along


@inlined
def _add_common(law, state):
    """From shares of v_dc around its middle to shares of the period: state.compare."""
    a, b, c = state.compare[0], state.compare[1], state.compare[2]
    above, below = max(a, b), min(a, b)
    above, below = max(above, c), min(below, c)
    span = above - below
    if law.scales != 0 and span > law.one:
        a, b, c = a / span, b / span, c / span
        above, below = above / span, below / span
    common = law.half
    if law.modulator == _SPACE_VECTOR:
        common = law.half - law.half * (above + below)
    elif law.modulator == _THIRD:
        size = a * a + b * b + c * c  # 3/2 of the amplitude's square
        if size > 0:
            common = law.half - a * b * c / size
    elif law.modulator != _SINE:
        common = law.one - above
        if above + below < 0:
            common = -below
    state.compare[0] = _share(law, a + common)
    state.compare[1] = _share(law, b + common)
    state.compare[2] = _share(law, c + common)


@inlined
def _share(law, value):
    """The value, or 0 or 1."""
    value = max(value, law.zero)
    return min(value, law.one)


@inlined
def _find_ripple(law, state):
    """The ripple of each leg's current at its edge down, p.u.: state.edges; at that up it is the
    opposite."""
    a, b, c = state.compare[0], state.compare[1], state.compare[2]
    scale, mean = law.ripple * state.m[V_DC], (a + b + c) * law.per_3
    ab, bc, ca = min(a, b), min(b, c), min(c, a)
    state.edges[0] = scale * _share_ahead(law, a, ab, ca, mean)
    state.edges[1] = scale * _share_ahead(law, b, bc, ab, mean)
    state.edges[2] = scale * _share_ahead(law, c, ca, bc, mean)


@inlined
def _share_ahead(law, on, with_one, with_other, mean):
    """Of v_dc and the period, by how much a leg is ahead of its average at its edge down. Until
    then it has had all of v_dc, and the mean of all legs what was on of them; on average it gets
    what its compare value says."""
    return on - (on + with_one + with_other) * law.per_3 - on * (on - mean)


@inlined
def _add_dead_time(law, state, x):
    """What dead time takes from leg x at its two edges, put back."""
    if law.compensate == _PREDICTED:
        down = _within(law, (state.legs[x] + state.edges[x]) * law.per_band)
        up = _within(law, (state.legs[x] - state.edges[x]) * law.per_band)
        state.compare[x] += law.half_dead * (down + up)
    else:
        state.compare[x] += law.dead * _within(law, state.phases[I_A + x] * law.per_band)
    state.compare[x] = _share(law, state.compare[x])


@inlined
def _within(law, value):
    """The value, or -1 or 1."""
    low = -law.one
    value = max(value, low)
    return min(value, law.one)


@inlined
def _pulse(law, on):
    """A share of the period, of which neither what is on nor what is off is too short."""
    if law.least > 0:
        off = law.one - on
        if on < law.least:
            on = law.least if on + on > law.least else law.zero
        elif off < law.least:
            on = law.one - law.least if off + off > law.least else law.one
    return on


@inlined
def _go_on(law, state):
    """Turn the frame on to the next tick."""
    state.speed = state.omega
    along, across = turn(law, law.turn * state.omega)
    cosine = state.angle[0] * along - state.angle[1] * across
    sine = state.angle[0] * across + state.angle[1] * along
    # takes the rounding out of its length
    length = law.three_halves - law.half * (cosine * cosine + sine * sine)
    state.angle[0], state.angle[1] = cosine * length, sine * length
