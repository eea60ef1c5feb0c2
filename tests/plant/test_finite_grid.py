"""A grid whose frequency follows its balance of power."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import Plant, breaker, grid_frequency, grid_load, make_plant
from gfm_plant.components import FiniteGrid
from gfm_plant.model import DELTA, f

GRID = {"S": 2.0, "H": 3.0, "D": 1.0, "droop": 0.05, "T_gov": 0.4}


def test_rests_where_it_starts(rest):
    plant = rest(grid={"finite": GRID, "omega_g": 0.998})
    plant.advance(5000)
    assert plant.truth()["omega_g"] == pytest.approx(0.998, abs=1e-12)
    assert plant.st["x"][0] == pytest.approx(plant.x, abs=1e-9)


def test_load_step_against_the_swing_equation(rest):
    """The converter's u is held, so its angle runs away from the grid's: both interact."""
    plant = rest(grid={"finite": GRID}, dc_source={"mode": "regulated"})
    s, c = plant.plant.of(FiniteGrid)[0], GRID

    def slope(_: float, z: Any) -> Any:
        w, P = z[8] - 1.0, z[9]
        error = 1.0 - z[7]
        i_dc = plant.par[0]["k_p"] * error + z[10]
        dx = f(z[:8].copy(), np.array([i_dc, *plant.u[1:]]), np.array([z[8], 1.0]), plant.par)
        p_g = np.cos(z[DELTA]) * z[4] - np.sin(z[DELTA]) * z[5]
        return np.concatenate([dx, [
            (P + p_g / c["S"] - load - c["D"] * w) / (2 * c["H"]),
            (P_set - w / c["droop"] - P) / c["T_gov"],
            plant.par[0]["k_i"] * error,
        ]])  # fmt: skip

    grid_load(plant.plant, 0.01)
    P_set, load = float(s["P_set"]), float(s["P_load"])
    t = np.arange(1, 3001) * 1e-4
    z = np.concatenate([plant.x, [1.0, s["P_turbine"], plant.u[0]]])
    exact = solve_ivp(slope, (0, t[-1]), z, "DOP853", t, rtol=1e-11, atol=1e-12).y
    found = np.empty((len(t), 2))
    for k in range(len(t)):
        plant.advance()
        truth = plant.truth()
        found[k] = truth["omega_g"], truth["p"]
    assert np.ptp(exact[8]) > 1e-4
    np.testing.assert_allclose(found[:, 0], exact[8], atol=1e-8)  # 1e-3 Hz would be 2e-5
    p = exact[2] * exact[4] + exact[3] * exact[5]
    np.testing.assert_allclose(found[:, 1], p, atol=1e-5)


def test_alone_it_settles_by_its_droop(rest):
    """Without the converter: -change / (1 / droop + D), by hand; the nadir lies lower."""
    local = {"load_R": 72.2, "load_L": 0.05}
    plant = rest(grid={"finite": GRID, **local}, dc_source={"mode": "regulated"})
    breaker(plant.plant, closed=False)
    w = []
    for _ in range(100):
        plant.advance(1000)
        w.append(plant.truth()["omega_g"] - 1.0)
    # 0.5 p.u. less what the load of Z = 2 + 0.435j takes at 1 p.u., over S; losses are small
    lost = -(0.5 - 2.0 / (2.0**2 + 0.4351**2)) / 2.0
    assert w[-1] == pytest.approx(lost / (1 / 0.05 + 1.0), rel=0.05)
    assert min(w) < 1.2 * w[-1]


def test_wrong_grids(rest):
    own = rest(grid={"finite": GRID})
    with pytest.raises(ValueError, match=r"plant.grid.finite: such a grid sets its own frequency"):
        grid_frequency(own.plant, 0.99)
    with pytest.raises(ValueError, match=r"plant.grid.finite: not set"):
        grid_load(rest().plant, 0.1)
    fast = Plant.model_validate({"grid": {"finite": {"S": 1.0, "H": 1e-6}}})
    with pytest.raises(ValueError, match=r"plant.grid.finite: it swings at .* raise S, H"):
        make_plant(fast, 1e-4)
