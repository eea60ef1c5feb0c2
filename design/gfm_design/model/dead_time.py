"""The describing function of a dead time: what it does to a loop around its operating point.

A leg of a two-level bridge whose current flows outwards at its rising edge loses the dead time t_d
of its upper level, one whose current flows inwards at its falling edge gains it. In a cycle that is
a voltage in phase with the current, of 4/pi t_d f_c v_dc if the ripple is small (a relay). With
ripple the current of a leg has both signs in the part of a cycle in which its mean is smaller than
the ripple; there the leg loses nothing (a relay with a dead zone), and how large the ripple is
there depends on the command.

A small, slow change of the current sees the slopes of this mean voltage. The relay's magnitude does
not change with the current, its direction does: across the current it is a resistance of
4/pi t_d f_c v_dc / |i|, along the current it is none. The harmonics of the current that the dead
time makes itself are left out.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gfm_design.model.closed_loop import ClosedLoop
from gfm_plant import load_converter

_AXES = np.exp(2j * np.pi / 3 * np.arange(3))
_POINTS = 4000  # in a sixth of a cycle, after which the legs change their roles
_STEP = 0.01  # p.u.; the slopes are those over twice this distance
_ROUNDS = 20  # of the search for the command


def dead_time_drop(i: complex, E: complex, share: float, ripple: float, per_leg: float) -> complex:
    """What a dead time takes from the voltage of a two-level bridge, as a mean over a cycle, p.u.

    Args:
        i: current of L_f in a frame that turns with the grid, p.u.
        E: voltage that space-vector modulation is commanded there, p.u.
        share: t_d f_c, of a period of the carrier.
        ripple: omega_b / (f_c L_f), p.u. of current by p.u. of voltage in a period.
        per_leg: v_dc in p.u. of a phase's nominal peak value, sqrt(3/2) V_dc / V_n.
    """
    turn = np.exp(1j * (np.arange(_POINTS) + 0.5) / _POINTS * np.pi / 3)[:, None]
    phases = (E * turn * _AXES.conj()).real / per_leg
    middle = (phases.max(axis=1, keepdims=True) + phases.min(axis=1, keepdims=True)) / 2
    duty = np.clip(phases - middle + 0.5, 0.0, 1.0)
    # of a leg at its falling edge; at the rising edge the opposite of it
    both = np.minimum(duty[:, :, None], duty[:, None, :])
    meets = 2 / 3 * (_AXES[:, None].conj() * _AXES).real
    swing = ripple * per_leg / 2 * ((both - duty[:, :, None] * duty[:, None, :]) * meets).sum(2)
    currents = (i * turn * _AXES.conj()).real
    lost = share * ((currents - swing > 0).astype(float) - (currents + swing < 0))
    return complex(np.mean(2 / 3 * per_leg * (lost @ _AXES) * turn[:, 0].conj()))


def with_dead_time(loop: ClosedLoop, seconds: float) -> ClosedLoop:
    """The loop with the dead time of a two-level bridge, at the operating point whose mean voltages
    are those without any.

    Args:
        loop: of one converter on its line, sampled.
        seconds: the dead time.

    Raises:
        ValueError: the loop is made of matrices, or has an inner stage; the bridge has three
            levels; or the dead time is not within half a period of the carrier.
    """
    of = loop.made_of
    r, bridge = of.par[0], of.plant.bridge
    f_c = bridge.carrier_hz or 1 / of.law.T_s
    if loop.stage is not None:
        raise ValueError("dead time: is taken into a loop without an inner stage only")
    if bridge.kind == "t-type":
        raise ValueError("dead time: is that of a two-level bridge; plant.bridge.kind is t-type")
    if not 0 <= seconds < 0.5 / f_c:
        raise ValueError(
            f"dead time = {seconds:g} s: must lie in [0, {0.5 / f_c:g}) s, half of the carrier"
        )
    omega_b, L_f = float(r["omega_b"]), float(r["L_f"])
    bases = load_converter(of.plant.converter).bases
    per_leg = math.sqrt(3 / 2) * bases.V_dcref / bases.V_n
    shape = seconds * f_c, omega_b / (f_c * L_f), per_leg
    i, E = complex(of.op.x[0], of.op.x[1]), complex(of.op.u[2])
    needed = E
    for _ in range(_ROUNDS):
        E = needed + dead_time_drop(i, E, *shape)
    i, E = i * abs(E) / E, complex(abs(E))  # in the frame of the command
    columns = [
        (dead_time_drop(i + d, E, *shape) - dead_time_drop(i - d, E, *shape)) / (2 * _STEP)
        for d in (_STEP, 1j * _STEP)
    ]
    by_E = dead_time_drop(i, E + _STEP, *shape) - dead_time_drop(i, E - _STEP, *shape)
    A, B = loop.plant.A.copy(), loop.plant.B.copy()
    for place, part in enumerate((np.real, np.imag)):
        A[place, :2] -= omega_b / L_f * part(columns)
        B[place, 2] -= omega_b / L_f * part(by_E) / (2 * _STEP)
    plant = replace(loop.plant, A=A, B=B)
    return ClosedLoop(plant, loop.law, loop.T_s, loop.u_delay, loop.y_delay)
