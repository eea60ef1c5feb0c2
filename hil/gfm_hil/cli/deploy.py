"""gfmhil deploy: the files that run a side as a service, in a container or on a bus."""

import argparse
import shutil
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty

_FOLDERS = (
    Path(__file__).resolve().parents[1] / "deploy",  # a wheel carries them here
    Path(__file__).resolve().parents[3] / "deploy",  # a checkout has them here
)
# Named, as keys and scenarios may lie beside them in a checkout; hatch_build.py has the same list.
FILES = ("can/*", "container/Containerfile", "container/compose.yaml", "systemd/**/*", "tune-*")


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Write what is in deploy/: units of systemd, container files, units of CAN "
        "interfaces and the script that tunes a machine for real time."
    )
    command.add_argument("-o", "--out", required=True, metavar="DIR", help="folder; new or empty")


def call(options: argparse.Namespace) -> int:
    """Write the files and list them; returns the exit code. Raises UserError: the folder is not
    empty or cannot be written."""
    source = next((folder for folder in _FOLDERS if folder.is_dir()), None)
    if source is None:
        raise UserError("gfmhil deploy: this installation came without the files of deploy/")
    out = Path(options.out)
    check_empty(out)
    for path in sorted(p for pattern in FILES for p in source.glob(pattern) if p.is_file()):
        target = out / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)  # with its mode: the script stays executable
        print(target)
    return 0
