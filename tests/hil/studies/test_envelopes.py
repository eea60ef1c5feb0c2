"""Envelopes against DyCoV's published curves, and the fit against swing equations and laws.

The curves are a few lines of the CSV files of https://github.com/dynawo/dyn-grid-compliance-
verification (c) RTE and Grupo AIA, MPL-2.0, commit b7576cb0: docs/GFM_envelopes_curves/Envelopes
and tests/dycov/gfm/resources. Their columns: time, expected, and the two limits.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfmhil
from gfm_plant import load_converter
from gfmhil import envelopes

from ...support.files import text_of

T = np.linspace(0.0, 5.0, 3000)
OMEGA_B = 100 * math.pi
OVERDAMPED, UNDERDAMPED = envelopes.Unit(200.0, 5.0, 0.27), envelopes.Unit(95.0, 5.0, 0.27)
JUMP = 0.3 * (0.27 + 0.1)  # rad, at SCR 10

OVER = text_of("jump_overdamped.csv")
UNDER = text_of("jump_underdamped.csv")
AMPLITUDE = text_of("amplitude_step.csv")


ROCOF = text_of("rocof.csv")
SCR = text_of("scr_jump.csv")


def lines(text: str) -> list[list[float]]:
    rows = [line for line in text.splitlines() if not line.startswith("#")]
    return [[float(x) for x in line.split(";")] for line in rows]


@pytest.mark.parametrize(
    ("made", "curve"),
    [
        (lambda: envelopes.phase_jump(OVERDAMPED, T, JUMP, 10.0, 0.5), OVER),
        (lambda: envelopes.phase_jump(UNDERDAMPED, T, JUMP, 10.0, 0.5), UNDER),
        (lambda: envelopes.amplitude_step(OVERDAMPED, T, 0.15 * 0.37, 10.0), AMPLITUDE),
    ],
    ids=["overdamped", "underdamped", "amplitude"],
)
def test_envelopes_are_the_published_ones_to_their_digits(made, curve):
    found: envelopes.Envelope = made()
    for t, expected, *limits in lines(curve):
        k = round(t / (T[1] - T[0]))
        for value, printed in zip(
            (found.expected[k], found.lower[k], found.upper[k]),
            (expected, min(limits), max(limits)),
            strict=True,
        ):
            assert value == pytest.approx(printed, abs=5.1e-5)  # half of the last digit


@pytest.mark.parametrize(
    ("made", "curve"),
    [
        (lambda t: envelopes.rocof(OVERDAMPED, t, 0.5 / 50, 2.0, 0.0, lasts=3.0), ROCOF),
        (lambda t: envelopes.scr_jump(OVERDAMPED, t, 10.0, 2.0, 0.95), SCR),
    ],
    ids=["RoCoF", "SCR"],
)
def test_envelopes_of_ramps_and_scr_jumps_are_the_published_ones(made, curve):
    step = 6.0 / 2999
    t = 3.334e-4 + step * np.arange(2499)  # DyCoV's from -1 to 5 s, from the event on
    found: envelopes.Envelope = made(t)
    for at, *printed in lines(curve):
        k = round((at - t[0]) / step)
        values = found.expected[k], found.lower[k], found.upper[k]
        assert values == pytest.approx(printed, rel=5e-4, abs=5e-5), at  # of the last digit


def test_an_underdamped_unit_stays_in_its_own_envelopes():
    """And twice the answer, or a tenth of it, does not."""
    t = np.linspace(0.0, 5.0, 3000)
    unit = envelopes.Unit(60.0, 5.0, 0.3)
    late = 11  # samples: the 20 ms of the envelope
    for made, answer in (
        (lambda u: envelopes.rocof(u, t, -0.03, 5.0, 0.2, lasts=2.0),
         lambda u: envelopes.rocof_response(u, t, -0.03, 5.0, lasts=2.0)),
        (lambda u: envelopes.rocof(u, t, 0.03, 5.0, 0.2, lasts=2.0),
         lambda u: envelopes.rocof_response(u, t, 0.03, 5.0, lasts=2.0)),
        (lambda u: envelopes.scr_jump(u, t, 10.0, 3.0, 0.5),
         lambda u: envelopes.scr_jump_response(u, t, 10.0, 3.0, 0.5)),
        (lambda u: envelopes.scr_jump(u, t, 3.0, 10.0, 0.5),
         lambda u: envelopes.scr_jump_response(u, t, 3.0, 10.0, 0.5)),
    ):  # fmt: skip
        allowed = made(unit)
        assert (allowed.lower <= allowed.upper).all()
        for factor, inside in ((1.0, True), (2.0, False), (0.1, False)):
            change = factor * np.concatenate([np.zeros(late), answer(unit)[:-late]])
            beyond = allowed.outside(t, allowed.expected[0] + change)
            assert bool(beyond.max() < 2e-3) is inside, factor


def test_a_step_of_scr_is_the_published_one():
    # SCRJump_S_SCRup1_OC1: at 0.2 s, with 20 ms of delay
    unit = envelopes.Unit(133.0, 10.0, 0.25)
    at = np.array([0.2501, 0.3001, 0.3501, 0.3741])
    p = 0.5 + envelopes.scr_jump_response(unit, at - 0.22, 2.0, 10.0, 0.5)
    assert p == pytest.approx([1.061, 1.004, 0.9151, 0.8667], abs=5.1e-4)


def test_a_ramp_ends_where_inertia_and_damping_lead():
    unit = envelopes.Unit(80.0, 6.0, 0.3)
    t = np.linspace(0.0, 20.0, 2000)
    p = envelopes.rocof_response(unit, t, 0.02, 5.0, T_pll=0.02, lasts=10.0)
    assert p[999] == pytest.approx(-0.02 * (2 * 6.0 + 80.0 * 0.02), rel=1e-3)
    assert abs(p[-1]) < 1e-4


def test_a_response_is_judged_against_its_envelope():
    found = envelopes.phase_jump(OVERDAMPED, T, JUMP, 10.0, 0.5)
    assert found.outside(T, found.expected).max() == 0.0
    assert found.outside([1.0], [0.7])[0] == pytest.approx(0.7 - np.interp(1.0, T, found.upper))


@pytest.mark.parametrize(("D", "H", "X"), [(60.0, 4.0, 0.3), (20.0, 6.0, 0.15), (300.0, 2.0, 0.5)])
def test_the_fit_finds_a_swing_equation_again(D, H, X):
    jump = math.radians(5.0)

    def swing(t: float, z: np.ndarray) -> list[float]:
        angle, omega = z
        return [OMEGA_B * omega, (-(angle - jump) / X - D * omega) / (2 * H)]

    t = np.arange(0.0, 3.0, 1e-3)
    solved = solve_ivp(swing, (0.0, 3.0), [0.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12)
    found = envelopes.fit_jump(t, (solved.y[0] - jump) / X, jump, OMEGA_B, 0.05)
    assert [found.D, found.H, found.X_eff] == pytest.approx([D, H, X - 0.05], rel=0.01)


@pytest.mark.parametrize("law", ["vsg-1", "vsg-2", "droop-5"])
def test_the_inertia_of_a_ramp_is_that_of_the_law_less_the_lag_of_the_line(law):
    rate = 0.02  # Hz/s
    run = gfmhil.run(
        {
            "title": "ramp",
            "duration": 6.0,
            "plant": {"delay": {"samples": 1}, "sensors": {"bandwidth_hz": 300.0}},
            "events": [{"type": "grid-frequency", "t": 0.5, "f_hz": 50.2, "rate": rate}],
        },
        law,
    )
    t, p = run.signals["t"] - 0.5, run.signals["p"]
    D, H = envelopes.fit_ramp(t, p - p[4999], rate / 50, 3.0)
    gains, pu = gfmhil.Law.load(law).gains, load_converter("paper").pu()
    lag = gains.get("T") or 1 / gains["k_22"]
    assert gains["D_p"] * D == pytest.approx(1.0, rel=1e-3)
    H_law, X = lag / (2 * gains["D_p"]), pu["L_f"] + pu["L_g"]
    assert abs(H - (H_law - D**2 * X / (2 * OMEGA_B))) <= 0.05


def test_a_law_makes_a_unit_of_its_converter():
    unit = envelopes.measure_unit("vsg-2", plant__grid={"scr": 3.0, "x_over_r": 10.0})
    damping, inertia = unit.D, unit.H
    assert damping == pytest.approx(100.0, rel=0.02) and inertia == pytest.approx(8.361, rel=0.02)
    assert unit.X_eff == pytest.approx(load_converter("paper").pu()["L_f"], abs=0.005)
    more = envelopes.measure_unit(
        "vsg-2", inner="virtual-stator", plant__grid={"scr": 3.0, "x_over_r": 10.0}
    )
    assert more.X_eff == pytest.approx(0.3, rel=0.1)  # X_v of the stage
    behind = envelopes.measure_unit(
        "vsg-2", plant__grid={"scr": 3.0, "x_over_r": 10.0}, plant__lcl={"L": 0.15}
    )
    assert behind.X_eff == pytest.approx(unit.X_eff + 0.15, abs=0.01)  # its transformer


def test_a_law_without_inertia_makes_a_unit_of_almost_none():
    at = {"plant__grid": {"scr": 10.0, "x_over_r": 10.0}, "references__P_ref": 0.0}
    unit = envelopes.measure_unit("droop-1", inner="virtual-stator", **at)
    assert pytest.approx(100.0, rel=0.15) == unit.D and unit.H < 0.05


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: envelopes.Unit(100.0, 0.0, 0.3), "H = 0.0: must be > 0"),
        (lambda: envelopes.Unit(-1.0, 2.0, 0.3), "D = -1.0: must be >= 0"),
        (lambda: envelopes.phase_jump(OVERDAMPED, T, 0.1, 0.0, 0.5), "scr = 0.0: must be > 0"),
        (lambda: envelopes.fit_jump(T, 0.0 * T, 0.1, OMEGA_B, 0.1), "the power does not change"),
        (lambda: envelopes.fit_ramp(T, 0.0 * T, 0.01, 9.0), "need a ramp, and samples in it"),
        (lambda: envelopes.measure_unit("vsg-2", degrees=0.0), "must lie in"),
    ],
)
def test_mistakes(call, message):
    with pytest.raises(gfmhil.UserError, match=message):
        call()
