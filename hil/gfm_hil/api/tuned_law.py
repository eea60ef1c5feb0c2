"""What a synthesis found: its channels as plain data, and the law file with its gains."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gfm_design.norms.performance import WeightedChannel
from gfm_hil.scenario import Scenario, toml_text
from gfm_runtime import law_file
from gfm_runtime.law import HomeGrid
from gfm_runtime.lawfile import LawFile, shipped_law

_PAPERS_GRID = HomeGrid().model_dump(mode="json")


def channels_as_json(channels: Sequence[WeightedChannel]) -> dict[str, Any]:
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


def problem_name(file: LawFile, on: Scenario | None = None, converter: str | None = None) -> str:
    """The problem whose gamma a synthesis gives: the paper's, or that of a scenario."""
    if on is not None:
        who = "" if converter is None else f"converter {converter} of "
        return f"the paper's weights on {who}{on.title!r}, sampled"
    if file.inner is None:
        return "the paper's problem (Section III-B)"
    return f"the paper's weights, behind {file.inner.type}, sampled at 10 kHz, u one sample late"


def law_text(
    file: LawFile, gains: Mapping[str, float], by: str, comments: Sequence[str], **about: Any
) -> str:
    """A law file with other gains, and comments above them: what differs from the law of the
    catalogue that ``file`` is, or all of it if the law is no such one.

    Args:
        file: the law.
        gains: the parameters that change.
        by: what found the gains; their source.
        comments: one a line.
        about: other keys of the file that change, such as name and title.
    """
    content = {**file.model_dump(mode="json", exclude_none=True), **about}
    for name, value in gains.items():
        content["parameters"][name] |= {"value": value, "source": by}
    if shipped_law(file.name) is not None:
        base = law_file(file.name).model_dump(mode="json", exclude_none=True)
        changed = _difference(content, base)
        content = content if changed is None else {"base": file.name, **changed}
    return "".join(f"# {line}\n" for line in comments) + "\n" + toml_text(content)


def _difference(new: Mapping[str, Any], old: Mapping[str, Any]) -> dict[str, Any] | None:
    """What of ``new`` is not in ``old``, table by table; None if ``new`` lacks what ``old`` has."""
    if old.keys() - new.keys():
        return None
    out: dict[str, Any] = {}
    for key, value in new.items():
        before = old.get(key)
        if value == before:
            continue
        if isinstance(value, dict) and isinstance(before, dict) and "type" not in value:
            value = _difference(value, before)
            if value is None:
                return None
        out[key] = value
    return out


def write_law(
    path: Path,
    file: LawFile,
    gains: Mapping[str, float],
    result: Mapping[str, Any],
    notes: Sequence[str] = (),
    by: str = "gfmhil design tune",
    problem: str | None = None,
) -> None:
    """Write a law file with its tuned gains and, as comments, what they were tuned for.

    Args:
        path: the new file; its stem is the name of the law.
        file: the law that was tuned. The new one is meant for the paper's grid, whatever this one
            was meant for.
        gains: the parameters that change.
        result: gamma, channels, evaluations, seconds and seed, as ``gfmhil design tune --json``.
        notes: more lines of comment.
        by: the command that found the gains.
        problem: whose gamma it is; the paper's if None.

    Raises:
        OSError: the file cannot be written.
    """
    comments = [
        f"gamma = {result['gamma']:.6g} of {problem or f'{problem_name(file)}, P_ref = 0.5'}",
        *(f"W_{c['i']}{c['j']}: {c['norm']:.6g}" for c in result["channels"]),
        f"{result['evaluations']} evaluations, {result['seconds']:.1f} s, seed {result['seed']}",
        *notes,
    ]
    source = f"{file.source.strip()}; tuned by {by}, see the comments"
    about = {"name": path.stem, "title": f"{file.title}, tuned", "source": source}
    changed_by = f"{by}, seed {result['seed']}"
    text = law_text(file, gains, changed_by, comments, home_grid=_PAPERS_GRID, **about)
    path.write_text(text, encoding="utf-8")
