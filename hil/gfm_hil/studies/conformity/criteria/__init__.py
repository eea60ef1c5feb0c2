"""The kinds of criteria of a conformity test, a file each: what the test file says, and how a run
is judged by it.

A new kind is a file with ``CRITERION`` and its name in ``KINDS``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Union

from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Clause

#: what ``kind`` says in a test file, and the file in this folder
KINDS = (
    "stays_within",
    "settles",
    "peak_delta",
    "rise_within",
    "damped",
    "adequately_damped",
    "equivalent_damping",
    "energy",
    "negative_sequence",
    "no_trip",
    "no_oscillation",
    "stays_in_step",
    "in_envelope",
    "nfp",
    "stiffness",
)

BY_KIND: dict[str, type[Clause]] = {
    kind: import_module(f"{__name__}.{kind}").CRITERION for kind in KINDS
}

if TYPE_CHECKING:
    Criterion = Clause
else:
    Criterion = Annotated[Union[tuple(BY_KIND.values())], Field(discriminator="kind")]  # noqa: UP007
