"""gfmhil scenarios: what ships."""

import argparse
import json
from pathlib import Path

from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario, shipped_scenarios


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="as JSON")


def call(options: argparse.Namespace) -> int:
    found = {name: load_scenario(name) for name in shipped_scenarios()}
    if options.json:
        rows = [{"name": n, "title": s.title, "mode": s.mode, "law": s.law, "duration": s.duration}
                for n, s in found.items()]  # fmt: skip
        print(json.dumps(rows, indent=2))
        return 0
    lines = [
        (name, s.mode, ", ".join(Path(law).name for law in s.laws()), f"{s.duration:g}", s.title)
        for name, s in found.items()
    ]
    heads = ("scenario", "mode", "laws", "s", "title")
    terminal().print(Table(heads, lines, text=None, fold=2))
    return 0
