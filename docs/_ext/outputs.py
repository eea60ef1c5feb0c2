"""What commands and checks really say, run while the pages are built."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from unittest import mock

from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import load_scenario
from gfm_runtime import LawError, discretise, get_law

DOCS = Path(__file__).resolve().parents[1]
EXAMPLES = DOCS / "examples"


def command(line: str, width: int = 88, folder: Path = DOCS) -> str:
    """A gfmhil command, run in a folder, and what it prints, as a block of text."""
    said = io.StringIO()
    environment = {"COLUMNS": str(width), "NO_COLOR": "1", "TERM": "dumb"}
    with (
        mock.patch.dict(os.environ, environment),
        contextlib.chdir(folder),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        try:
            code: object = main(line.split()[1:])
        except SystemExit as end:
            code = end.code
    text = "\n".join(part.rstrip() for part in said.getvalue().splitlines())
    status = f"\n[exit code {code}]" if code else ""
    return f"```text\n$ {line}\n{text}{status}\n```"


#: (what is wrong, text to find in the example, what stands there instead)
MISTAKES = (
    ("a key that does not exist", "T_t = 0.02", "T_track = 0.02"),
    ("a number given as text", "value = 0.01", 'value = "1 %"'),
    ("a cell outside the matrix", "31 = {", "41 = {"),
    ("an unknown name in an expression", "D_p / 2", "D_w / 2"),
    ("an element with the wrong numbers", '{ type = "IF", k = "D_p", T = "T" }',
     '{ type = "IF", k = "D_p" }'),
    ("a derivative without a filter", ', T_f = "T_f" }', " }"),
    ("a time constant that is negative", "value = 0.17", "value = -0.17"),
    ("an unknown error map", 'type = "linear"', 'type = "quadratic"'),
    ("impedances without hybrid-angle", 'type = "linear"', 'type = "linear"\nX = 0.0174'),
    ("a set-point that is no reference", 'i_u = "P_ref"', 'i_u = "p_ref"'),
    ("limits that do not ascend", "i_u = [-5.0, 5.0]", "i_u = [5.0, -5.0]"),
    ("a double integrator", '35 = { type = "PI", k = "k_v", T = "T_v" }',
     '35 = [{ type = "PI", k = "k_v", T = "T_v" }, { type = "I", T = 1.0 }]'),
    ("a fraction that is unstable", '{ type = "P", k = "k_23" }',
     '{ type = "TF", num = [1.0], den = [1.0, -2.0] }'),
    ("a fraction with more zeros than poles", '{ type = "P", k = "k_23" }',
     '{ type = "TF", num = [1.0, 0.0, 0.0], den = [0.1, 1.0] }'),
    ("an ω_u loop of gain one or more", "value = 0.25", "value = -1.25"),
)  # fmt: skip


#: the same for my-scenario.toml
SCENARIO_MISTAKES = (
    ("a misspelt key: it is unknown, and the one that was meant is missing",
     'duration = 3.0', 'durations = "3"'),
    ("a wrong type", "seed = 7", "seed = 7.5"),
    ("an unknown law", '"vsg-2"', '"vsg-13"'),
    ("a negative inductance", "factors = { C_f = 0.9 }", "factors = { L_f = -0.9 }"),
    ("an event after the end", "t = 2.0", "t = 20.0"),
    ("a reference out of range", "P_ref = 0.8", "P_ref = 8.0"),
    ("an event of an unknown kind", '"grid-voltage"', '"grid-sag"'),
    ("a ramp and a sag at once", "duration = 0.2 ", "rate = 1.0\nduration = 0.2 "),
    ("real time in one process", "seed = 7", 'seed = 7\nmode = "realtime"\nlink.type = "inproc"'),
    ("a file that is not TOML", "[references]", "[references"),
)  # fmt: skip


def _shown(
    example: str, mistakes: Iterable[tuple[str, str, str]], check: Callable[[str], object]
) -> str:
    """What ``check`` says of an example with one passage replaced, mistake by mistake."""
    good = (EXAMPLES / example).read_text(encoding="utf-8")
    lines: list[str] = []
    for what, find, replace in mistakes:
        if find not in good:
            raise ValueError(f"{find!r} is not in {example}")
        with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
            Path(example).write_text(good.replace(find, replace, 1), encoding="utf-8")
            try:
                check(example)
            except (LawError, UserError) as problem:
                lines += [f"{what[0].upper()}{what[1:]}:", "", "```text", str(problem), "```", ""]
            else:
                raise ValueError(f"{replace!r} is no mistake")
    return "\n".join(lines)


def mistakes() -> str:
    """Every mistake in a law file with its message."""
    return _shown("my-law.toml", MISTAKES, lambda name: discretise(get_law(name), 1e-4))


def scenario_mistakes() -> str:
    """Every mistake in a scenario with its message."""
    return _shown("my-scenario.toml", SCENARIO_MISTAKES, load_scenario)
