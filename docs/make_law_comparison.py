"""Tables and figures of docs/law-comparison.md, and the tuned laws that ship.

Runs ``gfmhil design compare`` on the whole catalogue into runs/law-comparison and copies from there

    docs/tables/law_comparison_*.md              the tables
    docs/_static/figures/law_comparison_*.png    the figures
    runtime/gfm_runtime/laws/tuned       the law files

A law whose row is in runs/law-comparison already is not tuned again; remove the folder for that.

Usage: python docs/make_law_comparison.py [--jobs N]    (some minutes on one core)
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from gfm_hil.cli import main as gfmhil

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
FOLDER = ROOT / "runs" / "law-comparison"
LAWS = ROOT / "runtime" / "gfm_runtime" / "laws" / "tuned"


def main() -> int:
    """Everything; returns the exit code of the command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--jobs", type=int, default=1)
    jobs = parser.parse_args().jobs
    code = gfmhil(["design", "compare", "--out", str(FOLDER), "--jobs", str(jobs)])
    if code:
        return code
    for path in FOLDER.glob("law_comparison_*.md"):
        shutil.copy(path, DOCS / "tables" / path.name)
    for path in FOLDER.glob("law_comparison_*.png"):
        shutil.copy(path, DOCS / "_static" / "figures" / path.name)
    shutil.rmtree(LAWS, ignore_errors=True)
    shutil.copytree(FOLDER / "laws", LAWS)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
