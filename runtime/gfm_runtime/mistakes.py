"""What pydantic finds wrong with a file, in one line a mistake."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from gfm_runtime.errors import meant, printable

_SHOWN = 20


Path = tuple[str | int, ...]


def lines(
    problem: ValidationError, model: Any = None, source: Callable[[Path], str] | None = None
) -> list[str]:
    """The mistakes, 20 at most: path, value, what is wrong, and the name that was perhaps meant.

    Args:
        problem: from pydantic.
        model: what was validated, a model or a union of models; its fields are suggested in place
            of a key that is unknown.
        source: names the file or option that the value at a path comes from; it begins the line.
    """
    errors = problem.errors()
    found = [(error["loc"], _line(error, model)) for error in errors[:_SHOWN]]
    if len(errors) > _SHOWN:
        found.append(((), f"and {len(errors) - _SHOWN} more mistakes"))
    return [printable(f"{source(path)}: {text}" if source else text) for path, text in found]


def _line(error: Any, model: Any) -> str:
    loc = error["loc"]
    path = ".".join(str(part) for k, part in enumerate(loc) if not _chooses(model, loc[: k + 1]))
    text = error["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if error["type"] == "value_error":
        return f"{path}: {text}" if path else text
    if error["type"] == "missing":
        return f"{path}: missing"
    shown = _cut(error["input"])
    context = error.get("ctx", {})
    if error["type"] in ("union_tag_not_found", "union_tag_invalid"):
        key = ".".join(filter(None, (path, context["discriminator"].strip("'"))))
        if "tag" not in context:
            return f"{key}: missing"
        tags = context["expected_tags"]
        return f"{key} = {_cut(context['tag'])}: must be one of {tags}" + meant(
            context["tag"], _quoted(tags)
        )
    if error["type"] == "extra_forbidden":
        *parents, last = error["loc"]
        known = _fields(model, parents)
        close = meant(last, known)
        allowed = "" if close or not known else f"; use one of {', '.join(sorted(known))}"
        return f"{path} = {shown}: unknown key{close}{allowed}"
    if error["type"] in ("model_type", "dict_type", "model_attributes_type"):
        models = _models_at(model, error["loc"])
        keys = [k for m in models for k, field in m.model_fields.items() if field.is_required()]
        # a file is always a table; only a message as a whole, in JSON, can be something else
        text = "must be a table" if path else "must be an object"
        text += f" with {', '.join(dict.fromkeys(keys))}" if keys else ""
    text += f", not {shown}"
    if error["type"] == "literal_error":
        text += meant(error["input"], _quoted(context["expected"]))
    return f"{path}: {text}" if path else text


def _quoted(text: str) -> list[str]:
    return re.findall(r"'([^']*)'", text)


def _fields(model: Any, path: Sequence[str | int]) -> set[str]:
    """The keys of the table that a path of an error leads to."""
    return {field for m in _models_at(model, path) for field in m.model_fields}


def _models_at(model: Any, path: Sequence[str | int]) -> list[type[BaseModel]]:
    """The models of the table that a path of an error leads to."""
    models = _models(model)
    for part in path:
        inside = [m.model_fields[part].annotation for m in models if part in m.model_fields]
        if inside:
            models = [m for annotation in inside for m in _models(annotation)]
        else:  # an index, a name in a table, or the type that chooses one of several models
            models = [m for m in models if part in _tags(m)] or models
    return models


def _chooses(model: Any, path: Sequence[str | int]) -> bool:
    """Whether a path ends on the type that chooses one of several models, which is no key."""
    *parents, last = path
    return bool(parents) and any(last in _tags(m) for m in _models_at(model, parents))


def _models(hint: Any) -> list[type[BaseModel]]:
    """The models that a type is made of."""
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return [hint]
    return [model for argument in get_args(hint) for model in _models(argument)]


def _tags(model: type[BaseModel]) -> tuple[Any, ...]:
    return get_args(model.model_fields["type"].annotation) if "type" in model.model_fields else ()


def _cut(value: Any) -> str:
    """A value as Python writes it, at most 60 characters."""
    shown = repr(value)
    return shown if len(shown) < 60 else shown[:57] + "..."
