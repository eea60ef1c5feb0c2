"""Scenarios made in one line, runs in this process, and the command as a separate process."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.core.errors import Unfinished
from gfm_hil.recording.run import Run
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import Scenario, check_scenario

from ..support.uml import Kernel

Make = Callable[..., Scenario]
RunIt = Callable[..., Run]
Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder with a short path, for an ipc endpoint; that of a test's own folder may be long."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as folder:
        yield Path(folder)


@pytest.fixture
def make() -> Make:
    """Makes a checked scenario, by default a tenth of a second in process."""

    def build(**content: Any) -> Scenario:
        base = {"title": "test", "duration": 0.1, "link": {"type": "inproc"}}
        return check_scenario({**base, **content}, "test")

    return build


@pytest.fixture
def run(make: Make, tmp_path: Path) -> RunIt:
    """Runs such a scenario without figures."""
    count = iter(range(100))

    def call(**content: Any) -> Run:
        return run_scenario(make(**content), tmp_path / f"run{next(count)}")

    return call


@pytest.fixture(scope="session", autouse=True)
def draw_run() -> Iterator[Callable[..., Any]]:
    """Reports are without the figures of a run, which take most of their time, see ``drawn``; this
    is what draws them."""
    from gfm_hil.results import figures

    with pytest.MonkeyPatch.context() as patch:
        draw = figures.draw_run
        patch.setattr(figures, "draw_run", lambda *_: nullcontext())
        yield draw


@pytest.fixture
def drawn(draw_run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports have the figures of a run, for tests that look at them."""
    monkeypatch.setattr("gfm_hil.results.figures.draw_run", draw_run)


@contextmanager
def unfinished() -> Iterator[list[tuple[Any, ...]]]:
    """A run in it ends before ``finish``, whose arguments are then in the list."""
    found: list[tuple[Any, ...]] = []

    def stop(*arguments: Any) -> None:
        found.append(arguments)
        raise Unfinished

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Unfinished):
        patch.setattr("gfm_hil.run.runner.finish", stop)
        yield found


@pytest.fixture
def endpoint(place: Path) -> str:
    """A new ipc endpoint."""
    return f"ipc://{place}/link"


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Any]]:
    """Takes what a test opens, and closes it at the end, the last first."""
    with ExitStack() as stack:

        def take(end: Any) -> Any:
            stack.callback(end.close)
            return end

        yield take


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Start]:
    """Starts ``python …`` in the test's own folder; kills processes that still run at the end."""
    started = []

    def call(
        *arguments: str, stdin: int | None = subprocess.PIPE, stderr: int | None = None
    ) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=tmp_path, text=True, stdin=stdin, stdout=subprocess.PIPE, stderr=stderr,
        )  # fmt: skip
        started.append(process)
        return process

    yield call
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def start(spawn: Start) -> Start:
    """Starts ``gfmhil …``, see ``spawn``."""
    return lambda *arguments: spawn("-m", "gfm_hil", *arguments, stdin=None, stderr=subprocess.PIPE)


_KERNEL: pytest.StashKey[Kernel] = pytest.StashKey()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests that wait for the user-mode kernel last: it boots beside the other tests."""
    items.sort(key=lambda item: item.get_closest_marker("uml") is not None)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Boot that kernel, if a test needs it."""
    wanted = any(item.get_closest_marker("uml") for item in session.items)
    if wanted and "GFMHIL_UML" in os.environ and not session.config.option.collectonly:
        session.config.stash[_KERNEL] = Kernel()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Clean up, however the session ended."""
    if _KERNEL in config.stash:
        config.stash[_KERNEL].clear()


@pytest.fixture
def uml_kernel(request: pytest.FixtureRequest) -> Kernel:
    """The kernel that was booted before the first test."""
    return request.config.stash[_KERNEL]
