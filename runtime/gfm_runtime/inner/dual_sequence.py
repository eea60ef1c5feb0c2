"""Dual sequence: the virtual stator for the positive sequence, an impedance of its own for the
negative one, and a limit of each.

Two complex filters tell the sequences of v apart, in the converter's frame, where the positive one
rests and the negative one turns at -2 omega:

    v_p' = w_c (v - v_p - v_n),    v_n' = -2 j omega v_n + w_c (v - v_p - v_n).

In the steady state v_p and v_n are exact. The stator sees v - v_n. The negative sequence has no
voltage behind its impedance: i_n* = -v_n / Z_n, with Z_n = R_n - j omega X_n in this frame, so that
the phasor I2 of the current leads V2 by 90 degrees and atan(R_n/X_n). A resonant term in the
current loop, x_n' = -2 j omega x_n + k_n (i_n* - i_n), has i_n follow in spite of filters and
delays; i_n comes from the current by the same filters.

|i_n*| <= I_n = part_n I_max, and the positive sequence gets I_max - |i_n*|. The peak of each phase
is then at most I_max, whatever the angle between the sequences. The stage does not know where the
phases are in its frame, so that it cannot limit each phase by itself.

Sources: Guo, Wu and Chen, IEEE Trans. Ind. Electron. 58(4), 2011: complex-coefficient filters;
Teodorescu, Liserre and Rodriguez, "Grid Converters for Photovoltaic and Wind Power Systems",
chapters 8 and 9: the same in other forms, resonant control. The sources were not at hand.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import I_D, I_Q, V_D, V_Q, limit_current
from gfm_runtime.inner.virtual_stator import VirtualStator, stator
from gfm_runtime.toml_file import NotNegative, Positive


class DualSequence(VirtualStator):
    """A virtual stator for the positive sequence, an impedance for the negative one."""

    type: Literal["dual-sequence"] = Field("dual-sequence", description="kind of stage")  # type: ignore[assignment]
    R_n: NotNegative = Field(0.06, description="resistance for the negative sequence, p.u.")
    X_n: Positive = Field(0.6, description="reactance for the negative sequence, p.u.")
    part_n: Positive = Field(0.5, description="of I_max, what the negative sequence gets; below 1")
    f_seq: Positive = Field(
        35.0, description="bandwidth with which the sequences are told apart, Hz"
    )
    f_v: Positive = Field(600.0, description="low-pass on v, Hz")
    k_n: NotNegative = Field(3.0, description="resonant term of the current loop, 1/s")

    @model_validator(mode="after")
    def _leaves_room(self) -> DualSequence:
        if isinstance(self.part_n, float) and not self.part_n < 1.0:
            raise ValueError(f"part_n = {self.part_n!r}: must be below 1")
        return self

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        own = {"R_n": self.R_n, "X_n": self.X_n, "I_n": self.part_n * self.I_max}
        follow = -math.expm1(-2 * math.pi * self.f_seq * T_s)
        return (
            super().constants(T_s, omega_b)
            | own
            | {"follow_s": follow, "T_k_n": T_s * self.k_n, "third": 1 / 3}
        )


@inlined
def dual_sequence(law, state, E_d, E_q):
    """One tick: i* of both sequences and the resonant term, between ``follow`` and the current
    loop."""
    m = state.m
    # the negative sequence turns by -2 omega: times (1 - j h) / (1 + j h) with h = tan(omega T)
    h = (state.omega + state.omega) * law.half_turn
    h += h * h * h * law.third
    size = law.one + h * h
    cosine, sine = (law.one - h * h) / size, (h + h) / size
    d, q = state.v_n[0], state.v_n[1]
    n_d, n_q = cosine * d + sine * q, cosine * q - sine * d
    error_d, error_q = m[V_D] - state.v_p[0] - n_d, m[V_Q] - state.v_p[1] - n_q
    state.v_p[0] += law.follow_s * error_d
    state.v_p[1] += law.follow_s * error_q
    state.v_n[0], state.v_n[1] = n_d + law.follow_s * error_d, n_q + law.follow_s * error_q
    d, q = state.i_n[0], state.i_n[1]
    n_d, n_q = cosine * d + sine * q, cosine * q - sine * d
    error_d, error_q = m[I_D] - state.i_p[0] - n_d, m[I_Q] - state.i_p[1] - n_q
    state.i_p[0] += law.follow_s * error_d
    state.i_p[1] += law.follow_s * error_q
    state.i_n[0], state.i_n[1] = n_d + law.follow_s * error_d, n_q + law.follow_s * error_q
    # i_n* = -v_n / (R_n - j X), within I_n
    v_d, v_q = state.v_n[0], state.v_n[1]
    X = state.omega * law.X_n
    size = law.R_n * law.R_n + X * X
    ref_d, ref_q = (X * v_q - law.R_n * v_d) / size, -(X * v_d + law.R_n * v_q) / size
    size = math.sqrt(ref_d * ref_d + ref_q * ref_q)
    full = size > law.I_n
    if full:
        ref_d, ref_q = ref_d * (law.I_n / size), ref_q * (law.I_n / size)
        size = law.I_n
    # the positive sequence in the room that is left
    stator(law, state, E_d + v_d, E_q + v_q)
    room = law.I_max / (law.I_max - size)
    state.i_ref[0] *= room
    state.i_ref[1] *= room
    limit_current(law, state)
    state.i_ref[0], state.i_ref[1] = state.i_ref[0] / room + ref_d, state.i_ref[1] / room + ref_q
    state.limited = state.limited != 0 or full
    d, q = state.x_n[0], state.x_n[1]
    state.x_n[0] = cosine * d + sine * q + law.T_k_n * (ref_d - state.i_n[0])
    state.x_n[1] = cosine * q - sine * d + law.T_k_n * (ref_q - state.i_n[1])
