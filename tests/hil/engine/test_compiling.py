"""What is compiled when: nothing by an import, everything by a warm-up, and runs say so."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba import njit, typeof

from gfm_hil.cli import main
from gfm_hil.core.roles import ROLES
from gfm_hil.engine import compiling_beside
from gfm_hil.engine.compiling import Set, compile_sets, everything
from gfm_hil.engine.setup import make_benches, unstarted_benches
from gfm_hil.links import link_names
from gfm_hil.run.runner import run_scenario

pytestmark = pytest.mark.processes

_IMPORTS = """
import importlib, pkgutil, sys
from numba.core import ccallback, event
import gfm_design, gfm_hil, gfm_plant, gfm_runtime

class Compiled(event.Listener):
    def on_start(self, event): print(event.data["dispatcher"])
    def on_end(self, event): pass

event.register("numba:compile", Compiled())
ccallback.CFunc.compile = lambda self: print(self)
for package in (gfm_design, gfm_hil, gfm_plant, gfm_runtime):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
"""
_LIGHT = """
import sys
from gfm_hil.cli import main
try:
    main(sys.argv[1:])
finally:
    print(*{"numba", "numpy", "scipy", "pydantic", "rich"} & set(sys.modules), file=sys.stderr)
"""


def test_importing_compiles_nothing(tmp_path):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _IMPORTS],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_the_help_loads_no_library(option):
    done = subprocess.run(
        [sys.executable, "-c", _LIGHT, option], capture_output=True, text=True, check=True
    )
    assert "gfmhil" in done.stdout and done.stderr.strip() == ""


def test_an_operator_s_command_loads_no_compiler(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", _LIGHT, "command", str(tmp_path)], capture_output=True, text=True
    )
    refusal, modules = done.stderr.splitlines()
    assert "no run is going on there" in refusal
    assert not {"numba", "scipy", "rich"} & set(modules.split())


def test_a_run_that_is_compiled_loads_no_compiler_s_libraries_nor_scipy_s(tmp_path):
    program = f"{_LIGHT}print(*{{'scipy.linalg', 'numba.np.arraymath'}} & set(sys.modules))"
    for k in range(2):  # the first one may compile
        words = "run", "pref_step", "--link", "inproc", "--no-figures", "--out"
        command = [sys.executable, "-c", program, *words, str(tmp_path / str(k))]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == ""


def test_only_what_is_compiled_is_said_and_which_of_how_many():
    new = njit(lambda x: x + 1)
    said: list[str] = []
    sets = [
        Set("nothing", lambda: None), Set("a sum", lambda: new(1)), Set("it again", lambda: new(2))
    ]  # fmt: skip
    assert compile_sets(sets, said.append) == 1
    assert said == ["compiling a sum (2 of 3, once a machine) …"]


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"inner": "virtual-stator"},
        {"law": "mimo-gfm", "ready_laws": ["vsg-2"], "plant": {"bridge": {"kind": "two-level"}}},
    ],
)
def test_loops_are_compiled_for_the_records_that_a_started_bench_has(make, content):
    scenario = make(**content)
    for ours, started in zip(unstarted_benches(scenario), make_benches(scenario), strict=True):
        assert typeof(ours.plant.typed) == typeof(started.plant.records)
        for a, b in [(ours.controller, started.controller), (ours, started)]:
            arrays = [name for name, value in vars(a).items() if hasattr(value, "dtype")]
            assert arrays
            assert [typeof(vars(a)[n]) for n in arrays] == [typeof(vars(b)[n]) for n in arrays]


_RUN = """
import gfmhil
gfmhil.run({"title": "test", "duration": 0.1})
"""


@pytest.mark.full  # compiles a whole run
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor")
def test_the_first_run_in_memory_says_what_it_compiles_and_a_second_process_helps(tmp_path):
    first, second = (
        subprocess.run(
            [sys.executable, "-c", _RUN], capture_output=True, text=True, check=True,
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        ).stderr
        for _ in range(2)
    )  # fmt: skip
    assert "the operating point" in first and "the plant's period" not in first
    assert list(tmp_path.rglob("*whole_period*.nbc"))
    assert second == ""


def test_a_second_process_that_dies_holds_nothing_up(make, monkeypatch):
    monkeypatch.setattr(compiling_beside.sys, "executable", shutil.which("false"))
    said: list[str] = []
    with compiling_beside.Beside(make(), ROLES, said.append) as beside:
        beside.begin("a set")
        beside.wait()
        beside.begin("another")  # which this process now compiles
    assert said[0] == "a set" and said[-1] == "another"


def test_no_second_process_begins_when_nothing_but_its_share_is_left(make, monkeypatch):
    monkeypatch.setattr(compiling_beside.subprocess, "Popen", lambda *_, **more: pytest.fail())
    with compiling_beside.Beside(make(), ROLES, lambda text: None) as beside:
        beside.wait()
        beside.begin("a set")


def cached(folder: Path) -> dict[Path, int]:
    """The files of numba's cache and their times; not those of a kernel in user mode beside."""
    files = (file for file in folder.rglob("*.nb[ic]") if ".pytest_cache" not in file.parts)
    return {file: file.stat().st_mtime_ns for file in files}


@pytest.mark.alone  # another test may compile something meanwhile
@pytest.mark.timeout(900)  # the first time it compiles everything
def test_after_a_warm_up_a_run_compiles_nothing_over_any_link(make, tmp_path):
    assert main(["warm-up", "--quiet"]) == 0
    said: list[str] = []
    assert compile_sets(everything(), said.append) == len(said) == 0
    root = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parents[3])
    before = cached(root)
    assert before
    # a link's functions are compiled apart from those of an inner stage
    kinds = [(link, ("none", "virtual-stator")[k % 2]) for k, link in enumerate(link_names())]
    for link, inner in kinds:
        options = {"every": 2} if link == "can" else {}
        about = {"type": link, "peer_timeout_s": 60.0, "options": options}
        scenario = make(link=about, duration=0.005, inner=inner)
        folder = tmp_path / f"{link}-{inner}"
        run = run_scenario(scenario, folder, notice=said.append)
        assert run.summary["status"] == "completed"
    assert said == ["starting controller and plant …"] * len(kinds)
    assert cached(root) == before
