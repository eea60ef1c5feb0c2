"""Errors that the user can fix: printed as one line, without a traceback."""

from __future__ import annotations

import importlib.util
from typing import Any

from pydantic import ValidationError

from gfm_runtime.errors import printable

_SHOWN = 20


class UserError(Exception):
    """Wrong input, or a bench that cannot start; the message names field, value and remedy."""


class Unfinished(Exception):
    """The run is over, but its folder could not be completed; no recorded data is lost."""


class PeerLost(Exception):
    """The other side never connected, stopped answering, or is not compatible with this side."""


def need(module: str, package: str, what: str, extra: str) -> None:
    """Raise UserError if the package that ``what`` needs is not installed."""
    if importlib.util.find_spec(module) is None:
        raise UserError(f"{what} needs {package}: pip install 'gfmhil[{extra}]'")


def lines(problem: ValidationError) -> list[str]:
    """pydantic's errors, one line each, 20 at most: path, what is wrong, the value."""
    errors = problem.errors()
    more = [f"and {len(errors) - _SHOWN} more mistakes"] if len(errors) > _SHOWN else []
    return [printable(_line(error)) for error in errors[:_SHOWN]] + more


def _line(error: Any) -> str:
    path = ".".join(str(part) for part in error["loc"])
    text = error["msg"].removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{path}: {text}" if path else text
    if error["type"] == "missing":
        return f"{path}: missing"
    shown = _cut(error["input"])
    if error["type"] in ("union_tag_not_found", "union_tag_invalid"):
        context = error["ctx"]
        key = ".".join(filter(None, (path, context["discriminator"].strip("'"))))
        if "tag" not in context:
            return f"{key}: missing"
        return f"{key} = {_cut(context['tag'])}: must be one of {context['expected_tags']}"
    if error["type"] == "extra_forbidden":
        return f"{path} = {shown}: unknown key"
    return f"{path}: {text}, not {shown}" if path else f"{text}, not {shown}"


def _cut(value: Any) -> str:
    """The repr of a value, at most 60 characters."""
    shown = repr(value)
    return shown if len(shown) < 60 else shown[:57] + "..."
