"""Two real processes: they start, connect, run, and end together, however one of them ends."""

import json
import os
import re
import signal
import socket
import time
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.processes import Processes
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import load_scenario

from ...support.processes import (
    end,
    free_port,
    has_run,
    roles_of,
    signals,
    summary,
    wait_for,
    write,
)

pytestmark = pytest.mark.processes

TOGETHER = ("--link", "inproc", "--no-figures", "--quiet", "--out")
LONG = {"title": "long", "duration": 20.0}  # far more than any test waits for


@pytest.fixture
def begun(start, tmp_path):
    """Starts a long run; returns its process and folder when it has recorded 200 ticks."""

    def begin(**content):
        folder = tmp_path / "run"
        scenario = write(tmp_path, **LONG | content)
        process = start("run", scenario, "--out", str(folder), "--json", "--no-figures")
        wait_for(lambda: has_run(folder, 200), process)
        return process, folder

    return begin


def assert_same(one: Path, other: Path) -> None:
    """Check that two runs recorded the same, bit by bit."""
    a, b = signals(one), signals(other)
    assert set(a) == set(b)
    for name in a:
        assert a[name].tobytes() == b[name].tobytes(), name


def test_two_processes_in_lockstep_are_bit_for_bit_one(start, tmp_path):
    scenario = write(
        tmp_path,
        seed=3,
        duration=0.1,
        law="mimo-gfm",
        plant={
            "delay": {"samples": 1},
            "adc": "DS2004",
            "sensors": {"bandwidth_hz": 300.0, "noise_std": {"p": 1e-4}},
        },
        events=[
            {"t": 0.02, "type": "reference", "P_ref": 0.6},
            {"t": 0.05, "type": "law", "law": "vsg-2"},
            {"t": 0.07, "type": "grid-frequency", "f_hz": 49.95},
        ],
        link={"peer_timeout_s": 20.0},
    )
    apart = start("run", scenario, "--out", "apart", "--json", "--quiet", "--no-figures")
    code, out, err = end(apart)
    assert (code, err) == (0, "")
    assert json.loads(out) == summary(tmp_path / "apart")
    assert json.loads(out)["link"] == "zmq"
    assert json.loads(out)["e2e"] == {"controller": "valid", "plant": "valid"}
    assert main(["run", scenario, *TOGETHER, str(tmp_path / "together")]) == 0
    assert_same(tmp_path / "apart", tmp_path / "together")
    left = {path.name for path in (tmp_path / "apart").iterdir()}
    assert left == {"scenario.toml", "signals.npz", "timing.npz", "events.jsonl", "summary.json"}


def test_both_roles_started_by_hand_over_tcp(start, tmp_path, monkeypatch, capsys, refused):
    scenario = write(
        tmp_path,
        law="vsg-2",
        duration=0.1,
        events=[{"t": 0.05, "type": "reference", "P_ref": 0.6}],
        link={"peer_timeout_s": 20.0, "endpoint": f"tcp://127.0.0.1:{free_port()}"},
    )
    processes = {role: start(role, scenario, "--out", role) for role in reversed(ROLES)}
    for role, process in processes.items():
        code, out, _ = end(process)
        assert code == 0, out
        assert "completed" in out
        found = summary(tmp_path / role)
        assert (found["status"], found["ticks"], found["laws"]) == ("completed", 1000, ["vsg-2"])
        assert found["misses"] == (0 if role == "plant" else None)
        assert f"{'–' if role == 'controller' else 0} misses" in out
        assert not (tmp_path / role / "parts").exists()
    plant, controller = signals(tmp_path / "plant"), signals(tmp_path / "controller")
    assert "true_p" in plant and "true_p" not in controller
    assert controller["ref_P_ref"][-1] == 0.6
    monkeypatch.chdir(tmp_path)
    assert main(["run", scenario, *TOGETHER, "together"]) == 0
    together = signals(tmp_path / "together")
    for name in plant.keys() - {"laws"}:
        assert plant[name].tobytes() == together[name].tobytes(), name

    assert main(["merge", "controller", "plant", "-o", "merged"]) == 0
    assert "p final" in capsys.readouterr().out
    assert_same(tmp_path / "merged", tmp_path / "together")
    assert summary(tmp_path / "merged")["events"] == summary(tmp_path / "together")["events"]
    assert (tmp_path / "merged" / "report.html").stat().st_size > 10_000
    assert "merged: holds the recording of controller and plant" in refused(
        "merge", "plant", "merged"
    )
    (tmp_path / "plant" / "summary.json").write_text(json.dumps(found | {"run": "another"}))
    assert "are not of the same run: run = 'another', " in refused("merge", "plant", "controller")


def test_a_recording_beyond_the_memory_of_the_machine_is_refused(tmp_path, monkeypatch):
    """9e6 ticks of y and u at least, 8 bytes each, of each converter; 1 GB is left."""
    monkeypatch.setattr("gfm_hil.engine.processes.available_memory", lambda: 1e9)
    scenario = load_scenario(
        "three_share_a_load", mode="realtime", duration=900.0, T_s=1e-4, link={"type": "shm"}
    )
    with pytest.raises(UserError) as problem:
        Processes(scenario, tmp_path / "run", print, print, Interrupt(), {}).run()
    said = re.fullmatch(
        r"duration = 900: in real time the recording takes (\S+) GB of memory, and 1\.0 GB are "
        "free; run for a shorter time",
        str(problem.value),
    )
    assert said is not None and float(said[1]) > 3 * 9e6 * 8 * 8 / 1e9
    assert not (tmp_path / "run").exists()


def test_real_time_runs_to_its_end_and_records_its_timing(start, tmp_path):
    """In a steady state, so that late frames on a loaded machine do not change the signals."""
    scenario = write(
        tmp_path,
        law="vsg-2",
        mode="realtime",
        duration=0.3,
        late_policy={"hold": 1_000_000},
        link={"peer_timeout_s": 60.0},
    )
    code, out, err = end(start("run", scenario, "--out", "run", "--json"))
    found = json.loads(out)
    assert code == 0, found
    # when it ends, and how to end it before
    assert re.search(r": 0\.3 s in real time, to about \d\d:\d\d:\d\d; Ctrl-C ends it …", err)
    assert (found["status"], found["mode"], found["ticks"]) == ("completed", "realtime", 3000)
    assert (tmp_path / "run" / "timing.png").stat().st_size > 10_000
    with np.load(tmp_path / "run" / "timing.npz") as file:
        timing = dict(file)
    due, sent, received = (timing[f"plant_{n}"] for n in ("scheduled", "sent", "received"))
    assert (np.diff(due) == 100_000).all()  # absolute deadlines: no drift
    assert (timing["plant_woke"] >= due).all()
    there = received >= 0
    assert found["misses"] == (~there).sum()
    assert (received[there] > sent[there]).all()
    assert set(found["round_trip_us"]) == {"p50", "p99", "p99.9", "max"}
    seen = timing["controller_received"] >= 0
    assert (timing["controller_sent"][seen] >= timing["controller_computed"][seen]).all()


def test_ctrl_c_ends_both_and_keeps_the_data(begun):
    process, folder = begun()
    assert set(roles_of(folder)) == set(ROLES)
    process.send_signal(signal.SIGINT)
    code, out, _ = end(process)
    found = json.loads(out)
    assert code == 130
    assert found["status"] == "interrupted"
    assert found["reason"] in ("stopped by the operator", "the controller was stopped")
    assert roles_of(folder) == {}
    recorded = signals(folder)
    assert len(recorded["t"]) == found["ticks"] >= 200
    assert not np.isnan(recorded["true_p"]).any()
    assert not (folder / "parts").exists()


def test_in_lockstep_either_role_may_stand_still_for_seconds(begun):
    """As on a busy machine."""
    process, folder = begun(duration=40.0, link={"type": "shm"})  # some seconds
    roles = roles_of(folder)
    assert len(roles) == 2
    for stopped in roles.values():
        os.kill(stopped, signal.SIGSTOP)
        time.sleep(2.0)
        os.kill(stopped, signal.SIGCONT)
    code, out, _ = end(process)
    found = json.loads(out)
    assert (code, found["status"], found["ticks"]) == (0, "completed", 400_000)
    assert found["wall_s"] > 4.0


STANDS_STILL = """\
import os, signal, sys, threading
if "plant" in sys.orig_argv:
    os.kill(os.getpid(), signal.SIGSTOP)
elif "run" in sys.orig_argv:
    threading.Thread(target=threading.Event().wait, daemon=True).start()
"""


def test_a_plant_that_is_late_is_the_reason_and_not_the_signal_that_ends_it(
    start, tmp_path, monkeypatch
):
    """The plant stands still before its first import, as one does that has to compile. It is a
    program of its own, no copy of the command, which has a second thread."""
    (tmp_path / "sitecustomize.py").write_text(STANDS_STILL, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    link = {"start_timeout_s": 1.0, "peer_timeout_s": 1.0}
    scenario = write(tmp_path, **LONG, link=link)
    folder = tmp_path / "run"
    process = start("run", scenario, "--out", str(folder), "--json", "--no-figures")
    code, out, _ = end(process)
    found = json.loads(out)
    assert (code, found["status"]) == (3, "safe")
    assert "the plant did not come within 1 s" in found["reason"]
    assert roles_of(folder) == {}


def test_without_the_command_that_started_them_both_roles_end_too(begun):
    process, folder = begun()
    process.kill()
    process.communicate()
    wait_for(lambda: roles_of(folder) == {})
    for role in ROLES:
        part = RolePart.open(folder, role)
        assert not np.isnan(part.signals[:200]).any()


def test_a_plant_that_never_comes(start, tmp_path):
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    scenario = write(tmp_path, link={"start_timeout_s": 1.2, "endpoint": endpoint})
    code, out, err = end(start("controller", scenario, "--out", "alone"))
    assert code == 3
    assert f"waiting for the plant at {endpoint} …" in err
    assert f"the plant did not come within 1.2 s at {endpoint}" in " ".join(out.split())
    assert summary(tmp_path / "alone")["status"] == "safe"


def test_a_port_that_is_taken_is_one_line_and_leaves_nothing(start, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        scenario = write(tmp_path, link={"endpoint": endpoint})
        code, out, err = end(start("run", scenario, "--out", "run", "--quiet"))
        assert (code, out) == (2, "")
        expected = f"gfmhil: link.endpoint = '{endpoint}': cannot be bound: Address already in use"
        assert err.strip() == expected
    assert [path.name for path in tmp_path.iterdir()] == ["scenario.toml"]
