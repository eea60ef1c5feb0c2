"""gfmhil doctor: is this machine fit for real time, and what to do where it is not."""

from __future__ import annotations

import argparse
import json

from rich.markup import escape
from rich.table import Table

from gfm_hil.cli.common import EXIT_OTHERWISE
from gfm_hil.core.terminal import terminal
from gfm_hil.run.doctor import examine, worst


def add(command: argparse.ArgumentParser) -> None:
    command.description = "Judge this machine for real time, in about a second; it changes nothing."
    command.add_argument("--json", action="store_true", help="all facts and findings as JSON")
    command.add_argument("--strict", action="store_true", help="exit code 3 if a line is red")


def call(options: argparse.Namespace) -> int:
    facts, findings = examine()
    level = worst(findings)
    if options.json:
        said = [finding._asdict() for finding in findings]
        print(json.dumps({"worst": level, "findings": said, "facts": facts}, indent=2))
    else:
        table = Table(box=None, pad_edge=False, show_header=False)
        for _ in ("level", "what", "found and what to do"):
            table.add_column(overflow="fold")
        for f in findings:
            mark = f"[bold {f.level}]{f.level}[/]"
            table.add_row(mark, f.what, escape(f.found))
            if f.advice:
                table.add_row("", "", escape(f"→ {f.advice}"))
        terminal().print(table, highlight=False)
    return EXIT_OTHERWISE if options.strict and level == "red" else 0
