"""The describing function of a dead time, against closed forms and against a switched bridge."""

import math

import numpy as np
import pytest
from scipy.signal import argrelextrema

import gfmhil
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.dead_time import DeadTime, with_dead_time
from gfm_hil.cli import main
from gfm_plant import TRUTH, Plant, make_plant, plant_advance, plant_equilibrium, plant_truth

T_S, PER_LEG = 1e-4, math.sqrt(3 / 2) * 700 / 380
LOOP = {
    "delay": {"samples": 1}, "sensors": {"bandwidth_hz": 300.0},
    "dc_source": {"mode": "regulated"},
}  # fmt: skip
NONE = 1e-6  # ripple


def swing(loop):
    return next(m for m in loop.modes() if 0.5 < m.frequency_hz < 20)


def test_without_ripple_it_is_that_of_a_relay():
    """4/pi of the voltage lost, along the current, whatever its size; across it a resistance."""
    i = 0.4 * np.exp(0.7j)
    dead = DeadTime(0.02, NONE, PER_LEG)
    drop = dead.drop(i, 1.0)
    size = 4 / math.pi * 0.02 * PER_LEG
    assert drop == pytest.approx(size * i / abs(i), rel=1e-3)
    assert dead.drop(3 * i, 1.0) == pytest.approx(drop, rel=1e-3)
    turned = dead.drop(i * np.exp(0.02j), 1.0)
    assert (turned - drop) / (i * 0.02j) == pytest.approx(size / abs(i), rel=0.02)
    by_e, by_dc = np.split(dead.slopes(0.4, 1.0)[:, 2:], [2], axis=1)
    assert dead.slopes(0.4, 1.0)[:, :2] == pytest.approx(np.diag([0.0, size / 0.4]), abs=1e-3)
    assert by_e == pytest.approx(np.zeros((2, 2)), abs=1e-3)
    assert by_dc[:, 0] == pytest.approx([size, 0.0], abs=1e-3)


def test_ripple_above_the_current_takes_it_away():
    assert DeadTime(0.02, 2.0, PER_LEG).drop(0.001, 1.0) == 0


@pytest.mark.parametrize("L", [1.0, 3.0])
@pytest.mark.parametrize("seconds", [1e-6, 3e-6])
def test_a_switched_bridge_loses_as_much(L, seconds):
    """At rest under a constant command: E - v - Z i, as a mean over 0.1 s. Within 4 % (ripple of
    0.5 p.u.) and 2 % (a third of it); the direction within 7 degrees."""
    off = {name: {"enabled": False} for name in ("over_current", "over_voltage", "under_voltage")}
    options = {
        "protection": off, "dc_source": {"mode": "regulated"}, "factors": {"L_f": L, "L_g": L},
        "bridge": {"kind": "two-level", "dead_time_s": seconds},
    }  # fmt: skip
    plant = make_plant(Plant.model_validate(options), T_S)
    x, u = plant_equilibrium(plant.par, 0.5, 1.0)
    plant.start(x, u)
    r, frame = plant.par[0], np.exp(1j * x[6])
    E = u[2] * frame
    i = complex(x[0], x[1]) * frame
    E += 4 / math.pi * seconds / T_S * PER_LEG * i / abs(i)
    # the command has the size and the angle of E from the first tick on
    x[6], u[2] = np.angle(E), abs(E)
    plant.start(x, u)
    rows = np.empty((6000, len(TRUTH)))
    for row in rows:
        plant_advance(plant.records, u)
        plant_truth(plant.records, 0, row)
    v_re, v_im, i_re, i_im = (
        rows[-1000:, TRUTH.index(name)].mean() for name in ("v_re", "v_im", "i_re", "i_im")
    )
    i = complex(i_re, i_im)
    lost = E - complex(v_re, v_im) - complex(r["R_f"], r["L_f"]) * i
    said = DeadTime.of(Plant.model_validate(options), plant.par, T_S, seconds).drop(i, E)
    assert abs(said) == pytest.approx(abs(lost), rel=0.04 if L == 1 else 0.02)
    assert abs(np.angle(said / lost, deg=True)) < 7.5


def test_a_small_dead_time_changes_nothing():
    loop = ClosedLoop.of("vsg-2", Plant.model_validate(LOOP))
    assert swing(with_dead_time(loop, 0.0)).sigma == pytest.approx(swing(loop).sigma, abs=1e-9)


def test_it_tells_what_loses_vsg_2_on_the_rig():
    """The swing of VSG-2 grows from 1 µs on, that of MIMO-GFM and of a fixed E_u (droop-3) at no
    dead time up to 3 µs; the mode near 50 Hz, which resistance alone damps, is gone."""
    for law, grows in (("vsg-2", True), ("mimo-gfm", False), ("droop-3", False)):
        loop = ClosedLoop.of(law, Plant.model_validate(LOOP))
        for seconds in (1.5e-6, 3e-6):
            modes = with_dead_time(loop, seconds).modes()
            assert (modes[0].sigma > 0) == grows
            assert not any(30 < m.frequency_hz < 80 and m.sigma > -50 for m in modes)


@pytest.mark.parametrize("seconds", [2e-6, 2.5e-6])
def test_the_swing_grows_as_the_switched_bridge_has_it(seconds):
    """p after the switchover, as one-cycle means: growth within 2 1/s, frequency within 8 %."""
    run = gfmhil.run(
        "switchover", plant__bridge={"kind": "two-level", "dead_time_s": seconds},
        plant__factors={"R_f": 1.0, "R_g": 1.0}, mode="lockstep",
    )  # fmt: skip
    mean = np.convolve(run.signals["p"][10_000:], np.ones(200) / 200, "valid")
    at = [argrelextrema(mean, which, order=300)[0] for which in (np.greater, np.less)]
    at = np.sort(np.concatenate(at))
    size, t = np.abs(np.diff(mean[at])) / 2, (at[1:] + at[:-1]) / 2 * T_S
    fits = (size > 0.02) & (np.arange(len(size)) < np.argmax(size > 0.35))
    assert fits.sum() >= 3
    sigma = np.polyfit(t[fits], np.log(size[fits]), 1)[0]
    said = swing(with_dead_time(ClosedLoop.of("vsg-2", Plant.model_validate(LOOP)), seconds))
    assert sigma == pytest.approx(said.sigma, abs=2.0)
    assert 1 / (2 * np.mean(np.diff(t[fits]))) == pytest.approx(said.frequency_hz, rel=0.08)


def test_the_command_takes_it_into_the_margins(capsys, refused):
    words = ["design", "margins", "--scenario", "rig_pref_step"]
    assert main([*words, "--law", "mimo-gfm", "--dead-time", "2e-6"]) == 0
    assert "2 µs of dead time" in capsys.readouterr().out
    assert main([*words, "--law", "vsg-2", "--dead-time", "2e-6"]) == 3
    capsys.readouterr()
    said = refused(*words, "--law", "mimo-gfm", "--dead-time", "1e-4")
    assert "--dead-time: dead time = 0.0001 s: must lie in [0, 5e-05) s" in said


def test_a_constant_voltage_rests_at_another_reactive_power():
    """Under droop-3 2 µs take 0.05 p.u. from a constant E_u, over the 0.07 p.u. of both chokes. A
    run of the switched bridge rests at q = -0.64 p.u.; the harmonics, which the function leaves
    out, make it 0.09 less."""
    plant = Plant.model_validate(LOOP)
    loop = ClosedLoop.of("droop-3", plant)
    assert loop.op.y[3] == pytest.approx(0.07, abs=0.01)
    run = gfmhil.run(
        "rig_pref_step", law="droop-3", plant__bridge={"kind": "two-level", "dead_time_s": 2e-6},
        plant__factors={}, events=[], duration=4.0, mode="lockstep",
    )  # fmt: skip
    rest = np.mean(run.signals["q"][-10_000:])
    assert rest == pytest.approx(-0.64, abs=0.03)
    with_it = with_dead_time(loop, 2e-6)
    assert with_it.op.y[3] == pytest.approx(rest, abs=0.12)
    # what the bridge is commanded less what it gives is the loss
    x, r = with_it.op.x, with_it.made_of.par[0]
    i, v = complex(x[0], x[1]), complex(x[2], x[3])
    lost = with_it.op.e - v - complex(r["R_f"], r["L_f"]) * i
    dead = DeadTime.of(plant, with_it.made_of.par, T_S, 2e-6)
    assert lost == pytest.approx(dead.drop(i, with_it.op.e), abs=1e-6)


def test_it_is_taken_into_an_inner_stage_too():
    """Without any it is the loop as it was; a scan confirms the one with 2 µs."""
    law = gfmhil.Law.load("droop-5").with_inner("virtual-stator")
    loop = law.closed_loop(Plant.model_validate(LOOP))
    assert with_dead_time(loop, 0.0).sigma() == pytest.approx(loop.sigma(), abs=1e-6)
    assert with_dead_time(loop, 2e-6).sigma() < 0


def test_three_levels_are_refused():
    plant = Plant.model_validate({**LOOP, "bridge": {"kind": "t-type"}})
    with pytest.raises(ValueError, match="is t-type"):
        with_dead_time(ClosedLoop.of("vsg-2", plant), 1e-6)
