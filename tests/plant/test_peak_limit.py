"""The bridge's peak-current limit: within the limit while the DC voltage can hold it there."""

import numpy as np
import pytest

import gfmhil
from gfm_plant import Plant, make_plant, plant_advance, plant_equilibrium
from gfm_plant.grid import fault

T_S, LIMIT = 1e-4, 2.0


def current(i_peak: float | None, R: float, modulation: str = "space-vector") -> np.ndarray:
    """|i| of a bridge that goes on as before while its terminal is short-circuited through R."""
    options = {"i_peak": i_peak, "modulation": modulation, "grid": {"scr": 3.0, "x_over_r": 6}}
    off = {name: {"enabled": False} for name in ("over_current", "under_voltage")}
    plant = make_plant(Plant.model_validate({**options, "protection": off}), T_S)
    x, u = plant_equilibrium(plant.par, 0.5, 1.0)
    plant.start(x, u)
    seen = []
    for k in range(300):
        if k == 20:
            fault(plant, 0.0, R, 0.01)
        plant_advance(plant.records, u)
        seen.append(np.hypot(*plant.st["x"][0, :2]))
    return np.array(seen)


@pytest.mark.parametrize("R", [0.01, 0.1, 0.5])
def test_the_current_stays_within_the_limit_in_a_fault(R):
    limited, free = current(LIMIT, R), current(None, R)
    within = slice(20, 120)  # while the fault lasts, v is far below what the bridge can give
    assert free[within].max() > 1.5 * LIMIT
    assert limited[within].max() <= 1.01 * LIMIT
    assert limited[within].max() >= 0.99 * LIMIT


def test_a_limit_that_is_not_reached_changes_nothing():
    """Near its limit the same circuit is solved in shorter pieces: E does not depend on v_dc
    here."""
    once = current(None, 0.5, "unlimited")
    for limit in (1.3 * once.max(), 1e3):
        assert np.abs(once - current(limit, 0.5, "unlimited")).max() < 1e-11


@pytest.mark.parametrize("scr", [2.0, 20.0])
@pytest.mark.parametrize(
    "event",
    [
        {"type": "grid-phase-jump", "degrees": 60.0},
        {"type": "grid-phase-jump", "degrees": -60.0},
        {"type": "grid-voltage", "V_g": 0.0, "duration": 0.05},
        {"type": "grid-unbalance", "retained": [0.0, 1.0, 1.0], "duration": 0.05},
    ],
    ids=["+60", "-60", "dip", "unbalance"],
)
def test_no_jump_of_the_grid_leads_beyond_the_limit(scr, event):
    """From far below it the limit looks in time; the bridge gives whatever voltage that takes."""
    plant = {"i_peak": LIMIT, "modulation": "unlimited", "delay": {"fraction": 0.3},
             "grid": {"scr": scr, "x_over_r": 6.0}}  # fmt: skip
    plant |= {"protection": {n: {"enabled": False} for n in ("over_current", "under_voltage")}}
    run = gfmhil.run(
        {"title": "jump", "duration": 0.2, "plant": plant, "events": [{"t": 0.1, **event}]},
        "droop-3", references={"P_ref": 0.5},
    )  # fmt: skip
    assert run.signals["i"].max() <= 1.01 * LIMIT
    assert run.signals["i"][1000:].max() > 0.99 * LIMIT or scr < 3.0
