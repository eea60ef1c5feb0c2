"""Run folders after kills and full disks: complete, or completed by ``gfmhil recover``."""

import errno
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.api.runs import recover
from gfm_hil.cli import main
from gfm_hil.core import files
from gfm_hil.core.errors import Unfinished, UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.engine.setup import make_bench
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.recording import npz
from gfm_hil.recording.merge import merge
from gfm_hil.recording.parts import RolePart
from gfm_hil.recording.run import Run
from gfm_hil.results.export import export_run
from gfm_hil.results.report import write_report
from gfm_hil.run.run_folder import finish
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import scenario_toml

from ...support.processes import has_run, roles_of, signals, summary, wait_for, write
from ..conftest import unfinished

pytestmark = pytest.mark.processes

EVENTS = [
    {"type": "reference", "t": 0.02, "P_ref": 0.6},
    {"type": "law", "t": 0.05, "law": "vsg-2"},
]
WHOLE = {"scenario.toml", "signals.npz", "timing.npz", "events.jsonl", "summary.json"}
FIGURES = {"signals.png", "waveforms.png"}
DRAWN = WHOLE | FIGURES | {"network.svg", "report.html"}


def held(lock: Path) -> bool:
    """Whether a process keeps the lock of a run folder."""
    with lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def same_run(one: Path, other: Path) -> None:
    """Check that two folders hold the same, except for the run's duration."""
    a, b = signals(one), signals(other)
    assert list(a) == list(b)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)
    about = [{**summary(folder), "wall_s": 0} for folder in (one, other)]
    assert about[0] == about[1]
    assert (one / "events.jsonl").read_text() == (other / "events.jsonl").read_text()


@pytest.fixture
def left(make, tmp_path):
    """A run folder before ``finish``, and the arguments of ``finish``."""
    with unfinished() as found:
        run_scenario(make(events=EVENTS), tmp_path / "left")
    return found[0]


# killed


@pytest.mark.attack(
    "7.1", "kill -9 of a whole run, then its folder is opened", "“the run is not over”, for ever"
)
@pytest.mark.parametrize(("link", "mode"), [("shm", "realtime"), ("zmq", "lockstep")])
def test_a_run_killed_as_a_whole_is_recovered(
    link, mode, start, tmp_path, capsys, drawn, attack_now
):
    folder = tmp_path / "run"
    scenario = write(
        tmp_path, mode=mode, law="vsg-2", duration=60.0, link={"type": link},
        late_policy={"hold": 10**6},
    )  # fmt: skip
    process = start("run", scenario, "--out", str(folder), "--no-figures")
    wait_for(lambda: has_run(folder, 300), process)
    assert main(["recover", str(folder)]) == 2
    assert capsys.readouterr().err == f"gfmhil: {folder}: the run is still going on\n"
    memory = (folder / "parts").resolve()
    for number in (process.pid, *roles_of(folder).values()):
        os.kill(number, signal.SIGKILL)
    process.communicate()
    while held(folder / ".lock"):
        time.sleep(0.02)
    assert main(["export", str(folder), "-o", str(tmp_path / "run.csv")]) == 2
    assert "was cut off, see gfmhil recover" in capsys.readouterr().err
    assert main(["recover", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == summary(folder) and found["status"] == "safe" and found["reason"]
    assert found["run"] and found["controller"] == "gfmhil"  # as agreed at the handshake
    recorded = signals(folder)
    assert len(recorded["t"]) == found["ticks"] >= 300
    assert np.isfinite(recorded["true_p"]).all()
    assert names(folder) - {f"{role}.log" for role in ROLES} == DRAWN | (
        {"timing.png"} if mode == "realtime" else set()
    )
    assert not memory.exists()
    assert len(open_recording(folder).columns["tick"]) == found["ticks"]
    attack_now(f"gfmhil recover completes the folder: {found['ticks']} ticks, {found['status']}")


@pytest.mark.attack(
    "7.2", "kill -9 while the folder is put together, before any change of a name",
    "BadZipFile or EOFError at the next np.load",
)  # fmt: skip
def test_a_kill_between_any_two_files_is_recovered(left, tmp_path, attack_now):
    scenario, folder, *rest = left
    whole, count = tmp_path / "whole", 0
    shutil.copytree(folder, whole)
    finish(scenario, whole, *rest)
    assert names(whole) == WHOLE
    killed = True
    while killed:
        count += 1
        place = tmp_path / f"killed-{count}"
        shutil.copytree(folder, place)
        killed = finish_killed_at(count, scenario, place, rest)
        present = {n for n in ("signals.npz", "timing.npz") if (place / n).exists()}
        for name in present:  # never an incomplete file under its name
            with np.load(place / name) as file:
                assert all(file[n] is not None for n in file.files)
        recover(place)
        same_run(place, whole)
        # with a report if killed before it stored its end
        assert names(place) in (WHOLE, DRAWN - FIGURES)
    assert count > 15
    attack_now(f"recovered after a kill at each of {count - 1} places, bit for bit the same")


def finish_killed_at(number: int, scenario, folder: Path, rest) -> bool:
    """Finish a folder in a process that kills itself before the n-th rename or removal."""
    child = os.fork()
    if child == 0:
        count = 0

        def deadly(change):
            def call(*arguments, **more):
                nonlocal count
                count += 1
                if count == number:
                    os.kill(os.getpid(), signal.SIGKILL)
                return change(*arguments, **more)

            return call

        Path.replace, Path.unlink = deadly(Path.replace), deadly(Path.unlink)
        shutil.rmtree = deadly(shutil.rmtree)
        try:
            finish(scenario, folder, *rest)
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def test_a_run_in_process_that_was_killed_is_recovered(start, tmp_path, drawn):
    folder = tmp_path / "run"
    scenario = write(tmp_path, duration=60.0, link={"type": "inproc"}, mode="lockstep")
    process = start("run", scenario, "--out", str(folder))

    def has_recorded() -> bool:
        part = RolePart.open(folder, "plant")
        return part is not None and len(part.signals) > 0 and not np.isnan(part.signals[999, 5])

    wait_for(has_recorded, process)
    process.kill()
    process.communicate()
    found = recover(folder)
    assert (found.summary["status"], found.summary["reason"]) == (
        "safe", "the run was cut off: no process recorded its end",
    )  # fmt: skip
    assert found.summary["ticks"] >= 1000
    assert names(folder) == DRAWN


def test_a_folder_that_is_complete_stays_as_it_is(run, capsys):
    folder = run().folder
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main(["recover", str(folder)]) == 0
    assert "completed" in capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_summary_that_was_lost_is_made_again(run):
    done = run(events=EVENTS)
    (done.folder / "summary.json").unlink()
    again = recover(done.folder).summary
    assert {**again, "wall_s": 0} == {**done.summary, "wall_s": 0}


def test_what_cannot_be_recovered_is_said_in_a_line(tmp_path, refused):
    line = refused("recover", str(tmp_path))
    assert "is not a run folder (scenario.toml is missing)" in line
    (tmp_path / "scenario.toml").touch()
    (tmp_path / "parts").symlink_to("/dev/shm/gone")
    line = refused("recover", str(tmp_path))
    assert "nothing is left of what was recorded (it lay in /dev/shm/gone)" in line


# the disk is full


@pytest.mark.attack(
    "7.3", "no room for one of the files when the run is over", "traceback; parts gone, no summary"
)
@pytest.mark.parametrize("name", ["ended.json", *sorted(DRAWN - {"scenario.toml"})])
def test_no_room_for_a_file_leaves_what_recover_needs(
    name, left, monkeypatch, capsys, request, attack_now
):
    scenario, folder, laws, wall_s, _, outside = left
    expected = DRAWN - FIGURES
    if name in FIGURES:
        request.getfixturevalue("drawn")
        expected = DRAWN
    replace = Path.replace

    def full(self, target):
        if target.name == name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(Unfinished, match=r"No space left .* then gfmhil recover"):
            finish(scenario, folder, laws, wall_s, write_report, outside)
        if name != "ended.json":
            assert main(["recover", str(folder)]) == 3
            assert capsys.readouterr().err.count("\n") == 1
    assert not (folder / name).exists() and not files.unfinished(folder)
    assert recover(folder).summary["status"] == "completed"
    assert names(folder) == expected
    attack_now("one line, exit code 3; gfmhil recover completes the folder once there is room")


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 8 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("no right to mount a file system")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(place: Path) -> Path:
    """Fill the remaining space."""
    with (place / "ballast").open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError as problem:
            assert problem.errno == errno.ENOSPC
    return place / "ballast"


@pytest.mark.attack(
    "7.4", "the disk fills up during a run (a real file system of 8 MiB)", "OSError and a traceback"
)
def test_a_disk_that_fills_up_ends_the_run_in_order(small_disk, make, drawn, attack_now):
    events = [{"type": "reference", "tick": 10 * k, "P_ref": 0.5} for k in range(1, 250)]
    folder = small_disk / "run"
    filled: list[Path] = []

    def progress(ticks: int, misses: int) -> None:
        if not filled:
            filled.append(fill(small_disk))

    with pytest.raises(Unfinished, match="No space left on device"):
        run_scenario(make(duration=0.4, events=events), folder, progress, report=write_report)
    with pytest.raises(Unfinished, match="No space left on device"):
        recover(folder)
    filled[0].unlink()
    run = recover(folder)
    assert run.summary["status"] == "safe"
    assert run.summary["reason"] == ("events_both.jsonl cannot be written: No space left on device")
    told = [e for e in Run.load(folder).events if e["event"] == "reference"]
    assert 0 < len(told) < 249
    assert 0 <= run.summary["ticks"] - told[-1]["tick"] <= 10  # the run ended where its log did
    assert np.isfinite(run.signals["true_p"]).all()
    assert names(folder) == DRAWN
    attack_now(f"ended in order at tick {run.summary['ticks']}; exit code 3; recovered with room")


def test_a_role_whose_log_cannot_be_written_ends_both(small_disk, start, tmp_path):
    events = [{"type": "reference", "tick": 100 * k, "P_ref": 0.5} for k in range(1, 110)]
    scenario = write(
        tmp_path,
        duration=11.0,  # long enough to fill the disk meanwhile, even on a busy machine
        T_s=1e-3,
        events=events,
        mode="realtime",
        late_policy={"hold": 10**6},
        link={"type": "shm", "peer_timeout_s": 60.0},
    )
    folder = small_disk / "run"
    process = start("run", scenario, "--out", str(folder))
    wait_for(lambda: has_run(folder, 10), process)
    ballast = fill(small_disk)
    _, err = process.communicate(timeout=90)
    assert process.returncode == 3
    assert err.splitlines()[-1].startswith(f"gfmhil: {folder}: No space left on device; all that")
    ballast.unlink()
    ended = recover(folder).summary
    # a plant whose controller stands still holds the last u, and its protection may act on that
    assert ended["status"] in ("safe", "completed", "interrupted", "tripped")
    if ended["status"] == "safe":
        assert ended["reason"].endswith("cannot be written: No space left on device")


def test_a_disk_without_room_is_said_before_the_run(small_disk, make):
    with pytest.raises(UserError, match=r"need .* GB, free are"):
        run_scenario(make(duration=10.0), small_disk / "run")
    assert not (small_disk / "run").exists()


# long runs


@pytest.mark.full
@pytest.mark.timeout(600)
@pytest.mark.attack("7.5", "8,000 events in a run", "more than 8 minutes, nearly all of it drawing")
def test_8000_events_are_summarised_in_one_pass(make, tmp_path, monkeypatch, drawn, attack_now):
    ticks, labels, read = 24_000, [], 0
    annotate = "matplotlib.axes.Axes.annotate"
    monkeypatch.setattr(annotate, lambda self, text, *_, **__: labels.append(text))
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # the figures are drawn in this process
    get = npz.Column.__getitem__

    def counting(self, rows):
        nonlocal read
        found = get(self, rows)
        read += len(found)
        return found

    events = [{"type": "reference", "tick": 3 * k, "P_ref": 0.5} for k in range(1, 8000)]
    events.append({"type": "reference", "tick": 12, "Q_ref": 0.1})  # two at a tick
    with monkeypatch.context() as patch:
        patch.setattr(npz.Column, "__getitem__", counting)
        scenario = make(duration=ticks * 1e-4, events=events)
        run = run_scenario(scenario, tmp_path / "run", report=write_report)
    starts = [e["tick"] for e in run.summary["events"]]
    assert len(starts) == 8000 and starts == sorted(starts)
    assert read < 80 * ticks  # each of 33 columns a few times, for any number of events
    assert 20 < len(labels) <= 80  # at most 40 in each of two figures
    attack_now(f"each row is read {read / ticks:.0f} times in all; {len(labels)} labels are drawn")


def test_metrics_of_a_file_are_those_of_arrays(run, make):
    from gfm_hil.run.metrics import event_metrics

    done = run(duration=0.5, events=EVENTS)
    whole = dict(done.signals)
    for first, last in ((200, 500), (500, 5000), (0, 5000), (4990, 5000)):
        one = event_metrics(done.columns, first, last, 1e-4, 50.0)
        assert one == event_metrics(whole, first, last, 1e-4, 50.0)


@pytest.mark.parametrize("piece", [7, 100, 1 << 18])
def test_metrics_do_not_depend_on_how_much_is_read_at_a_time(piece, run, monkeypatch):
    from gfm_hil.recording import columns
    from gfm_hil.run import cycles, metrics

    whole = dict(run(duration=0.3, events=EVENTS).signals)
    expected = metrics.event_metrics(whole, 200, 3000, 1e-4, 50.0)
    for module in (columns, cycles, metrics):
        monkeypatch.setattr(module, "PIECE", piece)
    found = metrics.event_metrics(whole, 200, 3000, 1e-4, 50.0)
    for name, value in expected.items():
        assert found[name] == (value if value is None else pytest.approx(value, rel=1e-12)), name


def test_finishing_takes_the_memory_of_pieces(make, tmp_path, drawn):
    """A run of 24 s, whose columns take 63 MB."""
    scenario = make(duration=24.0)
    # imports and compiles, which take more
    run_scenario(make(duration=1.0), tmp_path / "warm", report=write_report)
    tracemalloc.start()
    try:
        run = run_scenario(scenario, tmp_path / "run", report=write_report)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    whole = sum(len(x) * x.dtype.itemsize for x in run.columns.values())
    assert whole > 62e6
    assert peak < whole / 2


@pytest.mark.full
@pytest.mark.timeout(600)
@pytest.mark.attack(
    "7.6", "a recording of 5·10⁶ ticks, with times, is put together", "2.6 GB of memory"
)
def test_the_memory_of_recover_does_not_grow_with_the_run(make, tmp_path, drawn, attack_now):
    ticks = 1_000_000  # 0.3 GB
    scenario = make(duration=ticks * 1e-4, mode="realtime", link={"type": "shm"})
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "scenario.toml").write_text(scenario_toml(scenario), encoding="utf-8")
    for role in ROLES:
        part = RolePart.create(folder, role, ticks)
        for first in range(0, ticks, 100_000):
            piece = slice(first, first + 100_000)
            part.signals[piece] = 1.0
            part.times[piece] = 100_000 * np.arange(first, piece.stop)[:, None] + 40_000
        if role == "controller":
            part.signals[:, 5] = 0
    code = (
        "import sys; from pathlib import Path; from gfm_hil.api.runs import recover\n"
        "print(recover(Path(sys.argv[1])).summary['ticks'])\n"
        "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True
    )
    count, peak_kB = map(int, done.stdout.split())
    assert count == ticks
    assert peak_kB < 300_000
    attack_now(f"{peak_kB / 1e3:.0f} MB at most, all of the process (10⁶ ticks)")


# the files


@pytest.mark.attack("7.7", "signals.npz cut off or overwritten", "BadZipFile and a traceback")
@pytest.mark.parametrize("hurt", ["cut", "scrambled"])
def test_a_damaged_recording_is_said_in_a_line(hurt, run, tmp_path, capsys):
    folder = run().folder
    file = folder / "signals.npz"
    content = bytearray(file.read_bytes())
    if hurt == "cut":
        del content[len(content) // 2 :]
    else:
        content[2000:-4000] = bytes(len(content) - 6000)
    file.write_bytes(content)
    assert main(["export", str(folder), "-o", str(tmp_path / "run.csv")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "signals.npz" in said
    assert not (tmp_path / "run.csv").exists()


COLUMNS = {
    "many": np.arange(200_001) * 0.1,
    "few": np.array([3, 1, 2]),
    "none": np.empty(0),
    "words": np.array(["droop", "vsg"]),
}


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("npz") / "some.npz"
    npz.write_npz(path, [npz.ColumnGroup.of(**{name: x}) for name, x in COLUMNS.items()])
    return path


def test_numpy_reads_what_is_written(archive):
    with np.load(archive) as file:
        assert file.files == list(COLUMNS)
        for name, x in COLUMNS.items():
            assert file[name].dtype == x.dtype and np.array_equal(file[name], x)


@given(st.integers(-10, 200_100), st.integers(-10, 200_100))
def test_any_rows_are_read_alone(archive, first, last):
    column = npz.open_npz(archive)["many"]
    assert np.array_equal(column[first:last], COLUMNS["many"][first:last])


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_writes_is_read(save, tmp_path):
    save(tmp_path / "x.npz", **COLUMNS)
    found = npz.open_npz(tmp_path / "x.npz")
    assert all(np.array_equal(found[name][:], x) for name, x in COLUMNS.items())
    assert np.array_equal(found["many"][70_000:70_009], COLUMNS["many"][70_000:70_009])


def test_a_file_that_could_not_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "x.npz"
    npz.write_npz(path, [npz.ColumnGroup.of(a=np.arange(3))])

    def read(first, last):
        raise OSError(errno.EIO, "gone")

    with pytest.raises(OSError):
        npz.write_npz(path, [npz.ColumnGroup({"b": np.dtype(float)}, 9, read)])
    assert list(npz.open_npz(path)) == ["a"]
    assert names(tmp_path) == {"x.npz"}


def test_merging_leaves_the_parts(left):
    scenario, folder, laws, *_ = left
    merge(folder, scenario.T_s, laws)
    assert {f"{role}_signals.npy" for role in ROLES} <= names(folder / "parts")
    assert make_bench(scenario).controller.labels == laws


def test_every_format_is_written_from_a_recovered_folder(left, tmp_path):
    recover(left[1])
    for form in ("csv", "mat", "parquet", "mf4", "blf"):
        file = tmp_path / f"run.{form}"
        export_run(left[1], form, file)
        assert file.stat().st_size > 10_000
