"""gfmhil doctor: is this machine fit for real time, and what to do where it is not."""

import argparse
from typing import Any

from gfm_hil.cli.common import EXIT_OTHERWISE, print_result
from gfm_hil.results.table import Cell, Table
from gfm_hil.run.doctor import examine, worst

_STYLES = {"green": "good", "yellow": "warn", "red": "bad"}


def add(command: argparse.ArgumentParser) -> None:
    command.description = "Judge this machine for real time, in about a second; it changes nothing."
    command.add_argument("--json", action="store_true", help="all facts and findings as JSON")
    command.add_argument("--strict", action="store_true", help="exit code 3 if a line is red")


def call(options: argparse.Namespace) -> int:
    facts, findings = examine()
    level = worst(findings)
    content = {"worst": level, "findings": [f._asdict() for f in findings], "facts": facts}
    rows: list[tuple[Any, ...]] = []
    for f in findings:
        rows.append((Cell(f.level, _STYLES[f.level]), f.what, f.found))
        if f.advice:
            rows.append(("", "", f"→ {f.advice}"))
    print_result(options, content, [Table((), rows, text=None, fold=2)])
    return EXIT_OTHERWISE if options.strict and level == "red" else 0
