"""Two installations of gfmhil, measured alternately on the same machine."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from gfm_hil.bench.options import KINDS
from gfm_hil.bench.result import check_result, write_result
from gfm_hil.bench.rounds import ShowProgress, in_turn
from gfm_hil.core.errors import UserError

_LISTS = ("rounds_p50_us", "rounds_ratio", "turns")  # lists that every round extends


def interleave(
    a: str, b: str, turns: int, what: str, folder: Path, show: ShowProgress
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run both ``turns`` times, one round each; returns the results and writes them to ``folder``.

    Args:
        a, b: gfmhil commands, for example the path of one in another environment.
        turns: of each; every second one begins with B.
        what: kind and options of ``gfmhil bench``.
        folder: for A.json and B.json: the first turn's result with the rounds of all turns.
        show: gets the present work and the share done.

    Raises:
        UserError: there is no such command, or it fails (with its message).
    """
    if turns < 2:
        raise UserError(f"--interleave {turns}: must be at least 2")
    chosen = shlex.split(what)
    if not chosen or chosen[0] not in KINDS:
        raise UserError(f"--what {what!r}: must begin with one of {', '.join(KINDS)}")
    commands = {"A": shlex.split(a), "B": shlex.split(b)}
    for name, command in commands.items():
        if not command or shutil.which(command[0]) is None:
            raise UserError(f"{name} = {shlex.join(command)!r}: no such command")
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in commands}
    for turn, share, name in in_turn(list(commands), turns):
        show(f"round {turn + 1}, {name}", share)
        runs[name].append(_once(name, commands[name], chosen))
    for name, (first, *others) in runs.items():
        for other in others:
            _extend(first, other)
        write_result(first, folder / f"{name}.json")
    return runs["A"][0], runs["B"][0]


def _once(name: str, command: list[str], chosen: list[str]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        out = ["--rounds", "1", "--quiet", "--json", "--out", str(Path(place) / "bench")]
        line = [*command, "bench", *chosen, *out]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
    about = f"{name}: {shlex.join([*command, 'bench', *chosen])}"
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise UserError(f"{about}: {lines[-1] if lines else f'exit code {done.returncode}'}")
    try:
        return check_result(json.loads(done.stdout), about)
    except ValueError:
        raise UserError(f"{about}: printed no JSON") from None


def _extend(kept: Any, more: Any) -> None:
    """Extend a result's lists of rounds by those of another one."""
    if isinstance(kept, dict):
        for key, value in kept.items():
            if key in _LISTS:
                value += more[key]
            elif key in more:
                _extend(value, more[key])
    elif isinstance(kept, list):
        for a, b in zip(kept, more, strict=False):
            _extend(a, b)
