"""Fixtures ``bench`` and ``conform``, marker ``gfmhil``, options ``--gfmhil-link`` and
``--gfmhil-out``.

It imports only pytest until a test uses the bench.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from gfm_hil.studies.conformity.result import Conformity
    from gfm_hil.testing import Experiment

_FIGURE = "gfmhil_figure"  # user property of a report, which pytest-xdist passes on too


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
    config.addinivalue_line("markers", "gfmhil_LINK: uses the bench over a link, e.g. gfmhil_shm")
    wanted = config.getoption("--gfmhil-link")
    if wanted is not None:
        from gfm_hil.links import link_names

        if wanted not in (known := ["inproc", *link_names()]):
            raise pytest.UsageError(f"--gfmhil-link {wanted}: must be one of {known}")


@pytest.hookimpl(tryfirst=True)  # before -m evaluates the markers
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests that use the bench with their initial link."""
    known = set[str]()
    for item in items:
        if "bench" not in getattr(item, "fixturenames", ()):
            continue
        begin = _asked(item)
        link = config.getoption("--gfmhil-link") or begin.get("link")
        link = link or ("zmq" if begin.get("controller_command") else "inproc")
        if link not in known:
            known.add(link)
            config.addinivalue_line("markers", f"gfmhil_{link}: uses the bench over {link}")
        item.add_marker(f"gfmhil_{link}")


def _asked(item: Any) -> dict[str, Any]:
    """Arguments of the markers; those nearest to the test take precedence."""
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
    """A bench for experiments, ``gfm_hil.testing.Experiment``."""
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
        experiment.assert_no_trip()  # run the steps after the last assertion too


@pytest.fixture
def conform(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Conformity]:
    """``gfmhil.conform``, which fails the test unless every clause passes; files are looked for
    from the folder of the test, and the report is named."""
    from gfm_hil.testing.gate import gate

    out = request.config.getoption("--gfmhil-out")
    return gate(request.path.parent, _folders(out, request.node.nodeid, tmp_path_factory))


def _folders(out: str | None, nodeid: str, temporary: Any) -> Callable[[], Path]:
    """A function that makes a new folder per run, below ``out`` or in pytest's temporary folder."""
    name = re.sub(r"[^\w.-]+", "-", nodeid.replace(".py::", "-"))[-120:].strip("-")

    def make() -> Path:
        if out is None:
            return Path(temporary.mktemp(f"{name[-40:]}-"))
        k = 1
        while (folder := Path(out).absolute() / f"{name}-{k}").exists():
            k += 1
        return folder

    return make


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    call: pytest.CallInfo[None],
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Of wrong input show the line of the test, without what the bench called to find it."""
    errors = sys.modules.get("gfm_hil.core.errors")
    if errors and call.excinfo and isinstance(call.excinfo.value, errors.UserError):
        bench = Path(errors.__file__ or "").parents[1]
        entry = call.excinfo.tb
        while (
            entry.tb_next and bench not in Path(entry.tb_next.tb_frame.f_code.co_filename).parents
        ):
            entry = entry.tb_next
        entry.tb_next = None
    return (yield)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """List the figures that failed assertions have drawn."""
    figures = [
        (report.nodeid, value)
        for outcome in ("failed", "error")
        for report in terminalreporter.stats.get(outcome, ())
        for name, value in getattr(report, "user_properties", ())  # collection errors have none
        if name == _FIGURE
    ]
    if figures:
        terminalreporter.section("figures of the bench")
        for nodeid, figure in dict.fromkeys(figures):
            terminalreporter.line(f"{nodeid}: {figure}")
