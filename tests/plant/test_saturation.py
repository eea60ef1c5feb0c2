"""The core of a transformer: inrush in closed form, and a voltage that returns against SciPy."""

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from gfm_plant import Network, NetworkParts, Plant, make_network, make_plant
from gfm_plant.components import Saturation
from gfm_plant.grid import grid_voltage
from gfm_plant.names import TRIPS
from gfm_plant.steady_state import NoEquilibrium, plant_equilibrium

from .test_network import go

DC = {"mode": "regulated"}
OFF = {name: {"enabled": False} for name, *_ in TRIPS}
W_B = 100 * math.pi
CORE = {"knee": 1.2, "X_air": 0.4}
LINE, R, BANK, LOAD = 0.1, 0.02, 0.1, 0.5  # p.u.


def on_a_grid(
    T_s: float = 1e-4, line: float = LINE, bank: float = BANK, **more: Any
) -> tuple[Network, np.ndarray]:
    """A converter that runs idle on an open grid, and at the end of a line to
    the grid a bank with a core, all at rest."""
    parts = {
        "grid": "g",
        "lines": {
            "l": {"start": "g", "end": "n", "L": line, "R": R * line / LINE},
            "far": {"start": "g", "end": "a", "L": 2.0, "R": 0.2},
        },
        "capacitors": {"c": {"node": "n", "Q": bank}},
        "loads": {"z": {"node": "n", "P": LOAD}},
        "saturations": {"t": {"node": "n", "S": 1.0} | CORE | more},
    }
    plant = Plant.model_validate({"protection": OFF, "dc_source": DC})
    network = make_network(
        {"a": (plant, "a")}, T_s, Plant().grid, NetworkParts.model_validate(parts)
    )
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, 1.0, 0.0]])
    x[0, 7] = 1.0
    network.start(x, u)
    return network, u


def exact(s: np.ndarray, begin: float, V_g: float, t: np.ndarray) -> np.ndarray:
    """Current of the line, voltage and flux at the core, in the frame that stands still, (points,
    3), at the times t after ``begin``, by DOP853 of each phase's own equation."""
    turns = np.exp(2j * np.pi / 3 * np.array([0, -1, 1]))

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        i_l, v, flux = s
        phases = (flux * turns).real
        core = np.sign(phases) * np.maximum(np.abs(phases) - 1.2, 0.0) / 0.4
        i = 2 / 3 * (core * turns.conj()).sum()
        grid = V_g * np.exp(1j * W_B * (begin + t))
        return W_B * np.array([(grid - v - R * i_l) / LINE, (i_l - LOAD * v - i) / BANK, v])

    options: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12, "max_step": 1e-4}
    return solve_ivp(slope, (0, t[-1]), s, "DOP853", t, **options).y.T


def there(plant: Network) -> np.ndarray:
    """Current of the line, voltage and flux at the core, in the frame that stands still."""
    now, order = plant.now[0], plant.wiring.order
    (core,) = plant.of(Saturation)
    turn = np.exp(1j * W_B * plant.st["tick"][0] * plant.net[0]["T_s"])
    return np.array([
        now["w"][order.index("l")] * turn, now["w"][order.index("c")] * turn, core["flux"]
    ])  # fmt: skip


@pytest.mark.full  # compiles the plant for several converters
def test_a_voltage_that_returns_against_an_adaptive_integrator():
    """After a sag of ten milliseconds the flux has an offset, and the core saturates."""
    errors = []
    for T_s in (1e-4, 5e-5, 2.5e-5):
        plant, u = on_a_grid(T_s)
        grid_voltage(plant, 0.1)
        go(plant, u, round(0.01 / T_s))
        grid_voltage(plant, 1.0)
        times = np.arange(1, round(0.06 / T_s) + 1) * T_s
        truth = exact(there(plant), 0.01, 1.0, times)
        mine = np.array([(go(plant, u, 1), there(plant))[1] for _ in times])
        assert np.abs(truth[:, 2]).max() > 2.0  # far beyond the knee
        errors.append(np.abs(mine - truth).max())
    assert errors[0] < 5e-3
    assert 3.0 < errors[1] / errors[2] < 6.0  # a piece lasts 50 us at the first two


@pytest.mark.full
def test_inrush_in_closed_form():
    """A stiff voltage that comes where that of a phase is zero drives its flux to twice the
    voltage: its current peaks at (2 V - knee) / X_air, in each cycle, since nothing takes the
    offset of the flux away. The current of that phase alone is 2/3 of the space vector's."""
    plant, u = on_a_grid(line=2e-3, bank=0.02)
    (core,) = plant.of(Saturation)
    core["flux"] += 1.0  # that of phase a then goes from 0 to 2 V
    i = []
    for _ in range(400):
        go(plant, u, 1)
        line, v, _ = there(plant)
        i.append((line - LOAD * v).real)
    peak = (2.0 - CORE["knee"]) / CORE["X_air"]
    assert max(i) == pytest.approx(2 / 3 * peak, rel=0.02)


@pytest.mark.full
def test_no_current_below_the_knee():
    plant, u = on_a_grid()
    go(plant, u, 400)
    bare, _ = on_a_grid(knee=100.0)
    go(bare, u, 400)
    assert (plant.now["w"] == bare.now["w"]).all()
    assert abs(plant.of(Saturation)[0]["flux"]) == pytest.approx(
        abs(plant.now["w"][0, plant.wiring.order.index("c")]), abs=1e-6
    )


def test_a_transformer_of_the_converter():
    """The core of ``plant.lcl`` sees the voltage of the filter capacitor."""
    core = {"lcl": {"L": 0.15, "saturation": CORE}, "protection": OFF, "dc_source": DC}
    plant = make_plant(Plant.model_validate(core), 1e-4)
    x, u = plant_equilibrium(plant.par, 0.3, 1.0)
    plant.start(x, u)
    (own,) = plant.of(Saturation)
    assert own["flux"] == pytest.approx(-1j * plant.now["w"][0, 1], abs=1e-12)
    own["flux"] += 0.9
    u = np.array([[*u, 0.0]])
    i = []
    for _ in range(200):
        go(plant, u, 1)
        i.append(abs(plant.now["w"][0, 0]))
    assert max(i) > 1.0 > i[0]  # it saturates once a cycle


def test_a_rest_beyond_the_knee():
    with pytest.raises(NoEquilibrium, match=r"core at n: its flux of .* is beyond its knee, 0.9"):
        on_a_grid(knee=0.9)


def test_a_node_without_a_capacitor():
    with pytest.raises(ValueError, match="node g: the core of t needs a capacitor there"):
        on_a_grid(node="g")


def test_a_knee_below_any_voltage():
    with pytest.raises(ValidationError, match=r"greater than or equal to 0\.5"):
        Saturation.model_validate({"node": "n", "S": 1.0, "knee": 0.1})
