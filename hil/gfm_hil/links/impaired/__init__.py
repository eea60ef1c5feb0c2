"""Faults to inject into a link's messages: the table ``link.impairment`` of a scenario."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from gfm_hil.core.roles import Role
from gfm_hil.links.base import LinkOptions


class Impairment(LinkOptions):
    """Deliberate faults of a link, drawn from a seed for every frame that arrives.

    Probabilities are per frame; times are in s.
    """

    towards: Literal["both", "controller", "plant"] = Field(
        "both", description="the side whose incoming frames are hit"
    )
    seed: int = Field(1, ge=1, lt=2**32, description="each side draws its own sequence from it")
    loss: float = Field(0.0, ge=0, le=1, description="a frame is lost")
    burst: float = Field(1.0, ge=1, le=1e6, description="frames lost in a row, on average")
    corrupt: float = Field(0.0, ge=0, le=1, description="bits of a frame are flipped")
    bits: int = Field(1, ge=1, le=64, description="how many of them")
    duplicate: float = Field(0.0, ge=0, le=1, description="a frame arrives twice")
    reorder: float = Field(0.0, ge=0, le=1, description="a frame arrives after the next one")
    delay: float = Field(0.0, ge=0, le=10, description="every frame is late by that, s")
    jitter: float = Field(0.0, ge=0, le=2, description="and by up to that more, drawn evenly, s")
    pause_at: int | None = Field(
        None, ge=0, le=10**12, description="frame from which the link is silent"
    )
    pause: float = Field(0.1, gt=0, le=60, description="for so long, s")
    kill_at: int | None = Field(
        None, ge=0, le=10**12, description="frame at which the process is killed"
    )

    trace: str | None = Field(
        None,
        min_length=1,
        description="run folder or file of a trace: its delays and misses tick by tick, in lockstep"
        "; with no other fault",
    )

    @model_validator(mode="after")
    def _something(self) -> Impairment:
        faults = self.loss, self.corrupt, self.duplicate, self.reorder, self.delay, self.jitter
        others = any(faults) or self.pause_at is not None or self.kill_at is not None
        if self.trace is not None:
            if others:
                raise ValueError("trace: stands alone, without another fault")
            return self
        if not others:
            raise ValueError("nothing: give loss, corrupt, duplicate, reorder, delay, jitter, ...")
        if sum(faults[:4]) > 1:
            raise ValueError(
                f"loss + corrupt + duplicate + reorder = {sum(faults[:4]):g}: must be at most 1"
            )
        return self

    def hits(self, role: Role) -> bool:
        """Whether the faults apply to this side's incoming frames."""
        return self.trace is None and self.towards in ("both", role)
