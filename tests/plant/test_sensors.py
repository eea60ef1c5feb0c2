"""Sensors, noise and A/D."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_plant import Plant, make_plant, plant_sample
from gfm_plant.noise import gaussians
from gfm_plant.quantise import quantise


def test_ideal_sensors_see_the_truth(rest):
    plant = rest()
    plant.advance(50, plant.near(omega_u=1e-3, E_u=1e-3))
    y, truth = plant.sample(), plant.truth()
    assert list(y) == [truth[name] for name in ("v_dc", "p", "omega_u", "q", "V")]


def test_low_pass_against_the_exact_first_order(rest):
    """A step of the DC current makes v_dc a known ramp; the filter lags it exponentially."""
    plant = rest(P=0.0, V=1.0, sensors={"bandwidth_hz": 200.0})
    # A DC current of 0.1 p.u. and no power: v_dc = 1 + a t, apart from the loss in R_f.
    u = plant.near(i_u=0.1)
    a = 0.1 * 100 * math.pi / 19.242255
    tau = 1 / (2 * math.pi * 200)
    for k in range(1, 100):
        plant.advance(u=u)
        t = k * 1e-4
        assert plant.truth()["v_dc"] == pytest.approx(1 + a * t, abs=1e-6)
        exact = 1 + a * (t - tau * (1 - math.exp(-t / tau)))
        assert plant.sample()[0] == pytest.approx(exact, abs=1e-6)


def test_low_pass_of_a_step(rest):
    """A constant true value after a jump of the filter's state: a pure exponential."""
    plant = rest(sensors={"bandwidth_hz": 1000.0})
    plant.st["sensed"][0, :] += [0.1, 0.2, -0.3, 0.4]
    before = plant.sample() - [0.1, 0.2, 0.0, -0.3, 0.4]
    plant.advance(3)
    decay = math.exp(-2 * math.pi * 1000 * 3e-4)
    expected = before + decay * np.array([0.1, 0.2, 0.0, -0.3, 0.4])
    assert plant.sample() == pytest.approx(expected, abs=5e-8)


def test_gain_and_offset(rest):
    plant = rest(sensors={"gain": {"p": 1.02, "v_dc": 0.99}, "offset": {"p": 0.01, "q": -0.02}})
    truth = plant.truth()
    assert plant.sample() == pytest.approx(
        [
            0.99 * truth["v_dc"],
            1.02 * truth["p"] + 0.01,
            truth["omega_u"],
            truth["q"] - 0.02,
            truth["V"],
        ]
    )


def test_quantisation(rest):
    plant = rest(adc={"bits": 8, "range": {"p": [-0.75, 0.75]}})
    ideal = rest()
    lsb = 1.5 / 256
    u = plant.near(omega_u=2e-3)
    reached = 0.0
    for _ in range(200):
        plant.advance(u=u)
        ideal.advance(u=u)
        p, truth = plant.sample()[1], ideal.sample()[1]
        assert (p + 0.75) / lsb == pytest.approx(round((p + 0.75) / lsb), abs=1e-9)
        assert p == pytest.approx(min(truth, 0.75 - lsb), abs=lsb / 2 + 1e-12)
        assert plant.sample()[4] == ideal.sample()[4]  # a channel without a range is ideal
        reached = max(reached, truth)
    assert reached > 0.76  # full scale was exceeded


@pytest.mark.parametrize(
    ("value", "expected"),
    [(-2.0, -1.0), (2.0, 0.75), (0.1, 0.0), (0.13, 0.25), (-0.9, -1.0), (0.99, 0.75)],
)
def test_codes(value, expected):
    assert quantise(value, -1.0, 0.75, 0.25) == expected  # 3 bit over [-1, 1]


def test_noise_depends_on_seed_tick_and_channel_alone():
    options = {"noise_std": {"p": 0.01, "q": 0.01}, "seed": 7}
    samples = []
    for ticks in (5, 1000, 5):
        plant = make_plant(Plant.model_validate({"sensors": options}), 1e-4).records
        plant.st["tick"] = ticks
        y = np.empty(5)
        plant_sample(plant, 0, y)
        plant_sample(plant, 0, y)  # sampling again draws no new noise
        samples.append(y)
    assert (samples[0] == samples[2]).all()
    assert samples[0][1] != samples[1][1]
    assert samples[0][1] == pytest.approx(0.01 * gaussians(7, 5, 0)[1])
    assert samples[0][1] != samples[0][3]
    assert gaussians(8, 5, 0) != gaussians(7, 5, 0)


@given(st.integers(0, 2**63 - 1), st.integers(0, 10**9), st.integers(0, 7))
def test_noise_is_box_and_mullers_of_splitmix64(seed, tick, pair):
    """But for the series of the sine, which ends at x^9: 1.8e-9 of the length at 45 degrees."""
    bits = seed + 0x9E3779B97F4A7C15 * (8 * tick + pair)
    for _ in range(2):  # Steele, Lea and Flood, 2014
        bits %= 2**64
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
            bits = (bits ^ (bits >> shift)) * factor % 2**64
    length = math.sqrt(-2.0 * math.log((bits // 2**32 + 1) * 2.0**-32))
    quarter, share = divmod(bits % 2**32, 2**30)
    angle = (quarter + share * 2.0**-30 - 0.5) * math.pi / 2
    expected = length * math.cos(angle), length * math.sin(angle)
    assert gaussians(seed, tick, pair) == pytest.approx(expected, abs=2e-9 * length)


def test_noise_is_white_and_normal():
    n = 20_000
    z = np.array([gaussians(3, tick, 0) for tick in range(n)]).T
    assert z.mean(axis=1) == pytest.approx([0.0, 0.0], abs=4 / math.sqrt(n))
    assert z.var(axis=1) == pytest.approx([1.0, 1.0], abs=4 * math.sqrt(2 / n))
    assert (z**4).mean(axis=1) == pytest.approx([3.0, 3.0], abs=4 * math.sqrt(96 / n))
    for a, b in [(z[0, 1:], z[0, :-1]), (z[0], z[1])]:
        assert (a * b).mean() == pytest.approx(0.0, abs=4 / math.sqrt(n))
