"""A fault, and its end."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import PlantEvent
from gfm_plant.names import FAULTED_PHASES, FIRST_LINE


class Fault(PlantEvent):
    """A fault on a line, or at a node of a network, through ``R`` [p.u.]: three phases or one (LG)
    or two (LLG) to ground, or two to each other (LL)."""

    opens_phases = True

    type: Literal["fault"] = Field(description="kind of event")
    position: float | None = Field(
        None,
        ge=0,
        lt=1,
        description="place on the line: 0 at its start, which for a converter's line is the filter "
        "capacitor, with plant.lcl the point of connection; else 0.001 to 0.999, 1 being its end",
    )
    line: str | None = Field(
        None, description="in a network: name of the line, or of the converter whose line it is"
    )
    node: str | None = Field(None, description="in a network: the node, in place of a position")
    kind: Literal["3ph", "LG", "LL", "LLG"] = Field("3ph", description="which phases it connects")
    phases: str | None = Field(
        None, description="a, b or c (LG); bc, ca or ab (LL, LLG); the first of these if none"
    )
    R: float = Field(
        ge=0,
        le=1e6,
        description="resistance from each phase to ground, of an LL fault between the two, p.u.; "
        "at least 1e-4 at a capacitor",
    )
    X_0: float | None = Field(
        None,
        ge=0,
        le=1e6,
        description="of LG and LLG: reactance to ground for the zero sequence, p.u.; that of the "
        "lines to earthed star points if neither X_0 nor R_0 is given",
    )
    R_0: float | None = Field(
        None, ge=0, le=1e6, description="of LG and LLG: resistance for the zero sequence, p.u."
    )
    duration: float | None = Field(
        None, gt=0, description="s until it is cleared; none: fault-clear clears it"
    )
    clearing: Literal["zero", "instant"] = Field(
        "zero",
        description="zero: when it is cleared, each phase opens where its current next passes "
        "zero, as a breaker's poles do; instant: all phases open at once",
    )

    @model_validator(mode="after")
    def _has_one_place(self) -> Fault:
        if (self.position is None) == (self.node is None):
            raise ValueError(
                "position, node: give one of them" + (", not both" if self.node else "")
            )
        if self.line is not None and self.position is None:
            raise ValueError(f"line = {self.line!r}: goes with a position")
        return self

    @property
    def Z_0(self) -> complex | None:
        """Impedance for the zero sequence, p.u.; None: that of the lines to star points."""
        if self.X_0 is None and self.R_0 is None:
            return None
        return complex(self.R_0 or 0.0, self.X_0 or 0.0)

    @property
    def what(self) -> str:
        """The kind and the phases, in words."""
        if self.kind == "3ph":
            return "fault"
        return f"{self.kind} fault of {self.phases or FAULTED_PHASES[self.kind][0]}"

    def label(self) -> str:
        line = "the line" if self.line is None else f"line {self.line}"
        where = f"{self.position:g} of {line}" if self.position else f"the start of {line}"
        if self.node is not None:
            where = f"node {self.node}"
        return f"{self.what} at {where}" + (f" for {self.duration:g} s" if self.duration else "")

    def acts_on(self) -> str | None:
        return self.node or self.line or FIRST_LINE

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.fault(
            plant, self.position, self.R, self.duration, line=self.line, node=self.node,
            kind=self.kind, phases=self.phases, Z_0=self.Z_0, clearing=self.clearing,
        )  # fmt: skip


class FaultClear(PlantEvent):
    """The fault is cleared."""

    type: Literal["fault-clear"] = Field(description="kind of event")

    def label(self) -> str:
        return "fault cleared"

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.clear_fault(plant)
