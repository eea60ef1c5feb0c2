"""Tests of a controller in C against the emulated rig, over both links that it speaks."""

import os
import subprocess
import sys
import time
import uuid
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
FAULTS = {"towards": "plant", "seed": 1, "loss": 0.01, "corrupt": 0.01, "duplicate": 0.01}


@pytest.fixture(scope="session", autouse=True)
def programs():
    gfmhil = f"GFMHIL={sys.executable} -m gfm_hil"
    subprocess.run(["make", "--silent", gfmhil], cwd=HERE, check=True)


def begin(bench, link, *words, **changed):
    """The rig at rest; the program's own P_ref steps from 0.5 to 0.7 p.u. at tick 500."""
    command = [HERE / f"controller-{link}", "{endpoint}", *words, "0=0.5", "500=0.7"]
    bench.start(HERE / "scenario.toml", link=link, controller_command=command, **changed)


def test_power_follows_its_reference_over_both_links(bench):
    found = []
    for link in ("zmq", "shm"):
        begin(bench, link)
        bench.run(0.3)
        bench.assert_no_trip()
        assert bench.summary["controller"] == "droop in C"
        found.append(bench.signals["p"])
    assert np.abs(found[0][:500] - 0.5).max() < 0.01
    assert np.abs(found[0][2500:] - 0.7).max() < 0.02
    np.testing.assert_array_equal(found[0], found[1])

    begin(bench, "shm", link__impairment=FAULTS)
    bench.run(0.3)
    assert bench.summary["injected"]["plant"]["lost"] > 0
    np.testing.assert_array_equal(bench.signals["p"], found[0])


def test_ends_in_order_when_the_plant_trips(bench):
    begin(bench, "zmq")
    bench.run(0.1)
    bench.phase_jump(60)
    bench.run(0.1)
    assert bench.summary["status"] == "tripped"  # "safe" if the program had failed


def test_real_time(bench):
    # a busy machine misses ticks, which is not the program's fault: the plant waits for long
    begin(bench, "shm", "--realtime", mode="realtime", late_policy__hold=9000)
    bench.run(0.3)
    bench.assert_no_trip()


def test_shared_memory_has_one_owner_and_is_not_left_behind():
    name = f"own-controller-{uuid.uuid4().hex}"
    memory = Path(f"/dev/shm/gfmhil-{os.geteuid()}/link-{name}")
    command = [HERE / "controller-shm", f"shm://{name}", "0=0.5"]

    def occupied():
        second = subprocess.run(command, capture_output=True, text=True)
        return second.returncode == 1 and "cannot be created: File exists" in second.stderr

    first = subprocess.Popen(command)
    until = time.monotonic() + 60
    while not memory.exists() and time.monotonic() < until:
        time.sleep(0.01)
    assert occupied()
    first.kill()
    first.wait()
    assert memory.exists()

    heir = subprocess.Popen(command)  # replaces what the killed one left
    while owner(memory) != heir.pid:
        assert heir.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    assert occupied()
    heir.terminate()
    assert heir.wait() == 0
    assert not memory.exists()


def owner(memory):
    """The process number in the header of a link's memory; 0 while there is none."""
    try:
        return int.from_bytes(memory.read_bytes()[16:24], "little")
    except FileNotFoundError:
        return 0
