"""The base of what a user writes in a file: unknown keys and wrong types are mistakes."""

from pydantic import BaseModel, ConfigDict


class StrictSchema(BaseModel):
    """A table whose keys are all known, each of its own type; numbers are finite."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
