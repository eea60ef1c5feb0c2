"""The saturation of a transformer's core, at a node whose voltage a capacitor holds.

Each phase has a core with the flux linkage lambda, d(lambda)/dt = omega_b v, p.u. so that lambda =
v / omega at rest. Beyond its knee the core draws, besides what its magnetising inductance does,

    i = sign(lambda) (|lambda| - knee) / X_air.

The fluxes of the three phases add up to nothing, and what the three currents have in common flows
in the delta winding, so that space vectors stand for both. For the linear circuit the current is a
source. In each half of a piece it is held at its value in the middle of that half, extrapolated:
the error falls with the square of the length of a piece. The flux follows the voltage by Simpson's
rule. Resistances of the circuit alone take a constant flux away.
"""

import math
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from gfm_plant.components.part import DRAWN, Drawing, LinearPart, Matrix, see_middle
from gfm_plant.layout import field
from gfm_plant.parameters import Options, Positive
from gfm_plant.solution import draw
from gfm_plant.sparse import turned
from gfm_plant.steady_state import NoEquilibrium
from gfm_runtime.compiled import compiled

_SIN = math.sqrt(3.0) / 2.0


@compiled
def _beyond(flux: float, knee: float) -> float:
    """Return by how much the flux of a phase is beyond the knee, with its sign."""
    return math.copysign(max(abs(flux) - knee, 0.0), flux)


@compiled
def _current(one: Any, flux: complex) -> complex:
    """Return the current at a flux; both are space vectors in the frame that stands still."""
    a = _beyond(flux.real, one.knee)
    b = _beyond(-0.5 * flux.real + _SIN * flux.imag, one.knee)
    c = _beyond(-0.5 * flux.real - _SIN * flux.imag, one.knee)
    return complex((2.0 * a - b - c) / 3.0 / one.X_air, (b - c) / (2.0 * _SIN) / one.X_air)


@compiled
def _draw(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Add the current to the forcing of every mode. The voltage that the flux is to follow is
    taken to turn at nominal speed along the piece."""
    h, v = field(n, "half_h")[part], field(now, "w")[one.sees]
    one.v_begin = v
    slope = v * one.turn * n.omega_b
    quarter = turned(0.5 * n.omega_b * h)
    half = quarter * quarter
    one.turn_middle = one.turn * half
    one.turn_end = one.turn_middle * half
    first = one.flux + slope * complex(0.5 * h, 0.125 * n.omega_b * h * h)
    second = one.flux + slope * complex(1.5 * h, 1.125 * n.omega_b * h * h)
    draw(
        n, now, c, part, one.source,
        _current(one, first) * (one.turn * quarter).conjugate(),
        _current(one, second) * (one.turn_middle * quarter).conjugate(),
    )  # fmt: skip


@compiled
def _end(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    v, by = field(now, "w")[one.sees], n.omega_b * field(n, "half_h")[part] / 3.0
    one.flux += by * (one.v_begin * one.turn + v * one.turn_end)
    one.flux += 4.0 * by * one.v_middle * one.turn_middle
    u = one.turn_end
    one.turn = u * (1.5 - 0.5 * (u.real * u.real + u.imag * u.imag))  # takes the rounding out


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.flux_before, one.turn_before = one.flux, one.turn


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.flux, one.turn = one.flux_before, one.turn_before


@compiled
def _flow(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    field(now, "flow_i")[one.source] = _current(one, one.flux) * one.turn.conjugate()


class Core(Options):
    """Where a transformer's core saturates."""

    knee: Positive = Field(1.2, ge=0.5, description="flux at which each phase saturates, p.u.")
    X_air: Positive = Field(0.4, description="reactance beyond that, p.u. of the rating")


class Saturation(Core, Drawing):
    """The core of a transformer, which draws a current beyond its knee: after energising it, and
    when the voltage comes back after a fault. Its node needs a capacitor, of a bank or of a
    converter's filter. The magnetising current below the knee is that of ``X_m`` of a transformer.
    """

    title: ClassVar = "Saturation of a transformer"
    symbol: ClassVar = "box"
    example: ClassVar = {
        "saturations": {"x": {"node": "bus", "S": 1.0}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}},
    }
    more_states: ClassVar = (("flux", "p.u., a space vector", "of its core"),)
    lacks: ClassVar = (
        "the core of {} needs a capacitor there, of network.capacitors or of a converter's filter"
    )
    record: ClassVar = np.dtype(
        [
            *DRAWN, ("knee", "f8"), ("X_air", "f8"),  # p.u. of the network
            ("flux", "c16"), ("flux_before", "c16"),  # in the frame that stands still
            # from the common frame to that one, along a piece, and at the last tick
            ("turn", "c16"), ("turn_middle", "c16"), ("turn_end", "c16"), ("turn_before", "c16"),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "keep": _keep, "drive": _draw, "middle": see_middle, "end": _end, "go_back": _go_back,
        "flow": _flow,
    }  # fmt: skip

    node: str = Field(min_length=1, description="where it is; one with a capacitor")
    S: Positive = Field(description="rating over that of the first converter")

    def label(self) -> str:
        return f"knee {self.knee:g}, $X_{{air}}$ {self.X_air:g}"

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        record["knee"], record["X_air"] = self.knee, self.X_air / self.S

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        return 0j, []

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        record["flux"], record["turn"] = v / complex(0.0, omega), 1.0
        if abs(v) / omega > self.knee:
            raise NoEquilibrium(
                f"the core at {self.node}: its flux of {abs(v) / omega:.4g} p.u. is beyond its"
                f" knee, {self.knee:g}: there it draws harmonics"
            )
        return 0j

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        none = np.zeros((0, 0))
        return LinearPart(none, np.zeros((0, 2)), np.zeros((2, 0)), np.zeros(0))
