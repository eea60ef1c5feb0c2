"""A trace of delays and misses, replayed in lockstep."""

import subprocess
import sys

import numpy as np
import pytest

import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.engine.replay import trace_of
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario

CONTENT = {
    "title": "replay", "duration": 0.05, "law": "vsg-2", "mode": "lockstep",
    "plant": {"delay": {"samples": 1}, "sensors": {"noise_std": {"p": 1e-4}}},
    "events": [{"tick": 50, "type": "reference", "P_ref": 0.55}],
}  # fmt: skip
SHOWN = ("y_p", "y_q", "y_V", "u_omega_u", "u_E_u", "true_p")


def content(trace, link="shm", **more):
    return {**CONTENT, "link": {"type": link, "impairment": {"trace": str(trace)}}, **more}


def same(one, other):
    for name in SHOWN:
        assert np.array_equal(one.signals[name], other.signals[name]), name


@pytest.fixture
def trace(tmp_path):
    """Misses of each kind: u lost, the controller standing still, a u that acts late."""
    ticks = 500
    acts, steps = np.arange(ticks), np.ones(ticks, np.int64)
    for k, (acting, step) in {60: (59, 1), 61: (60, 1), 80: (79, 0), 81: (79, 0)}.items():
        acts[k], steps[k] = acting, step
    path = tmp_path / "trace.npz"
    np.savez(path, acts=acts, steps=steps)
    return path


@pytest.mark.processes
def test_a_trace_does_what_it_says_over_a_link_and_in_process(trace, tmp_path):
    plain = gfmhil.run(CONTENT)
    found = gfmhil.run(content(trace))
    over_link = run_scenario(check_scenario(content(trace), "test"), tmp_path / "run")
    assert over_link.status == found.status == "completed"
    same(found, over_link)
    u, before = found.signals["u_omega_u"], plain.signals["u_omega_u"]
    assert np.array_equal(u[:60], before[:60])
    assert u[60] == u[59] and u[61] != u[60]  # u[60] comes one tick late
    assert u[80] == u[79] == u[81] and u[82] != u[81]
    timing = over_link.timing["plant_received"][:]
    assert [int(k) for k in np.flatnonzero(timing[:-1] < 0)] == [60, 61, 80, 81]


@pytest.mark.processes
def test_a_run_in_real_time_is_replayed_tick_by_tick(tmp_path):
    """Whatever the run missed over one link, over another one too; a process takes its processor
    now and then, so that it does miss."""
    asked = {**CONTENT, "mode": "realtime", "duration": 1.0}
    asked["link"] = {"type": "zmq", "peer_timeout_s": 30.0}
    asked["late_policy"] = {"hold": 10**6}
    with subprocess.Popen([sys.executable, "-c", _DISTURB]) as other:
        try:
            first = run_scenario(check_scenario(asked, "test"), tmp_path / "first")
        finally:
            other.kill()
    assert first.status in ("completed", "oscillating")  # by its misses
    again = content(tmp_path / "first", duration=1.0, late_policy={"hold": 10**6})
    found = run_scenario(check_scenario(again, "test"), tmp_path / "again")
    same(first, found)
    same(first, gfmhil.run(again))
    assert np.array_equal(found.timing["plant_acts"][:], first.timing["plant_acts"][:])
    assert first.summary["misses"] > 0


_DISTURB = """
import os, time
parent = os.getpid()
for cpu in sorted(os.sched_getaffinity(0))[-1:]:
    if os.fork() == 0:
        os.sched_setaffinity(0, {cpu})
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
        except OSError:
            pass
        while os.getppid() == parent:
            until = time.monotonic() + 1e-3
            while time.monotonic() < until:
                pass
            time.sleep(0.019)
        os._exit(0)
time.sleep(60)
"""


def test_refuses_a_trace_that_is_none(trace, tmp_path):
    np.savez(tmp_path / "other.npz", t=np.zeros(3))
    future = tmp_path / "future.npz"
    np.savez(future, acts=np.arange(500) + 1, steps=np.ones(500))
    start = np.zeros(3)
    for file, more, words in (
        (tmp_path / "none", {}, "no such file: "),
        (tmp_path / "other.npz", {}, "has no times of a run in real time"),
        (trace, {"duration": 0.06}, "has 500 ticks, and the run 600; shorten duration"),
        (trace, {"late_policy": {"hold": 1}}, "2 misses in a row, but late_policy.hold = 1"),
        (trace, {"late_policy": {"extrapolate": 1}}, "late_policy.extrapolate must be 0"),
        (trace, {"mode": "realtime"}, "is replayed in lockstep"),
        (future, {}, "acts must be from -1 to the tick itself"),
    ):
        with pytest.raises(UserError, match="link.impairment.trace = .*" + words):
            trace_of(check_scenario(content(file, **more), "test"), start)
    with pytest.raises(UserError, match="trace: stands alone, without another fault"):
        check_scenario(
            {**CONTENT, "link": {"type": "shm", "impairment": {"trace": "x", "loss": 0.1}}}, "test"
        )


def test_refuses_a_run_with_another_sampling_time(tmp_path):
    due = 200_000 * np.arange(600)
    times = {"plant_received": due, "plant_acts": due, "controller_computed": due}
    np.savez(tmp_path / "timing.npz", plant_scheduled=due, **times)
    with pytest.raises(UserError, match=r"has T_s = 0\.0002 s, and the scenario 0\.0001 s"):
        trace_of(check_scenario(content(tmp_path), "test"), np.zeros(3))
