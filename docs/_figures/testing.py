"""What the wrong law of examples/own_law leaves behind: the message and the figure of a test."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from _figures.common import DOCS, FIGURES, TABLES

TEST = "tests/test_law.py::test_follows_a_step_of_power"


def failed_assertion() -> None:
    """Run the test as its reader would, and keep both."""
    project = DOCS.parent / "examples" / "own_law"
    with tempfile.TemporaryDirectory() as place:
        command = ["pytest", TEST, "--law=too-stiff"]
        quietly = [f"--gfmhil-out={place}", "-q", "-p", "no:cacheprovider"]
        done = subprocess.run(
            [sys.executable, "-m", *command, *quietly],
            cwd=project, capture_output=True, text=True, check=False,
        )  # fmt: skip
        (figure,) = Path(place).rglob("*.png")
        FIGURES.joinpath("testing_too_stiff.png").write_bytes(figure.read_bytes())
    said = done.stdout.replace(place, "figures").replace(f"{project}/", "")
    lines = [line for line in said.splitlines() if line.startswith(("E  ", ">  "))]
    text = "\n".join(["$ " + " ".join(command), *lines])
    (TABLES / "testing_too_stiff.md").write_text(f"```text\n{text}\n```\n", encoding="utf-8")
