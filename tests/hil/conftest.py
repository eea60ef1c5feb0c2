"""Scenarios made in a line, run in this process, and the command as a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.results.run import Run
from gfm_hil.results.runner import run_scenario
from gfm_hil.scenario.model import Scenario, check_scenario
from gfm_runtime import get_law

from .uml import Kernel

Make = Callable[..., Scenario]
RunIt = Callable[..., Run]
Start = Callable[..., "subprocess.Popen[str]"]


def home_plant(law: str) -> dict[str, Any]:
    """``plant`` with the grid that a law's defaults are meant for."""
    grid = get_law(law).home_grid
    return {"factors": {"L_g": grid.L_g, "R_g": grid.R_g}}


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder of short path, for an ipc endpoint."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as folder:
        yield Path(folder)


@pytest.fixture
def make() -> Make:
    """A checked scenario of a tenth of a second in process, with whatever is given instead."""

    def build(**content: Any) -> Scenario:
        base = {"title": "test", "duration": 0.1, "link": {"type": "inproc"}}
        return check_scenario({**base, **content}, "test")

    return build


@pytest.fixture
def run(make: Make, tmp_path: Path) -> RunIt:
    """Run such a scenario without figures."""
    count = iter(range(100))

    def call(**content: Any) -> Run:
        return run_scenario(make(**content), tmp_path / f"run{next(count)}", figures=False)

    return call


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A fresh ipc endpoint; its path must be short, which a test's own folder need not be."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as folder:
        yield f"ipc://{folder}/link"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start ``gfmhil …`` in the test's own folder; whatever still runs at the end is killed."""
    started = []

    def call(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "gfm_hil", *arguments],
            cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        started.append(process)
        return process

    yield call
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


_KERNEL: pytest.StashKey[Kernel] = pytest.StashKey()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What waits for a kernel that runs beside the other tests comes after them."""
    items.sort(key=lambda item: item.get_closest_marker("uml") is not None)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Boot that kernel, if a test wants it."""
    wanted = any(item.get_closest_marker("uml") for item in session.items)
    if wanted and "GFMHIL_UML" in os.environ and not session.config.option.collectonly:
        session.config.stash[_KERNEL] = Kernel()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Leave nothing behind, however the session ended."""
    if _KERNEL in config.stash:
        config.stash[_KERNEL].clear()


@pytest.fixture
def uml_kernel(request: pytest.FixtureRequest) -> Kernel:
    """The kernel that was booted before the first test."""
    return request.config.stash[_KERNEL]
