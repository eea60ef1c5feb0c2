"""Virtual stator: a reference current behind a virtual impedance, a limit, and the current loop.

(X_v/omega_b) di/dt = E - v - (R_v + j omega X_v) i gives i, which the limit cuts to i*.

The stator's own current is not cut. If it were, the cut would act like a resistance in series with
the virtual impedance: the limited current would come in phase with E - v, and after a large jump of
the grid's angle carry no power that could bring the angle back.

Source: Paquette and Divan, IEEE Trans. Ind. Appl. 51(2), 2015: virtual impedance current limiting.
"""

from typing import Literal

from pydantic import Field

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import V_D, V_Q, InnerStage
from gfm_runtime.toml_file import NotNegative, Positive


class VirtualStator(InnerStage):
    """A reference current behind a virtual impedance, a limit, and a current loop."""

    type: Literal["virtual-stator"] = Field("virtual-stator", description="kind of stage")
    R_v: NotNegative = Field(0.1, description="virtual resistance, p.u.")
    X_v: Positive = Field(0.3, description="virtual reactance, p.u.")

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        turn = omega_b * T_s
        return super().constants(T_s, omega_b) | {
            "R_v": self.R_v,
            "X_v": self.X_v,
            "stator_a": self.R_v / self.X_v * turn / 2,
            "stator_b": turn / self.X_v,
        }

    def voltage_drop(self, i: complex, i_o: complex, i_ref: complex, omega: float) -> complex:
        return complex(self.R_v, omega * self.X_v) * i_ref


@inlined
def stator(law, state, E_d, E_q):
    """One tick of the virtual stator by the trapezoidal rule on its own pole: i* from E - v, not
    limited."""
    m = state.m
    b = state.omega * law.half_turn
    keep, lose = law.one - law.stator_a, law.one + law.stator_a
    d, q = state.x_v[0], state.x_v[1]
    r_d = keep * d + b * q + law.stator_b * (E_d - m[V_D])
    r_q = keep * q - b * d + law.stator_b * (E_q - m[V_Q])
    size = lose * lose + b * b
    state.x_v[0], state.x_v[1] = (r_d * lose + r_q * b) / size, (r_q * lose - r_d * b) / size
    state.i_ref[0], state.i_ref[1] = state.x_v[0], state.x_v[1]
