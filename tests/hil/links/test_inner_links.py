"""Runs with an inner stage over every exact link give the bits of the run in process."""

import io
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_hil.ports.streams.messages import Sampler, block_messages
from gfm_hil.ports.streams.port import NewRows
from gfm_hil.recording.columns import CONTROLLER_INNER, PLANT_INNER
from gfm_hil.recording.live import LiveRun
from gfm_hil.run.run_folder import recover
from gfm_hil.run.runner import run_scenario
from gfm_runtime.signals import NU_INNER, NY_INNER

from ...support.links import PATIENT, RIG, assert_same, run_pair
from ...support.processes import end, signals, write
from ..conftest import unfinished

INNER = {"virtual-stator", "cascaded", "threshold-impedance"}
LINKS: dict[str, tuple[str, dict[str, Any]]] = {
    "shm": ("shm", {}),
    "zmq": ("zmq", {}),
    "pump": ("zmq", {"portable": True}),
}
JUMP = {"tick": 100, "type": "grid-phase-jump", "degrees": -25.0}
FALL = {"tick": 60, "type": "grid-voltage", "V_g": 0.0, "duration": 0.004}
TRIPPING = {"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}}
GRID = {"grid": {"scr": 3.0, "x_over_r": 10.0}}


pytestmark = pytest.mark.full  # loops of another shape to compile


@pytest.fixture
def limited(tmp_path: Path) -> str:
    """A law file with an inner stage of its own."""
    path = tmp_path / "limited.toml"
    text = files("gfm_runtime").joinpath("laws", "vsg-2.toml").read_text(encoding="utf-8")
    path.write_text('inner = "virtual-stator"\n' + text.replace('"vsg-2"', '"limited"', 1))
    return str(path)


def changes(limited: str, **more: Any) -> dict[str, Any]:
    """A run that starts without an inner stage, takes a law that has one, tunes it, jumps, and
    goes back."""
    return {
        "law": "vsg-2",
        "duration": 0.04,
        "link": PATIENT,
        "plant": {**RIG, **GRID},
        "events": [
            {"tick": 50, "type": "law", "law": limited},
            {"tick": 80, "type": "gains", "values": {"D_p": 0.02}},
            JUMP,
            {"tick": 300, "type": "law", "law": "droop-1"},
        ],
        **more,
    }


@pytest.mark.parametrize("kind", LINKS)
def test_changes_between_laws_with_and_without_a_stage(kind, limited, make, run, place):
    content = changes(limited)
    link, options = LINKS[kind]
    pair = run_pair(make(**content), place, link, options)
    together = run(**content).signals
    assert_same(pair.signals, together)
    assert {*PLANT_INNER, *CONTROLLER_INNER} <= pair.signals.keys()
    E_q, limiting = together["u_E_q"], together["limited"]
    assert (E_q[:50] == 0.0).all() and (np.abs(E_q[110:300]) > 0.0).all()
    assert limiting[100:300].any() and not limiting[:100].any()
    active = [one["law"] for one in pair.log if one["event"] == "law-active"]
    assert active == ["limited", "other gains 1", "droop-1"]


@pytest.mark.parametrize("inner", sorted(INNER))
def test_every_stage_over_shared_memory(inner, make, run, place):
    content = {
        "law": "vsg-2", "inner": inner, "duration": 0.03, "link": PATIENT,
        "plant": {**RIG, **GRID}, "events": [JUMP],
    }  # fmt: skip
    pair = run_pair(make(**content), place, "shm")
    assert_same(pair.signals, run(**content).signals)


@pytest.mark.parametrize("kind", LINKS)
def test_a_trip_a_reset_and_the_run_after_it(kind, make, run, place):
    content = {
        "law": "vsg-2", "inner": "cascaded", "duration": 0.03, "after_trip": "wait",
        "link": PATIENT, "plant": {**GRID, **TRIPPING},
        "events": [FALL, {"tick": 150, "type": "reset"}],
    }  # fmt: skip
    link, options = LINKS[kind]
    pair = run_pair(make(**content), place, link, options)
    ours = run(**content).signals
    assert_same(pair.signals, ours)
    assert (ours["true_trip"][100:150] != 0).all() and (ours["true_trip"][151:] == 0).all()
    fresh = run(**{**content, "events": []}).signals
    for name in (*PLANT_INNER, *CONTROLLER_INNER, "y_p", "u_E_u"):  # as a new run
        assert np.array_equal(ours[name][151:], fresh[name][: 300 - 151]), name


def test_damaged_lost_and_doubled_frames_in_lockstep(make, run, place):
    faults = {"seed": 3, "corrupt": 0.05, "loss": 0.05, "duplicate": 0.05, "reorder": 0.05}
    content = {
        "law": "vsg-2", "inner": "virtual-stator", "duration": 0.02,
        "link": {**PATIENT, "impairment": faults}, "plant": GRID, "events": [JUMP],
    }  # fmt: skip
    pair = run_pair(make(**content), place, "shm")
    assert all(sum(one.values()) > 0 for one in pair.injected.values())
    assert_same(pair.signals, run(**content).signals)


@pytest.mark.parametrize("group", ["y", "u"])
def test_a_frame_of_the_other_kind_of_run_is_refused_by_its_size(group):
    count = {"y": (5, NY_INNER), "u": (3, NU_INNER)}[group]
    for inner in (False, True):
        message = FrameWriter(group, inner).pack(0, 0, 0, np.zeros(count[inner]))
        reader, values = FrameReader(group, not inner), np.full(count[not inner], 7.0)
        with pytest.raises(FrameError, match="size"):
            reader.unpack(message, values)
        assert (values == 7.0).all() and reader.faults["size"] == 1


def test_an_old_frame_is_refused_by_its_version(make):
    writer = FrameWriter("y", True)
    writer.frame["version"] = 1
    message = writer.pack(0, 0, 0, np.zeros(NY_INNER))
    with pytest.raises(FrameError, match="version"):
        FrameReader("y", True).unpack(message, np.zeros(NY_INNER))


def test_the_parts_of_a_cut_run_are_followed_streamed_and_recovered(make, tmp_path):
    scenario = make(law="vsg-2", inner="virtual-stator", plant=GRID, events=[JUMP], duration=0.03)
    whole = run_scenario(scenario, tmp_path / "a").signals
    with unfinished():
        run_scenario(scenario, tmp_path / "b")
    live = LiveRun(tmp_path / "b")
    for role, name in (("plant", "u_E_q"), ("controller", "i_ref_d")):
        assert live.row(role, 200)[name] == whole[name][200]
        part = live.parts[role]
        rows = NewRows(role, 0, part.signals, part.times)
        got = np.concatenate([np.load(io.BytesIO(body)) for _, body in block_messages(rows)])
        assert got[name].tobytes() == whole[name].tobytes()
        sent = Sampler(scenario.T_s, 1e4, 0).messages(rows, 1.0)
        sample = json.loads(sent[200][1])
        assert (sample["u"]["E_q"] if role == "plant" else sample[name]) == whole[name][200]
    recovered = recover(tmp_path / "b").signals
    assert_same(dict(recovered), dict(whole))


@pytest.mark.processes
@pytest.mark.parametrize("link", ["shm", "zmq"])
def test_two_processes(link, limited, start, tmp_path):
    scenario = write(tmp_path, **changes(limited, link={"peer_timeout_s": 20.0}))
    apart = start("run", scenario, "--link", link, "--out", "apart", "--json", "--quiet",
                  "--no-figures")  # fmt: skip
    code, out, err = end(apart)
    assert (code, err) == (0, "")
    assert json.loads(out)["link"] == link
    assert main(["run", scenario, "--link", "inproc", "--out", str(tmp_path / "together"),
                 "--no-figures", "--quiet"]) == 0  # fmt: skip
    one, other = signals(tmp_path / "apart"), signals(tmp_path / "together")
    assert_same(dict(one), dict(other))
