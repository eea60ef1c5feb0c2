"""Metrics of signals with known values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gfm_hil.results.metrics import METRICS, dominant_oscillation, event_metrics

T_s, F_N = 1e-3, 50.0
START, LENGTH = 200, 4000
t = np.arange(LENGTH) * T_s


def metrics(p=None, f=None, V=None, before=0.5):
    """Metrics of a window of 4 s after 0.2 s of rest; each signal at rest unless given."""

    def whole(x, rest):
        return np.concatenate([np.full(START, rest), np.full(LENGTH, rest) if x is None else x])

    signals = {
        "true_p": whole(p, before),
        "true_omega_u": whole(None if f is None else f / F_N, 1.0),
        "true_V": whole(V, 1.0),
    }
    return event_metrics(signals, START, START + LENGTH, T_s, F_N)


def second_order(zeta: float, f_hz: float, low: float = 0.5, high: float = 1.0) -> np.ndarray:
    """Step response of w^2/(s^2 + 2 zeta w s + w^2) whose damped frequency is f_hz."""
    w_d = 2 * math.pi * f_hz
    w = w_d / math.sqrt(1 - zeta**2)
    y = 1 - np.exp(-zeta * w * t) * (np.cos(w_d * t) + zeta * w / w_d * np.sin(w_d * t))
    return low + (high - low) * y


@pytest.mark.parametrize(("low", "high"), [(0.5, 1.0), (1.0, 0.5), (0.2, -0.6)])
@pytest.mark.parametrize("zeta", [0.2, 0.4, 0.7])
def test_overshoot_and_settling_of_a_second_order_step(zeta, low, high):
    f = 2.0
    found = metrics(second_order(zeta, f, low, high), before=low)
    overshoot = 100 * math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert found["p_before"] == low
    assert found["p_final"] == pytest.approx(high, abs=1e-3)
    assert found["overshoot_pct"] == pytest.approx(overshoot, abs=0.3)
    assert found["p_peak"] == pytest.approx(high + (high - low) * overshoot / 100, abs=2e-3)
    y = (second_order(zeta, f) - 0.5) / 0.5
    settled = (np.flatnonzero(np.abs(y - 1) > 0.02)[-1] + 1) * T_s
    assert found["settling_s"] == pytest.approx(settled, abs=0.01)
    assert found["damping_ratio"] == pytest.approx(zeta, abs=0.02)
    assert found["oscillation_hz"] == pytest.approx(f, rel=0.02)


def test_a_first_order_step_neither_overshoots_nor_oscillates():
    found = metrics(1 - 0.5 * np.exp(-t / 0.1))
    assert found["overshoot_pct"] == pytest.approx(0, abs=1e-6)
    assert found["settling_s"] == pytest.approx(-0.1 * math.log(0.02), abs=2 * T_s)
    assert found["damping_ratio"] is None
    assert found["oscillation_hz"] is None


def test_frequency_nadir_peak_and_rocof_of_a_ramp():
    f = np.clip(50.0 - 0.5 * t, 49.8, None)
    found = metrics(f=f)
    assert found["f_nadir_hz"] == pytest.approx(49.8)
    assert found["f_peak_hz"] == pytest.approx(50.0)
    assert found["rocof_hz_s"] == pytest.approx(0.5, rel=1e-6)


def test_rocof_is_a_slope_over_a_tenth_of_a_second():
    f = np.where(t < 1.0, 50.0, 50.05)  # a step, not a slope over a tick
    assert metrics(f=f)["rocof_hz_s"] == pytest.approx(0.5, rel=1e-6)


def test_extremes_of_the_voltage():
    found = metrics(V=1.0 + 0.1 * np.sin(2 * np.pi * t) * (t < 1))
    assert found["v_min"] == pytest.approx(0.9, abs=1e-4)
    assert found["v_max"] == pytest.approx(1.1, abs=1e-4)


def test_without_a_step_there_is_no_overshoot():
    found = metrics(0.5 + 0.1 * np.exp(-t / 0.1))
    assert found["overshoot_pct"] is None
    assert found["p_peak"] == pytest.approx(0.6)
    assert found["settling_s"] == pytest.approx(0.1 * math.log(0.1 / 0.02), abs=2 * T_s)


def test_rest_has_settled_at_once_and_does_not_oscillate():
    found = metrics()
    assert found["settling_s"] == 0.0
    assert found["overshoot_pct"] is None
    assert found["rocof_hz_s"] == 0.0
    assert found["damping_ratio"] is None


def test_what_still_swings_at_the_end_has_not_settled():
    found = metrics(0.75 + 0.1 * np.sin(2 * np.pi * 3 * t))
    assert found["settling_s"] is None
    assert found["damping_ratio"] == pytest.approx(0.0, abs=1e-3)
    assert found["oscillation_hz"] == pytest.approx(3.0, rel=1e-3)


def test_an_unstable_oscillation_has_negative_damping():
    growing = 0.5 + 1e-3 * np.exp(0.5 * t) * np.sin(2 * np.pi * 10 * t)
    found = metrics(growing)
    assert found["damping_ratio"] == pytest.approx(-0.5 / math.hypot(0.5, 20 * np.pi), abs=1e-3)
    assert found["oscillation_hz"] == pytest.approx(10, rel=1e-2)


@settings(max_examples=40)
@given(st.floats(0.02, 0.8), st.floats(0.5, 20.0), st.floats(1e-2, 1.0))
def test_the_dominant_oscillation_is_found_whatever_it_is(zeta, f, size):
    x = size * (second_order(zeta, f) - 1.0)
    damping, frequency = dominant_oscillation(0.5 + x, T_s)
    assert damping == pytest.approx(zeta, abs=0.05)
    assert frequency == pytest.approx(f, rel=0.05)


def test_of_two_oscillations_the_stronger_is_named():
    x = 0.1 * np.exp(-t) * np.sin(2 * np.pi * 2 * t) + 0.02 * np.exp(-t) * np.sin(2 * np.pi * 9 * t)
    _, frequency = dominant_oscillation(0.5 + x, T_s)
    assert frequency == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("length", [1, 2, 19])
def test_a_window_of_a_few_ticks_says_nothing(length):
    signals = {name: np.ones(300) for name in ("true_p", "true_omega_u", "true_V")}
    found = event_metrics(signals, 100, 100 + length, T_s, F_N)
    assert found == dict.fromkeys(METRICS)


@pytest.mark.parametrize("length", [20, 50, 130])
def test_a_short_window_has_what_it_can_have(length):
    signals = {name: np.ones(300) for name in ("true_p", "true_omega_u", "true_V")}
    found = event_metrics(signals, 100, 100 + length, T_s, F_N)
    assert set(found) == set(METRICS)
    assert found["p_peak"] == 1.0
    assert (found["rocof_hz_s"] is None) == (length <= 100)
