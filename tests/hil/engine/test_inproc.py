"""Both sides in one process: a steady state stays, events have their effects, reasons of ends."""

import math
import re
from importlib import resources

import numpy as np
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.engine.inproc import CHUNK, run_inproc
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.recording.columns import CONTROLLER_COLUMNS, PLANT_COLUMNS
from gfm_hil.recording.parts import RolePart
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario
from gfm_hil.scenario.events.gains import ready_gains
from gfm_runtime import load_law
from gfm_runtime.inner import INNER_CONSTANTS

from ...support.laws import every_law, home_plant

LOAD = {"load_R": 36.1, "load_L": 1e-3}  # about 1 p.u.
WEAK = {"factors": {"L_g": 10.0, "R_g": 10.0}}


def at(t: float, **content):
    """One event."""
    return {"t": t, **content}


@pytest.mark.parametrize("law", every_law())
def test_every_law_starts_in_an_equilibrium_on_its_home_grid(law, run):
    done = run(law=law, duration=0.2, plant=home_plant(law))
    assert done.summary["status"] == "completed"
    assert len(done.signals["tick"]) == 2000
    for name, x in done.signals.items():
        if name.startswith(("y_", "u_", "true_")):
            assert np.ptp(x) <= 1e-9, name
    assert done.signals["true_p"][0] == pytest.approx(0.5, abs=0.05)


def test_the_operating_point_knows_grid_references_and_sensors(run):
    done = run(
        references={"P_ref": 0.7, "Q_ref": 0.1, "V_ref": 1.02, "omega_g": 0.999},
        plant={"grid": {"omega_g": 0.999, "V_g": 1.01}, "sensors": {"gain": {"V": 1.01}}},
    )
    assert np.ptp(done.signals["true_p"]) <= 1e-9
    assert done.signals["true_omega_u"][-1] == pytest.approx(0.999, abs=1e-12)


def test_without_an_equilibrium_nothing_starts(make, tmp_path):
    scenario = make(references={"P_ref": 2.0}, plant={"factors": {"L_g": 100.0}})
    with pytest.raises(UserError, match=r"^references, plant\.grid: P = 2\.0 p\.u\."):
        run_scenario(scenario, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_reference_steps_and_ramps(run):
    done = run(
        duration=3.0,
        events=[
            at(0.5, type="reference", P_ref=1.0),
            at(1.0, type="reference", V_ref=1.004, ramp_s=0.2),
        ],
    )
    P, V = done.signals["ref_P_ref"], done.signals["ref_V_ref"]
    assert (P[:5000] == 0.5).all() and (P[5000:] == 1.0).all()
    ramp = V[10000:12000]
    np.testing.assert_allclose(np.diff(ramp), 0.004 / 2000, rtol=1e-6)
    assert V[9999] == 1.0 and V[12000] == pytest.approx(1.004, abs=1e-12)
    assert done.signals["true_p"][4999] == pytest.approx(0.5, abs=1e-9)
    assert done.signals["true_p"][-1] == pytest.approx(1.0, abs=0.02)
    assert [e["label"] for e in done.summary["events"]] == ["P_ref = 1", "V_ref = 1.004"]


def test_the_grid_frequency_steps_and_ramps(run):
    done = run(
        duration=2.0,
        events=[
            at(0.1, type="grid-frequency", f_hz=49.9),
            at(0.5, type="grid-frequency", f_hz=50.0, rate=0.5),
        ],
    )
    f = done.signals["true_omega_g"] * 50
    assert (f[:1000] == 50.0).all()
    np.testing.assert_allclose(f[1000:5000], 49.9, rtol=1e-12)
    # 0.1 Hz at 0.5 Hz/s: a straight line for 0.2 s
    np.testing.assert_allclose(f[5001:7000], 49.9 + 0.5e-4 * np.arange(1, 2000), atol=1e-4)
    np.testing.assert_allclose(f[7001:], 50.0, rtol=1e-12)
    # the converter follows the grid's frequency: droop of 0.01 p.u. turns 0.1 Hz into 0.2 p.u.
    assert done.signals["true_p"][4999] > 0.6


def test_a_sag_recovers_and_a_ramp_of_the_voltage_does_not(run):
    done = run(
        duration=1.0,
        plant=WEAK,
        law="vsg-2",
        events=[
            at(0.1, type="grid-voltage", V_g=0.95, duration=0.1),
            at(0.5, type="grid-voltage", V_g=0.97, rate=0.1),
        ],
    )
    V = done.signals["true_V_g"]
    assert (V[:1000] == 1.0).all() and (V[1000:2000] == 0.95).all() and (V[2000:5000] == 1.0).all()
    assert V[6500] == pytest.approx(0.985, abs=2e-5)
    np.testing.assert_allclose(V[8001:], 0.97, rtol=1e-12)
    assert done.summary["events"][0]["v_min"] < 1.0


def test_a_phase_jump_of_the_grid_moves_the_angle(run):
    done = run(plant=WEAK, law="vsg-2", events=[at(0.05, type="grid-phase-jump", degrees=2.0)])
    delta = done.signals["true_delta"]
    assert delta[500] - delta[499] == pytest.approx(-math.radians(2.0), abs=1e-9)
    assert done.signals["true_p"][600] < 0.45


def test_a_longer_line_is_felt(run):
    done = run(duration=1.0, law="vsg-2", events=[at(0.1, type="grid-impedance", L_g=5.0, R_g=5.0)])
    delta = done.signals["true_delta"]
    assert done.summary["status"] == "completed"
    assert abs(delta[-1]) > 2.5 * abs(delta[0])  # X_f + X_g, with X_g as large as X_f at first


def test_an_island_run_feeds_the_load_and_comes_back(run):
    done = run(
        duration=0.6,
        law="droop-5",
        plant={"grid": LOAD},
        references={"P_ref": 0.9},
        events=[
            at(0.1, type="grid-breaker", closed=False),
            at(0.3, type="grid-breaker", closed=True),
        ],
    )
    assert done.summary["status"] == "completed"
    p = done.signals["true_p"]
    V_ll, R, X = 380.0, LOAD["load_R"], LOAD["load_L"] * 2 * math.pi * 50
    load = V_ll**2 * R / (R**2 + X**2) / 4000
    assert p[2999] == pytest.approx(load, abs=0.03)
    assert [e["label"] for e in done.summary["events"]] == [
        "grid breaker opens",
        "grid breaker closes",
    ]


def test_events_of_one_tick_happen_in_the_order_of_the_file(run):
    done = run(events=[{"tick": 5, "type": "reference", "P_ref": p} for p in (0.6, 0.7, 0.55)])
    assert (done.signals["ref_P_ref"][5:] == 0.55).all()
    assert [e["label"][-3:] for e in done.summary["events"]] == ["0.6", "0.7", ".55"]


def test_events_at_the_first_and_the_last_tick(run):
    done = run(events=[
        {"tick": 0, "type": "reference", "P_ref": 0.6},
        {"tick": 999, "type": "reference", "P_ref": 0.7},
    ])  # fmt: skip
    assert done.signals["ref_P_ref"][0] == 0.6
    assert list(done.signals["ref_P_ref"][-2:]) == [0.6, 0.7]
    assert done.summary["ticks"] == 1000
    assert done.summary["events"][1]["p_peak"] is None  # one tick is too short


def test_a_scheduled_law_changes_its_stage_by_itself(run):
    """It needs excitation to see the line: P_ref steps back and forth on a ten times longer one."""
    steps = [at(1.0 + 0.75 * k, type="reference", P_ref=0.5 if k % 2 else 0.8) for k in range(5)]
    line = at(0.5, type="grid-impedance", L_g=10.0, R_g=10.0)
    done = run(law="mimo-gfm-scheduled", duration=5.0, events=[line, *steps])
    stiff = run(law="mimo-gfm-scheduled", duration=5.0, events=steps)
    assert done.summary["laws"] == ["mimo-gfm-scheduled", "mimo-gfm-scheduled[1]"]
    assert max(done.summary["bump_pu"]) <= 1e-6
    assert stiff.summary["laws"] == ["mimo-gfm-scheduled"]
    assert done.signals["X_est"][-1] > 3 * stiff.signals["X_est"][-1]
    change = int(np.flatnonzero(np.diff(done.signals["law"]))[0]) + 1
    for name in ("u_i_u", "u_omega_u", "u_E_u"):
        u = done.signals[name]
        before = np.abs(np.diff(u[change - 20 : change])).max()
        assert abs(u[change] - u[change - 1]) <= 2 * before + 1e-6


def test_a_law_file_may_bear_any_name(run, tmp_path):
    """Even the name of a catalogue law in the same run: the file's own name tells them apart."""
    from importlib.resources import files

    text = (files("gfm_runtime") / "laws" / "vsg-2.toml").read_text()
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("\nvalue = 90.0", "\nvalue = 80.0"))
    done = run(
        law="vsg-2", duration=0.3, plant=WEAK,
        events=[at(0.1, type="law", law=str(path)), at(0.2, type="law", law="vsg-2")],
    )  # fmt: skip
    assert done.summary["laws"] == ["vsg-2", "vsg-2 (mine.toml)", "vsg-2"]
    assert max(done.summary["bump_pu"]) <= 1e-6


def test_gains_change_at_the_converters_own_frequency(tmp_path):
    """The constants of an inner stage depend on omega_b, which other gains do not change."""
    paper = resources.files("gfm_plant") / "converters" / "paper.toml"
    text = paper.read_text("utf-8").replace("314.1592653589793", "376.99111843077515")
    (tmp_path / "sixty.toml").write_text(text)
    content = {"title": "60 Hz", "duration": 0.1, "law": "vsg-2", "inner": "virtual-stator"}
    content |= {"plant": {"converter": str(tmp_path / "sixty.toml")}, "link": {"type": "inproc"}}
    scenario = check_scenario(content, "")
    controller = make_bench(scenario).controller
    assert controller.omega_b == pytest.approx(120 * math.pi)
    same = load_law("vsg-2").laws[0].parameters["D_p"].value
    (packed,) = ready_gains(controller, {"D_p": same})[1]
    own = controller.laws[0]
    assert {name: packed[name] for name in INNER_CONSTANTS} == {
        name: own[name] for name in INNER_CONSTANTS
    }


def test_changing_to_the_law_in_force_changes_nothing(run):
    done = run(events=[at(0.05, type="law", law="mimo-gfm")])
    assert done.summary["laws"] == ["mimo-gfm"]
    assert done.summary["bump_pu"] == []
    assert done.summary["events"][0]["bump_pu"] is None


def test_a_trip_ends_the_run_and_says_why(run):
    plant = {"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}}
    done = run(duration=1.0, plant=plant, events=[at(0.1, type="grid-phase-jump", degrees=20.0)])
    assert done.summary["status"] == "tripped"
    assert done.summary["reason"].startswith("over-current: |i_dq| = ")
    assert 1000 < done.summary["ticks"] < 1200
    assert all(len(x) == done.summary["ticks"] for x in done.signals.values())


def test_a_measurement_out_of_range_leads_to_the_safe_state(run):
    """Here p after a jump of the grid's angle that the protection is set to tolerate."""
    plant = {"protection": {"over_current": {"enabled": False}}}
    done = run(
        duration=1.0, plant=plant,
        events=[at(0.1, type="grid-phase-jump", degrees=120.0)],
    )  # fmt: skip
    assert done.summary["status"] == "safe"
    assert done.summary["reason"].startswith("a measurement is not finite or out of range: ")
    last = {name: x[-1] for name, x in done.signals.items()}
    assert last["state"] == 3
    assert (done.signals["state"][:-1] == 2).all()


_TRIPS = {
    "plant": {"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}},
    "events": [at(0.02, type="grid-phase-jump", degrees=20.0)], "after_trip": "wait",
}  # fmt: skip


@pytest.mark.parametrize(
    ("content", "why"), [({}, ""), (_TRIPS, r"; since 0\.02\d* s: over-current: .*")]
)
def test_an_operator_who_stops_the_run_keeps_what_there_is(make, tmp_path, content, why):
    from gfm_hil.engine.setup import make_bench
    from gfm_hil.run.run_folder import finish

    scenario = make(duration=2.0, **content)
    bench = make_bench(scenario)
    parts = {role: RolePart.create(tmp_path, role, scenario.ticks) for role in ROLES}
    timeline = Timeline(bench, tmp_path / "events_both.jsonl", ROLES)
    run_inproc(
        [bench], [parts["plant"]], [parts["controller"]], [timeline], lambda ticks: ticks < CHUNK
    )
    timeline.close()
    (tmp_path / "scenario.toml").write_text("")
    done = finish(scenario, tmp_path, bench.controller.labels, 0.0)
    assert done.summary["status"] == "interrupted"
    assert re.fullmatch("stopped by the operator" + why, done.summary["reason"])
    assert len(done.signals["t"]) == done.summary["ticks"] == CHUNK
    assert not np.isnan(done.signals["true_p"]).any()


def test_the_same_seed_gives_the_same_noise_and_another_another(run):
    noisy = {"sensors": {"noise_std": {"p": 1e-3}}}
    one, same, other = (run(seed=seed, plant=noisy).signals["y_p"] for seed in (4, 4, 5))
    assert (one == same).all()
    assert (one != other).mean() > 0.9


def test_the_folder_of_a_run_holds_what_the_design_says(make, tmp_path, drawn):
    scenario = make(events=[at(0.05, type="reference", P_ref=0.6)])
    run_scenario(scenario, tmp_path / "run", report=write_report)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "scenario.toml", "signals.npz", "timing.npz", "events.jsonl", "summary.json",
        "report.html", "signals.png", "waveforms.png", "network.svg",
    }  # fmt: skip
    with np.load(tmp_path / "run" / "signals.npz") as file:
        assert list(file["laws"]) == ["mimo-gfm"]
        columns = {"tick", "t", *PLANT_COLUMNS, *CONTROLLER_COLUMNS}
        assert set(file) == {"laws", *columns}
        assert all(file[name].shape == (1000,) for name in columns)


def test_a_folder_that_holds_something_is_left_alone(make, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="not empty"):
        run_scenario(make(), tmp_path)
    with pytest.raises(UserError, match=r"notes\.txt is not a folder"):
        run_scenario(make(), tmp_path / "notes.txt" / "run")
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_recording_that_the_disk_has_no_room_for_is_refused(make, tmp_path):
    with pytest.raises(UserError, match=r"ticks need .* GB, free are"):
        run_scenario(make(duration=86400.0, T_s=1e-6), tmp_path / "run")
    assert not (tmp_path / "run").exists()
