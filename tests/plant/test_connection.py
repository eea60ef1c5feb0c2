"""p, q and V at the connection point, against the law of the transformer itself in phase
quantities, v_c = v - L di_o/dt - R i_o, and the energy that it stores."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gfm_plant import CONNECTION, clear_fault, fault, grid_unbalance, plant_options
from gfm_plant.records import I_O, V

L, R, T_s = 0.15, 0.004, 2e-6
GRID = {"scr": 3.0, "x_over_r": 8.0}
OFF = {
    name: {"enabled": False}
    for name in ("over_current", "over_voltage", "under_voltage", "dc_over_voltage")
}
STIFF = {"mode": "regulated", "k_p": 200.0}
FAULTS = [
    {"kind": "3ph"},
    {"kind": "LG", "phases": "b"},
    {"kind": "LL", "phases": "ca"},
    {"kind": "LLG", "phases": "ab"},
]


@pytest.fixture
def at_connection(rest: Callable[..., Any]) -> Callable[[], Any]:
    transformer = {"L": L, "R": R, "earthed": True}
    return lambda: rest(T_s, grid=GRID, lcl=transformer, protection=OFF, dc_source=STIFF)


def walk(made: Any, ticks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """p, q and V at the connection point, (ticks, 3), and the capacitor's voltage and the current
    behind it as vectors in the frame that stands still, from the states alone."""
    out = np.empty((ticks, len(CONNECTION)))
    v, i = np.empty(ticks, complex), np.empty(ticks, complex)
    turn = np.exp(1j * made.par["omega_b"][0] * T_s * (made.st["tick"][0] + np.arange(ticks)))
    for k in range(ticks):
        plant_options(made.plant.records, 0, out[k])
        v[k], i[k] = made.now["w"][0, V], made.now["w"][0, I_O]
        made.advance()
    return out, v * turn, i * turn


def test_at_rest_the_transformer_takes_its_reactive_power_alone(rest: Callable[..., Any]) -> None:
    made = rest(1e-4, P=0.6, grid=GRID, lcl={"L": L, "R": R})
    out = np.empty(3)
    plant_options(made.plant.records, 0, out)
    truth, i = made.truth(), made.phasor("converter.i_o")
    v = made.phasor("converter.v") - complex(R, L) * i
    assert out == pytest.approx(
        [truth["p"] - R * abs(i) ** 2, truth["q"] - L * abs(i) ** 2, abs(v)], abs=1e-12
    )


@pytest.mark.parametrize("position", [0.0, 0.5])
@pytest.mark.parametrize("kind", FAULTS, ids=lambda f: f["kind"])
def test_in_a_fault_it_is_what_the_transformer_leaves(
    at_connection: Callable[..., Any], kind: dict[str, str], position: float
) -> None:
    made = at_connection()
    made.advance(500)
    fault(made.plant, position, 0.0, clearing="instant", **kind)
    shorted = _agrees(made)
    if kind["kind"] == "3ph" and position == 0.0:
        assert np.abs(shorted).max() < 1e-14
    else:
        assert np.abs(shorted[:, 1]).max() > 0.1
    clear_fault(made.plant)
    _agrees(made)


def test_with_a_negative_sequence_of_the_grid(at_connection: Callable[..., Any]) -> None:
    made = at_connection()
    grid_unbalance(made.plant, [0.6, 1.0, 0.8j])
    _agrees(made)


def _agrees(made: Any) -> np.ndarray:
    omega_b = float(made.par["omega_b"][0])
    out, v, i = walk(made, 1500)
    slope = (i[:-4] - 8 * i[1:-3] + 8 * i[3:-1] - i[4:]) / (12 * T_s * omega_b)
    v_c = (v - R * i)[2:-2] - L * slope
    s = v_c * i[2:-2].conj()
    exact = np.stack([s.real, s.imag, np.abs(v_c)], axis=1)
    np.testing.assert_allclose(out[2:-2], exact, atol=2e-6)
    return out


def test_without_a_transformer_nothing_is_looked_at(rest: Callable[..., Any]) -> None:
    net = rest().plant.net
    assert not net["connections"][0]
    assert net["node_w"].shape[2] == 2  # the sides of a synchro-check alone
