"""gfmhil scenarios: what ships."""

import argparse
from pathlib import Path

from gfm_hil.cli.common import print_result
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario, shipped_scenarios


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="as JSON")


def call(options: argparse.Namespace) -> int:
    found = {name: load_scenario(name) for name in shipped_scenarios()}
    content = [{"name": n, "title": s.title, "mode": s.mode, "law": s.law, "duration": s.duration}
               for n, s in found.items()]  # fmt: skip
    lines = [
        (name, s.mode, ", ".join(Path(law).name for law in s.laws()), f"{s.duration:g}", s.title)
        for name, s in found.items()
    ]
    heads = ("scenario", "mode", "laws", "s", "title")
    print_result(options, content, [Table(heads, lines, text=None, fold=2)])
    return 0
