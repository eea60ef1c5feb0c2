"""Metrics of signals with known values."""

import math

import numpy as np
import pytest
import scipy.fft
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

import gfmhil
from gfm_hil.api.law import as_law
from gfm_hil.core.errors import UserError
from gfm_hil.run.cycles import cycle_means, fast_length
from gfm_hil.run.metrics import METRICS, event_metrics
from gfm_hil.run.modes import _TAPS, Acting, _filter, acting, free_from, oscillations
from gfm_hil.scenario import check_scenario

T_s, F_N = 1e-3, 50.0
COLUMNS = ("true_p", "true_omega_u", "true_V", "true_i")
START, LENGTH = 200, 4000
t = np.arange(LENGTH) * T_s


def metrics(p=None, f=None, V=None, i=None, before=0.5):
    """Metrics of a window of 4 s after 0.2 s of rest; each signal at rest unless given."""

    def whole(x, rest):
        return np.concatenate([np.full(START, rest), np.full(LENGTH, rest) if x is None else x])

    signals = {
        "true_p": whole(p, before),
        "true_omega_u": whole(None if f is None else f / F_N, 1.0),
        "true_V": whole(V, 1.0),
        "true_i": whole(i, 0.5),
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
@given(st.floats(0.02, 0.8), st.floats(0.5, 20.0), st.floats(3e-2, 1.0))
def test_the_dominant_oscillation_is_found_whatever_it_is(zeta, f, size):
    x = size * (second_order(zeta, f) - 1.0)
    found = oscillations(0.5 + x, T_s, F_N).swing
    assert found.damping == pytest.approx(zeta, abs=0.01)
    assert found.hz == pytest.approx(f, rel=0.01)


def test_of_two_oscillations_the_stronger_is_named():
    x = 0.1 * np.exp(-t) * np.sin(2 * np.pi * 2 * t) + 0.02 * np.exp(-t) * np.sin(2 * np.pi * 9 * t)
    assert oscillations(0.5 + x, T_s, F_N).swing.hz == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("length", [1, 2, 19])
def test_a_window_of_a_few_ticks_says_nothing(length):
    signals = {name: np.ones(300) for name in COLUMNS}
    found = event_metrics(signals, 100, 100 + length, T_s, F_N)
    assert found == dict.fromkeys(METRICS)


@pytest.mark.parametrize("length", [20, 50, 130])
def test_a_short_window_has_what_it_can_have(length):
    signals = {name: np.ones(300) for name in COLUMNS}
    found = event_metrics(signals, 100, 100 + length, T_s, F_N)
    assert set(found) == set(METRICS)
    assert found["p_peak"] == 1.0
    assert (found["rocof_hz_s"] is None) == (length <= 100)


@pytest.mark.parametrize("width", [1.0, 7.0, 20.0, 166.66666666666669])
def test_means_over_a_cycle_are_those_worked_out_one_by_one(width, monkeypatch):
    x = np.random.default_rng(1).normal(size=700)
    n = math.ceil(width - 1e-6)
    part = width - math.floor(width + 1e-6)
    weights = np.ones(n)
    if part > 1e-6:
        weights[-1] = part
    expected = [np.dot(x[k : k + n], weights) / width for k in range(50, 650 - n + 1)]
    for piece in (1, 100, 1 << 18):
        monkeypatch.setattr("gfm_hil.run.cycles.PIECE", piece)
        found = np.concatenate(list(cycle_means(x, 50, 650, width)))
        assert found == pytest.approx(np.array(expected), abs=1e-14)
    assert not list(cycle_means(x, 0, n - 1, width))


def test_a_ripple_of_the_nominal_frequency_moves_only_what_is_of_every_tick():
    step = 1 - 0.5 * np.exp(-t / 0.1)
    ripple = 0.1 * np.sin(2 * np.pi * 50 * t)
    pure, found = metrics(step), metrics(step + ripple, V=1 + ripple, i=0.5 + ripple)
    for name in ("p_final", "settling_s", "overshoot_pct", "p_peak_cycle"):
        assert found[name] == pytest.approx(pure[name], abs=1e-9), name
    assert found["p_peak"] == pytest.approx(1.1 - 0.1 * (1 - math.cos(0.1 * math.pi)), abs=6e-3)
    assert (found["i_peak"], found["i_peak_cycle"]) == (
        pytest.approx(0.6, abs=6e-3), pytest.approx(0.5, abs=1e-12),
    )  # fmt: skip
    assert (found["v_max"], found["v_max_cycle"]) == (
        pytest.approx(1.1, abs=6e-3), pytest.approx(1.0, abs=1e-12),
    )  # fmt: skip
    assert found["damping_ratio"] is None  # the step itself does not swing
    assert found["fast_hz"] == pytest.approx(50.0, rel=1e-6)
    assert found["fast_damping_ratio"] == pytest.approx(0.0, abs=1e-6)


def test_the_time_to_90_percent():
    found = metrics(1 - 0.5 * np.exp(-t / 0.1))
    assert found["t90_s"] == pytest.approx(0.1 * math.log(10), abs=2 * T_s)  # of the step
    jump = metrics(0.5 + 0.2 * (t / 0.01) * np.exp(1 - t / 0.01))  # no step: of its peak at 10 ms
    assert jump["t90_s"] == pytest.approx(0.01 * 0.6084, abs=T_s)  # x e^(1-x) = 0.9
    assert metrics()["t90_s"] is None


@pytest.mark.parametrize("hertz", [49.5, 120.0, 761.0, 2400.0])
@pytest.mark.parametrize("sigma", [-20.0, 1.5])
def test_a_fast_mode_is_found_beside_a_larger_swing_without_aliasing(hertz, sigma):
    """761 Hz, taken every 50th tick without a filter, was shown as 39 Hz."""
    now = np.arange(30_000) * 1e-4
    size = 0.02 if sigma < 0 else 0.02 * math.exp(-1.5 * 2)
    fast = size * np.exp(sigma * now) * np.cos(2 * np.pi * hertz * now)
    slow = 0.2 * np.exp(-3 * now) * np.cos(2 * np.pi * 3 * now)
    p = 0.7 + slow + fast
    swings, found = oscillations(p, 1e-4, F_N)
    assert found.hz == pytest.approx(hertz, rel=1e-4)
    assert found.damping == pytest.approx(-sigma / math.hypot(sigma, 2 * np.pi * hertz), abs=1e-5)
    assert swings.hz == pytest.approx(3.0, rel=1e-3)
    assert swings.damping == pytest.approx(3 / math.hypot(3, 6 * np.pi), abs=1e-3)


@given(st.integers(1, 10**6))
def test_a_fast_length_is_that_of_scipy(n):
    assert fast_length(n) == scipy.fft.next_fast_len(n, real=True)


@pytest.mark.parametrize("stride", [2, 10, 33])
def test_the_low_pass_is_that_of_scipy(stride):
    taps = _TAPS * stride + 1
    steep = scipy.signal.firwin(taps, 0.8 / stride)
    least = scipy.signal.minimum_phase(steep, n_fft=fast_length(32 * taps), half=False)
    weights = _filter(stride).ravel()
    assert weights[:taps] == pytest.approx(least / least.sum(), abs=1e-13)
    assert not weights[taps:].any()


def test_the_offset_of_the_line_is_no_swing():
    """A DC offset of the line shows in p at 50 Hz, dying with the line's R/L."""
    p = 0.5 + 0.2 * np.exp(-30 * t) * np.cos(2 * np.pi * 50 * t)
    swings, found = oscillations(p, T_s, F_N)
    assert swings is None
    assert (found.hz, found.damping) == (
        pytest.approx(50.0, rel=1e-6), pytest.approx(30 / math.hypot(30, 100 * np.pi), rel=1e-6),
    )  # fmt: skip


@pytest.mark.parametrize("last", [[math.inf], [math.nan], [-math.inf, 0.0], [1e200, 1e300]])
def test_what_is_not_finite_has_no_modes(last):
    p = np.concatenate([0.5 + 0.1 * np.sin(2 * np.pi * 3 * t[:1500]), last])
    assert oscillations(p, T_s, F_N) == (None, None)


@pytest.mark.parametrize("first", [(1.0,), (-7.7, -60.3, 37495.7, -0.39, -8.55), (1e-3, -40, 1e6)])
def test_a_pole_that_grows_beyond_all_numbers_neither_hangs_nor_fails(first):
    """The least squares got e^(sigma t) = inf: LAPACK did not come back, or did not converge."""
    for length in range(40, 240, 7):
        x = np.zeros(length)
        x[-len(first) :] = first
        found = oscillations(x, T_s, F_N)
        assert all(one is None or math.isfinite(one.damping) for one in found)


@pytest.mark.parametrize(
    ("law", "to_hz", "rate", "then"),
    [
        ("vsg-2", 49.8, 0.2, None),
        ("vsg-2", 49.7, 0.5, None),
        ("droop-5", 49.7, 0.5, None),
        ("droop-5", 50.1, 0.05, 2.5),  # the window of the step has the end of the ramp in it
    ],
)
def test_after_a_ramp_of_the_grid_the_swing_is_that_of_the_linear_loop(law, to_hz, rate, then):
    """Fitted over ramp and corner it was 0.64 at 0.40 Hz, 0.28 at 1.05 Hz, 0.71 at 0.97 Hz."""
    events = [{"t": 1.0, "type": "grid-frequency", "f_hz": to_hz, "rate": rate}]
    events += [{"t": then, "type": "reference", "P_ref": 0.45}] if then else []
    grid = {"scr": 3.0, "x_over_r": 6.0}
    content = {"title": "", "duration": 7.0, "law": law, "events": events, "plant": {"grid": grid}}
    content["references"] = {"P_ref": 0.5}
    modes = as_law(law).closed_loop(check_scenario(content, "test")).modes()
    (mode,) = [m for m in modes if 0.3 < m.frequency_hz < 5.0]
    found = gfmhil.run(content).summary["events"][-1]
    assert found["damping_ratio"] == pytest.approx(mode.ratio, abs=0.005)
    assert found["oscillation_hz"] == pytest.approx(mode.frequency_hz, rel=0.02)


def until(*events, done=9000, omega_g=1.0, V_g=1.0):
    """What acts after the newest of these events, in ticks of 1 ms."""
    content = {"title": "", "duration": 9.0, "T_s": T_s, "events": [*events]}
    signals = {"true_omega_g": np.full(done, omega_g), "true_V_g": np.full(done, V_g)}
    return acting(check_scenario(content, "test"), signals, done)


RAMP = {"t": 1.0, "type": "grid-frequency", "f_hz": 49.0, "rate": 0.5}
SAG = {"t": 1.0, "type": "grid-voltage", "V_g": 0.5, "duration": 3.0}


def test_how_long_an_event_acts():
    assert until(RAMP) == [Acting(1000, 3000, 3000)]
    assert until(RAMP, omega_g=0.99) == [Acting(1000, 2000, 2000)]
    assert until({"t": 1.0, "type": "grid-voltage", "V_g": 0.5, "rate": 0.1}, V_g=0.9)[0].moved == (
        5000
    )
    assert until(SAG) == [Acting(1000, 4000, 0)]
    step = {"t": 2.0, "type": "reference", "P_ref": 0.4}
    assert until(RAMP, step)[-1] == Acting(2000, 3000, 3000)
    assert until(RAMP, {**RAMP, "t": 2.0, "rate": 5.0})[-1].moved == 2200  # in place of the first
    ramps = [{**step, "ramp_s": 4.0}, {"t": 3.0, "type": "reference", "V_ref": 1.01}]
    assert until(*ramps)[-1].moved == 6000  # V_ref does not end that of P_ref
    fault = {"t": 1.0, "type": "fault", "position": 0.5, "R": 0.1, "duration": 5.0}
    assert until(fault, {"t": 2.0, "type": "fault-clear"})[-1].held == 2000
    assert until(RAMP, {**step, "t": 5.0}, done=4000) == [Acting(1000, 3000, 3000)]


def test_a_window_is_fitted_from_where_nothing_acts_any_more():
    assert free_from(until(RAMP), 1000, 6000) == 3000
    assert free_from(until(RAMP), 1000, 2500) == 2500  # nothing is left of it
    assert free_from(until(RAMP), 500, 1000) == 500
    assert free_from(until(SAG), 1000, 6000) == 4000
    assert free_from(until(SAG), 1000, 3500) == 1000  # all of it within the sag
    assert free_from([], 1000, 3500) == 1000


def test_a_note_is_kept_and_cuts_no_response_short():
    step = {"type": "reference", "t": 0.05, "P_ref": 0.6}
    note = {"type": "note", "t": 0.1, "text": "the lab is warm"}
    base = {"title": "x", "duration": 0.4, "link": {"type": "inproc"}}
    plain, noted = (gfmhil.run({**base, "events": e}) for e in ([step], [step, note]))
    assert noted.summary["notes"] == [{"t": 0.1, "text": "the lab is warm"}]
    same = ("events", "ripple_pu", "status")
    assert [noted.summary[k] for k in same] == [plain.summary[k] for k in same]
    assert "notes" not in plain.summary
    with pytest.raises(UserError, match=r"events\.0\.text"):
        gfmhil.run({**base, "events": [{**note, "text": "two\nlines"}]})
