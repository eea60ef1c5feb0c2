"""Fixture ``bench``, marker ``gfmhil``, options ``--gfmhil-link`` and ``--gfmhil-out``.

Nothing but pytest is imported before a test asks for the bench.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from gfm_hil.testing import Experiment

_FIGURE = "gfmhil_figure"  # user property of a report, which comes back from pytest-xdist too
_LINKS = ("inproc", "shm", "zmq", "can")  # those that come with gfmhil; others are registered late


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("gfmhil", "hardware-in-the-loop bench (gfmhil)")
    group.addoption("--gfmhil-link", metavar="LINK", help="run all tests of the bench over it")
    group.addoption("--gfmhil-out", metavar="DIR", help="keep run folders and figures in it")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "gfmhil(scenario=None, law=None, link=None, mode=None, controller_command=(), **changed): "
        "what the fixture bench begins with",
    )
    for link in _LINKS:
        _register(config, link)
    wanted = config.getoption("--gfmhil-link")
    if wanted is not None:
        from gfm_hil.links import link_names

        if wanted not in ("inproc", *link_names()):
            raise pytest.UsageError(
                f"--gfmhil-link {wanted}: must be one of {['inproc', *link_names()]}"
            )


def _register(config: pytest.Config, link: str) -> None:
    config.addinivalue_line("markers", f"gfmhil_{link}: uses the bench over {link}")


@pytest.hookimpl(tryfirst=True)  # before -m looks at the markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests of the bench by the link they begin with."""
    known = set(_LINKS)
    for item in items:
        if "bench" not in getattr(item, "fixturenames", ()):
            continue
        begin = _asked(item)
        link = config.getoption("--gfmhil-link") or begin.get("link")
        link = link or ("zmq" if begin.get("controller_command") else "inproc")
        if link not in known:
            known.add(link)
            _register(config, link)
        item.add_marker(f"gfmhil_{link}")


def _asked(item: Any) -> dict[str, Any]:
    """Arguments of the markers, those nearest to the test last."""
    asked: dict[str, Any] = {}
    for marker in reversed(list(item.iter_markers("gfmhil"))):
        asked.update(marker.kwargs)
        if marker.args:
            asked["scenario"] = marker.args[0]
    return asked


@pytest.fixture
def bench(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Experiment]:
    """A bench to run experiments on, ``gfm_hil.testing.Experiment``."""
    from gfm_hil.testing import Experiment

    config, node = request.config, request.node

    def notice(figure: Path) -> None:
        node.user_properties.append((_FIGURE, str(figure)))

    link = config.getoption("--gfmhil-link")
    folders = _folders(config.getoption("--gfmhil-out"), node.nodeid, tmp_path_factory)
    experiment = Experiment(request.path.parent, folders, link, notice, pytest.skip)
    asked = _asked(node)
    failed = request.session.testsfailed
    if asked:
        experiment.start(**asked)
    yield experiment
    if experiment.pending and request.session.testsfailed == failed:
        experiment.assert_no_trip()  # what nobody has asked about is run all the same


def _folders(out: str | None, nodeid: str, temporary: Any) -> Callable[[], Path]:
    """Makes a new folder for each run: below ``out``, or among pytest's temporary ones."""
    name = re.sub(r"[^\w.-]+", "-", nodeid.replace(".py::", "-"))[-120:].strip("-")

    def make() -> Path:
        if out is None:
            return Path(temporary.mktemp(f"{name[-40:]}-"))
        k = 1
        while (folder := Path(out).absolute() / f"{name}-{k}").exists():
            k += 1
        return folder

    return make


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the figures that failed assertions have left."""
    figures = [
        (report.nodeid, value)
        for outcome in ("failed", "error")
        for report in terminalreporter.stats.get(outcome, ())
        for name, value in getattr(report, "user_properties", ())  # a collection error has none
        if name == _FIGURE
    ]
    if figures:
        terminalreporter.section("figures of the bench")
        for nodeid, figure in dict.fromkeys(figures):
            terminalreporter.line(f"{nodeid}: {figure}")
