"""Figures and tables of start, experiments, identification, cli and more: runs and writes

    docs/_static/figures/*.png    the figures
    docs/tables/*.md              the numbers that the page quotes

Usage: python docs/make_figures.py    (some minutes; nothing else is needed)
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from _ext.outputs import command
from _figures import eigenvalues, steps
from _figures.common import FIGURES, TABLES
from _figures.dead_time import dead_time
from _figures.identification import envelope, identification
from _figures.inner_stage import inner_stage
from _figures.limit_cycle import limit_cycles
from _figures.services import services
from _figures.start import start
from _figures.streams import from_mf4
from _figures.testing import failed_assertion


def terminal() -> None:
    """What the two commands that run the bench print, for cli.md."""
    for name, line in (
        ("cli_run", "gfmhil run switchover --mode lockstep --out runs/switchover --quiet"),
        ("cli_compare", "gfmhil compare pref_step --link inproc --out runs/pref_step --quiet"),
    ):
        with tempfile.TemporaryDirectory() as place:
            text = command(line, folder=Path(place))
        (TABLES / f"{name}.md").write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Everything."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    TABLES.mkdir(parents=True, exist_ok=True)
    for name in ("pref_step", "grid_frequency_step"):
        steps.compared(name, name, 0.8, 3.0)
        steps.rig(f"rig_{name}", f"rig_{name}", name, 0.8, 3.0)
    steps.equivalence()
    steps.rig_tables()
    steps.switchover()
    eigenvalues.ideal_table()
    eigenvalues.bandwidth_table()
    eigenvalues.resistance_figure()
    eigenvalues.imperfection_table()
    eigenvalues.couplings_table()
    eigenvalues.q_droop_table()
    limit_cycles()
    dead_time()
    inner_stage()
    identification()
    envelope()
    failed_assertion()
    from_mf4()
    services()
    start()
    terminal()


if __name__ == "__main__":
    main()
