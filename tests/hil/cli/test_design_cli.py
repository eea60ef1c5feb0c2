"""gfmhil design gamma and tune: their output, files and errors."""

import json

import control
import numpy as np
import pytest

from gfm_design.norms.performance import PAPER_WEIGHTS
from gfm_design.tuning.paper import LATE
from gfm_hil.api.law import Law
from gfm_hil.cli.main import main
from gfm_runtime import law_file

Capture = pytest.CaptureFixture[str]


def said(capsys: Capture, *arguments: str, code: int = 0) -> dict:
    assert main(["design", *arguments, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_gamma(capsys):
    out = said(capsys, "gamma", "--law", "mimo-gfm")
    assert out["gamma"] == pytest.approx(2.0209, rel=5e-5)
    assert [(c["i"], c["j"]) for c in out["channels"]] == [
        (1, 1), (2, 1), (2, 2), (3, 1), (3, 2), (4, 1),
    ]  # fmt: skip
    assert set(out["channels"][0]) == {"i", "j", "norm", "omega_rad_s"}


def test_gamma_of_other_gains_as_data_and_as_a_table(capsys):
    gains = ("gamma", "--law", "vsg-2", "--gains", "k_34=1.9048, k_22=5.9801")  # k_35 is tied
    assert said(capsys, *gains)["gamma"] == pytest.approx(15.97, rel=1e-3)
    assert main(["design", *gains]) == 0
    assert "γ = 15.97" in capsys.readouterr().out
    sampled = said(capsys, "gamma", "--law", "vsg-2", "--discrete")["gamma"]
    assert sampled == pytest.approx(15.97, rel=0.2)  # 10 kHz is fast for this loop


def test_an_unstable_loop_has_no_gamma(capsys):
    out = said(capsys, "gamma", "--law", "vsg-2", "--gains", "k_34=50", code=3)
    assert out["gamma"] is None
    assert "unstable" in out["reason"]


def test_weights_of_ones_own(capsys, tmp_path):
    path = tmp_path / "w.toml"
    path.write_text("[W_21]\nnum = [2.0]\nden = [1.0]\n")
    out = said(capsys, "gamma", "--law", "mimo-gfm", "--weights", str(path))
    assert len(out["channels"]) == 1
    assert out["gamma"] == pytest.approx(2.0, rel=0.2)  # p follows P_ref, with little overshoot


def test_tune(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    options = ("--starts", "1", "--evaluations", "640", "--seed", "4", "--quiet")
    out = said(capsys, "tune", "--law", "vsg-2", *options, "--out", str(path))
    assert out["gamma"] <= 15.98
    assert out["gamma_full_order"] is None
    assert {"gains", "seconds", "channels", "seed"} <= set(out)
    assert out["gains"]["k_35"] == pytest.approx(20 * out["gains"]["k_34"])
    assert law_file(str(path)).parameters["k_22"].value == out["gains"]["k_22"]


def test_tune_names_the_gain_at_its_bound(capsys):
    options = ("--starts", "1", "--evaluations", "40", "--quiet")
    assert main(["design", "tune", "--law", "vsg-5", *options]) == 0
    assert "k_qp is at its bound 0.1" in capsys.readouterr().out
    out = said(capsys, "tune", "--law", "vsg-5", *options)
    assert out["at_bounds"] == {"k_qp": 0.1}


def test_tune_says_what_gamma_was_and_which_channel_no_gain_moves(capsys):
    """q follows Q_ref in droop-3 with a gain that is not free, and W_41 is large at rest."""
    options = ("--starts", "1", "--evaluations", "320", "--quiet")
    out = said(capsys, "tune", "--law", "vsg-2", *options)
    start = said(capsys, "gamma", "--law", "vsg-2")["gamma"]
    assert out["gamma_before"] == pytest.approx(start, rel=1e-5) and out["unmoved"] == []
    assert main(["design", "tune", "--law", "droop-3", *options]) == 0
    said_of_it = capsys.readouterr().out
    assert "γ = 987.98, before the search 987.98" in said_of_it
    assert "no free gain moves W_41 T_41, the largest" in said_of_it


def test_a_weight_that_is_largest_at_infinite_frequency_is_named(capsys):
    assert main(["design", "gamma", "--law", "droop-5"]) == 0  # P_ref acts on omega_u at once
    out = capsys.readouterr().out
    assert "W_31 T_31 is largest at infinite frequency" in out and "inf\n" not in out
    assert main(["design", "gamma", "--law", "vsg-2"]) == 0
    assert "infinite" not in capsys.readouterr().out


def test_none_to_be_found_names_the_mode(capsys):
    options = ("--starts", "1", "--evaluations", "320", "--quiet")
    out = said(capsys, "tune", "--law", "droop-1", *options, code=3)
    assert out["gamma"] is None
    assert "mode at 50.7" in out["reason"]  # the synchronous resonance


@pytest.mark.parametrize("kind", ["bode", "nyquist"])
def test_a_loop_is_drawn_with_its_margins(kind, capsys, tmp_path):
    figure = tmp_path / "loop.png"
    out = said(capsys, kind, "--law", "vsg-2", "--at", "E_u,V", "--out", str(figure))
    assert list(out["at"]) == ["E_u", "V"]
    assert out["at"]["E_u"]["gain_high"] == pytest.approx(1.12, abs=0.01)  # docs/tuning.md
    assert figure.read_bytes().startswith(b"\x89PNG")
    out = said(capsys, kind, "--law", "vsg-2", "--scenario", "rig_pref_step", code=3)
    assert out["mode"]["frequency_hz"] == pytest.approx(49.5, abs=0.1)


def test_poles_and_a_step(capsys, tmp_path):
    out = said(capsys, "poles", "--law", "vsg-2", "--scenario", "rig_pref_step")
    assert not out["stable"] and out["modes"][0]["frequency_hz"] == pytest.approx(49.5, abs=0.1)
    figure = tmp_path / "step.svg"
    out = said(capsys, "step", "--law", "mimo-gfm", "--seconds", "4", "--out", str(figure))
    assert out["y"]["p"]["end"] == pytest.approx(1.0, abs=0.01)
    assert figure.read_text("utf-8").startswith("<?xml")
    assert main(["design", "step", "--law", "mimo-gfm"]) == 0
    assert "after P_ref" in capsys.readouterr().out


def test_any_key_of_the_scenario_is_set(capsys):
    weak = {"scr": 1.5, "x_over_r": 10}
    words = [w for key, value in weak.items() for w in ("--set", f"plant.grid.{key}={value}")]
    out = said(capsys, "poles", "--law", "vsg-2", *words)
    poles = Law.load("vsg-2").closed_loop("pref_step", plant__grid=weak).poles()
    assert out["modes"][0]["sigma"] == pytest.approx(poles.real.max(), rel=1e-9)


STAGED = ("--law", "vsg-2", "--inner", "virtual-stator")


def test_gamma_and_poles_behind_an_inner_stage(capsys):
    out = said(capsys, "gamma", *STAGED)
    # python-control's own norm of the loop, with the paper's weights by Tustin
    loop = Law.load("vsg-2").with_inner("virtual-stator").closed_loop(LATE)
    system = control.ss(*loop.performance(), loop.T_s)
    omega = np.geomspace(1e-2, 0.999 * np.pi / loop.T_s, 4000)
    z = np.exp(1j * omega * loop.T_s)
    s = 2.0 / loop.T_s * (z - 1.0) / (z + 1.0)
    T = system.frequency_response(omega).frdata
    peaks = [np.abs(w(s) * T[w.i - 1, w.j - 1]).max() for w in PAPER_WEIGHTS]
    assert out["gamma"] == pytest.approx(max(peaks), rel=1e-3)
    scenario = "phase_jump_within_rating"
    poles = said(capsys, "poles", *STAGED, "--scenario", scenario)
    assert poles["stable"]
    # the same stage by the scenario's own key, and none
    assert poles["modes"] == said(capsys, "poles", "--scenario", scenario)["modes"]
    bare = said(capsys, "poles", "--law", "vsg-2", "--inner", "none", "--scenario", scenario)
    assert bare["modes"] != poles["modes"]
    step = said(capsys, "step", *STAGED, "--scenario", scenario, "--seconds", "4")
    assert step["y"]["p"]["end"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.full
def test_tune_behind_an_inner_stage(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    before = said(capsys, "gamma", "--law", "mimo-gfm-practical", "--inner", "virtual-stator")
    options = ("--inner", "virtual-stator", "--starts", "1", "--evaluations", "64", "--quiet")
    out = said(capsys, "tune", "--law", "mimo-gfm-practical", *options, "--out", str(path))
    # the reactive power's loop is too slow for the voltage over the stage's reactance
    assert out["gamma"] < 2.5 < 20.0 < before["gamma"]
    assert law_file(str(path)).inner.type == "virtual-stator"
    again = said(capsys, "gamma", "--law", str(path))
    assert again["gamma"] == pytest.approx(out["gamma"], rel=1e-4)


@pytest.mark.parametrize("kind", ["gamma", "tune"])
def test_refuses_an_improper_weight(kind, refused, tmp_path):
    path = tmp_path / "w.toml"
    path.write_text("[W_11]\nnum = [1.0, 1.0]\nden = [1.0]\n")
    line = refused("design", kind, "--law", "vsg-2", "--weights", str(path))
    assert "W_11: improper" in line


OWN = """
name = "own"
title = "t"
source = "s"
[phi]
22 = { type = "P", k = "k" }
23 = { type = "P", k = "a" }
35 = { type = "I", k_i = 20.0 }
[parameters]
k = { value = 0.01, unit = "p.u.", source = "s", free = [0.001, 0.1] }
a = { value = 0.5, unit = "p.u.", source = "s", free = [-2.0, 2.0] }
"""


@pytest.mark.parametrize(
    ("was", "becomes", "words"),
    [
        ("value = 0.5", "value = -1.0", "omega_u loop"),  # omega_u = ... + omega_u
        (
            "",
            "",
            "no steady state at P_ref = 0.5 p.u., V_ref = 1 p.u., omega_g = 1 p.u., "
            "V_g = 1 p.u.; nothing holds v_dc: row 1 answers to no measurement",
        ),
        ("[-2.0, 2.0]", "[2.0, -2.0]", "parameters.a.free: [2, -2] must be finite and ascending"),
        ("[-2.0, 2.0]", "[1.0, 2.0]", "start 0.5 lies outside [1, 2]"),
    ],
)
def test_refuses_a_problem_that_is_none(was, becomes, words, refused, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(OWN.replace(was, becomes))
    assert words in refused("design", "tune", "--law", str(path))
