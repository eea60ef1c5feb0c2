"""Settings for the whole suite, and its tiers.

``python -m pytest`` runs the fast tier: what needs no process of its own, in parallel. The other
tiers are marked; the last two run one test at a time unless ``-n`` says otherwise:

* ``full``: every law where the fast tier takes one of each structure, long computations, the
  paper's comparisons in ``examples``, and compilers from apt,
* ``processes``: real processes, sockets, real time,
* ``systems``: a browser, user-mode Linux, systemd, a C compiler, kills, soaks.

The mark ``alone`` is for tests of the last two that fail beside another one on two processors, or
let it fail.
``--tier`` chooses tiers; a path, ``-k`` or ``-m`` on the command line chooses from all of them.
"""

import gc
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from hypothesis import settings

pytest_plugins = ["tests.support.attacks"]

# One thread in BLAS: small matrices, and both processors are busy (see gfm_hil.core.blas).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tables have no width of a terminal, which xdist sets for its workers.
os.environ.pop("COLUMNS", None)

# Figures are drawn without a display.
os.environ.setdefault("MPLBACKEND", "Agg")

# In the background, as with nohup, a shell has programs ignore signals that tests send.
for number, handler in (
    (signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL),
):  # fmt: skip
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# The first example may compile a kernel, which takes longer than hypothesis' deadline. Each run
# draws others.
settings.register_profile("gfmhil", deadline=None, max_examples=50)
settings.load_profile("gfmhil")
# Fuzzing of any length, see CONTRIBUTING.md. An input that exceeds the deadline is a bug.
settings.register_profile("fuzz", deadline=60_000, max_examples=20_000)

_MOST_WORKERS = 8  # more would compile the same functions once more each
#: Files that take longest in the other tiers, the longest first. Workers begin with them, and then
#: with those of most tests: one that begins last leaves all processors but one idle.
_LONGEST = (
    "test_wheel.py", "hil/recording/test_recover.py", "hil/ports/test_scope_browser.py",
    "runtime/test_firmware_c.py", "hil/api/test_testing.py", "hil/studies/test_conformity.py",
    "hil/ports/test_scope_crowd.py", "hil/controllers/test_library.py", "hil/run/test_counts.py",
    "hil/controllers/test_snapshot.py", "hil/bench/test_peer.py",
    "hil/engine/test_network_links.py", "hil/engine/test_processes.py",
    "hil/engine/test_left_behind.py", "hil/ports/test_modbus.py", "hil/engine/test_compiling.py",
    "hil/ports/test_telemetry.py", "hil/controllers/test_shared_start.py",
    "hil/results/test_export_can.py", "hil/bench/test_bench.py",
    "hil/controllers/test_controllers.py", "hil/controllers/test_pil.py", "hil/engine/test_kill.py",
    "hil/studies/test_identification.py", "hil/ports/test_telemetry_metrics.py",
    "hil/engine/test_sd_notify.py", "hil/engine/test_loops.py", "hil/links/test_can.py",
    "hil/ports/test_xcp.py", "test_deploy_sandbox.py", "hil/ports/test_operator.py",
    "hil/studies/test_campaign.py", "hil/studies/test_unit_fit.py",
    "runtime/test_firmware_targets.py", "runtime/test_firmware_fixed.py", "hil/run/test_network.py",
    "hil/run/test_network_parts.py", "runtime/test_firmware.py", "hil/links/test_inner_links.py",
    "plant/test_network.py", "plant/test_bridge.py", "hil/scenario/test_published.py",
    "hil/cli/test_network_design.py", "plant/test_bergeron_line.py", "design/test_certificate.py",
    "test_packaging.py",
)  # fmt: skip
#: Of the fast tier: the file that compiles the loop in process first, and those that find it
#: compiled if they begin when files of more tests than this have ended.
_COMPILES, _AFTER = "hil/studies/test_conformity.py", 60
_LATER = ("hil/cli/test_wrong_use.py", "hil/links/test_link_contract.py", "hil/cli/test_cli.py")
_TIER_OF = {**dict.fromkeys(("apt", "soak", "uml"), "systems"), "compilers": "full"}
FAST, TIERS = "fast", ("full", "processes", "systems")


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Carries out a command that cannot be done; returns the one line in which it says so."""

    from gfm_hil.cli import main  # not before the variables above are set

    def call(*words: str) -> str:
        assert main(words) == 2
        out, error = capsys.readouterr()
        *progress, error = error.splitlines(keepends=True)  # on a slow machine there may be some
        assert all(line.endswith("…\n") for line in progress), progress
        assert out == "" and error.startswith("gfmhil: ") and error.endswith("\n"), error
        assert error[:-1].isprintable(), error
        return error

    return call


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--tier",
        action="append",
        choices=[FAST, *TIERS, "all"],
        help="run the tests of this tier; may be repeated (default: fast)",
    )


def chosen(config: pytest.Config) -> set[str]:
    """The tiers that the command line asks for."""
    tiers = set(config.option.tier or ())
    if not tiers:
        narrowed = config.option.keyword or config.option.markexpr
        whole = config.args_source == pytest.Config.ArgsSource.TESTPATHS
        tiers = {FAST} if whole and not narrowed else {"all"}
    return {FAST, *TIERS} if "all" in tiers else tiers


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file that marks nothing for the tiers: all files together take 10 s to import."""
    tiers = chosen(config)
    if FAST in tiers or "full" in tiers or collection_path.suffix != ".py":  # helpers mark full too
        return None
    names = {*tiers, *(mark for mark, home in _TIER_OF.items() if home in tiers)}
    words = collection_path.read_text(encoding="utf-8")
    return None if any(f"pytest.mark.{name}" in words for name in names) else True


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Run the fast tier on all processors, a file at a time, unless told how many (``-n``)."""
    if not getattr(config.option, "reruns", None):
        # its thread would keep the sides of a run from beginning as copies of this process
        config.pluginmanager.unregister(name="rerunfailures")
    if hasattr(config, "workerinput"):  # a worker, which must not start workers
        return
    config.option.loadscopereorder = False  # see longest_first
    if getattr(config.option, "maxworkerrestart", 0) is None:
        config.option.maxworkerrestart = "0"  # a test kills each, or all wait for ever
    if chosen(config) <= {FAST, "full"} and getattr(config.option, "numprocesses", 0) is None:
        workers = min(len(os.sched_getaffinity(0)), _MOST_WORKERS)
        config.option.numprocesses, config.option.dist = workers, "loadfile"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    tiers = chosen(config)
    left = [item for item in items if tier(item.iter_markers()) not in tiers]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if tier(item.iter_markers()) in tiers]
    if hasattr(config, "workerinput"):
        longest_first(items, tiers == {FAST})


def pytest_collection_finish() -> None:
    """Leave the objects of all modules to themselves: else each pass over them takes half a second,
    which is a tenth of the fast tier."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


def longest_first(items: list[pytest.Item], fast: bool) -> None:
    """Put the files of ``_LONGEST`` first, and the others by their number of tests.

    In the fast tier two workers would otherwise compile the same loop at the same time, for 36 s.
    """
    here = Path(__file__).parent
    rank = {here / name: k for k, name in enumerate((_COMPILES,) if fast else _LONGEST)}
    count = Counter(item.path for item in items)
    if fast:
        for name in _LATER:
            count[here / name] = _AFTER
    items.sort(key=lambda item: (rank.get(item.path, len(rank)), -count[item.path], item.path))


def tier(markers: Iterable[pytest.Mark]) -> str:
    """The last of ``TIERS`` that a test is marked with; fast if it is marked with none."""
    names = {_TIER_OF.get(mark.name, mark.name) for mark in markers}
    return max((t for t in TIERS if t in names), key=TIERS.index, default=FAST)
