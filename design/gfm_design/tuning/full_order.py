"""A lower bound of gamma for every law, from controllers of full order.

gamma is the largest of the norms of the channels W_ij T_ij. To minimise it is no standard
H-infinity problem, since each input w_j counts separately. For a single w_j, the m channels stacked
are a standard problem, and the norm of the stack is at most sqrt(m) times that of its largest
channel. Let gamma_j be the least norm of the stack over *all* stabilising controllers that measure
(v_dc, p, q, V) and P_ref. Then

    gamma of any law  >=  max over j of gamma_j / sqrt(m_j),

and a single channel (m = 1) gives a bound without the root. These controllers have neither a droop
D_p nor a structure, and each w_j may have its own.

The Riccati solution (``control.hinfsyn``, which needs slycot, GPL: never a dependency of this
project) requires full rank at every frequency. For that, small multiples of all inputs and outputs
are added to w and z. They can only raise gamma_j: the bound holds up to a part of order 1e-4.
"""

import multiprocessing
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearPlant
from gfm_design.norms.hinf import balance
from gfm_design.norms.performance import D_Q, StateSpace, Weight
from gfm_plant.names import SENSED
from gfm_runtime.children import end_with_parent

Matrix = NDArray[np.float64]

_REGULAR = 1e-4
_U_SCALE = (1.0, 1e-4, 1.0)  # omega_u moves by 1e-4 p.u. where the others move by one
# in these units, by j: 1e-2 p.u. on omega_u where W_32 weights it by 1, more where W_31 has 1e6
_REGULAR_U = {1: (1e-4, 1e-5, 1e-4), 2: (1e-4, 1e-6, 1e-4)}
_MEASURED = list(SENSED)


class Missing(ModuleNotFoundError):
    """The solver is not installed."""


@dataclass(frozen=True)
class FullOrder:
    """bound: no law has a smaller gamma; columns: gamma_j of each stack, None if not solved."""

    bound: float
    columns: tuple[float | None, float | None]


def full_order(
    plant: LinearPlant, weights: tuple[Weight, ...], seconds: float = 15.0
) -> FullOrder | None:
    """The bound; None if the solver finished no part of the problem in time.

    The solver runs in a separate process, with ``seconds`` for each part: it may never return
    from a part that is nearly singular.

    Raises:
        Missing: python-control or slycot is not installed.
    """
    if find_spec("control") is None or find_spec("slycot") is None:
        raise Missing(
            "the full-order bound needs python-control and slycot (GPL): pip install slycot"
        )
    columns = [tuple(w for w in weights if w.j == j) for j in (1, 2)]
    stacks = [c for c in columns if c] + [(w,) for w in weights]
    stacks = list(dict.fromkeys(stacks))
    solved = _in_time([generalised_plant(plant, stack) for stack in stacks], seconds)
    found = {stack: g for stack, g in zip(stacks, solved, strict=False) if g is not None}
    if not found:
        return None
    first, second = (found.get(c) for c in columns)
    bound = max(gamma / np.sqrt(len(stack)) for stack, gamma in found.items())
    return FullOrder(float(bound), (first, second))


def generalised_plant(plant: LinearPlant, stack: Sequence[Weight]) -> StateSpace:
    """From (w_j, regularising w, u) to (W_ij z_i, regularising z, y); all weights of one j."""
    n, m = len(plant.A), len(stack)
    size = n + sum(len(w.den) - 1 for w in stack)
    by_power = stack[0].j == 1
    p, q, V = plant.C[1], plant.C[3], plant.C[4]
    z, zero = np.array([-p, p, 0 * p, q + V / D_Q]), np.zeros((4, 1))
    z_w, z_u = zero.copy(), np.zeros((4, 3))
    z_w[0, 0], z_u[2, 1] = float(by_power), _U_SCALE[1]
    y_w = zero.copy()
    y_w[1, 0] = float(by_power)
    A, B_w, B_u = np.zeros((size, size)), np.zeros((size, 1 + n + 4)), np.zeros((size, 3))
    A[:n, :n], B_u[:n], B_w[:n, 1 : n + 1] = plant.A, plant.B * _U_SCALE, _REGULAR * np.eye(n)
    if not by_power:
        B_w[:n, 0] = plant.B_d[:, 0]
    C_z, D_zw, D_zu = np.zeros((m + 7, size)), np.zeros((m + 7, n + 5)), np.zeros((m + 7, 3))
    at = n
    for k, weight in enumerate(stack):
        a, b, c, d = weight.state_space()
        own, i = slice(at, at + len(a)), [weight.i - 1]
        A[own, own], A[own, :n] = a, b @ z[i]
        B_w[own, :1], B_u[own] = b @ z_w[i], b @ z_u[i]
        C_z[[k], :n], C_z[[k], own], D_zw[[k], :1], D_zu[[k]] = d @ z[i], c, d @ z_w[i], d @ z_u[i]
        at += len(a)
    D_zu[m : m + 3], C_z[m + 3 :, :n] = (
        np.diag(_REGULAR_U[stack[0].j]),
        _REGULAR * plant.C[_MEASURED],
    )
    C_y, D_yw = np.zeros((4, size)), np.zeros((4, n + 5))
    C_y[:, :n], D_yw[:, :1], D_yw[:, n + 1 :] = -plant.C[_MEASURED], y_w, _REGULAR * np.eye(4)
    D = np.block([[D_zw, D_zu], [D_yw, np.zeros((4, 3))]])
    return A, np.hstack([B_w, B_u]), np.vstack([C_z, C_y]), D


def _in_time(systems: list[StateSpace], seconds: float) -> list[float | None]:
    """The least norms of the first systems, up to the first that took longer than ``seconds``."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe(duplex=False)
    process = spawn.Process(target=_solve, args=(systems, there, os.getpid()), daemon=True)
    process.start()
    there.close()
    done: list[float | None] = []
    while len(done) < len(systems) and here.poll(seconds):
        try:
            done.append(here.recv())
        except EOFError:  # it died
            break
    process.kill()
    process.join()
    return done


def _solve(systems: list[StateSpace], out: Connection, parent: int) -> None:
    end_with_parent(parent, signal.SIGKILL)
    import control

    for A, B, C, D in systems:
        try:
            out.send(float(control.hinfsyn(control.ss(*balance(A, B, C), D), 4, 3)[2]))
        except Exception:  # slycot's own classes: ranks lost, no solution, no convergence
            out.send(None)
