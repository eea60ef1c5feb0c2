"""Dual sequence: a virtual stator whose impedance is another one for the negative sequence, and a
limit of each sequence.

Two complex filters tell the sequences of x apart, in the converter's frame, where the positive one
rests and the negative one turns at -2 omega:

    x_p' = w_s (x - x_p - x_n),    x_n' = -2 j omega x_n + w_s (x - x_p - x_n).

Balanced quantities at rest have no x_n. With the sequences of its own current i and those of the
law's E, which an unbalance makes ripple, the stator is

    (X_v/omega_b) i' = E - E_n - v - (R_v + j omega X_v) i - (Z_n - Z_v) i_n,

where Z_v = R_v - j omega X_v and Z_n = R_n - j omega X_n are impedances at -2 omega. There
i = -v / Z_n: the phasor I2 of the current leads V2 by 90 degrees and atan(R_n/X_n). With X_n = X_v
only a resistance is taken out, in a narrow band and behind X_v. That leaves the impedance passive,
which no grid makes unstable. A current that follows a filtered v through 1 / Z_n does not: the
grid's reactance passes on its changes, and the loop grows around -2 omega where the grid is weak,
in an island, or at a limit. The offset of a fault's current, which stands at -omega, passes the
filters the less the narrower their band is.

The low-pass on v and the delay let the current loop lag v by some 20 degrees at -2 omega. The
stator knows v there, which is -Z_n i_n, so the stage adds to e what the loop lacks, and takes away
the part of j omega L_f i whose sign is wrong in a frame that turns backwards.

|i_n*| <= I_n = part_n I_max. Beyond I_max both sequences get the same share of it, and the positive
one has I_max - |i_n*|, so that no phase passes I_max whatever the angle between the sequences, and
all stay sines. While |i_n*| is small it may be what the filters make of a change: the positive
sequence may then take more, up to any for i_n* = 0, and the sum is cut at I_max in each tick. A
balanced fault is thus limited as by ``virtual-stator``. The stage does not know where the phases
are in its frame, so that it cannot limit each phase by itself.

Source: Guo, Wu and Chen, IEEE Trans. Ind. Electron. 58(4), 2011: complex-coefficient filters; not
at hand. The rest is ours.
"""

from __future__ import annotations

import cmath
import math
from typing import Literal

from pydantic import Field, model_validator

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import current_loop, limit_current
from gfm_runtime.inner.virtual_stator import VirtualStator, stator
from gfm_runtime.toml_file import NotNegative, Positive

_SMALL = 0.2  # of I_max; less of the negative sequence leaves the limit to the sum


class DualSequence(VirtualStator):
    """A virtual stator with an impedance and a limit of its own for the negative sequence."""

    type: Literal["dual-sequence"] = Field("dual-sequence", description="kind of stage")  # type: ignore[assignment]
    R_n: NotNegative = Field(0.03, description="resistance for the negative sequence, p.u.")
    X_n: Positive = Field(
        0.3, description="reactance for the negative sequence, p.u.; far from X_v it is not passive"
    )
    part_n: Positive = Field(0.5, description="of I_max, what the negative sequence gets; below 1")
    f_seq: Positive = Field(
        10.0, description="bandwidth with which the sequences are told apart, Hz"
    )
    delay: NotNegative = Field(
        1.8, description="from v to the middle of the bridge's pulse that it causes, samples"
    )

    @model_validator(mode="after")
    def _leaves_room(self) -> DualSequence:
        if isinstance(self.part_n, float) and not self.part_n < 1.0:
            raise ValueError(f"part_n = {self.part_n!r}: must be below 1")
        return self

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        of = super().constants(T_s, omega_b)
        z = cmath.exp(-2j * omega_b * T_s)  # the negative sequence from tick to tick
        Z_n, turn = complex(self.R_n, -self.X_n), 0.5j * omega_b * T_s
        # what the stator's rule, with x_n of the tick before, needs beyond Z_v for x = -v / Z_n
        behind = (1 + of["stator_a"] + turn) - (1 - of["stator_a"] - turn) / z
        more = z * (Z_n - behind / of["stator_b"])
        keeps = of["follow_v"] / (1 - (1 - of["follow_v"]) / z)  # of v by its low-pass
        ahead = z**self.delay
        lead = (keeps - ahead) * Z_n - 1j * self.L_f * (ahead - 1)
        return of | {
            "R_more": more.real,
            "X_more": more.imag,
            "lead_d": lead.real,
            "lead_q": lead.imag,
            "I_n": self.part_n * self.I_max,
            "I_small": _SMALL * self.I_max,
            "follow_s": -math.expm1(-2 * math.pi * self.f_seq * T_s),
            "third": 1 / 3,
        }


@inlined
def split_sequences(law, p, n, d, q, cosine, sine):
    """One tick of the two filters on d + j q: its positive sequence p (2,) and its negative one
    n (2,), which turns by cosine - j sine from tick to tick."""
    n_d, n_q = cosine * n[0] + sine * n[1], cosine * n[1] - sine * n[0]
    lack_d, lack_q = law.follow_s * (d - p[0] - n_d), law.follow_s * (q - p[1] - n_q)
    p[0] += lack_d
    p[1] += lack_q
    n[0], n[1] = n_d + lack_d, n_q + lack_q


@inlined
def dual_sequence(law, state, E_d, E_q):
    """One tick: i* of both sequences, and the current loop with what it lacks for the negative
    one."""
    # the negative sequence turns by -2 omega: times (1 - j h) / (1 + j h) with h = tan(omega T)
    h = (state.omega + state.omega) * law.half_turn
    h += h * h * h * law.third
    size = law.one + h * h
    cosine, sine = (law.one - h * h) / size, (h + h) / size
    split_sequences(law, state.E_p, state.E_n, E_d, E_q, cosine, sine)
    n_d, n_q = state.i_n[0], state.i_n[1]
    E_d -= state.E_n[0] + law.R_more * n_d - law.X_more * n_q
    E_q -= state.E_n[1] + law.R_more * n_q + law.X_more * n_d
    stator(law, state, E_d, E_q)
    split_sequences(law, state.i_p, state.i_n, state.x_v[0], state.x_v[1], cosine, sine)
    n_d, n_q = state.i_n[0], state.i_n[1]
    lead_d, lead_q = law.lead_d * n_d - law.lead_q * n_q, law.lead_d * n_q + law.lead_q * n_d
    # i_n* within I_n and within its share of I_max
    p_d, p_q = state.x_v[0] - n_d, state.x_v[1] - n_q
    p, n = math.sqrt(p_d * p_d + p_q * p_q), math.sqrt(n_d * n_d + n_q * n_q)
    total = p + n
    most = law.I_max / max(total, law.I_max) * n
    most = min(law.I_n, most)
    full = n > most
    if full:
        n_d, n_q, n = n_d * (most / n), n_q * (most / n), most
    # the positive sequence in the room that is left, which a small unbalance does not narrow
    room = law.I_max - n
    crowded = p > room and p * n > room * law.I_small
    if crowded:
        small = law.I_small / n
        scale = room / p * max(law.one, small)
        p_d, p_q = p_d * scale, p_q * scale
    state.i_ref[0], state.i_ref[1] = p_d + n_d, p_q + n_q
    limit_current(law, state)
    state.limited = state.limited != 0 or full or crowded
    current_loop(law, state)
    X = (state.omega + state.omega) * law.L_f
    state.e_now[0] += lead_d + X * n_q
    state.e_now[1] += lead_q - X * n_d
