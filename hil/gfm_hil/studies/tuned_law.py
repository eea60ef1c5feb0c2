"""What a synthesis found: its channels as plain data, and the law file with its gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfm_design.norms.performance import Channel
from gfm_hil.core.errors import UserError
from gfm_hil.scenario.toml_out import toml_text
from gfm_runtime.lawfile import LawFile


def channels_as_json(channels: Sequence[Channel]) -> dict[str, Any]:
    """gamma and its channels as plain data; a peak that is only a limit has no frequency."""
    rows = [
        {
            "i": c.i,
            "j": c.j,
            "norm": c.norm,
            "omega_rad_s": c.omega if np.isfinite(c.omega) else None,
        }
        for c in channels
    ]
    return {"gamma": max(c.norm for c in channels), "channels": rows}


def write_law(
    path: Path,
    file: LawFile,
    gains: Mapping[str, float],
    result: Mapping[str, Any],
    notes: Sequence[str] = (),
    by: str = "gfmhil design tune",
) -> None:
    """Write a law file with its tuned gains and, as comments, what they were tuned for.

    Its name is that of the path.

    Args:
        path: the new file.
        file: the law that was tuned. The new one is meant for the paper's grid, whatever this one
            was meant for.
        gains: the parameters that change.
        result: gamma, channels, evaluations, seconds and seed, as ``gfmhil design tune --json``.
        notes: more lines of comment.
        by: the command that found the gains.

    Raises:
        UserError: the file cannot be written.
    """
    content = file.model_dump(mode="json", exclude_none=True)
    content["name"] = path.stem
    content["title"] = f"{file.title}, tuned"
    content["source"] = f"{file.source.strip()}; tuned by {by}, see the comments"
    content.pop("home_grid")
    for name, value in gains.items():
        content["parameters"][name]["value"] = value
        content["parameters"][name]["source"] = f"{by}, seed {result['seed']}"
    lines = [
        f"gamma = {result['gamma']:.6g} of the paper's problem (Section III-B), P_ref = 0.5",
        *(f"W_{c['i']}{c['j']}: {c['norm']:.6g}" for c in result["channels"]),
        f"{result['evaluations']} evaluations, {result['seconds']:.1f} s, seed {result['seed']}",
        *notes,
    ]
    text = "".join(f"# {line}\n" for line in lines) + "\n" + toml_text(content)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as problem:
        raise UserError(f"--out {path}: {problem.strerror}") from None
