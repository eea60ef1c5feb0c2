"""gfmhil fit: D, H and X_eff of a run or of a recording, with intervals, and the parameters of
WECC's models that follow from them."""

import argparse
from dataclasses import asdict
from pathlib import Path

from rich.markup import escape

from gfm_hil.api.runs import load_run
from gfm_hil.cli.common import print_result
from gfm_hil.recording.foreign import ABOUT
from gfm_hil.results.table import Table
from gfm_hil.studies.unit_fit import fit_run

_UNITS = {"D": "p.u./p.u.", "H": "s", "X_eff": "p.u.", "mp": "p.u.", "TPf": "s"}


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "The swing equation 2 H dω/dt = -p - D ω behind X_eff, fitted to p after a phase jump of a "
        "stiff grid, the first event."
    )
    command.add_argument("what", type=Path, metavar="RUN|FILE", help="run folder, or a recording")
    command.add_argument(
        "--map", type=Path, metavar="FILE", help="of a recording: what its channels are"
    )
    command.add_argument(
        "--scenario", metavar="NAME", help="of a recording: what was done, a name or a file"
    )
    command.add_argument("--json", action="store_true", help="print JSON, nothing else")


def call(options: argparse.Namespace) -> int:
    run = load_run(options.what, options.map, options.scenario)
    found = fit_run(run)
    content = asdict(found) | {"mp": found.mp, "TPf": found.TPf}
    about = [escape(run.summary[ABOUT]["words"])] if ABOUT in run.summary else []
    rows = [
        [name, f"{getattr(found, name):.4g}", f"{low:.4g} to {high:.4g}", _UNITS[name]]
        for name, (low, high) in ((name, found.interval[name]) for name in _UNITS)
    ]
    said: list[str | Table] = [
        *about,
        Table(["", "", "95 %", ""], rows, text=None),
        "REGFM_A1: mp, TPf and X_L = X_eff; REGFM_B1: X_L = X_eff, 1/mp + D1 = D and",
        "H + D2/(2 omega_D) + TPf D/2 = H, which one jump does not part",
        f"left after the jump: {found.left:.2g} p.u. RMS; before it p has {found.noise:.2g}",
    ]
    print_result(options, content, said)
    return 0
