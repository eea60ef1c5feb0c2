"""Run folders that somebody else has prepared: links, pipes, devices, sizes, JSON and npz files.

GFMHIL_HOSTILE_FOLDERS=500 tries 500 of them.
"""

import io
import json
import os
import random
import shutil
import socket
import stat
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.core import temporary as scratch
from gfm_hil.core.files import replacing, write_text
from gfm_hil.recording import parts as recording
from gfm_hil.run.run_folder import recover
from gfm_hil.run.runner import run_scenario

from ..conftest import unfinished

pytestmark = [
    pytest.mark.processes,
    pytest.mark.timeout(0 if "GFMHIL_HOSTILE_FOLDERS" in os.environ else 600),
]

FOLDERS = int(os.environ.get("GFMHIL_HOSTILE_FOLDERS", "40"))
EACH = Path(__file__).parents[2] / "support" / "recover_each.py"
MOST_S, MOST_MB = 2.0, 300.0
GIGABYTE = 1 << 30
EVENTS = [{"type": "reference", "t": 0.02, "P_ref": 0.6}]
LINK_END = {"role": "plant", "faults": {"lost": 0}, "e2e": "valid"}
ENDED = {
    "wall_s": 1.0, "figures": False,
    "outside": {"status": "safe", "reason": "cut off", "tick": 3},
}  # fmt: skip
JSON = ("summary.json", "ended.json", "link_plant.json", "link_controller.json")
LOGS = ("events.jsonl", "events_both.jsonl", "events_plant.jsonl")
DATA = ("signals.npz", "timing.npz")
PARTS = tuple(
    f"parts/{role}_{what}.npy"
    for role in ("plant", "controller")
    for what in ("signals", "times", "progress")
)
OTHERS = (".lock", "scenario.toml", "report.html", "signals.png", "parts", "profiles", "x")
ODD = (
    None, True, -1, 0, 10**30, 1e308, float("nan"), float("inf"), "", "\x1b[2J", "x" * 5000, [],
    {}, [[]], {"a": 1}, [None], "2", [1, "a"],
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The folder of a finished run."""
    from gfm_hil.scenario import check_scenario

    folder = tmp_path_factory.mktemp("good") / "whole"
    given = {"title": "test", "duration": 0.05, "link": {"type": "inproc"}, "events": EVENTS}
    run_scenario(check_scenario(given, "test"), folder)
    return folder


@pytest.fixture(scope="module")
def cut(whole) -> Path:
    """The folder of a run that was cut off while its files were made."""
    from gfm_hil.scenario import load_scenario

    folder = whole.with_name("cut")
    with unfinished():
        run_scenario(load_scenario(whole / "scenario.toml"), folder)
    (folder / "ended.json").write_text(json.dumps(ENDED))
    for role in ("plant", "controller"):
        (folder / f"link_{role}.json").write_text(json.dumps({**LINK_END, "role": role}))
    return folder


@pytest.fixture
def elsewhere(tmp_path) -> Iterator[Path]:
    """A folder of the user's, private as ~/.ssh is, and the recording of another run in memory."""
    place = tmp_path / "elsewhere"
    (place / "inner").mkdir(parents=True)
    place.chmod(0o700)
    for name in ("key", "plant_signals.npy", "inner/file", "events_x"):
        (place / name).write_bytes(b"mine")
    run = tmp_path / "another"
    run.mkdir()
    recording.keep_in_memory(run, 10)
    memory = (run / "parts").readlink()
    (memory / "plant_signals.npy").write_bytes(b"of another run")
    (place / "memory").symlink_to(memory)
    yield place
    recording.remove_parts(run)


def content(place: Path) -> dict[str, tuple[int, bytes]]:
    """Modes and contents below a folder, and below the folder in memory that it links to."""
    found = {}
    for root in (place, (place / "memory").readlink()):
        for path in sorted([root, *root.rglob("*")]):
            mode = path.lstat().st_mode
            data = path.read_bytes() if stat.S_ISREG(mode) else b""
            found[str(path)] = mode, os.fsencode(path.readlink()) if path.is_symlink() else data
    return found


@pytest.fixture(params=["complete", "cut off"])
def folder(request, whole, cut, tmp_path) -> Path:
    """The folder of a run, complete or cut off."""
    place = tmp_path / "run"
    shutil.copytree(whole if request.param == "complete" else cut, place)
    return place


@pytest.mark.attack(
    "16.2", "parts of a run folder links to a folder such as ~/.ssh", "recover emptied that folder"
)
@pytest.mark.parametrize("to", ["private", "relative", "another run", "named alike"])
def test_no_folder_is_removed_through_a_link(to, folder, elsewhere, refused, attack_now):
    alike = Path("/dev/shm") / f"gfmhil-parts-test-{os.getpid()}"
    target = {
        "private": elsewhere,
        "relative": Path("..") / "elsewhere",
        "another run": (elsewhere / "memory").readlink(),
        "named alike": alike,
    }[to]
    if to == "named alike":
        alike.symlink_to(elsewhere)
    before = content(elsewhere)
    shutil.rmtree(folder / "parts", ignore_errors=True)
    (folder / "parts").symlink_to(target)
    try:
        assert f"parts: is a link to {target}, " in refused("recover", str(folder))
        assert content(elsewhere) == before
    finally:
        alike.unlink(missing_ok=True)
    attack_now("refused in a line, nothing touched")


def test_the_recording_of_a_renamed_folder_is_recovered(cut, tmp_path):
    made, place = tmp_path / "made", tmp_path / "renamed"
    made.mkdir()
    recording.keep_in_memory(made, 500)
    memory = (made / "parts").readlink()
    try:
        for path in (cut / "parts").iterdir():
            shutil.copy(path, memory)
        scratch.release(recording._holds.pop(made / "parts"))
        for path in cut.iterdir():
            if path.is_file():
                shutil.copy(path, made)
        made.rename(place)
        assert recover(place).ticks == 500
        assert not memory.exists()
    finally:
        shutil.rmtree(memory, ignore_errors=True)


@pytest.mark.attack(
    "16.3",
    "a link under the name of the file beside the one that is written",
    "the file that it linked to was overwritten",
)
def test_no_file_is_written_through_a_link(tmp_path, elsewhere, attack_now):
    before = content(elsewhere)
    path = tmp_path / "summary.json"
    (tmp_path / f".part-{os.getpid()}-summary.json").symlink_to(elsewhere / "key")
    path.symlink_to(elsewhere / "plant_signals.npy")
    write_text(path, "new")
    assert (path.read_text(), path.is_symlink()) == ("new", False)
    names = set()
    for _ in range(20):
        with replacing(path) as part:
            names.add(part.name)
            assert not part.read_bytes()
            part.write_text("newer")
    assert len(names) == 20
    assert content(elsewhere) == before
    attack_now("a new name each time, which cannot be told in advance; nothing else touched")


def test_files_of_the_user_in_a_run_folder_stay(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    for name in ("events_notes.txt", "link_list.json", "commands_mine.json"):
        (folder / name).touch()
    (folder / "events_plant.jsonl").mkdir()
    recover(folder)
    assert (folder / "events_notes.txt").exists() and (folder / "link_list.json").exists()
    assert (folder / "commands_mine.json").exists() and (folder / "events_plant.jsonl").is_dir()


def put(kind: str, path: Path, original: Path) -> None:
    """Something else in place of a file: a pipe, 1 GB of zeros, or a link."""
    path.unlink(missing_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "gigabyte":
        path.touch()
        os.truncate(path, GIGABYTE)
    else:
        path.symlink_to("/dev/zero" if kind == "zero" else original)


@pytest.mark.attack(
    "16.4",
    "a pipe or a file of 1 GB in place of a file of a run folder",
    "recover and export waited for ever, or took 4 GB",
)
@pytest.mark.parametrize("kind", ["pipe", "gigabyte", "link", "zero"])
@pytest.mark.parametrize("name", [*JSON[1:], *LOGS[:2], *PARTS[::2]])
def test_what_is_no_file_of_a_run_is_said_in_a_line(kind, name, cut, tmp_path, refused, attack_now):
    folder, path = tmp_path / "run", tmp_path / "run" / name
    shutil.copytree(cut, folder)
    put(kind, path, cut / name)
    reason = {"pipe": "is not a regular file", "gigabyte": ""}.get(kind, "is a link, which is not")
    assert f"{path}: {reason}" in refused("recover", str(folder))
    assert (folder / "parts" / "plant_times.npy").exists()  # what was recorded is kept
    attack_now("refused in a line, what was recorded is kept")


@pytest.mark.parametrize("name", ["signals.npz", "timing.npz", "summary.json", "events.jsonl"])
@pytest.mark.parametrize("kind", ["pipe", "gigabyte", "link"])
def test_a_finished_run_is_read_from_regular_files(kind, name, whole, tmp_path, refused):
    folder, path = tmp_path / "run", tmp_path / "run" / name
    shutil.copytree(whole, folder)
    put(kind, path, whole / name)
    for words in (["recover", str(folder)], ["export", str(folder), "-o", f"{tmp_path}/x.mat"]):
        assert refused(*words).startswith(f"gfmhil: {path}")


def test_a_log_without_times_is_exported(whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    log = folder / "events.jsonl"
    log.write_text(
        log.read_text() + '{"tick": 3, "event": "a"}\n{"tick": 3, "t": "1", "event": 1}\n'
    )
    assert main(["export", str(folder), "-o", str(tmp_path / "x.mat")]) == 0


# what is wrong with a folder


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


def other_kind(chance: random.Random, folder: Path, away: Path) -> str:
    """Something else than a file in place of a file."""
    name = chance.choice((*JSON, *LOGS, *DATA, *PARTS, *OTHERS))
    path = folder / name
    if not path.parent.is_dir() or path.parent.is_symlink():
        return ""
    remove(path)
    kind = chance.choice(("link", "link", "folder", "gone", "zero", "pipe", "socket", "device",
                          "sparse", "directory", "empty", "noise"))  # fmt: skip
    match kind:
        case "link":
            path.symlink_to(chance.choice([away / "key", away / "plant_signals.npy"]))
        case "folder":
            path.symlink_to(chance.choice([away, (away / "memory").readlink()]))
        case "gone":
            path.symlink_to(away / "not there")
        case "zero":
            path.symlink_to("/dev/zero")
        case "pipe":
            os.mkfifo(path)
        case "socket":
            here = os.open(path.parent, os.O_RDONLY)
            with socket.socket(socket.AF_UNIX) as end:
                end.bind(f"/proc/self/fd/{here}/{path.name}")
            os.close(here)
        case "device" if os.geteuid() == 0:
            os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 5))
        case "sparse":
            path.touch()
            os.truncate(path, GIGABYTE)
        case "directory":
            path.mkdir()
            (path / "x").touch()
        case "noise":
            path.write_bytes(chance.randbytes(50_000))
        case _:
            path.touch()
    return f"{name}: {kind}"


def odd(chance: random.Random, value: object) -> object:
    """A value in which one place holds something else, or nothing."""
    if isinstance(value, dict) and value and chance.random() < 0.85:
        key = chance.choice([*value])
        if chance.random() < 0.2:
            return {k: v for k, v in value.items() if k != key}
        return {**value, key: odd(chance, value[key])}
    if isinstance(value, list) and value and chance.random() < 0.85:
        k = chance.randrange(len(value))
        return [*value[:k], odd(chance, value[k]), *value[k + 1 :]]
    return chance.choice(ODD)


def odd_json(chance: random.Random, folder: Path, away: Path) -> str:
    """JSON that no run writes."""
    path = folder / chance.choice((*JSON, *LOGS))
    if not path.is_file() or path.is_symlink():
        return ""
    lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    kind = chance.choice(("odd", "odd", "odd", "odd", "deep", "many", "long", "no JSON"))
    match kind:
        case "odd":
            for k in range(len(lines)):
                lines[k] = json.dumps(odd(chance, json.loads(lines[k])))
        case "deep":
            sign = chance.choice(("[", '{"a":'))
            lines.append(sign * chance.choice((150, 100_000)))
        case "many":
            nothing = "[" + "[]," * 3_000_000 + "[]]"
            line = '{"tick":1,"t":0,"event":"a"}\n'
            untimed = '{"tick":1,"event":"a"}\n'
            lines = [chance.choice((nothing, line * 10**6, untimed * 10**6, untimed * 9))]
        case "long":
            lines.append('"' + "x" * 40_000_000 + '"')
        case _:
            lines = [chance.choice(("", "{", "\x00", "\ud800", '{"a": 1', "nan", "[1, 2]"))]
    path.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    return f"{path.name}: {kind}"


def header(shape: object, kind: str) -> bytes:
    about = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(about)) + about.encode()


def odd_array(chance: random.Random) -> bytes:
    shape = chance.choice(("(500,)", "(-1,)", "(10**12,)", "(2**62, 30)", "()", "'a'", "(0,)",
                           "(" * 200, "(5, 5)", "(True,)"))  # fmt: skip
    kind = chance.choice(("<f8", "<f8", "<i8", "|O", "<U100000000", "|V9", "<c16", ">f8", "x"))
    return header(shape, kind) + bytes(chance.choice((0, 40, 4000)))


def odd_npz(chance: random.Random, folder: Path, away: Path) -> str:
    """Archives that no run writes."""
    path = folder / chance.choice(DATA)
    if not path.is_file() or path.is_symlink():
        return ""
    kind = chance.choice(("bits", "bits", "cut", "arrays", "bomb", "members", "method", "field"))
    data = bytearray(path.read_bytes())
    match kind:
        case "bits":
            for _ in range(chance.randint(1, 20)):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        case "cut":
            del data[chance.randrange(len(data)) :]
        case "field":  # of the directory: where the blocks begin
            for _ in range(3):
                at = data.find(b"gf", chance.randrange(len(data)))
                value = chance.choice((0, 1, 2**63, 2**64 - 1))
                if at > 0:
                    data[at + 4 : at + 12] = struct.pack("<Q", value)
        case _:
            made = io.BytesIO()
            with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
                if kind == "members":
                    for k in range(30_000):
                        archive.writestr(f"{k}.npy", b"")
                elif kind == "bomb":
                    rows = 1 << 25
                    zeros = header(f"({rows},)", "<f8") + bytes(8 * rows)
                    archive.writestr("tick.npy", zeros)
                    archive.writestr("laws.npy", header("(1,)", "<U60000000") + bytes(240_000_000))
                else:
                    how = {"method": chance.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))}
                    for name in ("tick", "t", "laws", "true_p", "../x", "plant_sent"):
                        archive.writestr(f"{name}.npy", odd_array(chance), how.get(kind))
            data = bytearray(made.getvalue())
    path.write_bytes(data)
    return f"{path.name}: {kind}"


def odd_part(chance: random.Random, folder: Path, away: Path) -> str:
    """Arrays that no run writes."""
    path = folder / chance.choice(PARTS)
    if not path.is_file() or path.is_symlink():
        return ""
    data = path.read_bytes()
    match kind := chance.choice(("array", "cut", "bits", "values", "longer")):
        case "array":
            data = odd_array(chance)
        case "cut":
            data = data[: chance.randrange(len(data))]
        case "bits":
            at = chance.randrange(128)
            data = data[:at] + chance.randbytes(2) + data[at + 2 :]
        case "values":
            value = chance.choice((np.nan, np.inf, 1e308, -1e9, 0.0))
            data = data[:128] + np.full((len(data) - 128) // 8, value).tobytes()
        case "longer":
            data = header("(400_000, 28)", "<f8") + b"\x01" * (400_000 * 28 * 8)
    path.write_bytes(data)
    return f"{path.name}: {kind}"


def odd_scenario(chance: random.Random, folder: Path, away: Path) -> str:
    """A scenario that names something else than files, or the folders of others."""
    path = folder / "scenario.toml"
    if not path.is_file() or path.is_symlink():
        return ""
    pipe = folder / "pipe.toml"
    if not pipe.exists():
        os.mkfifo(pipe)
    old, new = chance.choice((
        ('converter = "paper"', f'converter = "{pipe}"'),
        ('converter = "paper"', f'converter = "{away / "key"}.toml"'),
        ('law = "mimo-gfm"', f'law = "{pipe}"'),
        ('law = "mimo-gfm"', 'law = "/dev/zero"'),
        ("duration = 0.05", "duration = 86400.0"),
        ("duration = 0.05", "duration = 1e-4"),
        ("T_s = 0.0001", "T_s = 1e-6"),
        ("[references]", "a = " + "[" * 5000 + "]" * 5000 + "\n[references]"),
        ("title", "\ud800title"),
        ("[plant]", f'[network.converters."../elsewhere"]\n[network.converters."{away}"]\n[plant]'),
    ))  # fmt: skip
    text = path.read_text().replace(old, new)
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return f"scenario.toml: {new[:60]}"


def link_for_writing(chance: random.Random, folder: Path, away: Path) -> str:
    """Links under the names of what is written."""
    made = []
    for name in ("events.jsonl", "summary.json", "report.html", "signals.png", "network.svg",
                 f".part-{os.getpid()}-summary.json", "waveforms.png", "signals.npz"):  # fmt: skip
        if not os.path.lexists(folder / name) and chance.random() < 0.5:
            (folder / name).symlink_to(away / chance.choice(("key", "new")))
            made.append(name)
    return f"links: {', '.join(made)}" if made else ""


WRONG: tuple[Callable[[random.Random, Path, Path], str], ...] = (
    other_kind, other_kind, odd_json, odd_json, odd_npz, odd_part, odd_scenario, link_for_writing,
)  # fmt: skip


def prepare(seed: int, good: list[Path], folder: Path, away: Path) -> str:
    """Make the hostile folder of a number; returns what is wrong with it."""
    chance = random.Random(seed)
    shutil.copytree(chance.choice(good), folder)
    wrong: list[str] = []
    while not wrong or chance.random() < 0.3:
        wrong += filter(None, [chance.choice(WRONG)(chance, folder, away)])
    return "; ".join(wrong)


@pytest.fixture
def each(whole, tmp_path) -> Iterator[Callable[..., dict[str, object]]]:
    """Carries out a command in a process of its own and says what it took."""
    good = tmp_path / "good"
    shutil.copytree(whole, good)
    (good / "summary.json").unlink()  # so that it draws once
    process = subprocess.Popen(
        [sys.executable, str(EACH), str(good)], text=True, cwd=tmp_path,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert process.stdout.readline() == "ready\n"

    def call(*words: str) -> dict[str, object]:
        process.stdin.write(json.dumps(words) + "\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    yield call
    process.kill()
    process.communicate()


def faults(took: dict[str, object]) -> list[str]:
    """What is wrong with how a command ended."""
    said = str(took["said"])
    found = []
    if took["code"] not in (0, 2, 3):
        found.append(f"exit code {took['code']}")
    if "Traceback" in said or (took["code"] and not said.startswith("gfmhil: ")):
        found.append("a traceback")
    if len(said) > 20_000 or any(c < " " and c != "\n" for c in said):
        found.append("an unreadable message")
    if took["cpu_s"] > MOST_S:
        found.append(f"{took['cpu_s']:.1f} s of processor time")
    if took["peak_MB"] > MOST_MB:
        found.append(f"{took['peak_MB']:.0f} MB")
    return found


@pytest.mark.attack(
    "16.1",
    "run folders of others: links, pipes, devices, sizes, JSON and npz files",
    "files outside removed, recover waits for ever, 4 GB of memory, 35 kinds of traceback",
)
def test_recover_bears_any_folder(each, whole, cut, elsewhere, tmp_path, attack_now):
    before = content(elsewhere)
    broken, most_s, most_MB, done = [], 0.0, 0.0, 0
    for seed in range(FOLDERS):
        folder = tmp_path / f"run-{seed}"
        wrong = prepare(seed, [whole, cut, cut], folder, elsewhere)
        out = str(tmp_path / f"out.{'mat' if seed % 2 else 'csv'}")
        for words in (["recover", str(folder)], ["export", str(folder), "-o", out]):
            took = each(*words)
            done += words[0] == "recover" and took["code"] == 0
            most_s, most_MB = max(most_s, took["cpu_s"]), max(most_MB, took["peak_MB"])
            if found := faults(took):
                said = took["said"][-600:]
                broken.append(f"{seed} {words[0]} ({wrong}): {', '.join(found)}: {said}")
        if content(elsewhere) != before:
            broken.append(f"{seed} ({wrong}): something elsewhere has changed")
            break
        shutil.rmtree(folder)
    print(f"{FOLDERS} folders, {done} completed: {most_s:.2f} s and {most_MB:.0f} MB at most")
    assert not broken, "\n".join(broken)
    attack_now(
        f"{FOLDERS} folders: nothing elsewhere touched, no traceback; at most {most_s:.1f} s of "
        f"processor time and {most_MB:.0f} MB"
    )
