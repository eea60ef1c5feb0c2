"""Starts `gfmhil` as a process, finds its roles' processes, waits for their recording."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.roles import ROLES
from gfm_hil.recording.parts import Part
from gfm_hil.scenario.toml_out import toml_text


def places(folder: Path) -> set[Path]:
    """What a run in progress has outside its folder: memory, the folder of a socket."""
    words = Path(f"/proc/{roles_of(folder)['plant']}/cmdline").read_bytes().decode().split("\0")
    kind, _, name = words[words.index("--endpoint") + 1].partition("://")
    found = {Path("/dev/shm") / f"gfmhil-link-{name}" if kind == "shm" else Path(name).parent}
    if (folder / "parts").is_symlink():
        found.add((folder / "parts").resolve())
    return found


PATIENCE_S = 90.0


def write(folder: Path, **content: Any) -> str:
    """Write a scenario file to ``folder``; returns its path."""
    path = folder / "scenario.toml"
    path.write_text(toml_text({"title": "test", "duration": 0.1, **content}))
    return str(path)


def wait_for(what: Any, process: subprocess.Popen[str]) -> Any:
    """Poll until ``what()`` is true; fail if the process ends or the timeout expires."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found = what()
        if found:
            return found
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise AssertionError("the condition did not come true in time")


def has_run(folder: Path, ticks: int) -> bool:
    """Whether the plant has recorded that many ticks."""
    part = Part.open(folder, "plant")
    return part is not None and int(part.progress[0]) >= ticks


def roles_of(folder: Path) -> dict[str, int]:
    """Process ids of the sides that record into ``folder``."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes().decode().split("\0")
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            except OSError:
                continue
            if str(folder) in words and state != "Z":
                found.update({role: int(entry.name) for role in ROLES if role in words})
    return found


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
