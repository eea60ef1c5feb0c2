"""The path of a command to the bridge and the DC source: D/A, delay, limits, regulation."""

from typing import Any

import numpy as np
import pytest


def commands(n: int, u0: Any) -> Any:
    rng = np.random.default_rng(5)
    return u0 + 1e-3 * rng.standard_normal((n, 3))


@pytest.mark.parametrize("samples", [0, 1, 2, 5])
def test_whole_delay_is_a_shifted_input(rest, samples):
    late, prompt = rest(delay={"samples": samples}), rest()
    u = commands(50, late.u)
    shifted = np.concatenate([np.tile(late.u, (samples, 1)), u])
    for k in range(50):
        late.advance(u=u[k])
        prompt.advance(u=shifted[k])
        assert (late.st["x"] == prompt.st["x"]).all()
        assert late.sample()[2] == shifted[k, 1]  # the omega_u in effect


@pytest.mark.parametrize("samples", [0, 1, 2, 5])
@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.5, 0.99])
def test_fraction_splits_the_period_exactly(rest, samples, fraction):
    """Reference: a plant with a hundredth of the period; its command changes at the right tick."""
    late = rest(delay={"samples": samples, "fraction": fraction})
    fine = rest(T_s=1e-6)
    u = commands(20, late.u)
    shifted = np.concatenate([np.tile(late.u, (samples + 1, 1)), u])
    split = round(100 * fraction)
    for k in range(20):
        late.advance(u=u[k])
        fine.advance(split, shifted[k])
        fine.advance(100 - split, shifted[k + 1])
        assert late.st["x"][0] == pytest.approx(fine.st["x"][0], abs=1e-9)
        assert late.truth()["delta"] == pytest.approx(fine.truth()["delta"], abs=1e-13)


def test_dac_rounds_and_clamps(rest):
    plant = rest(dac={"bits": 8, "range": {"E_u": [0.0, 2.0], "i_u": [-1.0, 1.0]}})
    plant.advance(u=np.array([5.0, 1.00123, 1.001]))
    assert list(plant.st["u_now"][0, :4]) == [1.0 - 2 / 256, 1.00123, 1.0, 0.0]


def test_rig_boards_by_name(rest):
    plant = rest(adc="DS2004", dac="DS2101")
    plant.advance(100)
    assert plant.sample()[1] == pytest.approx(plant.truth()["p"], abs=2 / 2**16)
    assert plant.st["u_now"][0, 2] == pytest.approx(plant.u[2], abs=1 / 2**12)


def test_limited_source(rest):
    limited, other = rest(dc_source={"i_max": 0.7}), rest()
    limited.advance(10, limited.near(i_u=5.0))
    other.advance(10, np.array([0.7, *other.u[1:]]))
    assert (limited.st["x"] == other.st["x"]).all()
    assert limited.truth()["i_dc"] == other.truth()["i_dc"] == 0.7


def test_regulated_source_ignores_i_u_and_holds_v_dc(rest):
    plant = rest(dc_source={"mode": "regulated"})
    plant.advance(50, plant.near(i_u=9.0, omega_u=5e-3))
    assert plant.truth()["p"] > 0.57
    plant.advance(10_000, plant.near(i_u=-9.0))
    assert plant.truth()["v_dc"] == pytest.approx(1.0, abs=1e-4)
    drawn = plant.st["u_now"][0, 2] * plant.st["x"][0, 0]  # E_u i_d, which the source delivers
    assert plant.truth()["i_dc"] * plant.truth()["v_dc"] == pytest.approx(drawn, abs=1e-4)


def test_regulated_source_does_not_wind_up(rest):
    """At the current limit the integral is frozen, so that v_dc does not overshoot afterwards."""
    plant = rest(P=0.3, dc_source={"mode": "regulated", "i_max": 0.5})
    plant.advance(50, plant.near(omega_u=0.01))  # the power rises beyond 0.5 p.u.
    plant.advance(300, plant.u)
    assert plant.truth()["p"] > 0.6
    assert plant.truth()["v_dc"] < 0.95
    assert plant.st[0]["i_reg"] <= 0.5
    plant.advance(50, plant.near(omega_u=-0.01))  # and back
    peak = 0.0
    for _ in range(3000):
        plant.advance(u=plant.u)
        peak = max(peak, plant.truth()["v_dc"])
    assert plant.truth()["v_dc"] == pytest.approx(1.0, abs=1e-3)
    assert peak < 1.01
