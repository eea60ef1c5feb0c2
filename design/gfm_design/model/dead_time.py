"""The describing function of a dead time: what it does to a loop around its operating point.

A leg of a two-level bridge whose current flows outwards at its rising edge loses the dead time t_d
of its upper level, one whose current flows inwards at its falling edge gains it. In a cycle that is
a voltage in phase with the current, of 4/pi t_d f_c v_dc if the ripple is small (a relay). With
ripple the current of a leg has both signs in the part of a cycle in which its mean is smaller than
the ripple; there the leg loses nothing (a relay with a dead zone), and how large the ripple is
there depends on the command.

The operating point is that of this mean voltage: a law that does not hold q or V, such as a droop
with a constant E_u, rests at another reactive power. A small, slow change of the current sees the
slopes there. The relay's magnitude does not change with the current, its direction does: across the
current it is a resistance of 4/pi t_d f_c v_dc / |i|, along the current it is none. The harmonics
of the current that the dead time makes itself are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.inner import linearise_stage
from gfm_design.model.linear import linearise_law, linearise_plant
from gfm_design.model.operating_point import operating_point
from gfm_plant import Plant, load_converter
from gfm_plant.model import V_DC
from gfm_plant.records import Record

_AXES = np.exp(2j * np.pi / 3 * np.arange(3))
_POINTS = 500  # in a sixth of a cycle, after which the legs change their roles
_STEP = 1e-3  # p.u.; the slopes are those over twice this distance


@dataclass(frozen=True)
class DeadTime:
    """What a dead time takes from the voltage of a two-level bridge, as a mean over a cycle.

    Attributes:
        share: t_d f_c, of a period of the carrier.
        ripple: omega_b / (f_c L_f), p.u. of current by p.u. of voltage in a period.
        per_leg: v_dc in p.u. of a phase's nominal peak value, sqrt(3/2) V_dc / V_n.
    """

    share: float
    ripple: float
    per_leg: float

    @classmethod
    def of(cls, plant: Plant, par: Record, T_s: float, seconds: float) -> DeadTime:
        """That of a plant's bridge.

        Args:
            plant, par: its options, and its parameters from ``gfm_plant.make_plant``.
            T_s: sampling time, s.
            seconds: the dead time.

        Raises:
            ValueError: the bridge has three levels, or the dead time is not within half a period
                of the carrier.
        """
        f_c = plant.bridge.carrier_hz or 1 / T_s
        if plant.bridge.kind == "t-type":
            raise ValueError("dead time: is of a two-level bridge; plant.bridge.kind is t-type")
        if not 0 <= seconds < 0.5 / f_c:
            raise ValueError(
                f"dead time = {seconds:g} s: must lie in [0, {0.5 / f_c:g}) s, half of the carrier"
            )
        bases, r = load_converter(plant.converter).bases, par[0]
        per_leg = bases.V_dcref / bases.V_peak
        return cls(seconds * f_c, float(r["omega_b"]) / (f_c * float(r["L_f"])), per_leg)

    def drop(self, i: complex, e: complex) -> complex:
        """The voltage that is lost, p.u., by the current of L_f and what space-vector modulation is
        commanded, both in a frame that turns with the grid, p.u."""
        turn = np.exp(1j * (np.arange(_POINTS) + 0.5) / _POINTS * np.pi / 3)[:, None]
        phases = (e * turn * _AXES.conj()).real / self.per_leg
        middle = (phases.max(axis=1, keepdims=True) + phases.min(axis=1, keepdims=True)) / 2
        duty = np.clip(phases - middle + 0.5, 0.0, 1.0)
        # of a leg at its falling edge; at the rising edge the opposite of it
        both = np.minimum(duty[:, :, None], duty[:, None, :])
        meets = 2 / 3 * (_AXES[:, None].conj() * _AXES).real
        swing = (both - duty[:, :, None] * duty[:, None, :]) * meets
        swing = self.ripple * self.per_leg / 2 * swing.sum(2)
        currents = (i * turn * _AXES.conj()).real
        lost = self.share * (_positive(currents - swing) - _positive(-currents - swing))
        return complex(np.mean(2 / 3 * self.per_leg * (lost @ _AXES) * turn[:, 0].conj()))

    def slopes(self, i: complex, e: complex) -> NDArray[np.float64]:
        """The real and the imaginary part of ``drop`` by those of i and of e, and by v_dc, shape
        (2, 5)."""
        wide, narrow = (replace(self, per_leg=self.per_leg * k) for k in (1 + _STEP, 1 - _STEP))
        pairs = [(self.drop(i + d, e), self.drop(i - d, e)) for d in (_STEP, 1j * _STEP)]
        pairs += [(self.drop(i, e + d), self.drop(i, e - d)) for d in (_STEP, 1j * _STEP)]
        pairs += [(wide.drop(i, e), narrow.drop(i, e))]
        found = np.array([more - less for more, less in pairs]) / (2 * _STEP)
        return np.array([found.real, found.imag])


def _positive(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The part of each step of the first axis in which x, straight within it, is above zero."""
    change = np.abs(np.gradient(x, axis=0)) + 1e-300
    return np.clip(0.5 + x / change, 0.0, 1.0)


def with_dead_time(loop: ClosedLoop, seconds: float) -> ClosedLoop:
    """The loop with the dead time of a two-level bridge, at the operating point with it.

    Args:
        loop: of one converter on its line, sampled.
        seconds: the dead time.

    Raises:
        ValueError: the loop is made of matrices; or as of ``DeadTime.of``.
        NoEquilibrium: there is no operating point with it.
    """
    of = loop.made_of
    dead = DeadTime.of(of.plant, of.par, of.law.T_s, seconds)
    grid, inner = of.plant.grid, of.law.law.inner
    around = grid.omega_g, grid.V_g
    op = operating_point(of.par, of.law, of.ref, *around, dead.drop)
    i, e = complex(op.x[0], op.x[1]), op.e
    by_i, by_e, by_dc = np.split(dead.slopes(i, e), [2, 4], axis=1)
    # what the bridge gives, and what it does to the filter
    gives = replace(op, e=e - dead.drop(i, e))
    plant = linearise_plant(of.par, gives, *around, grid.finite, inner=True)
    A, B = plant.A.copy(), plant.B.copy()
    A[:, :2] -= B[:, 2:] @ by_i
    A[:, V_DC] -= (B[:, 2:] @ by_dc)[:, 0]
    B[:, 2:] -= B[:, 2:] @ by_e
    plant = replace(plant, A=A, B=B)
    stage = None
    if inner is None:  # E_u lies on the d axis, and there are no other measurements
        plant = replace(plant, B=B[:, :3], C=plant.C[: len(plant.C_true)])
    else:
        stage = linearise_stage(inner, of.law.T_s, float(of.par[0]["omega_b"]), op)
    law = linearise_law(of.law.law, of.law, op, of.ref, of.plant.dc_source.mode == "controlled")
    origin = replace(of, op=op)
    return ClosedLoop(plant, law, loop.T_s, loop.u_delay, loop.y_delay, origin=origin, stage=stage)
