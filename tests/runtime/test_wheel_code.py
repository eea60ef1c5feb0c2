"""Machine code that a wheel carries: it is used where it fits, and never where it does not."""

import importlib.util
import os
import platform
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from gfm_hil.engine.compiling import Set, compile_sets
from gfm_runtime import compiled, wheel_code
from gfm_runtime.wheel_code import TARGETS, WheelCode, environment, pack

pytestmark = pytest.mark.skipif(platform.machine() not in TARGETS, reason="no wheel is for it")

_SOURCE = """
from gfm_runtime.compiled import compiled

@compiled
def twice(x):
    return 2.0 * x

@compiled
def caller(x):
    return twice(x) + 1.0
"""
_SOURCES = compiled.sources().hex()


def _imported(source: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("mine", source)
    assert spec and spec.loader
    module = sys.modules["mine"] = importlib.util.module_from_spec(spec)  # pickle asks for it
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A source, and a file of the code of its function ``twice``, as another process makes it."""
    folder = tmp_path_factory.mktemp("wheel")
    source, file = folder / "mine.py", folder / "wheel_code.bin"
    source.write_text(_SOURCE)
    subprocess.run(
        [sys.executable, "-c", "import mine; mine.twice(1.0)"], check=True,
        env={**os.environ, **environment(), "NUMBA_CACHE_DIR": str(folder / "cache"),
             "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
    )  # fmt: skip
    _imported(source)
    assert pack(folder / "cache", file, _SOURCES) == 1
    yield source, file
    del sys.modules["mine"]


@pytest.fixture
def use(monkeypatch, tmp_path, made):
    """Imports the source in an environment with another file, or none, of code."""
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path / "cache"))

    def imported(code: WheelCode, source: Path = made[0]) -> ModuleType:
        monkeypatch.setattr(compiled, "wheel_code", lambda: code)
        monkeypatch.setattr("gfm_hil.engine.compiling.wheel_code", lambda: code)
        return _imported(source)

    return imported


def _compiles(module: ModuleType) -> bool:
    assert module.twice(3.0) == 6.0
    return bool(sum(module.twice.stats.cache_misses.values()))


def test_what_fits_is_used_and_nothing_is_compiled(made, use):
    code = WheelCode(_SOURCES, made[1])
    assert not _compiles(use(code))
    assert code.unfit == ""


def test_a_caller_that_the_wheel_has_not_is_compiled_with_its_callee(made, use):
    module = use(WheelCode(_SOURCES, made[1]))
    assert not _compiles(module)
    assert module.caller(3.0) == 7.0
    assert module.twice(4.0) == 8.0  # as before
    assert sum(module.caller.stats.cache_misses.values()) == 1


def test_a_clone_has_none_and_says_nothing(use, tmp_path):
    code = WheelCode(_SOURCES, tmp_path / "none")
    assert _compiles(use(code))
    assert code.unfit == ""


@pytest.mark.parametrize("at", [0, 33, 60, -1, None])
def test_a_damaged_file_is_not_used(made, use, tmp_path, at):
    held = bytearray(made[1].read_bytes())
    if at is None:
        del held[len(held) // 2 :]
    else:
        held[at] ^= 1
    file = tmp_path / "wheel_code.bin"
    file.write_bytes(held)
    code = WheelCode(_SOURCES, file)
    assert _compiles(use(code))
    assert code.unfit == f"{file} is damaged"


def test_code_of_other_sources_is_not_used(made, use):
    code = WheelCode("00" * 32, made[1])
    assert _compiles(use(code))
    assert code.unfit == "the sources have changed since"


def test_a_function_that_has_changed_is_compiled(made, use, tmp_path):
    changed = tmp_path / made[0].parent.name / "mine.py"
    changed.parent.mkdir()
    changed.write_text(_SOURCE.replace("2.0 * x", "3.0 * x"))
    assert use(WheelCode(_SOURCES, made[1]), changed).twice(3.0) == 9.0


def test_a_processor_without_the_features_compiles_and_says_so(made, use, monkeypatch):
    has = wheel_code.llvm.get_host_cpu_features()
    lacking = TARGETS[platform.machine()][1][:2]
    monkeypatch.setattr(
        wheel_code.llvm, "get_host_cpu_features", lambda: {**has, **dict.fromkeys(lacking, False)}
    )
    module = use(WheelCode(_SOURCES, made[1]))
    said: list[str] = []
    sets = [
        Set("a number", lambda: module.twice(3.0)), Set("another", lambda: module.twice(3))
    ]  # fmt: skip
    assert compile_sets(sets, said.append) == 2
    why = f"the code in this wheel is not used (this processor lacks {', '.join(lacking)})"
    assert said[0].splitlines() == [why, "compiling a number (1 of 2, once a machine) …"]
    assert said[1] == "compiling another (2 of 2, once a machine) …"


@pytest.mark.parametrize("name", ["numba", "llvmlite"])
def test_code_for_another_compiler_is_not_used(made, use, monkeypatch, name):
    here = wheel_code.version(name)
    real = wheel_code.version
    monkeypatch.setattr(wheel_code, "version", lambda of: "0.1" if of == name else real(of))
    code = WheelCode(_SOURCES, made[1])
    assert _compiles(use(code))
    assert code.unfit == f"it is for {name} {here}, and here is 0.1"
