"""Folders that exist as long as their processes, and recordings in memory that outlive theirs."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.core import temporary as scratch
from gfm_hil.recording import parts as recording

from ...support.processes import kill

pytestmark = pytest.mark.processes

HOLD = """
import sys, time
from pathlib import Path
from gfm_hil.recording.parts import RolePart, keep_in_memory
folder = Path(sys.argv[1])
keep_in_memory(folder, 100)
part = RolePart.create(folder, sys.argv[2], 100)
part.signals[:60] = 1.5
print("ready", flush=True)
time.sleep(600)
"""

Record = Callable[[Path, str], "subprocess.Popen[str]"]


@pytest.fixture
def memory(tmp_path, monkeypatch) -> Path:
    """A folder that replaces /dev/shm for this process."""
    place = tmp_path / "memory"
    place.mkdir()
    monkeypatch.setattr(recording, "_MEMORY", place)
    return place


@pytest.fixture
def record(memory, spawn) -> Record:
    """A process that has recorded 60 of 100 ticks and then sleeps."""

    def call(folder: Path, role: str) -> subprocess.Popen[str]:
        folder.mkdir(exist_ok=True)
        where = (
            "import gfm_hil.recording.parts as r, pathlib; "
            f"r._MEMORY = pathlib.Path({str(memory)!r})"
        )
        process = spawn("-c", where + HOLD, str(folder), role)
        assert process.stdout.readline() == "ready\n"
        return process

    return call


def another_run(tmp_path: Path) -> list[str]:
    """Do what any run in real time does at its start and its end; returns its notices."""
    folder, said = tmp_path / "another", []
    folder.mkdir()
    recording.keep_in_memory(folder, 10, said.append)
    recording.remove_parts(folder)
    folder.rmdir()
    return said


def test_a_folder_is_left_behind_once_nobody_holds_it(tmp_path):
    place, first = scratch.make("x-", tmp_path)
    second = scratch.hold(place)
    assert list(scratch.left_behind("x-", tmp_path)) == []
    scratch.release(first)
    assert list(scratch.left_behind("x-", tmp_path)) == []
    scratch.release(second)
    ((found, handle),) = scratch.left_behind("x-", tmp_path)
    assert found == place
    assert list(scratch.left_behind("x-", tmp_path)) == []  # only one process can remove them
    scratch.release(handle)


def test_a_temporary_folder_goes_with_its_context_and_left_ones_go_too(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    left, handle = scratch.make("x-", tmp_path)
    (left / "link").touch()
    scratch.release(handle)
    (tmp_path / "x-a-file").touch()
    with scratch.temporary("x-") as place:
        (place / "link").touch()
        with scratch.temporary("x-") as other:
            assert place.is_dir() and other.is_dir()
        assert not left.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["x-a-file"]


def test_what_a_killed_run_recorded_in_memory_is_moved_to_its_folder(record, memory, tmp_path):
    folder = tmp_path / "run"
    kill(record(folder, "plant"))
    assert (folder / "parts").is_symlink()
    another_run(tmp_path)
    assert not (folder / "parts").is_symlink()
    assert list(memory.iterdir()) == []
    part = recording.RolePart.open(folder, "plant")
    assert part is not None
    assert (part.signals[:60] == 1.5).all() and np.isnan(part.signals[60:]).all()
    assert {path.name for path in folder.iterdir()} == {"parts"}


def test_it_stays_while_one_role_lives(record, memory, tmp_path):
    folder = tmp_path / "run"
    plant, controller = record(folder, "plant"), record(folder, "controller")
    kill(plant)
    another_run(tmp_path)
    assert (folder / "parts").is_symlink()
    kill(controller)
    another_run(tmp_path)
    assert not (folder / "parts").is_symlink()
    assert all(recording.RolePart.open(folder, role) for role in ("plant", "controller"))
    assert list(memory.iterdir()) == []


def test_it_is_found_in_a_folder_that_was_renamed(record, memory, tmp_path):
    folder = tmp_path / "run"
    kill(record(folder, "plant"))
    folder = folder.rename(tmp_path / "a better name")
    assert another_run(tmp_path) == []
    assert not (folder / "parts").is_symlink()
    assert recording.RolePart.open(folder, "plant") is not None
    assert list(memory.iterdir()) == []


def test_it_stays_and_is_named_where_the_run_folder_is_gone(record, memory, tmp_path):
    folder, elsewhere = tmp_path / "run", tmp_path / "archive" / "2026" / "run"
    kill(record(folder, "plant"))
    elsewhere.parent.mkdir(parents=True)
    folder.rename(elsewhere)
    (place,) = memory.iterdir()
    for _ in range(2):
        (said,) = another_run(tmp_path)
        assert said.startswith(f"{place}: kept, ")
        assert str(folder) in said
    assert recording.RolePart.open(elsewhere, "plant") is not None


def test_a_place_in_which_nothing_was_recorded_goes(memory, tmp_path):
    _, handle = scratch.make("gfmhil-parts-", memory)
    scratch.release(handle)
    assert another_run(tmp_path) == []
    assert list(memory.iterdir()) == []


def test_it_stays_where_its_folder_has_no_room(record, memory, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    kill(record(folder, "plant"))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copyfileobj", full)
    another_run(tmp_path)
    assert (folder / "parts").is_symlink()
    assert {path.name for path in folder.iterdir()} == {"parts"}  # no incomplete copy
    assert recording.RolePart.open(folder, "plant") is not None
