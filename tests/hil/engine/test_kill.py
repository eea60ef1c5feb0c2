"""kill -9 and SIGSTOP at any moment: the other side is safe in time, and nothing is left behind.

2 rounds by default; GFMHIL_KILLS=100 runs the number of the acceptance test, GFMHIL_KILLS_SEED
selects other rounds, and GFMHIL_KILLS_REPORT=file writes a line per round: link, mode, killed side,
ticks recorded, and the time in s from the last frame of the killed side to the end of the other.
"""

import contextlib
import json
import os
import random
import signal
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.roles import ROLES

from ...support.processes import end, has_run, places, roles_of, signals, summary, wait_for, write

pytestmark = pytest.mark.systems

ROUNDS = int(os.environ.get("GFMHIL_KILLS", "2"))
SEED = int(os.environ.get("GFMHIL_KILLS_SEED", "119"))  # both links, modes and roles
REPORT = os.environ.get("GFMHIL_KILLS_REPORT")
PEER_TIMEOUT_S, HOLD = 0.5, 2000
GENEROUS_S = 10.0  # margin: a crowded machine may not run a process for seconds


def log_of(folder: Path) -> list[dict[str, Any]]:
    """The lines of events.jsonl."""
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def watchdog_s(folder: Path, victim: str) -> float:
    """Time from the last frame of the killed side to the end of the other one."""
    other = "plant" if victim == "controller" else "controller"
    (last,) = [e for e in log_of(folder) if e["event"] == "end"]
    assert last["role"] == other and last["status"] == "safe"
    with np.load(folder / "timing.npz") as file:
        return (last["clock_ns"] - file[f"{other}_received"].max()) * 1e-9


@pytest.mark.timeout(30 + 30 * ROUNDS)
def test_kill_9_of_either_role_at_random_ticks(start, tmp_path):
    chance = random.Random(SEED)
    done = 0
    for k in range(2 * ROUNDS):
        if done == ROUNDS:
            break
        link, mode, victim = (
            chance.choice(("shm", "zmq")),
            chance.choice(("lockstep", "realtime")),
            chance.choice(ROLES),
        )
        ticks = chance.randrange(1, 3000)
        folder = tmp_path / f"run{k}"
        scenario = write(
            tmp_path,
            mode=mode,
            law="vsg-2",
            duration=60.0,
            late_policy={"hold": HOLD},
            link={"type": link, "peer_timeout_s": PEER_TIMEOUT_S},
        )
        process = start("run", scenario, "--out", str(folder), "--json", "--no-figures")
        wait_for(lambda f=folder, n=ticks: has_run(f, n), process)
        outside: set[Path] = set()
        with contextlib.suppress(KeyError, OSError):  # a run may end by itself at any moment
            outside = places(folder)
            os.kill(roles_of(folder)[victim], signal.SIGKILL)
        code, out, err = end(process)
        found = json.loads(out)
        if sum(e["event"] == "end" for e in log_of(folder)) == 2:
            continue  # a stall of the machine ended the run before we did
        done += 1
        assert len(outside) == (2 if mode == "realtime" else 1)
        assert (code, found["status"]) == (3, "safe")
        assert found["reason"] == f"the {victim} was ended by SIGKILL" and found["reason"] in err
        took = watchdog_s(folder, victim)
        assert took < PEER_TIMEOUT_S + GENEROUS_S
        recorded = signals(folder)
        n = len(recorded["t"])
        assert n == found["ticks"] >= ticks
        for name in ("true_p", "y_p", "u_omega_u"):
            assert np.isfinite(recorded[name]).all()
        assert np.isfinite(recorded["ref_P_ref"]).any()  # the controller's own
        if victim == "controller" and mode == "realtime":
            with np.load(folder / "timing.npz") as file:
                late = file["plant_received"] < 0
            # the plant itself counts ticks, however long they took
            assert late[-HOLD - 1 :].all() and n > HOLD
        assert roles_of(folder) == {}
        assert not any(path.exists() for path in outside)
        if REPORT:
            with Path(REPORT).open("a", encoding="utf-8") as file:
                file.write(json.dumps([link, mode, victim, n, took]) + "\n")
    assert done == ROUNDS
    scenario = write(tmp_path, law="vsg-2", link={"type": "shm", "peer_timeout_s": 60.0})
    code, out, _ = end(start("run", scenario, "--out", str(tmp_path / "next"), "--json",
                             "--no-figures"))  # fmt: skip
    assert (code, json.loads(out)["status"]) == (0, "completed")


def test_without_a_survivor_the_next_run_clears_up(start, tmp_path):
    folder = tmp_path / "run"
    content = {"mode": "realtime", "law": "vsg-2", "link": {"type": "shm"}}
    patient = {"late_policy": {"hold": 10**6}}
    scenario = write(tmp_path, **content, **patient, duration=60.0)
    process = start("run", scenario, "--out", str(folder), "--no-figures")
    wait_for(lambda: has_run(folder, 300), process)
    roles, outside = roles_of(folder), places(folder)
    for number in (process.pid, *roles.values()):
        os.kill(number, signal.SIGKILL)
    process.communicate()
    wait_for(lambda: roles_of(folder) == {})
    assert all(path.exists() for path in outside)
    scenario = write(tmp_path, **content, **patient)
    code, *_ = end(start("run", scenario, "--out", str(tmp_path / "next"), "--no-figures"))
    assert code in (0, 3)  # depends on the load of the machine
    assert not any(path.exists() for path in outside)
    assert {path.name for path in (folder / "parts").iterdir()} == {
        f"{role}_{what}.npy" for role in ROLES for what in ("signals", "times", "progress")
    }
    assert np.isfinite(np.load(folder / "parts" / "plant_signals.npy")[:300]).all()


@pytest.mark.parametrize(("link", "victim"), [("shm", "controller"), ("zmq", "plant")])
def test_a_role_that_hangs_makes_the_other_safe_and_ends_when_it_goes_on(
    victim, link, start, tmp_path
):
    """SIGSTOP of one side, and SIGCONT after the other has ended."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        endpoint = f"ipc://{place}/link" if link == "zmq" else f"shm://{Path(place).name}"
        options = {"type": link, "peer_timeout_s": 1.0, "endpoint": endpoint}
        scenario = write(
            tmp_path, mode="realtime", law="vsg-2", duration=60.0, link=options,
            late_policy={"hold": 5000},
        )  # fmt: skip
        roles = {
            role: start(role, scenario, "--out", str(tmp_path / role), "--quiet") for role in ROLES
        }
        other = "plant" if victim == "controller" else "controller"
        wait_for(lambda: has_run(tmp_path / "plant", 300), roles["plant"])
        os.kill(roles[victim].pid, signal.SIGSTOP)
        try:
            assert end(roles[other])[0] == 3
        finally:
            os.kill(roles[victim].pid, signal.SIGCONT)
        assert end(roles[victim])[0] in (3, 130)
        for role in ROLES:
            found = summary(tmp_path / role)
            assert found["reason"], role
        assert summary(tmp_path / other)["status"] == "safe"
        recorded = signals(tmp_path / other)
        assert np.isfinite(recorded["ref_P_ref" if other == "controller" else "true_p"]).any()
