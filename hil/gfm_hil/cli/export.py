"""gfmhil export: a finished run as a file that other tools open."""

import argparse
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.results.export import FORMATS, export_run


def add(command: argparse.ArgumentParser) -> None:
    command.description = "; ".join(f"{name}: {form.text}" for name, form in FORMATS.items())
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument(
        "--format", choices=list(FORMATS), help="by the ending of FILE if not given"
    )
    command.add_argument(
        "--three-phase", choices=["pu", "si"],
        help="add v_abc of the filter capacitor and i_abc of the bridge and of the line, in p.u. "
        "or in V and A",
    )  # fmt: skip
    command.add_argument("-o", "--out", type=Path, metavar="FILE", help="the run's name by default")


def call(options: argparse.Namespace) -> int:
    name, file = options.format, options.out
    if name is None:
        name = file.suffix.removeprefix(".") if file is not None else ""
        if name not in FORMATS:
            said = "is not given" if file is None else f"is not told by {file.name}"
            raise UserError(f"--format {said}: must be one of {', '.join(FORMATS)}")
    if file is None:
        file = Path(f"{options.folder.resolve().name}.{name}")
    if not file.name:
        raise UserError(f"--out {file}: must name a file")
    for path in export_run(options.folder, name, file, options.three_phase):
        print(path)
    return 0
