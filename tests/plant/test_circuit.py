"""The modes of a circuit: its motion is that of its differential equations, however it is drawn."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from gfm_plant.circuit import GROUND, Branch, Capacitor, Circuit, Modes, VoltageSource, find_modes

OMEGA_B = 100 * np.pi
GRID = VoltageSource("grid", "g")
E, F = VoltageSource("e", "e"), VoltageSource("f", "e")


def modes(branches: Any, capacitors: Any, sources: Any, order: Any) -> Modes:
    circuit = Circuit(tuple(branches), tuple(capacitors), tuple(sources))
    return find_modes(circuit, OMEGA_B, tuple(order))


def moved(m: Modes, w: Any, s: Any, t: float) -> Any:
    """w after t seconds under constant sources s, by the modes."""
    grown = np.exp(m.rates * t)
    return m.states @ (grown * (m.modes @ w) + (grown - 1) / m.rates * (m.drive @ s))


def converter(k: int, node: str, L: float = 0.1) -> tuple[list[Branch], Capacitor, VoltageSource]:
    """Filter L, C and a line of a converter to a node."""
    return (
        [
            Branch(f"i_f{k}", f"bridge{k}", f"t{k}", 0.02, 0.002),
            Branch(f"i_o{k}", f"t{k}", node, L, 0.01),
        ],
        Capacitor(f"v{k}", f"t{k}", 0.2),
        VoltageSource(f"bridge{k}", f"bridge{k}"),
    )


def test_lc_filter_against_the_matrix_exponential():
    branches, capacitor, bridge = converter(1, "g")
    order = ["i_f1", "i_o1", "v1"]
    m = modes(branches, [capacitor], [bridge, GRID], order)
    A = OMEGA_B * np.array([
        [-0.002 / 0.02, 0.0, -1 / 0.02], [0.0, -0.01 / 0.1, 1 / 0.1], [1 / 0.2, -1 / 0.2, 0.0],
    ]) - 1j * OMEGA_B * np.eye(3)  # fmt: skip
    B = OMEGA_B * np.array([[1 / 0.02, 0.0], [0.0, -1 / 0.1], [0.0, 0.0]])
    whole = np.zeros((5, 5), complex)
    whole[:3, :3], whole[:3, 3:] = A, B
    w, s, t = np.array([0.3, 0.1j, 1.0]), np.array([1.0 + 0.1j, 0.9]), 3e-3
    exact = (expm(whole * t) @ np.concatenate([w, s]))[:3]
    np.testing.assert_allclose(moved(m, w, s, t), exact, atol=1e-12)


def test_a_line_in_two_pieces_is_the_same_line():
    branches, capacitor, bridge = converter(1, "g", L=0.1)
    whole = modes(branches, [capacitor], [bridge, GRID], ["i_f1", "i_o1", "v1"])
    pieces = [
        branches[0],
        Branch("i_o1", "t1", "middle", 0.03, 0.004),
        Branch("i_g", "middle", "g", 0.07, 0.006),
    ]
    order = ["i_f1", "i_o1", "v1", "i_g"]
    split = modes(pieces, [capacitor], [bridge, GRID], order)
    w, s = np.array([0.3, 0.1j, 1.0]), np.array([1.0 + 0.1j, 0.9])
    a, b = moved(whole, w, s, 2e-3), moved(split, np.append(w, w[1]), s, 2e-3)
    np.testing.assert_allclose(b[:3], a, atol=1e-12)
    assert b[3] == pytest.approx(b[1], abs=1e-12)


@pytest.mark.parametrize("n", [2, 5, 10])
def test_identical_converters_in_parallel(n):
    """Their eigenvalues repeat; each then moves as one converter on a line that n share."""
    branches, capacitors, sources, order = [], [], [], []
    for k in range(n):
        two, capacitor, bridge = converter(k, "bus")
        branches += two
        capacitors.append(capacitor)
        sources.append(bridge)
        order += [f"i_f{k}", f"i_o{k}", f"v{k}"]
    branches.append(Branch("i_g", "bus", "g", 0.3, 0.02))
    many = modes(branches, capacitors, [*sources, GRID], [*order, "i_g"])
    two, capacitor, bridge = converter(0, "bus")
    one = modes(
        [*two, Branch("i_g", "bus", "g", 0.3 * n, 0.02 * n)], [capacitor], [bridge, GRID],
        ["i_f0", "i_o0", "v0", "i_g"],
    )  # fmt: skip
    w, e = np.array([0.2, 0.1 + 0.1j, 1.0]), 1.0 + 0.1j
    a = moved(one, np.append(w, w[1]), np.array([e, 0.95]), 5e-3)
    b = moved(many, np.append(np.tile(w, n), n * w[1]), np.array([e] * n + [0.95]), 5e-3)
    np.testing.assert_allclose(b[:-1], np.tile(a[:3], n), atol=1e-10)
    assert b[-1] == pytest.approx(n * a[3], abs=1e-10)


def test_switching_keeps_the_flux_of_a_loop():
    """Two inductors that an opened breaker puts in series share (L1 i1 + L2 i2) / (L1 + L2)."""
    m = modes(
        [Branch("a", "e", "n", 0.3, 0.1), Branch("b", "n", GROUND, 0.2, 0.5)], [],
        [E], ["a", "b"],
    )  # fmt: skip
    after = m.states @ (m.modes @ np.array([1.0, 0.4j]))
    np.testing.assert_allclose(after, np.full(2, (0.3 + 0.2 * 0.4j) / 0.5), atol=1e-14)


A, B = Branch("a", "e", "n", 0.1, 0.0), Branch("b", "n", "g", 0.1, 0.0)


@pytest.mark.parametrize(
    ("branches", "capacitors", "sources", "message"),
    [
        ([A], [], [E], "node n: only a ends there"),
        ([Branch("a", "e", "g", 0.0, 0.1)], [], [E, GRID], "a = 0.0: must be > 0"),
        ([A, B], [Capacitor("c", "n", -1.0)], [E, GRID], "c = -1.0: must be > 0"),
        ([A, B], [], [E, F, GRID], "node e: e and f, one source"),
        ([A, B], [Capacitor("c", "g", 1.0)], [E, GRID], "node g: a source and a"),
    ],
)
def test_circuits_that_cannot_be(branches, capacitors, sources, message):
    with pytest.raises(ValueError, match=message):
        modes(branches, capacitors, sources, ["a", "b", "c"])
