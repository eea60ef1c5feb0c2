"""Tables and figures of docs/conformity.md.

Runs all sets on all laws of the catalogue behind the inner stage ``virtual-stator`` into
runs/conformity, and from there writes

    docs/tables/conformity_laws.md                  what each law passes and fails
    docs/tables/conformity_causes.md                why, by test and clause
    docs/tables/conformity_stages.md                two laws behind each inner stage
    docs/tables/conformity_grid.md                  the laws for grid codes, behind dual-sequence
    docs/_static/figures/conformity_matrix.png      laws x tests
    docs/_static/figures/conformity_grid.png        the same of the laws for grid codes
    docs/_static/figures/conformity_part.png        one run with its windows and limits

Usage: python docs/make_conformity.py    (20 to 40 minutes on two processors that others use too)
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from gfm_hil.cli import main as gfmhil
from gfm_hil.core.terminal import markdown
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, SIGNS
from gfm_runtime import grid_names

DOCS = Path(__file__).resolve().parent
FOLDER = DOCS.parent / "runs" / "conformity"
FIGURES = DOCS / "_static" / "figures"
STAGE, LAW = "virtual-stator", "vsg-2"
STAGED = (LAW, "mimo-gfm-practical")
STAGES = (STAGE, "cascaded", "threshold-impedance", "dual-sequence")
VERDICTS = tuple(SIGNS)


def conform(folder: Path, *arguments: str, stage: str = STAGE) -> dict[str, Any]:
    """Run the command; that a test fails is a result. Returns the tests by law."""
    shutil.rmtree(folder, ignore_errors=True)
    code = gfmhil(["conform", "--inner", stage, "-o", str(folder), *arguments])
    if code not in (0, 1, 4):
        raise SystemExit(code)
    laws: dict[str, Any] = json.loads((folder / "results.json").read_text("utf-8"))["laws"]
    return laws


def table(laws: dict[str, Any]) -> str:
    """One row a law: how many tests pass, fail and cannot be judged, and which fail."""
    rows = []
    for law, tests in laws.items():
        by = {v: [t for t, found in tests.items() if found["verdict"] == v] for v in VERDICTS}
        counts = [str(len(by[v])) for v in VERDICTS]
        rows.append([law, *counts, ", ".join(by["fail"]) or "–"])
    rows.sort(key=lambda row: -int(row[1]))
    return markdown(["law", *VERDICTS, "fails"], rows)


def causes(laws: dict[str, Any]) -> str:
    """One row a test and clause that is the cause of a verdict, with the laws that it is about, and
    what was found for the first of them."""
    by: dict[tuple[str, str, str], dict[str, str]] = {}
    for law, tests in laws.items():
        for test, found in tests.items():
            if found["verdict"] not in (FAIL, CANNOT):
                continue
            part = next(p for p in found["parts"] if p["verdict"] == found["verdict"])
            clause, text = (part["cause"] or {"clause": "–", "text": part["reason"]}).values()
            by.setdefault((test, found["verdict"], clause), {})[law] = text
    rows = []
    for (test, verdict, clause), about in sorted(by.items()):
        first, text = next(iter(about.items()))
        who = "all" if len(about) == len(laws) else ", ".join(about)
        rows.append([test, verdict, clause, who, f"{first}: {text}"])
    return markdown(["test", "verdict", "clause", "laws", "what was found"], rows)


def stages() -> str:
    """One row a test that not all pass: the verdicts of two laws behind each stage."""
    found = {
        stage: conform(
            FOLDER / stage, *(x for law in STAGED for x in ("--law", law)), "--no-figures",
            stage=stage,
        )
        for stage in STAGES
    }  # fmt: skip
    columns = [found[stage][law] for law in STAGED for stage in STAGES]
    tests = [[test, *(column[test]["verdict"] for column in columns)] for test in columns[0]]
    rows = [row for row in tests if {*row[1:]} != {"pass"}]
    counts = [str(sum(row[k] == "pass" for row in tests)) for k in range(1, len(columns) + 1)]
    rows.append([f"passes, of {len(tests)}", *counts])
    return markdown(["test", *(f"{law}, {stage}" for law in STAGED for stage in STAGES)], rows)


def main() -> None:
    """Everything."""
    laws = conform(FOLDER / "laws", "--law", "all", "--no-figures")
    (DOCS / "tables" / "conformity_laws.md").write_text(table(laws) + "\n", "utf-8")
    (DOCS / "tables" / "conformity_causes.md").write_text(causes(laws) + "\n", "utf-8")
    (DOCS / "tables" / "conformity_stages.md").write_text(stages() + "\n", "utf-8")
    names = [x for law in grid_names() for x in ("--law", law)]
    grid = conform(FOLDER / "grid", *names, "--no-figures", stage=STAGES[-1])
    (DOCS / "tables" / "conformity_grid.md").write_text(table(grid) + "\n", "utf-8")
    shutil.copy(FOLDER / "grid" / "matrix.png", FIGURES / "conformity_grid.png")
    shutil.copy(FOLDER / "laws" / "matrix.png", FIGURES / "conformity_matrix.png")
    conform(FOLDER / "one", "--law", LAW, "--against", "miso")
    part = FOLDER / "one" / "runs" / LAW / "miso-3-phase-jump" / "figure.png"
    shutil.copy(part, FIGURES / "conformity_part.png")


if __name__ == "__main__":
    main()
