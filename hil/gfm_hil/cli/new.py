"""gfmhil new: files to start from, with comments, and a project of them."""

import argparse
import re
from importlib.resources import files
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text

KINDS = ("law", "scenario", "campaign", "conformity", "network", "project")
#: a file of a project, and the start file that it is made from
PROJECT = {
    "README.md": "project/README.md",
    "pyproject.toml": "project/pyproject.toml",
    "lab.toml": "scenario.toml",
    "network.toml": "network.toml",
    "campaign.toml": "campaign.toml",
    "laws/NAME.toml": "law.toml",
    "conformity/phase-jump.toml": "conformity.toml",
    "tests/test_law.py": "project/test_law.py",
}


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Writes NAME.toml, which runs as it is and says what each line means; of a project the "
        "folder NAME with all of them, and tests for pytest."
    )
    command.add_argument("kind", choices=KINDS, help="kind of file")
    command.add_argument("name", metavar="NAME", help="lower case letters, digits, _, . and -")


def call(options: argparse.Namespace) -> int:
    if not re.fullmatch(r"[a-z0-9][a-z0-9_.-]*", options.name):
        raise UserError(f"{options.name!r}: must be lower case letters, digits, _, . and -")
    project = options.kind == "project"
    path = Path(options.name if project else f"{options.name.removesuffix('.toml')}.toml")
    if path.exists():
        raise UserError(f"{path}: is there already; choose another name, or delete it")
    words = {"NAME": path.name.removesuffix(".toml"), "SCENARIO": "rig_pref_step", "LAW": "droop-3"}
    if project:
        words |= {"SCENARIO": "lab.toml", "LAW": f"laws/{path}.toml"}
    for place, start_file in PROJECT.items() if project else [("", f"{options.kind}.toml")]:
        at = path / place.replace("NAME", path.name) if place else path
        at.parent.mkdir(parents=True, exist_ok=True)
        text = files("gfm_hil").joinpath("cli", "start_files", start_file)
        write_text(at, re.sub("|".join(words), lambda m: words[m[0]], text.read_text("utf-8")))
    print(path)
    return 0
