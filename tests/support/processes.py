"""Starts `gfmhil` as a process, finds its roles' processes, waits for their recording."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.roles import ROLES
from gfm_hil.core.temporary import private_folder
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import toml_text


def places(folder: Path) -> set[Path]:
    """What a run in progress has outside its folder: memory, the folder of a socket."""
    plant = Path(f"/proc/{roles_of(folder)['plant']}")
    command = Path(f"/proc/{parent_of(parent_of(plant.name))}")  # of its guard
    mapped = {Path(line.split()[-1]) for line in (plant / "maps").read_text().splitlines()}
    found = {path for path in mapped if path.match(f"{private_folder()}/link-*")}
    found = found or {path for path in opened(command) if path.match("gfmhil-run-*")}
    if (folder / "parts").is_symlink():
        found.add((folder / "parts").resolve())
    return found


def parent_of(process: int | str) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def opened(process: Path) -> set[Path]:
    """The files that a process has open."""
    return {file.readlink() for file in (process / "fd").iterdir() if file.is_symlink()}


PATIENCE_S = 400.0  # the first to need a loop compiles it
GFMHIL = [sys.executable, "-m", "gfm_hil"]


def write(folder: Path, **content: Any) -> str:
    """Write a scenario file to ``folder``; returns its path."""
    path = folder / "scenario.toml"
    path.write_text(toml_text({"title": "test", "duration": 0.1, **content}))
    return str(path)


def wait_for(what: Callable[[], Any], process: subprocess.Popen[str] | None = None) -> Any:
    """Poll until ``what()`` is true, and return it; fail if the process ends or time runs out."""
    until = time.monotonic() + PATIENCE_S
    while not (found := what()):
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < until, "the condition did not come true in time"
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def running(
    folder: Path, scenario: str, *options: str, converters: Sequence[str] = ("",)
) -> Iterator[subprocess.Popen[str]]:
    """A run of a scenario's text into ``folder``, which takes commands, of a network at all of its
    ``converters``; ends it as Ctrl-C does."""
    file = folder.with_suffix(".toml")
    file.write_text(scenario, encoding="utf-8")
    command = [*GFMHIL, "run", str(file), "--out", str(folder), "--quiet", "--no-figures"]
    process = subprocess.Popen([*command, *options], stdout=subprocess.DEVNULL, text=True)
    try:
        wait_for(lambda: all(takes_commands(folder / name) for name in converters), process)
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


def free_port() -> int:
    """A TCP port of the loopback device that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def takes_commands(folder: Path) -> bool:
    """Whether both command servers of a run are announced."""
    return all((folder / f"commands_{role}.json").exists() for role in ROLES)


def has_run(folder: Path, ticks: int) -> bool:
    """Whether the plant has recorded that many ticks."""
    part = RolePart.open(folder, "plant")
    return part is not None and int(part.progress[0]) >= ticks


def roles_of(folder: Path) -> dict[str, int]:
    """Process ids of the sides that record into ``folder``."""
    found = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):  # it has ended
            name = (entry / "comm").read_text().strip() if entry.name.isdigit() else ""
            if name in NAMES and folder.resolve() / ".lock" in opened(entry):
                found[NAMES[name]] = int(entry.name)
    return found


#: of the sides' processes, as top and ps show them
NAMES = {f"gfm {role}": role for role in ROLES}


def kill(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()


def end(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a process that is about to end."""
    out, err = process.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in err
    return process.returncode, out, err


def summary(folder: Path) -> dict[str, Any]:
    """The content of summary.json."""
    return json.loads((folder / "summary.json").read_text())


def signals(folder: Path) -> dict[str, np.ndarray]:
    """The content of signals.npz."""
    with np.load(folder / "signals.npz") as file:
        return dict(file)
