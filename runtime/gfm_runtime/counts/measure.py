"""From the counts of an A/D at the phases to the measurements y of a law.

Offset, known or found at the start, and scale of each channel, whose count may be the sum of
several conversions in the last sampling time; Clarke's amplitude-invariant transform; Park's, by
the angle of the controller's own frame; then p, q and V at the filter capacitor, Eq. (9)-(11), and
a low-pass.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from gfm_runtime.compiled import inlined
from gfm_runtime.errors import LawError
from gfm_runtime.signals import (
    CHANNELS,
    COUNT_BITS,
    FULL_SCALES,
    MOST_SAMPLES,
    N_ADC,
    N_LEGS,
    Y_I_D,
    Y_I_OD,
    Y_I_OQ,
    Y_OMEGA,
    Y_P,
    Y_Q,
    Y_V,
    Y_V_D,
    Y_V_DC,
    Y_V_Q,
    Channel,
    quantity,
)
from gfm_runtime.toml_file import TomlTable

I_A, V_A, I_O_A = 1, 4, 7
"""Where the phases of each quantity begin."""

_IN_TURN = 3  # each tick looks for faults of the sensors of one of the three quantities

_STILL_ABOVE = 0.1  # p.u.


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise PydanticCustomError("ascending", "must be [lo, hi], ascending")
    return value


FullScale = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ascending)]


class Measure(TomlTable):
    """What the firmware takes its sensors and its A/D for; p.u. of a phase's nominal peak value."""

    bits: int = Field(12, ge=8, le=16, description="of the A/D")
    samples: int = Field(
        1,
        ge=1,
        le=MOST_SAMPLES,
        description="conversions of each channel in a sampling time, evenly apart, the last at the "
        "tick; a count is their sum, and the law takes their mean",
    )
    v_dc: FullScale = Field(
        FULL_SCALES["v_dc"], description="full scale [lo, hi] of the DC voltage, p.u."
    )
    i: FullScale = Field(FULL_SCALES["i"], description="full scale of the currents of L_f, p.u.")
    v: FullScale = Field(FULL_SCALES["v"], description="full scale of the voltages of C_f, p.u.")
    i_o: FullScale = Field(
        FULL_SCALES["i_o"], description="full scale of the currents of the line, p.u."
    )
    offset: dict[Channel, float] = Field(
        {}, description="that a channel is known to have, p.u.; it is taken off"
    )
    gain: dict[Channel, float] = Field(
        {}, description="that a channel is known to have; it is divided by"
    )
    calibrate: int = Field(
        0,
        ge=0,
        le=65536,
        description="counts without current from which the start takes the offsets of the sensors "
        "of i and i_o; 0: none",
    )
    offset_most: float = Field(
        0.1, gt=0, le=100, description="largest offset so found, p.u.; more: SAFE"
    )
    phases: Literal[2, 3] = Field(
        3, description="currents of i and i_o with a sensor; with 2 the third is their negative sum"
    )
    sum_most: float = Field(
        0.2,
        gt=0,
        le=100,
        description="largest sum of the three phases of a quantity, p.u.; more, for sum_s: SAFE",
    )
    sum_s: float = Field(0.002, ge=0, le=10, description="how long, s")
    still_s: float = Field(
        0.015,
        ge=0,
        le=10,
        description="how long a phase may read the same while its quantity is above 0.1 p.u., and "
        "v_dc an end of its range, s; then SAFE",
    )
    f_y: float = Field(0.0, ge=0, description="low-pass on v_dc, p, q and V, Hz; 0: none")

    def constants(self, T_s: float, omega_b: float) -> dict[str, Any]:
        """The constants in ``law_dtype``, by name; T_s in s, omega_b in rad/s.

        Raises:
            LawError: a sum of ``samples`` conversions does not fit 16 bits.
        """
        if self.samples << self.bits > 1 << COUNT_BITS:
            raise LawError(
                "measure.samples",
                f"{self.samples}: their sum must fit {COUNT_BITS} bits, so with bits = {self.bits} "
                f"at most {1 << COUNT_BITS - self.bits}",
            )
        zero, per_count = [], []
        for name in CHANNELS:
            low, high = getattr(self, quantity(name))
            lsb, gain = (high - low) / 2**self.bits, self.gain.get(name, 1.0)
            zero.append(self.samples * ((self.offset.get(name, 0.0) - low) / lsb))
            per_count.append(lsb / gain / self.samples)
        follow = -math.expm1(-2 * math.pi * self.f_y * T_s) if self.f_y > 0 else 1.0
        apart = _IN_TURN * T_s
        return {
            "two": int(self.phases == 2),
            "adc_zero": zero,
            "adc_scale": per_count,
            "adc_top": self.samples * (2.0**self.bits - 1),
            "turn_back": omega_b * T_s * (self.samples - 1) / (2 * self.samples),
            "calibrate": float(self.calibrate),
            "per_calibrate": 1.0 / max(self.calibrate, 1),
            "offset_most": self.offset_most,
            "sum_most": self.sum_most,
            "sum_checks": float(math.ceil(self.sum_s / apart - 1e-6)),
            "still_checks": float(math.ceil(self.still_s / apart - 1e-6)),
            "still_above": 1.5 * _STILL_ABOVE**2,
            "follow_y": follow,
        }


@inlined
def measure(law, state, adc, first):
    """y of this tick from counts: state.sensed; and the channel that is not plausible, or -1:
    state.suspect.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``.
        adc: counts of the channels, from index ``first`` on.
    """
    y = state.sensed
    for j in range(N_ADC):
        state.phases[j] = adc[first + j]  # in the law's own precision
        if law.calibrate > 0 and _of_current(law, j):
            state.phases[j] -= state.shift[j]
        state.phases[j] = (state.phases[j] - law.adc_zero[j]) * law.adc_scale[j]
    if law.two != 0:
        state.phases[I_A + 2] = -state.phases[I_A] - state.phases[I_A + 1]
        state.phases[I_O_A + 2] = -state.phases[I_O_A] - state.phases[I_O_A + 1]
    state.suspect = -1
    state.turn += law.one
    if state.turn >= law.in_turn:
        state.turn = law.zero
    cosine, sine = state.angle[0], state.angle[1]
    if law.turn_back > 0:  # a mean over the last sampling time is that of its middle
        along, across = turn(law, law.turn_back * state.speed)
        cosine = state.angle[0] * along + state.angle[1] * across
        sine = state.angle[1] * along - state.angle[0] * across
    for k in range(_IN_TURN):
        at = I_A + N_LEGS * k
        a, b, c = state.phases[at], state.phases[at + 1], state.phases[at + 2]
        if state.turn == k:
            _check(law, state, adc, first, k)
        y[Y_I_D + 2 * k], y[Y_I_D + 1 + 2 * k] = _park(law, a, b, c, cosine, sine)
    p = y[Y_V_D] * y[Y_I_OD] + y[Y_V_Q] * y[Y_I_OQ]
    q = y[Y_V_Q] * y[Y_I_OD] - y[Y_V_D] * y[Y_I_OQ]
    V = math.sqrt(y[Y_V_D] * y[Y_V_D] + y[Y_V_Q] * y[Y_V_Q])
    y[Y_V_DC] = _smoothed(law, y[Y_V_DC], state.phases[0])
    y[Y_P] = _smoothed(law, y[Y_P], p)
    y[Y_OMEGA] = state.speed
    y[Y_Q] = _smoothed(law, y[Y_Q], q)
    y[Y_V] = _smoothed(law, y[Y_V], V)


@inlined
def _check(law, state, adc, first, k):
    """Look for a channel of quantity k that is not plausible, with v_dc at the first. It is one
    that does not change; or of phases that do not add up one that has not changed meanwhile, else
    the first."""
    at = I_A + N_LEGS * k
    if k == 0:
        at_end = adc[first] <= law.zero or adc[first] >= law.adc_top
        state.still[0] = state.still[0] + law.one if at_end else law.zero
        if state.still[0] > law.still_checks:
            state.suspect = 0
    for x in range(N_LEGS):
        if x < N_LEGS - 1 or k == 1 or law.two == 0:  # else the sensor is not there
            state.still[at + x] += law.one
            if adc[first + at + x] != state.last[at + x]:
                state.still[at + x] = law.zero
            state.last[at + x] = adc[first + at + x]
    a, b, c = state.phases[at], state.phases[at + 1], state.phases[at + 2]
    state.odd[k] += law.one
    if abs(a + b + c) <= law.sum_most:
        state.odd[k] = law.zero
    if state.odd[k] > law.sum_checks and state.suspect < 0:
        state.suspect = at
        for x in range(N_LEGS):
            if state.still[at + x] >= law.sum_checks:
                state.suspect = at + x
    if a * a + b * b + c * c > law.still_above:
        for x in range(N_LEGS):
            if state.still[at + x] >= law.still_checks:
                state.suspect = at + x


@inlined
def _park(law, a, b, c, cosine, sine):
    """The d and q components of three phases."""
    alpha, beta = (a + a - b - c) * law.per_3, (b - c) * law.per_root_3
    return alpha * cosine + beta * sine, beta * cosine - alpha * sine


@inlined
def _smoothed(law, low, value):
    """One tick of the low-pass of v_dc, p, q and V."""
    if law.follow_y < law.one:
        value = low + law.follow_y * (value - low)
    return value


@inlined
def align(law, state, adc, first):
    """Set the frame's angle so that the voltage of these counts has the components that
    state.sensed has; arguments as of ``measure``."""
    for j in range(N_LEGS):
        state.legs[j] = adc[first + V_A + j]
        state.legs[j] = (state.legs[j] - law.adc_zero[V_A + j]) * law.adc_scale[V_A + j]
    a, b, c = state.legs[0], state.legs[1], state.legs[2]
    alpha, beta = (a + a - b - c) * law.per_3, (b - c) * law.per_root_3
    cosine = alpha * state.sensed[Y_V_D] + beta * state.sensed[Y_V_Q]
    sine = beta * state.sensed[Y_V_D] - alpha * state.sensed[Y_V_Q]
    size = math.sqrt(cosine * cosine + sine * sine)
    if size > law.least_v:
        state.angle[0], state.angle[1] = cosine / size, sine / size
        if law.turn_back > 0:
            along, across = turn(law, law.turn_back * state.speed)
            cosine = state.angle[0] * along - state.angle[1] * across
            state.angle[1] = state.angle[0] * across + state.angle[1] * along
            state.angle[0] = cosine


@inlined
def calibrate(law, state, adc, first):
    """Take one of the first ``law.calibrate`` counts, of a bridge without current, into the mean
    from which the sensors of i and i_o measure: state.shift; after the last of them
    state.suspect is a channel whose offset is too large, else -1. Arguments as of ``measure``."""
    state.suspect = -1
    if state.calibrated < law.calibrate:
        state.calibrated += law.one
        for j in range(N_ADC):
            if _of_current(law, j):
                state.phases[j] = adc[first + j]
                state.shift[j] += (state.phases[j] - law.adc_zero[j]) * law.per_calibrate
        if state.calibrated >= law.calibrate:
            for j in range(N_ADC):
                if _of_current(law, j) and abs(state.shift[j] * law.adc_scale[j]) > law.offset_most:
                    state.suspect = j


@inlined
def _of_current(law, j):
    """Whether a channel is one of i or i_o with a sensor."""
    return (j >= I_A and j < V_A - law.two) or (j >= I_O_A and j < N_ADC - law.two)


@inlined
def turn(law, x):
    """The cosine and the sine of a small angle, rad, by their series: to 6e-12 at 0.04, the turn of
    a tick of 100 us; to 1e-6 at 0.3."""
    x2 = x * x
    cosine = law.one - x2 * (law.half - x2 * law.per_24)
    sine = x * (law.one - x2 * (law.per_6 - x2 * law.per_120))
    return cosine, sine
