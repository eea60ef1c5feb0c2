"""Inner stages in TOML: the ``[inner]`` table of a law file, or a file of its own.

The shipped ones are in ``gfm_runtime/inner_stages``. A number may be an expression over the
parameters of the law that has the table.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

from pydantic import TypeAdapter, ValidationError

from gfm_runtime.errors import LawError, meant
from gfm_runtime.inner import Inner, InnerStage
from gfm_runtime.mistakes import lines
from gfm_runtime.toml_file import parse_toml, read_text

NO_INNER = "none"


_ADAPTER: TypeAdapter[InnerStage] = TypeAdapter(Inner)


def acting(inner: InnerStage) -> dict[str, Any]:
    """The parameters of a stage by name, and those of its power limiter if it has one."""
    names = [name for name in type(inner).model_fields if name not in ("type", "power")]
    out = {name: getattr(inner, name) for name in names}
    if (power := inner.power) is not None:
        out |= {"P_max": power.P_max, "P_min": power.P_min, "k_P": power.k_p, "k_Pi": power.k_i}
    return out


@cache
def inner_names() -> tuple[str, ...]:
    """The names of the shipped inner stages, and ``none``."""
    folder = files("gfm_runtime").joinpath("inner_stages")
    found = [p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")]
    return (NO_INNER, *sorted(found))


def named_inner(name: str) -> InnerStage | None:
    """The inner stage of a shipped name, or of a path that ends in ``.toml``; None for ``none``.

    Raises:
        LawError: an unknown name, or every mistake of the file.
    """
    if name == NO_INNER:
        return None
    where = f"inner stage {name}"
    try:
        if name.endswith(".toml"):
            text = read_text(name)
        elif name in inner_names():
            folder = files("gfm_runtime").joinpath("inner_stages")
            text = folder.joinpath(f"{name}.toml").read_text(encoding="utf-8")
        else:
            known = list(inner_names())
            raise ValueError(f"unknown; use a .toml file or one of {known}{meant(name, known)}")
        content = parse_toml(text)
        return _ADAPTER.validate_python(content)
    except ValidationError as problem:
        raise LawError(where, *lines(problem, Inner, content=content)) from None
    except ValueError as problem:
        raise LawError(where, str(problem)) from None
