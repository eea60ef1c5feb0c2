"""Lines with charging: against the chain matrix of a pi, and against two lines and a bank."""

import numpy as np
import pytest

from gfm_plant import Network, NetworkParts, Plant, make_network, plant_command, plant_step
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS

OFF = {name: {"enabled": False} for name, *_ in TRIPS}
LOAD, L, R, B = 0.8, 0.2, 0.02, 0.3


def make(parts: dict) -> Network:
    plant = Plant.model_validate({"protection": OFF, "dc_source": {"mode": "regulated"}})
    given = NetworkParts.model_validate(parts)
    return make_network({"a": (plant, "m")}, 1e-4, Plant().grid, given)


def settled(plant: Network, e: float, ticks: int) -> dict[str, complex]:
    """Currents and voltages a time after a voltage e at the bridge, at nominal frequency."""
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, e, 0.0]])
    x[0, V_DC], x[0, DELTA] = 1.0, 0.0
    plant.start(x, u)
    for _ in range(ticks):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
    return dict(zip(plant.wiring.order, plant.now[0]["w"], strict=False))


@pytest.mark.full  # compiles the plant for several converters
def test_its_steady_state_is_that_of_the_chain_matrix():
    """(V, I) at the start by those at the end, with Z = R + j L and Y = j B / 2."""
    line = {"start": "m", "end": "n", "L": L, "R": R, "B": B}
    parts = {"lines": {"x": line}, "loads": {"z": {"node": "n", "P": LOAD}}}
    plant = make(parts)
    found = settled(plant, 1.05, 20_000)
    Z, Y = complex(R, L), 0.5j * B
    chain = np.array([[1 + Z * Y, Z], [Y * (2 + Z * Y), 1 + Z * Y]])
    v_n = found["x.end"]
    V, i = chain @ [v_n, v_n * LOAD]
    assert found["x.start"] == pytest.approx(V, abs=1e-9)
    assert found["a.i_o"] == pytest.approx(i, abs=1e-9)
    assert abs(v_n) > 0.9  # something is there


def test_all_at_a_node_is_one_capacitor():
    line = {"start": "m", "end": "n", "L": L, "R": R, "B": B}
    parts = {
        "lines": {"x": line, "y": line}, "loads": {"z": {"node": "n", "P": LOAD}},
        "capacitors": {"c": {"node": "n", "Q": 0.1}, "d": {"node": "n", "Q": 0.2}},
    }  # fmt: skip
    banks = {one.name: (one.node, one.C) for one in make(parts).wiring.capacitors}
    assert banks == {"x.start": ("m", B), "x.end": ("n", pytest.approx(B + 0.3))}


def test_at_the_grid_there_is_none():
    line = {"start": "m", "end": "n", "L": L, "R": R, "B": B}
    plant = make({"lines": {"x": line}, "grid": "n"})
    assert [(one.name, one.node) for one in plant.wiring.capacitors] == [("x.start", "m")]


def test_a_negative_charging():
    line = {"start": "m", "end": "n", "L": L, "R": R, "B": -0.1}
    with pytest.raises(ValueError, match=r"lines.x.B\n.*greater than or equal to 0"):
        NetworkParts.model_validate({"lines": {"x": line}})
