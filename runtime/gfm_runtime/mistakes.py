"""What pydantic finds wrong with a file, in one line a mistake."""

import re
from collections.abc import Callable, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from gfm_runtime.errors import allowed, closest, meant, printable

_SHOWN = 20


Path = tuple[str | int, ...]


def lines(
    problem: ValidationError,
    model: Any = None,
    source: Callable[[Path], str] | None = None,
    content: Any = None,
) -> list[str]:
    """The mistakes, 20 at most: path, value, what is wrong, and the name that was perhaps meant.

    Args:
        problem: from pydantic.
        model: what was validated, a model or a union of models; its fields are suggested in place
            of a key that is unknown.
        source: names the file or option that the value at a path comes from; it begins the line.
        content: what was validated; paths then are those of the file, without pydantic's names of
            the alternatives that it tried, whose mistakes share a line.
    """
    found: dict[tuple[Path, str], list[Any]] = {}
    for error in problem.errors():
        path = _path(error, model, content)
        alternatives = found.setdefault((path, _cut(error["input"])), [])
        if not alternatives or path != error["loc"]:
            alternatives.append(error)
        else:
            found[path, f"{error['type']} of {_cut(error['input'])}"] = [error]
    meant_keys = {(*path[:-1], _meant_key(errors[0], model)) for (path, _), errors in found.items()}
    told = [
        (path, _line(path, errors, model))
        for (path, _), errors in found.items()
        if not (errors[0]["type"] == "missing" and path in meant_keys)
    ]
    if len(told) > _SHOWN:
        told = [*told[:_SHOWN], ((), f"and {len(told) - _SHOWN} more mistakes")]
    return [printable(f"{source(path)}: {text}" if source else text) for path, text in told]


def _path(error: Any, model: Any, content: Any) -> Path:
    """The path of a mistake in the file."""
    loc, path, value = error["loc"], list[str | int](), content
    for k, part in enumerate(loc):
        if _chooses(model, loc[: k + 1]):
            continue
        there = part in value if isinstance(value, dict) else isinstance(part, int) and (
            isinstance(value, list | tuple) and part < len(value)
        )  # fmt: skip
        if there:
            value = value[part]
        elif content is not None and not (error["type"] == "missing" and k == len(loc) - 1):
            continue
        path.append(part)
    return tuple(path)


def _meant_key(error: Any, model: Any) -> str | None:
    """The key that an unknown one was perhaps meant to be."""
    if error["type"] != "extra_forbidden":
        return None
    *parents, last = error["loc"]
    return closest(last, _fields(model, parents))


def _line(at: Path, errors: Sequence[Any], model: Any) -> str:
    error, path = errors[0], ".".join(map(str, at))
    text = _said(error)
    if error["type"] == "value_error":
        return f"{path}: {text}" if path else text
    if error["type"] == "missing":
        return f"{path}: missing"
    shown = _cut(error["input"])
    context = error.get("ctx", {})
    if error["type"] in ("union_tag_not_found", "union_tag_invalid"):
        tag = context["discriminator"].strip("'")
        key = ".".join(filter(None, (path, tag)))
        if "tag" in context:
            tags = _quoted(context["expected_tags"])
            return f"{key} = {_cut(context['tag'])}: {allowed(context['tag'], tags)}"
        table = error["input"] if isinstance(error["input"], dict) else {}
        close = closest(tag, [word for word in table if word not in _fields(model, error["loc"])])
        if close:
            other = ".".join(filter(None, (path, close)))
            return f"{other} = {_cut(table[close])}: unknown key; did you mean {tag!r}?"
        return f"{key}: missing"
    if error["type"] == "extra_forbidden":
        known = _fields(model, error["loc"][:-1])
        hint = meant(error["loc"][-1], known)
        others = "" if hint or not known else f"; use one of {', '.join(sorted(known))}"
        return f"{path} = {shown}: unknown key{hint}{others}"
    if error["type"] in ("model_type", "dict_type", "model_attributes_type"):
        models = _models_at(model, error["loc"])
        keys = [k for m in models for k, field in m.model_fields.items() if field.is_required()]
        # a file is always a table; only a message as a whole, in JSON, can be something else
        text = "must be a table" if path else "must be an object"
        text += f" with {', '.join(dict.fromkeys(keys))}" if keys else ""
    if error["type"] == "string_pattern_mismatch":  # a pattern is not for people
        *parents, last = error["loc"]
        of = (m.model_fields.get(str(last)) for m in _models_at(model, parents))
        words = [field.description for field in of if field is not None and field.description]
        text = f"must be {words[0]}" if words else text
    needs = [text, *(_said(other).removeprefix("must be ") for other in errors[1:])]
    words = [w for e in errors if "expected" in e.get("ctx", {}) for w in
             _quoted(str(e["ctx"]["expected"]))]  # fmt: skip
    text = f"{' or '.join(needs)}, not {shown}{meant(error['input'], words)}"
    return f"{path}: {text}" if path else text


def _said(error: Any) -> str:
    said = str(error["msg"]).removeprefix("Value error, ").partition(" after validation, not")[0]
    return re.sub("^(Input|String|Dictionary|List|Tuple) should", "must", said)


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
