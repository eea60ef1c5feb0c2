"""What a user writes in a TOML file: unknown keys and wrong types are mistakes, one line each."""

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml

Model = TypeVar("Model", bound=BaseModel)


class StrictSchema(BaseModel):
    """A table whose keys are all known, each of its own type; numbers are finite."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def read_model(path: str | Path, model: type[Model]) -> Model:
    """The content of a TOML file. Raises UserError: it cannot be read, or one line a mistake."""
    try:
        content = read_toml(path)
    except ValueError as problem:
        raise UserError(printable(f"{path}: {problem}")) from None
    return validate(path, model, content)


def validate(path: str | Path, model: type[Model], content: Any, table: str = "") -> Model:
    """The content of a table of a file, by default of all of it. Raises UserError: one line a
    mistake."""
    try:
        return model.model_validate(content)
    except ValidationError as problem:
        wrong = lines(problem, model, content=content)
        raise UserError("\n".join(f"{path}: {table}{line}" for line in wrong)) from None
