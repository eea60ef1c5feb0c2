"""The converter under test: its plant, and what its owner declares."""

from __future__ import annotations

from pydantic import Field

from gfm_hil.core.schema import StrictSchema
from gfm_hil.studies.envelopes import Unit
from gfm_plant import Plant


class UnderTest(StrictSchema):
    """The converter under test: its plant, and what its owner declares."""

    plant: Plant = Field(description="converter and instruments, without a grid")
    droop: float = Field(
        gt=0,
        allow_inf_nan=True,
        description="declared: frequency over power in the steady state, p.u./p.u.; inf: none",
    )
    P_max: float = Field(description="declared: most power in the steady state, p.u.")
    P_min: float = Field(description="declared: least power in the steady state, p.u.")
    unit: Unit | None = Field(
        None, description="declared, for in_envelope; measured by a small phase jump if none"
    )
