"""Linear models against SciPy, finite differences, the nonlinear bench, and known figures."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode, hold, linearise_plant
from gfm_design.model.operating_point import operating_point
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import Bench, make_bench
from gfm_hil.recording.columns import PLANT_COLUMNS
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import check_scenario
from gfm_plant import Plant, make_plant, phase_jump
from gfm_plant.model import DELTA, N_X, f, g
from gfm_runtime import discretise, get_law

from ..support.laws import every_law

REF = np.array([1.0, 0.5, 1.0, 0.0, 1.0])
RIG = {
    "delay": {"samples": 1},
    "sensors": {"bandwidth_hz": 300.0},
    "factors": {"R_f": 0.5, "R_g": 0.5},
}
PV = {
    "dc_source": {
        "mode": "array",
        "pv": {"V_oc": 1.25, "I_sc": 1.08, "V_mp": 1.0, "I_mp": 1.0, "irradiance": 0.7},
    }
}
REGULATED = {"dc_source": {"mode": "regulated"}}


def modes(law: str, plant: dict[str, Any], T_s: float = 1e-4, ideal: bool = False) -> list[Mode]:
    options = Plant.model_validate(plant)
    return ClosedLoop.of(law, options, REF, T_s=T_s, ideal=ideal).modes()


def near(found: list[Mode], frequency_hz: float) -> Mode:
    return min(found, key=lambda mode: abs(mode.frequency_hz - frequency_hz))


def test_plant_agrees_with_central_differences():
    # 1e-6 p.u. up and down: an error of order 1e-12 from the curvature, 1e-10 from rounding,
    # both on derivatives of up to 2e4 1/s
    par = make_plant(Plant(), 1e-4).par
    op = operating_point(par, discretise(get_law("vsg-2"), 1e-4), REF)
    plant, d, h = linearise_plant(par, op), np.array([1.0, 1.0]), 1e-6
    for j in range(N_X):
        e = np.eye(N_X)[j] * h
        slope = (f(op.x + e, op.u, d, par) - f(op.x - e, op.u, d, par)) / (2 * h)
        np.testing.assert_allclose(plant.A[:, j], slope, atol=1e-4)
        slope = (g(op.x + e, op.u) - g(op.x - e, op.u)) / (2 * h)
        np.testing.assert_allclose(plant.C[:, j], slope, atol=1e-7)
    for j in range(3):
        e = np.eye(3)[j] * h
        slope = (f(op.x, op.u + e, d, par) - f(op.x, op.u - e, d, par)) / (2 * h)
        np.testing.assert_allclose(plant.B[:, j], slope, atol=1e-4)
    for j in range(2):
        e = np.eye(2)[j] * h
        slope = (f(op.x, op.u, d + e, par) - f(op.x, op.u, d - e, par)) / (2 * h)
        np.testing.assert_allclose(plant.B_d[:, j], slope, atol=1e-4)


@pytest.mark.parametrize("T", [0.0, 1e-5, 1e-4, 1e-2])
def test_hold_agrees_with_scipy(T):
    par = make_plant(Plant.model_validate({**RIG, **REGULATED}), 1e-4).par
    plant = linearise_plant(par, operating_point(par, discretise(get_law("vsg-2"), 1e-4), REF))
    n = len(plant.A)
    M = np.zeros((n + 3, n + 3))
    M[:n, :n], M[:n, n:] = plant.A * T, plant.B * T
    out = expm(M)
    A, B = hold(plant.A, plant.B, T)
    np.testing.assert_allclose(A, out[:n, :n], rtol=0, atol=1e-12 * np.abs(out).max())
    np.testing.assert_allclose(B, out[:n, n:], rtol=0, atol=1e-12 * np.abs(out).max())


def bench_of(law: str, plant: dict[str, Any], duration: float) -> Bench:
    content = {"title": "", "duration": duration, "law": law, "plant": plant}
    return make_bench(check_scenario(content, "test"))


def perturbed_run(law: str, plant: dict[str, Any], ticks: int, angle: float, place: Path) -> Any:
    """(simulated, predicted) deviation of the measured p after a jump of delta by ``angle``."""
    bench = bench_of(law, plant, ticks * 1e-4)
    c = bench.controller
    loop = ClosedLoop.of(c.active_law, bench.scenario.plant, REF)
    x = np.zeros(len(loop.A))
    x[DELTA] = angle
    predicted = np.empty(ticks)
    for k in range(ticks):
        predicted[k] = loop.plant.C[1] @ x[: len(loop.plant.A)]
        x = loop.A @ x
    phase_jump(bench.plant, -math.degrees(angle))
    parts = [RolePart.create(place, role, ticks) for role in ("plant", "controller")]
    done = run_ticks(
        bench.plant.records,
        stack([bench]),
        parts[0].signals[None],
        parts[1].signals[None],
        0,
        ticks,
    )
    assert done == ticks
    p = parts[0].signals[:, PLANT_COLUMNS.index("y_p")]
    return p - bench.start.y[1], predicted


@pytest.mark.parametrize(
    ("law", "plant"),
    [
        ("vsg-2", RIG),
        ("vsg-2", {}),
        ("mimo-gfm", RIG),
        ("mimo-gfm", {**RIG, **REGULATED}),
        ("mimo-gfm", {**RIG, "delay": {"samples": 1, "fraction": 0.37}}),
        ("droop-5", {**RIG, "delay": {"samples": 2, "fraction": 0.5}}),
        ("vsg-5", {**RIG, "sensors": {"bandwidth_hz": 300.0, "gain": {"p": 1.05, "V": 0.98}}}),
        ("vsg-2", {"dc_source": {"tau_s": 0.005}, "modulation": "space-vector"}),
        ("vsg-2", {"dc_source": {"mode": "regulated", "tau_s": 0.001}}),
        pytest.param(
            "vsg-2", {"grid": {"finite": {"S": 3.0, "H": 4.0, "D": 1.0}}}, marks=pytest.mark.full
        ),
        ("hybrid-angle", {}),
        ("matching-2", PV),
        ("mimo-gfm-deployable-rig", {**PV, "delay": {"samples": 1}}),
        ("psc-dc", {"factors": {"L_g": 10.0, "R_g": 10.0}}),
        ("dvoc", {"factors": {"L_g": 10.0, "R_g": 10.0}, "delay": {"samples": 1}}),
    ],
)
def test_predicts_the_nonlinear_bench(law, plant, tmp_path):
    simulated, predicted = perturbed_run(law, plant, 2000, 1e-5, tmp_path)
    assert np.abs(simulated - predicted).max() < 2e-3 * np.abs(predicted).max()


def rate_and_frequency(x: np.ndarray, T: float, band: tuple[float, float]) -> tuple[float, float]:
    """sigma and frequency of the strongest oscillation of x in a band, by the matrix pencil."""
    hankel = np.lib.stride_tricks.sliding_window_view(x - x.mean(), len(x) // 3)
    basis = np.linalg.svd(hankel, full_matrices=False)[2][:12].T
    s = np.log(np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:])[0]).astype(complex)) / T
    shapes = np.exp(np.outer(np.arange(len(x)) * T, s))
    size = np.abs(shapes * np.linalg.lstsq(shapes, x - x.mean() + 0j)[0]).sum(axis=0)
    f_hz = s.imag / (2 * np.pi)
    inside = (f_hz > band[0]) & (f_hz < band[1])
    k = np.flatnonzero(inside)[np.argmax(size[inside])]
    return float(s[k].real), float(f_hz[k])


@pytest.mark.parametrize(
    ("law", "band", "ticks", "stride"),
    [("vsg-2", (40.0, 60.0), 4000, 10), ("mimo-gfm", (1000.0, 1120.0), 2500, 2)],
)
def test_mode_is_what_the_bench_shows(law, band, ticks, stride, tmp_path):
    simulated, _ = perturbed_run(law, RIG, ticks, 1e-6, tmp_path)
    sigma, f_hz = rate_and_frequency(simulated[500::stride], stride * 1e-4, band)
    mode = near(modes(law, RIG), sum(band) / 2)
    assert sigma == pytest.approx(mode.sigma, rel=0.02)
    assert f_hz == pytest.approx(mode.frequency_hz, rel=1e-3)


@pytest.mark.parametrize(
    ("law", "plant", "ideal", "frequency", "sigma"),
    [
        # figures computed before this module existed, with other programs
        ("vsg-2", {}, True, 3.7, -2.94),
        ("vsg-2", {}, True, 50.2, -3.1),
        ("vsg-2", RIG, False, 49.5, 12.0),
        ("mimo-gfm", RIG, False, 1074.0, -2.7),
        ("mimo-gfm", {"delay": {"samples": 1}}, False, 1180.0, 22.6),
    ],
)
def test_known_figures(law, plant, ideal, frequency, sigma):
    mode = near(modes(law, plant, ideal=ideal), frequency)
    assert mode.sigma == pytest.approx(sigma, abs=0.06)
    assert mode.frequency_hz == pytest.approx(frequency, abs=0.5)


@pytest.mark.parametrize("law", every_law())
def test_sampling_fast_leads_to_the_continuous_loop(law):
    # without delay only the hold's half a sample differs: at 1 us it turns 1.1 kHz by 0.4 deg
    home = get_law(law).home_grid
    plant = {"factors": {"L_g": home.L_g, "R_g": home.R_g}}
    fast, ideal = modes(law, plant, T_s=1e-6), modes(law, plant, T_s=1e-6, ideal=True)
    assert len(fast) == len(ideal)
    assert fast[0].sigma == pytest.approx(ideal[0].sigma, rel=0.02, abs=0.02)
    assert fast[0].sigma < 0.0  # the catalogue's promise for each law's home grid


def test_row_1_is_no_mode_beside_a_regulated_source():
    # its integrator would be an open one, at z = 1
    assert max(m.sigma for m in modes("vsg-2", {**REGULATED})) < -0.1


def test_mode_ratio():
    assert Mode(-3.0, 4.0 / (2 * np.pi)).ratio == pytest.approx(0.6)
    assert Mode(2.0, 0.0).ratio == -1.0
    assert Mode(0.0, 0.0).ratio == 0.0
