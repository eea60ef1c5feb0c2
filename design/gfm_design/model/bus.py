"""The impedance of a network at a bus, with all its converters under their laws."""

import numpy as np
from numpy.typing import ArrayLike

from gfm_design.model.closed_loop import Response, acts, response
from gfm_design.model.network import NetworkLoop


def bus_impedance(loop: NetworkLoop, node: str, omega: ArrayLike) -> Response:
    """Z of a network at a node with a capacitor, shape (K, 2, 2), p.u. of the first
    converter: (v_d, v_q) = Z (i_d, i_q) for a small current into the node, in the frame that turns
    steadily at the speed of its island.

    Of a sampled loop this is the answer at the frequency itself: sampling also excites its images
    at multiples of the sampling frequency.

    Args:
        node: its name.
        omega: frequencies in that frame, rad/s, > 0, shape (K,).

    Raises:
        ValueError: the network has no such node.
    """
    if node not in loop.network.nodes:
        raise ValueError(f"{node!r}: must be one with a capacitor, {[*loop.network.nodes]}")
    plant, (by_i, v) = loop.network.plant, loop.network.nodes[node]
    s = 1j * np.asarray(omega, float)
    z, p = np.exp(s * loop.T_s), loop.held(loop.u_delay, loop.y_delay)
    n_y, n_u = len(p.C), p.B.shape[1]
    G = response((p.A, p.B, p.C, np.zeros((n_y, n_u))), z)
    K = np.zeros((len(s), n_u, n_y), complex)
    for member in loop.members:
        c = member.controller
        K[:, member.u, member.y] = response((c.A, c.B, c.C, c.D), z)
    y = response((plant.A, by_i, plant.C, np.zeros((n_y, 2))), s)
    y = y * np.exp(-s[:, None] * loop.y_delay)[:, :, None]
    u = np.linalg.solve(np.eye(n_u) - K @ G, K @ y) * acts(s, loop.T_s, loop.u_delay)
    both = response((plant.A, np.hstack([plant.B, by_i]), v, np.zeros((2, n_u + 2))), s)
    return np.asarray(both[..., n_u:] + both[..., :n_u] @ u)


def positive_sequence(Z: Response) -> Response:
    """What a small positive-sequence current meets in its own sequence, (K,): at omega of Z, which
    is (K, 2, 2), its frequency is that of the frame above omega."""
    return np.asarray(0.5 * (Z[:, 0, 0] + Z[:, 1, 1] + 1j * (Z[:, 1, 0] - Z[:, 0, 1])))
