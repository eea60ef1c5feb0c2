"""A run in real time for GFMHIL_SOAK_S seconds with clients that connect and disconnect.

``GFMHIL_SOAK_S=900 python -m pytest tests/hil/ports/test_soak.py`` takes a quarter of an hour per
link. With GFMHIL_SOAK_CSV=FOLDER the test of each link writes its samples there as
``soak_LINK.csv``.
"""

import contextlib
import os
import re
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.engine.announcement import running_roles
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.device import Device
from gfm_hil.ports.scope.channels import make_channels
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.scenario import load_scenario

from ...support.modbus import GFMHIL
from ...support.processes import PATIENCE_S, has_run, places, roles_of, signals, summary, wait_for
from ...support.scope import RIG, addresses
from ...support.soak import MB, Clients, Sampler, ports_in

pytestmark = [pytest.mark.systems, pytest.mark.alone]

SOAK_S = float(os.environ.get("GFMHIL_SOAK_S", "0"))
LINKS = ("zmq", "shm") if SOAK_S >= 60 else ("zmq",)  # seconds show the clients' leaks, no link's
CSV = os.environ.get("GFMHIL_SOAK_CSV")
FAULTS = """
[link.impairment]
loss = 0.01
burst = 3.0
corrupt = 0.005
duplicate = 0.01
reorder = 0.01
jitter = 2e-4
"""
WARM_UP = 0.25  # of the rounds: imports, caches and threads that a process makes once
GROWTH = 8 * MB  # of a process's own memory after the warm-up
# glibc returns freed memory at once: memory that it would keep is not our growth
AT_ONCE = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": "65536",
    "MALLOC_TRIM_THRESHOLD_": "65536",
}
MORE_THREADS = 2  # that asyncio's pool may add when a call comes while the others are busy
EXTREMES = 2 * 4 / 7  # bytes of the scope's pyramid, for each channel and tick


@contextlib.contextmanager
def bench(link: str, place: Path) -> Iterator[tuple[Clients, dict[str, subprocess.Popen[str]]]]:
    """A run with its three servers, all in separate processes, and their clients."""
    file, folder = place / "soak.toml", place / "run"
    faulty = RIG.replace('type = "shm"', f'type = "{link}"').replace("[plant]", f"{FAULTS}[plant]")
    file.write_text(faulty.replace("duration = 300.0", f"duration = {SOAK_S + 600}"), "utf-8")
    started: dict[str, subprocess.Popen[str]] = {}

    def start(name: str, *arguments: str) -> subprocess.Popen[str]:
        with (place / f"{name}.log").open("w") as log:
            # nobody reads what the run prints, and its table of events is longer than a pipe
            out = subprocess.DEVNULL if name == "run" else subprocess.PIPE
            started[name] = subprocess.Popen(
                [*GFMHIL, *arguments], stdout=out, stderr=log, text=True, env=environment
            )
        return started[name]

    environment = {**os.environ, **AT_ONCE, "TMPDIR": str(place)}
    try:
        stream = start("stream", "stream", str(folder), "--wait", "--port", "0",
                       "--prometheus", "0")  # fmt: skip
        scope = start("scope", "scope", str(folder), "--wait", "--port", "0")
        run = start("run", "run", str(file), "--out", str(folder), "--quiet", "--no-figures")
        wait_for(lambda: has_run(folder, 100) and len(running_roles(folder)) == 2, run)
        served = start("modbus", "modbus", str(folder), "--port", "0", "--heartbeat", "0")
        (modbus,) = map(int, re.findall(r":(\d+), unit 1", next(iter(served.stdout or ()))))
        look, control = addresses(iter(scope.stdout or ()))
        samples, blocks, metrics = ports_in(stream.stdout or (), 3)
        scenario = load_scenario(str(folder / "scenario.toml"))
        image = Device(scenario, scenario.laws(), lambda: None, print, 0, lambda: 0.0).image
        token = control.partition("#token=")[2]
        yield Clients(folder, look, token, modbus, samples, blocks, metrics, image), started
    finally:
        for process in started.values():
            if process.poll() is None:
                process.kill()
            process.communicate()


@pytest.mark.soak
@pytest.mark.skipif(SOAK_S == 0, reason="takes as long as GFMHIL_SOAK_S says, which is not set")
@pytest.mark.timeout(2 * SOAK_S + 600)
@pytest.mark.parametrize("link", LINKS)
@pytest.mark.attack(
    "11.1",
    "clients that come and go, law changes, trips and a faulty link for as long as wanted",
    "never tried",
)
def test_nothing_grows_and_nothing_is_left(link, capsys, attack_now):
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as name, bench(link, Path(name)) as (
        clients, started,
    ):  # fmt: skip
        folder, run = clients.folder, started["run"]
        pids = {name: process.pid for name, process in started.items()} | roles_of(folder)
        outside = places(folder)
        sampler = Sampler(pids)
        while time.monotonic() - sampler.begin < SOAK_S or clients.rounds < 6:
            assert {name: p.poll() for name, p in started.items()} == dict.fromkeys(started)
            clients.round()
            sampler.take()
        ticks = open_recording(folder).done()
        operator = Operator(folder)
        operator.stop()
        operator.close()
        # the operator stopped it; then it compresses what it has recorded
        assert run.wait(PATIENCE_S + SOAK_S) == 130
        assert [started[name].wait(PATIENCE_S) for name in ("modbus", "stream")] == [0, 0]
        started["scope"].terminate()
        started["scope"].wait(PATIENCE_S)
        found, recorded = summary(folder), signals(folder)
        logs = {path.stem: path.read_text() for path in Path(name).glob("*.log")}
        left = {path.name for path in Path(name).iterdir() if path.suffix != ".log"}

    first = int(WARM_UP * clients.rounds)
    lines = [f"soak {link}: {clients.rounds} rounds, {ticks} ticks", *sampler.table(first)]
    with capsys.disabled():
        print("", *lines, sep="\n")
    if CSV:
        sampler.write_csv(Path(CSV) / f"soak_{link}.csv")
    t = sampler.column("run", "t")
    by_design = {"scope": EXTREMES * len(make_channels(1e-3, 50.0)) * 1e3 * (t[-1] - t[first])}
    for name in pids:
        rise = sampler.rise(name, first) - by_design.get(name, 0.0)
        assert rise < GROWTH, (name, lines)
        own = sampler.column(name, "own")[first:]
        assert own.max() - own[0] - by_design.get(name, 0.0) < 2 * GROWTH, (name, lines)
        for what, more in (("descriptors", 0), ("threads", MORE_THREADS)):
            counted = sampler.column(name, what)[first:]
            assert counted[-1] <= counted[: len(counted) // 2].max() + more, (name, what, lines)
    assert (found["status"], found["reason"]) == ("interrupted", "stopped by the operator")
    assert not any("Traceback" in said for said in logs.values()), logs
    assert found["ticks"] == len(recorded["t"]) >= ticks
    assert np.isfinite(recorded["true_p"]).all()
    assert np.unique(recorded["law"][np.isfinite(recorded["law"])]).size >= 2
    assert all(found["injected"][role]["lost"] > 0 for role in ("controller", "plant"))
    assert left == {"soak.toml", "run"} and not any(path.exists() for path in outside)
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids.values())
    most = max(sampler.rise(name, first) - by_design.get(name, 0.0) for name in pids)
    attack_now(f"{clients.rounds} rounds in {t[-1]:.0f} s: at most {most / MB:.1f} MB more memory")
