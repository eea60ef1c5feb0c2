"""The worked example of tuning.md: the commands, run one after the other, and what they say."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection
from pathlib import Path

from _ext.outputs import command
from _figures.common import DOCS, TABLES, write_table

from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PAPER_START, PaperProblem, tune_paper
from gfm_runtime import law_file

LAW, TUNED = "my-tunable.toml", "my-tuned.toml"
_HEAD = 13  # lines of the law file that the page shows

#: name of the table: command
EXAMPLE = {
    "tune_tune": f"gfmhil design tune --law {LAW} --out {TUNED} --quiet",
    "tune_run": f"gfmhil run pref_step --law {TUNED} --link inproc --out runs/tuned --quiet",
    "tune_margins": f"gfmhil design margins --law {TUNED} --scenario pref_step",
}
#: commands of the page that stand by themselves
OTHERS = {
    "tune_none": "gfmhil design tune --law droop-1 --starts 1 --quiet",
    "tune_full_order": "gfmhil design tune --law mimo-gfm --full-order --quiet",
}

#: of the example's two couplings, which may move; a coupling that may not is 0
COUPLINGS = (("neither", ()), ("$k_{31}$", ("k_31",)), ("$k_{21}$", ("k_21",)),
             ("both", ("k_21", "k_31")))  # fmt: skip
_SPARSE = ("k_pdc", "k_idc", "k_22", "k_34")


def run_example(folder: Path, names: Collection[str] = tuple(EXAMPLE)) -> dict[str, str]:
    """What these commands of the example say, and the head of the law file that they leave."""
    shutil.copy(DOCS / "examples" / LAW, folder)
    said = {name: command(EXAMPLE[name], folder=folder) for name in names}
    lines = (folder / TUNED).read_text(encoding="utf-8").splitlines()[:_HEAD]
    return said | {"tune_file": "\n".join(["```toml", *lines, "# …", "```"])}


def couplings() -> None:
    """The gamma that each of the example's two couplings is worth, beside MIMO-GFM's all."""
    file, rows = law_file(str(DOCS / "examples" / LAW)), []
    for label, names in COUPLINGS:
        problem = PaperProblem(file, free_gains(file, only=(*_SPARSE, *names)))
        rows.append([label, str(len(problem.gains)), f"{tune_paper(problem).cost:.3f}"])
    full = law_file("mimo-gfm")
    whole = PaperProblem(full, free_gains(full, PAPER_START["mimo-gfm"]))
    rows.append(["all of MIMO-GFM's", str(len(whole.gains)), f"{tune_paper(whole).cost:.3f}"])
    write_table("tune_couplings", ["couplings", "free gains", "γ, tuned"], rows)


def worked_example() -> None:
    """The page's blocks of text."""
    with tempfile.TemporaryDirectory() as place:
        said = run_example(Path(place))
    said |= {name: command(line) for name, line in OTHERS.items()}
    for name, text in said.items():
        (TABLES / f"{name}.md").write_text(text + "\n", encoding="utf-8")
