"""gfmhil new: a law or scenario file to start from, with comments."""

import argparse
import re
from importlib.resources import files
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text

KINDS = ("law", "scenario")


def add(command: argparse.ArgumentParser) -> None:
    command.description = "Writes NAME.toml, which runs as it is and says what each line means."
    command.add_argument("kind", choices=KINDS, help="kind of file")
    command.add_argument("name", metavar="NAME", help="lower case letters, digits, _, . and -")


def call(options: argparse.Namespace) -> int:
    if not re.fullmatch(r"[a-z0-9][a-z0-9_.-]*", options.name):
        raise UserError(f"{options.name!r}: must be lower case letters, digits, _, . and -")
    path = Path(f"{options.name.removesuffix('.toml')}.toml")
    if path.exists():
        raise UserError(f"{path}: is there already; choose another name")
    text = files("gfm_hil").joinpath("cli", "start_files", f"{options.kind}.toml")
    write_text(path, text.read_text(encoding="utf-8").replace("NAME", path.stem))
    print(path)
    return 0
