"""The base of what a file of a user may hold."""

from pydantic import BaseModel, ConfigDict


class Schema(BaseModel):
    """Unknown keys, wrong types and NaN are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
