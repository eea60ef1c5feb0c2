"""Tables and figures of docs/conformity.md.

Runs all sets on all laws of the catalogue behind the inner stage ``virtual-stator`` into
runs/conformity, and from there writes

    docs/tables/conformity_laws.md                  what each law passes and fails
    docs/_static/figures/conformity_matrix.png      laws x tests
    docs/_static/figures/conformity_part.png        one run with its windows and limits

Usage: python docs/make_conformity.py    (less than 10 minutes on two processors)
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from gfm_hil.cli import main as gfmhil
from gfm_hil.core.terminal import markdown

DOCS = Path(__file__).resolve().parent
FOLDER = DOCS.parent / "runs" / "conformity"
FIGURES = DOCS / "_static" / "figures"
STAGE, LAW = "virtual-stator", "vsg-2"
VERDICTS = ("pass", "fail", "cannot judge")


def conform(folder: Path, *arguments: str) -> None:
    """Run the command; that a test fails is a result."""
    shutil.rmtree(folder, ignore_errors=True)
    code = gfmhil(["conform", "--inner", STAGE, "-o", str(folder), *arguments])
    if code not in (0, 1):
        raise SystemExit(code)


def table(results: dict[str, Any]) -> str:
    """One row a law: how many tests pass, fail and cannot be judged, and which fail."""
    rows = []
    for law, tests in results["laws"].items():
        by = {v: [t for t, found in tests.items() if found["verdict"] == v] for v in VERDICTS}
        counts = [str(len(by[v])) for v in VERDICTS]
        rows.append([law, *counts, ", ".join(by["fail"]) or "–"])
    rows.sort(key=lambda row: -int(row[1]))
    return markdown(["law", *VERDICTS, "fails"], rows)


def main() -> None:
    """Everything."""
    conform(FOLDER / "laws", "--law", "all", "--no-figures")
    results = json.loads((FOLDER / "laws" / "results.json").read_text("utf-8"))
    (DOCS / "tables" / "conformity_laws.md").write_text(table(results) + "\n", "utf-8")
    shutil.copy(FOLDER / "laws" / "matrix.png", FIGURES / "conformity_matrix.png")
    conform(FOLDER / "one", "--law", LAW, "--against", "miso")
    part = FOLDER / "one" / "runs" / LAW / "miso-3-phase-jump" / "figure.png"
    shutil.copy(part, FIGURES / "conformity_part.png")


if __name__ == "__main__":
    main()
