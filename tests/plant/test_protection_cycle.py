"""Protection by quantities over one cycle: overload profile and measured frequency."""

import math
from typing import Any

import numpy as np
import pytest
from numba import njit
from pydantic import ValidationError

from gfm_plant import TRIP_REASONS, Plant, grid_voltage, make_plant, trip_reason
from gfm_plant.layout import field
from gfm_plant.protection import protect

CYCLE = 200  # ticks of 100 µs in 20 ms
PROFILE = [{"threshold": 2.0, "delay_s": 0.04}, {"threshold": 1.6, "delay_s": 0.5}]
HIGH = {"over_current": {"threshold": 100.0}}


@njit
def look(plant: Any, i: Any, v: Any, seen: Any) -> None:
    """Show the protection currents (n,) and voltages (n, 2), and keep what it makes of them."""
    s, now = plant.st[0], plant.now[0]
    for k in range(len(i)):
        s.tick += 1
        s.x[0], s.x[1] = i[k], 0.0
        field(now, "w")[1] = complex(v[k, 0], v[k, 1])
        s.x[2], s.x[3] = 1.0, 0.0
        protect(plant, 0)
        seen[k, 0], seen[k, 1], seen[k, 2] = s.i_rms, s.omega_v, s.trip


def shown(i: Any, angle: Any = 0.0, size: Any = 1.0, T_s: float = 1e-4, **protection: Any) -> Any:
    """RMS, frequency and trip, shape (n,) each, and the plant."""
    n = max(np.size(i), np.size(angle))
    plant = make_plant(Plant.model_validate({"protection": {**HIGH, **protection}}), T_s).records
    angle, size = np.broadcast_to(angle, n), np.broadcast_to(size, n)
    v = np.column_stack([size * np.cos(angle), size * np.sin(angle)])
    seen = np.empty((n, 3))
    look(plant, np.broadcast_to(np.asarray(i, float), n).copy(), v, seen)
    return seen[:, 0], seen[:, 1], seen[:, 2], plant


@pytest.mark.parametrize("T_s", [1e-4, 2.5e-5, 1e-3])
def test_rms_over_a_cycle_of_a_sine_and_a_mean(T_s):
    t = np.arange(1, round(0.06 / T_s) + 1) * T_s
    i = 0.7 + 0.4 * np.sin(2 * np.pi * 50 * t + 0.5) + 0.2 * np.cos(2 * np.pi * 150 * t)
    rms, *_ = shown(i, T_s=T_s, overload=PROFILE)
    wanted = math.sqrt(0.7**2 + 0.4**2 / 2 + 0.2**2 / 2)
    assert rms[t > 0.0201] == pytest.approx(wanted, abs=1e-9 if T_s >= 1e-4 else 1e-3)


def test_the_sums_do_not_drift():
    i = np.full(1_000_000, 3.0)
    i[-CYCLE:] = 0.5
    rms, *_ = shown(i, overload=[{"threshold": 50.0, "delay_s": 0.0}])
    assert rms[-1] == pytest.approx(0.5, abs=1e-9)
    assert rms[-CYCLE - 1] == pytest.approx(3.0, abs=1e-9)


@pytest.mark.parametrize(
    ("step", "factor", "trips"),
    [(0, 1.01, True), (0, 0.99, False), (1, 1.01, True), (1, 0.99, False)],
)
def test_the_overload_profile_one_percent_above_and_below(step, factor, trips):
    """From 1 p.u. to i the squared RMS rises in a line: it crosses the threshold after
    (th^2 - 1) / (i^2 - 1) of a cycle."""
    threshold, delay = PROFILE[step]["threshold"], PROFILE[step]["delay_s"]
    current = factor * threshold
    before = 1000
    i = np.concatenate([np.full(before, 1.0), np.full(8000, current)])
    *_, trip, plant = shown(i, overload=PROFILE[step : step + 1])
    if not trips:
        assert not trip.any()
        return
    crossing = CYCLE * (threshold**2 - 1) / (current**2 - 1)
    at = before + math.floor(crossing) + 1 + round(delay * 1e4)
    assert TRIP_REASONS[int(trip[-1])] == "overload"
    assert int(plant.st[0]["trip_tick"]) == pytest.approx(at, abs=1)
    assert trip_reason(plant).startswith(f"overload: RMS of i over a cycle = {current:.3g}"[:33])
    assert f"> {threshold:g} p.u. for {delay:g} s at tick" in trip_reason(plant)


def test_each_step_of_the_profile_has_its_own_time():
    short = np.concatenate([np.full(1000, 1.0), np.full(350, 2.5), np.full(8000, 1.5)])
    *_, trip, _ = shown(short, overload=PROFILE)  # 35 ms of 2.5 p.u.
    assert not trip.any()
    between = np.concatenate([np.full(1000, 1.0), np.full(8000, 1.8), np.zeros(1000)])
    *_, trip, plant = shown(between, overload=PROFILE)
    assert "> 1.6 p.u. for 0.5 s" in trip_reason(plant)


@pytest.mark.parametrize("omega", [0.94, 1.0, 1.06])
def test_the_frequency_of_the_voltage(omega):
    turn = 100 * np.pi * (omega - 1.0) * np.arange(3000) * 1e-4  # in a frame of 50 Hz
    _, found, trip, plant = shown(1.0, turn, frequency="voltage", over_frequency={
        "threshold": 1.05, "delay_s": 0.05}, under_frequency={"threshold": 0.95, "delay_s": 0.05},
    )  # fmt: skip
    assert found[1:] == pytest.approx(omega, abs=1e-12)
    if omega == 1.0:
        assert not trip.any()
    else:
        side = "over" if omega > 1 else "under"
        assert trip_reason(plant).startswith(
            f"{side}-frequency: omega of V over a cycle = {omega:g} p.u. "
        )
        assert int(plant.st[0]["trip_tick"]) == pytest.approx(502, abs=1)


def test_an_offset_of_the_line_and_a_voltage_that_is_gone_are_no_frequency():
    t = np.arange(3000) * 1e-4
    v = 1.0 + 0.1 * np.exp(-100j * np.pi * t)  # DC in the phases: backwards at 50 Hz
    _, found, *_ = shown(1.0, np.angle(v), np.abs(v), frequency="voltage")
    assert found[CYCLE + 1 :] == pytest.approx(1.0, abs=1e-12)
    wild = np.where(t < 0.1, 0.0, np.random.default_rng(1).uniform(-3, 3, len(t)))
    _, found, trip, *_ = shown(1.0, wild, np.where(t < 0.1, 1.0, 0.1), frequency="voltage")
    assert found[1:] == pytest.approx(1.0, abs=1e-12)
    assert not trip.any()


def test_a_command_that_jitters_trips_by_command_and_not_by_voltage(rest):
    tight = {"over_frequency": {"threshold": 1.03, "delay_s": 0.0}}
    for frequency, code in (("command", "over-frequency"), ("voltage", "none")):
        plant = rest(protection={**tight, "frequency": frequency})
        for k in range(400):
            plant.advance(1, plant.near(omega_u=0.05 if k % 2 else -0.05))
        assert TRIP_REASONS[int(plant.truth()["trip"])] == code


def test_a_sag_through_which_the_profile_lets_the_plant_ride(rest):
    """A blip of 3 ms above 2 p.u., which an instantaneous protection does not forgive."""
    at_once = {"over_current": {"threshold": 1.2, "delay_s": 0.0}}
    for protection, code in ((at_once, "over-current"), ({"overload": PROFILE}, "none")):
        plant = rest(protection={**HIGH, **protection})
        plant.advance(400)
        grid_voltage(plant.plant, 0.95, None, 0.003)
        plant.advance(400)
        assert TRIP_REASONS[int(plant.truth()["trip"])] == code


def test_wrong_profiles_are_refused():
    for overload in ([{"threshold": 0.0, "delay_s": 1.0}], [{"threshold": 2.0}], PROFILE * 3):
        with pytest.raises(ValidationError, match="overload"):
            Plant.model_validate({"protection": {"overload": overload}})
