"""Every protection trips in time, latches, blocks the bridge and says why."""

import math

import numpy as np
import pytest

from gfm_plant import TRIP_REASONS, grid_voltage, trip_reason


def code_of(reason: str) -> int:
    return next(code for code, name in TRIP_REASONS.items() if name == reason)


@pytest.mark.parametrize(
    ("name", "threshold", "text"),
    [
        # in equilibrium with P = 0.5: |i| = 0.569, V = 1, v_dc = 1, omega_u = 1
        ("over_current", 0.5, "over-current: |i_dq| = 0.569"),
        ("over_voltage", 0.9, "over-voltage: V = 1 p.u. > 0.9"),
        ("under_voltage", 1.1, "under-voltage: V = 1 p.u. < 1.1"),
        ("dc_over_voltage", 0.9, "dc-over-voltage: v_dc = 1 p.u. > 0.9"),
        ("dc_under_voltage", 1.1, "dc-under-voltage: v_dc = 1 p.u. < 1.1"),
        ("over_frequency", 0.9, "over-frequency: omega_u = 1 p.u. > 0.9"),
        ("under_frequency", 1.1, "under-frequency: omega_u = 1 p.u. < 1.1"),
    ],
)
def test_trip_after_its_time(rest, name, threshold, text):
    plant = rest(protection={name: {"threshold": threshold, "delay_s": 0.002}})
    plant.advance(20)  # first seen at tick 1, so 1.9 ms have passed
    assert plant.truth()["trip"] == 0
    assert trip_reason(plant.plant.records) == ""
    plant.advance(1)
    assert TRIP_REASONS[int(plant.truth()["trip"])] == name.replace("_", "-")
    reason = trip_reason(plant.plant.records)
    assert reason.startswith(text)
    assert reason.endswith("p.u. for 0.002 s at tick 21 (t = 0.0021 s)")
    assert plant.truth()["i"] == 0.0


def test_disabled_never_trips(rest):
    plant = rest(protection={"over_voltage": {"threshold": 0.9, "enabled": False}})
    plant.advance(1000)
    assert plant.truth()["trip"] == 0


def test_shorter_than_its_time_does_not_trip(rest):
    plant = rest(protection={"over_frequency": {"threshold": 1.01, "delay_s": 0.002}})
    for _ in range(2):  # twice 1.5 ms
        plant.advance(15, plant.near(omega_u=0.02))
        plant.advance(1)
    assert plant.truth()["trip"] == 0
    plant.advance(21, plant.near(omega_u=0.02))
    assert plant.truth()["trip"] == code_of("over-frequency")


def test_trip_latches_blocks_and_the_network_goes_on(rest):
    plant = rest(protection={"over_current": {"threshold": 0.5, "delay_s": 0.0}})
    plant.advance(1)
    v_dc, tick = plant.truth()["v_dc"], int(plant.st[0]["trip_tick"])
    plant.advance(15_000, plant.near(i_u=0.5, omega_u=0.1, E_u=0.2))
    truth = plant.truth()
    assert (truth["i"], int(plant.st[0]["trip_tick"])) == (0.0, tick)
    assert truth["v_dc"] == v_dc  # source off, bridge blocked
    assert truth["omega_u"] == 1.0  # commands are ignored
    # only the grid still feeds C_f through the line
    r = plant.par[0]
    Z_g = complex(r["R_g"], r["L_g"])
    v = 1 / (1 + 1j * r["C_f"] * Z_g)
    assert truth["V"] == pytest.approx(abs(v), abs=1e-6)
    assert truth["q"] == pytest.approx(abs(v) ** 2 * r["C_f"], abs=1e-6)


def test_first_trip_is_kept(rest):
    plant = rest(protection={"over_current": {"threshold": 0.5, "delay_s": 0.0}})
    plant.advance(1)
    plant.advance(1, np.array([math.nan, 1.0, 1.0]))
    assert plant.truth()["trip"] == code_of("over-current")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_command_that_is_no_number(rest, bad):
    plant = rest()
    plant.advance(3)
    plant.advance(1, np.array([0.5, 1.0, bad]))
    assert trip_reason(plant.plant.records).startswith(
        f"command not finite: u held {bad} at tick 3"
    )
    plant.advance(10)
    assert np.isfinite(plant.sample()).all()


OFF = {
    name: {"enabled": False}
    for name in (
        "over_current",
        "over_voltage",
        "under_voltage",
        "dc_over_voltage",
        "dc_under_voltage",
        "over_frequency",
        "under_frequency",
    )
}


@pytest.mark.parametrize(
    "u",
    [[0.5, 1.0, 1e12], [0.5, 1e300, 1.0], [-1e9, 1.0, 1.0], [0.5, 1.0, 1e308], [-2.0, 1.0, 1.0]],
)
def test_divergence_leaves_finite_values(rest, u):
    plant = rest(protection=OFF, sensors={"bandwidth_hz": 1000.0})
    plant.advance(2000, np.array(u))
    assert plant.truth()["trip"] == code_of("diverged")
    assert "diverged: the state left the range of the model" in trip_reason(plant.plant.records)
    assert np.isfinite(plant.sample()).all()
    assert np.isfinite(list(plant.truth().values())).all()


def test_a_blocked_plant_outlives_a_grid_beyond_the_model(rest):
    """It keeps its last good state meanwhile; then it settles as one that saw none of it."""
    plant, other = rest(), rest()
    for one in (plant, other):
        one.advance(1, np.array([0.5, 1.0, math.nan]))
    grid_voltage(plant.plant, 1e9)
    plant.advance(20)
    grid_voltage(plant.plant, 1.0)
    plant.advance(1)
    assert plant.truth()["V"] < 2.0
    for one in (plant, other):
        one.advance(20_000)
    assert plant.truth()["V"] == pytest.approx(other.truth()["V"], abs=1e-6)
