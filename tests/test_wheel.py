"""A wheel with compiled code and an sdist, built, checked, and installed where nothing else is."""

import os
import platform
import subprocess
import sys
import tarfile
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest

from gfm_runtime.wheel_code import TARGETS

ROOT = Path(__file__).resolve().parents[1]

pytestmark = [
    pytest.mark.systems,
    pytest.mark.timeout(1500),  # it compiles and installs; 2 minutes where nothing else runs
    pytest.mark.skipif(platform.machine() not in TARGETS, reason="no wheel is for it"),
]


def _done(*command: object, **environment: str) -> str:
    done = subprocess.run(
        list(map(str, command)), cwd=ROOT, env={**os.environ, **environment}, check=False,
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A wheel that carries what pref_step calls."""
    folder = tmp_path_factory.mktemp("dist")
    _done(ROOT / ".ci" / "wheel", folder, "pref_step", PYTHON=sys.executable)
    (wheel,) = folder.glob("*.whl")
    return wheel


def test_the_wheel_is_for_one_python_and_machine_and_its_metadata_is_good(built):
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    assert built.name.endswith(f"-{python}-{python}-manylinux_2_27_{platform.machine()}.whl")
    _done(sys.executable, "-m", "twine", "check", "--strict", built)
    names = zipfile.ZipFile(built).namelist()
    assert "gfm_runtime/wheel_code.bin" in names
    assert not [name for name in names if name.endswith((".so", ".pyc", ".nbi", ".nbc"))]


@pytest.fixture(scope="module")
def without_code(tmp_path_factory):
    """The wheel for every Python, built from the sdist."""
    folder = tmp_path_factory.mktemp("source")
    _done(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder)
    (sdist,) = folder.glob("*.tar.gz")
    _done(sys.executable, "-m", "twine", "check", "--strict", sdist)
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "out", filter="data")
    (source,) = (folder / "out").iterdir()
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


def test_the_sdist_builds_the_wheel_for_every_python(without_code):
    assert without_code.name.endswith("-py3-none-any.whl")


def _newest_python() -> str:
    """The newest Python that pyproject.toml claims and this machine has."""
    for minor in range(14, sys.version_info.minor, -1):
        environment = {**os.environ, "PYENV_VERSION": f"3.{minor}"}  # where pyenv has them
        ask = [f"python3.{minor}", "-c", "import sys; print(sys.executable)"]
        with suppress(FileNotFoundError, subprocess.CalledProcessError):
            return subprocess.check_output(ask, env=environment, text=True).strip()
    return sys.executable


def test_the_newest_python_runs_it(without_code, tmp_path):
    """In a new environment with what the image has."""
    _done(_newest_python(), "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    lock = ROOT / "requirements" / "container.txt"
    install = [python, "-m", "pip", "install", "--quiet", "--no-compile"]  # imports do that
    _done(*install, "--require-hashes", "-r", lock)
    _done(*install, "--no-deps", without_code)
    _done(python, "-m", "pip", "check")
    cache = str(tmp_path / "cache")
    command = [python, "-P", "-m", "gfm_hil", "run", "pref_step", "--link", "inproc"]
    said = _done(*command, "-o", tmp_path / "run", NUMBA_CACHE_DIR=cache)
    assert "completed" in said and "compiling the loop" in said


def test_the_first_run_compiles_nothing(built, tmp_path):
    """The wheel stands before our own folders on the path, with the packages of the tests."""
    place, cache = tmp_path / "place", tmp_path / "cache"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--no-deps"]
    _done(*pip, "--target", place, built)
    said = _done(
        sys.executable, "-P", "-m", "gfm_hil", "run", "pref_step", "-o", tmp_path / "run",
        NUMBA_CACHE_DIR=str(cache), PYTHONPATH=str(place),
    )  # fmt: skip
    assert "completed" in said and "compiling" not in said
    assert not list(cache.rglob("*.nb[ic]"))
