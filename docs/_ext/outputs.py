"""What commands and checks really say, run while the pages are built."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from pathlib import Path
from unittest import mock

from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.scenario.model import load_scenario
from gfm_runtime import LawError, build_law, discretise, parse_law

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
    ("an ω_u loop of gain one or more", "value = 0.25", "value = -1.25"),
)  # fmt: skip


def mistake(find: str, replace: str) -> str:
    """What the checks say of the example with one passage replaced."""
    good = (EXAMPLES / "my-law.toml").read_text(encoding="utf-8")
    if good.count(find) < 1:
        raise ValueError(f"{find!r} is not in my-law.toml")
    try:
        discretise(
            build_law(parse_law(good.replace(find, replace, 1), "law file my-law.toml")), 1e-4
        )
    except LawError as problem:
        return str(problem)
    raise ValueError(f"{replace!r} is no mistake")


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
    ("a sensor faster than the integration resolves", "bandwidth_hz = 300.0",
     "bandwidth_hz = 50000.0"),
    ("real time in one process", "seed = 7", 'seed = 7\nmode = "realtime"\nlink.type = "inproc"'),
    ("a file that is not TOML", "[references]", "[references"),
)  # fmt: skip


def scenario_mistake(find: str, replace: str) -> str:
    """What the checks say of the example scenario with one passage replaced."""
    good = (EXAMPLES / "my-scenario.toml").read_text(encoding="utf-8")
    if good.count(find) < 1:
        raise ValueError(f"{find!r} is not in my-scenario.toml")
    with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
        Path("my-scenario.toml").write_text(good.replace(find, replace, 1), encoding="utf-8")
        try:
            load_scenario("my-scenario.toml")
        except UserError as problem:
            return str(problem)
    raise ValueError(f"{replace!r} is no mistake")


def _listed(found: list[tuple[str, str]]) -> str:
    lines: list[str] = []
    for what, message in found:
        lines += [f"{what[0].upper()}{what[1:]}:", "", "```text", message, "```", ""]
    return "\n".join(lines)


def mistakes() -> str:
    """Every mistake in a law file with its message."""
    return _listed([(what, mistake(find, replace)) for what, find, replace in MISTAKES])


def scenario_mistakes() -> str:
    """Every mistake in a scenario with its message."""
    return _listed([(w, scenario_mistake(find, replace)) for w, find, replace in SCENARIO_MISTAKES])
