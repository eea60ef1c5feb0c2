"""Runs that wait after a trip or a safe state, and what a reset restores."""

from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import Link
from gfm_hil.links.frame import frame_dtype
from gfm_hil.recording.log import read_log
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import Scenario
from gfm_plant import CONTROLLER_SAFE
from gfm_runtime.states import READY, RUNNING, SAFE

from ...support.links import PATIENT, Tampering, assert_same, run_pair

TRIP, RESET = 200, 700
BASE = {"title": "reset", "duration": 0.12, "law": "vsg-2", "after_trip": "wait", "link": PATIENT}
#: a voltage dip to nothing and back: over-current; then a step of P_ref, and a reset
FALLS = [
    {"type": "grid-voltage", "tick": TRIP, "V_g": 0.0},
    {"type": "reference", "tick": 300, "P_ref": 0.9},
    {"type": "reset", "tick": RESET},
]


def scenario(**more) -> Scenario:
    return Scenario.model_validate({**BASE, "events": FALLS, **more})


def test_after_a_reset_the_run_is_that_of_a_fresh_start(tmp_path):
    run = run_scenario(scenario(), tmp_path / "a")
    s = run.signals
    assert run.summary["status"] == "completed"
    tripped = np.flatnonzero(s["true_trip"] != 0)
    assert TRIP < tripped[0] < 300 and tripped[-1] == RESET
    assert (s["state"][tripped[0] : RESET] == SAFE).all()
    assert s["state"][RESET] == READY
    assert (s["state"][RESET + 1 :] == RUNNING).all()
    assert (s["ref_P_ref"][RESET + 1 :] == 0.5).all()
    fresh = run_scenario(scenario(events=[]), tmp_path / "b").signals
    again = s["tick"] > RESET
    for name in s.keys() - {"tick", "t"}:  # the same bits as a new run
        assert np.array_equal(s[name][again], fresh[name][: again.sum()]), name


def test_while_it_waits_the_bridge_is_blocked(tmp_path):
    s = run_scenario(scenario(), tmp_path / "a").signals
    waiting = slice(RESET - 100, RESET)
    assert np.abs(s["true_i"][waiting]).max() < 1e-12
    assert np.ptp(s["u_E_u"][waiting]) == 0.0


@pytest.mark.parametrize("kind", ["shm", "zmq", "portable"])
def test_over_a_link_it_is_the_same_to_the_bit(kind, tmp_path):
    ours = run_scenario(scenario(), tmp_path / "a").signals
    portable = kind == "portable"
    pair = run_pair(
        scenario(),
        tmp_path / "b",
        "zmq" if portable else kind,
        {"portable": True} if portable else {},
    )
    for name in ours:
        assert np.array_equal(ours[name], pair.signals[name], equal_nan=True), name
    assert {end[0] for end in pair.ends().values()} == {"completed"}
    said = [(e["event"], e["role"]) for e in pair.log if e["event"] in ("tripped", "recovered")]
    assert sorted(said) == sorted(
        (event, role) for event in ("tripped", "recovered") for role in ("plant", "controller")
    )


def test_without_a_reset_it_ends_as_what_it_waits_for(tmp_path):
    run = run_scenario(scenario(events=FALLS[:1]), tmp_path / "a")
    assert run.summary["status"] == "tripped"
    assert run.summary["ticks"] == 1200
    pair = run_pair(scenario(events=FALLS[:1]), tmp_path / "b", "shm")
    assert {end[0] for end in pair.ends().values()} == {"tripped"}


@pytest.mark.parametrize("kind", ["inproc", "shm"])
def test_a_safe_controller_blocks_the_plant_and_both_come_back(kind, tmp_path):
    """Power beyond the measurement's range, after a jump that the protection tolerates."""
    events = [{"type": "grid-phase-jump", "tick": TRIP, "degrees": 120.0}, FALLS[-1]]
    what = scenario(events=events, plant={"protection": {"over_current": {"enabled": False}}})
    if kind == "inproc":
        s = run_scenario(what, tmp_path / "a").signals
    else:
        s = run_pair(what, tmp_path / "a", kind).signals
    safe = int(np.flatnonzero(s["state"] == SAFE)[0])
    assert TRIP < safe < 300
    assert s["true_trip"][safe] == 0 and (s["true_trip"][safe + 1 : RESET + 1] != 0).all()
    assert (s["state"][RESET + 1 :] == RUNNING).all()
    assert (s["true_trip"][RESET + 1 :] == 0).all()
    log = read_log(*(tmp_path / "a").glob("events*.jsonl"))
    reasons = {e["reason"] for e in log if e["event"] == "safe"}
    assert "a measurement is not finite or out of range: p" in reasons
    assert reasons <= {"a measurement is not finite or out of range: p", CONTROLLER_SAFE}


def test_a_reset_of_what_runs_is_refused_and_written_down(tmp_path):
    run = run_scenario(scenario(events=[FALLS[-1]]), tmp_path / "a")
    assert run.summary["status"] == "completed"
    log = (tmp_path / "a" / "events.jsonl").read_text()
    assert "the controller is RUNNING, not SAFE" in log


def test_a_reset_needs_a_run_that_waits():
    with pytest.raises(ValueError, match=r"events.2: nothing to reset with after_trip = 'end'"):
        scenario(after_trip="end")


def test_other_gains_are_those_of_a_law_that_has_them(tmp_path):
    """From a steady state, a change of D_p gives the run of a law file with that D_p."""
    gains = {"type": "gains", "tick": 0, "values": {"D_p": 0.02}}
    step = {"type": "reference", "tick": 100, "P_ref": 0.6}
    ours = run_scenario(scenario(events=[gains, step]), tmp_path / "a")
    assert ours.summary["laws"] == ["vsg-2", "other gains 1"]
    plain = run_scenario(scenario(events=[step]), tmp_path / "b")
    path = tmp_path / "mine.toml"
    text = files("gfm_runtime").joinpath("laws", "vsg-2.toml").read_text()
    path.write_text(text.replace("value = 0.01\n", "value = 0.02\n"))
    theirs = run_scenario(scenario(events=[step], law=str(path)), tmp_path / "c")
    away = np.abs(ours.signals["true_p"] - theirs.signals["true_p"]).max()
    assert away < 1e-6
    assert np.abs(ours.signals["true_p"] - plain.signals["true_p"]).max() > 1e-3


def test_a_gain_that_a_law_does_not_have_is_refused_before_anything_starts(tmp_path):
    gains = {"type": "gains", "tick": 0, "values": {"k_99": 0.02}}
    with pytest.raises(UserError, match=r"events, k_99 = 0\.02: .*parameter k_99: unknown"):
        run_scenario(scenario(events=[gains]), tmp_path / "a")


@pytest.mark.parametrize("kind", ["shm", "portable"])
def test_answers_that_come_twice_while_it_waits_are_not_taken_for_new_ones(kind, tmp_path):
    """The plant repeats y so soon that most answers come more than once."""
    ours = run_scenario(scenario(), tmp_path / "a").signals
    impairment = {"duplicate": 0.2, "loss": 0.05, "seed": 3}
    link = {**PATIENT, "repeat_s": 0.0005, "impairment": impairment}
    options = {"portable": True} if kind == "portable" else {}
    name = "zmq" if kind == "portable" else kind
    pair = run_pair(scenario(link=link), tmp_path / "b", name, options)
    for column in ours:
        assert np.array_equal(ours[column], pair.signals[column], equal_nan=True), column
    assert {end[0] for end in pair.ends().values()} == {"completed"}


def test_an_answer_lost_just_before_the_reset_is_repeated_as_it_was(tmp_path, endpoint):
    """The controller has been reset by the time the plant asks again for the tick before."""
    dropped = []

    def drop(count: int, message: bytes) -> bytes | None:
        tick = np.frombuffer(message, frame_dtype("u"))["tick"][0]
        if tick != RESET - 1 or dropped:
            return message
        dropped.append(tick)
        return None

    def touch(role: Role, link: Link) -> Any:
        return Tampering(link, drop) if role == "controller" else link

    ours = run_scenario(scenario(), tmp_path / "a").signals
    pair = run_pair(scenario(), tmp_path / "b", "zmq", touch=touch, endpoint=endpoint)
    assert dropped == [RESET - 1]
    assert_same(pair.signals, ours)
