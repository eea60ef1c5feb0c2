"""--box and --want of the design commands: another box, and other demands on its loops."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, get_args

import numpy as np

from gfm_design.model.box import Box, Source
from gfm_design.tuning.robust import Wanted
from gfm_hil.core.errors import UserError

_SOURCES = get_args(Source)
#: the least and the largest that a plant of the box may be
_RANGE = {
    "R_f": (0.001, 100.0),
    "R_g": (0.001, 100.0),
    "L_g": (0.01, 100.0),
    "delay": (0.0, 5.99),
    "P_ref": (-1.5, 1.5),
}


def add_box(command: argparse.ArgumentParser) -> None:
    """The option of the box."""
    command.add_argument(
        "--box",
        action="append",
        default=[],
        metavar="NAME=v,v,…",
        help="other extremes of R_f, R_g, L_g, delay (samples), P_ref, dc; may be repeated",
    )


def read_box(entries: Sequence[str]) -> Box:
    """The box with some of its extremes replaced.

    Raises:
        UserError: an unknown name, no value, or one that no plant of the box can have.
    """
    found: dict[str, Any] = {}
    for entry in entries:
        name, _, text = (part.strip() for part in entry.partition("="))
        values = [v.strip() for v in text.split(",") if v.strip()]
        known = [f.name for f in fields(Box)]
        if name not in known or not values:
            raise UserError(f"--box {entry!r}: must be NAME=v,v,… with a NAME of {known}")
        if name in found:
            raise UserError(f"--box: {name} is given twice")
        found[name] = tuple(_source(v) if name == "dc" else _number(name, v) for v in values)
    return replace(Box(), **found)


def _source(text: str) -> str:
    if text not in _SOURCES:
        raise UserError(f"--box dc={text}: must be of {list(_SOURCES)}")
    return text


def _number(name: str, text: str) -> float:
    low, high = _RANGE[name]
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not low <= value <= high:
        raise UserError(f"--box {name}={text}: must be a number from {low:g} to {high:g}")
    return value


def wanted(named: dict[str, float], box: Box) -> Wanted:
    """The demands, some replaced; those on the rig's source are relaxed only beside the other.

    Raises:
        UserError: an unknown name, a number that is not positive, a demand on a source that is
            not in the box.
    """
    known = [f.name for f in fields(Wanted)]
    for name, value in named.items():
        if name not in known or value <= 0.0:
            raise UserError(f"--want {name}={value:g}: must be positive, a name of {known}")
    both = len(set(box.dc)) > 1
    if not both and (odd := {"rig_alpha", "rig_weight"} & set(named)):
        raise UserError(f"--want {min(odd)}: only for a box with both DC sources")
    return replace(Wanted() if both else Wanted(rig_alpha=None), **named)
