"""kill -9 of a command at any moment: of all that it has started nothing is left after seconds.

A round a command by default; GFMHIL_KILLS=20 runs the number of the acceptance test,
GFMHIL_KILLS_SEED selects other moments, and GFMHIL_KILLS_REPORT=file writes a line per round:
command, processes that were there, and the time in s until the last of them was gone.
"""

import json
import os
import random
import shutil
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest

import gfm_hil.controllers

from ...support.firmware import cc
from ...support.processes import GFMHIL, PATIENCE_S, wait_for, write

pytestmark = pytest.mark.systems

ROUNDS = int(os.environ.get("GFMHIL_KILLS", "1"))
SEED = int(os.environ.get("GFMHIL_KILLS_SEED", "4"))
PAPER = Path(__file__).parents[3] / "examples" / "paper"
REPORT = os.environ.get("GFMHIL_KILLS_REPORT")
LEFT_S = 5.0
COMPILES_S = 600.0  # the first round may compile what it runs
GENEROUS_S = 10.0  # margin: a crowded machine may not run a process for seconds

CAMPAIGN = """
title = "killed"
scenario = "rig_pref_step"
laws = ["mimo-gfm", "vsg-2"]
runs = 100000
seed = 3
[[draw]]
path = "plant.factors.L_g"
type = "uniform"
low = 0.9
high = 1.1
"""
LONG = {"law": "vsg-2", "duration": 600.0, "link": {"type": "shm", "peer_timeout_s": 60.0}}


def library(folder: Path) -> str:
    include = Path(gfm_hil.controllers.__file__).parent
    source = Path(__file__).parents[2] / "support" / "foreign_library.c"
    done = cc(folder, "-shared", "-fPIC", f"-I{include}", str(source), "-o", "fails.so", "-lm")
    assert done.returncode == 0, done.stderr
    return f"c:{folder / 'fails.so'}"


def campaign(folder: Path) -> list[str]:
    (folder / "killed.toml").write_text(CAMPAIGN)
    return [*GFMHIL, "campaign", str(folder / "killed.toml"), "--workers", "2"]


def paper(folder: Path) -> list[str]:
    command = [sys.executable, "-m", "law_comparison", "--laws", "droop-1,vsg-2,vsg-5"]
    return [*command, "--jobs", "2"]


def conform_c(folder: Path) -> list[str]:
    command = [*GFMHIL, "conform", "--controller", library(folder), "--inner", "virtual-stator"]
    return [*command, "--workers", "2"]


def pil(folder: Path) -> list[str]:
    return [*GFMHIL, "run", write(folder, **LONG), "--controller", "pil:m4f", "--no-figures"]


def run_c(folder: Path) -> list[str]:
    command = [*GFMHIL, "run", write(folder, **LONG), "--controller", library(folder)]
    return [*command, "--inner", "virtual-stator", "--no-figures"]


def marked(mark: str) -> set[int]:
    """The processes whose environment has the mark, but for those that have ended."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if mark.encode() in (entry / "environ").read_bytes():
                found.add(int(entry.name))
        except OSError:
            continue
    return found


@pytest.mark.attack(
    "23.4", "kill -9 of a command",
    "left for good: fork server, workers, manager, a controller in gfmhil_new, a library's fork",
)  # fmt: skip
@pytest.mark.parametrize(
    ("words", "least"),
    [
        (campaign, 5),  # with fork server, resource tracker and two workers
        (paper, 6),  # and the manager
        # workers as a campaign's, each with guard, controller and its fork
        pytest.param(conform_c, 9, marks=pytest.mark.apt),
        pytest.param(pil, 7, marks=pytest.mark.compilers),  # three guards, plant, controller, QEMU
        pytest.param(run_c, 6, marks=pytest.mark.apt),  # two guards, plant, controller, its fork
    ],
)
@pytest.mark.timeout(COMPILES_S + 60 * ROUNDS)
def test_a_killed_command_leaves_no_process(words, least, tmp_path, attack_now):
    chance, command, took = random.Random(f"{SEED}, {words.__name__}"), words(tmp_path), []
    for k in range(ROUNDS):
        mark = f"GFMHIL_ROUND={uuid.uuid4()}"
        process = subprocess.Popen(
            [*command, "--quiet", "--out", str(tmp_path / f"out{k}")],
            env={**os.environ, **dict([mark.split("=")]), "FOREIGN_WHAT": "fork",
                 "PYTHONPATH": str(PAPER)},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            until = time.monotonic() + COMPILES_S
            while len(marked(mark)) < least:
                assert process.poll() is None and time.monotonic() < until
                time.sleep(0.05)
            time.sleep(chance.uniform(0.0, 2.0))
            assert process.poll() is None
            there = len(marked(mark))
        finally:
            process.kill()
            process.wait()
        killed = time.monotonic()
        while (left := marked(mark)) and time.monotonic() < killed + LEFT_S + GENEROUS_S:
            time.sleep(0.02)
        took.append(time.monotonic() - killed)
        told = [Path(f"/proc/{one}/cmdline").read_bytes() for one in left]
        for one in left:
            os.kill(one, 9)
        assert not told
        shutil.rmtree(tmp_path / f"out{k}", ignore_errors=True)  # gigabytes of recording
        if REPORT:
            with Path(REPORT).open("a", encoding="utf-8") as file:
                file.write(json.dumps([words.__name__, there, took[-1]]) + "\n")
    attack_now(f"{words.__name__}: nothing left after {max(took):.1f} s, {ROUNDS} times")


@pytest.mark.apt
@pytest.mark.attack(
    "23.4", "SIGTERM where a library blocks in gfmhil_new",
    "the reason is that SIGKILL ended the controller; what the library forked is left for good",
)  # fmt: skip
@pytest.mark.parametrize("which", ["run", "controller"])
def test_a_library_that_blocks_where_it_is_opened_is_named(which, tmp_path, attack_now):
    model, file, mark = library(tmp_path), write(tmp_path, **LONG), f"GFMHIL_ROUND={uuid.uuid4()}"
    options = ["--inner", "virtual-stator", "--out", str(tmp_path / "out"), "--quiet"]
    words = ["run", file, "--controller", model]
    if which == "controller":
        words = ["controller", file, "--model", model, "--endpoint", f"shm://{uuid.uuid4().hex}"]
    process = subprocess.Popen(
        [*GFMHIL, *words, *options], stderr=subprocess.PIPE, text=True,
        env={**os.environ, **dict([mark.split("=")]), "FOREIGN_WHAT": "block"},
    )  # fmt: skip

    def loaded() -> bool:
        maps = (Path(f"/proc/{one}/maps").read_text() for one in marked(mark))
        return any("fails.so" in text for text in maps)

    wait_for(loaded, process)
    process.terminate()
    _, said = process.communicate(timeout=PATIENCE_S)
    assert said == "gfmhil: fails.so: gfmhil_new does not come back\n"
    assert process.returncode == 2
    assert not marked(mark)
    attack_now(f"{which}: {said.strip()}")


@pytest.mark.apt
@pytest.mark.attack(
    "23.5", "a library that prints 66 kB at each step", "controller.log grows as long as it runs"
)
def test_the_log_of_a_controller_is_bounded(
    start, tmp_path,
    monkeypatch, attack_now
):  # fmt: skip
    monkeypatch.setenv("FOREIGN_WHAT", "talk")
    file = write(tmp_path, **{**LONG, "duration": 0.1})
    command = ["run", file, "--controller", library(tmp_path), "--inner", "virtual-stator"]
    process = start(*command, "--out", str(tmp_path / "out"), "--quiet", "--no-figures")
    assert process.communicate(timeout=PATIENCE_S)[1] == ""
    size = (tmp_path / "out" / "controller.log").stat().st_size
    assert 2 * 2**18 < size < 2 * 2**18 + 100
    attack_now(f"{size} bytes of 67 MB: the beginning and the end")
