"""The page to begin with: its commands, run one after the other, what they print and leave."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from _ext.outputs import command
from _figures.common import FIGURES, TABLES

#: name of the block of text: command; each leaves a run folder of its own
COMMANDS = {
    "start_run": "gfmhil run rig_pref_step --out runs/first --quiet",
    "start_lockstep": "gfmhil run rig_pref_step --link inproc --out runs/lockstep --quiet",
    "start_law": "gfmhil run rig_pref_step --link inproc --law droop-5 --out runs/droop --quiet",
    "start_switchover": "gfmhil run switchover --link inproc --out runs/switchover --quiet",
}
#: figure of the page: the run folder whose signals it shows
PICTURES = {"start_run": "first", "start_law": "droop"}


def listing(folder: Path) -> str:
    """The files of a run folder with their sizes."""
    rows = [
        f"{path.stat().st_size / 1000:8.1f} kB  {path.name}" for path in sorted(folder.iterdir())
    ]
    return "\n".join(["```text", *rows, "```"])


def start() -> None:
    """The page's blocks of text and its figures."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        said = {table: command(line, folder=place) for table, line in COMMANDS.items()}
        said["start_folder"] = listing(place / "runs" / "first")
        for picture, run in PICTURES.items():
            shutil.copy(place / "runs" / run / "signals.png", FIGURES / f"{picture}.png")
    for table, text in said.items():
        (TABLES / f"{table}.md").write_text(text + "\n", encoding="utf-8")
