"""A note that an operator leaves in the log of a run."""

from typing import ClassVar, Literal

from pydantic import Field

from gfm_hil.core.roles import Role
from gfm_hil.scenario.events.base import Event, EventTarget

NOTE = "note"


class Note(Event):
    """Words for the log of the run, with their time and author; nothing else changes, and what is
    judged of the event before goes on."""

    side: ClassVar[Role] = "plant"
    type: Literal["note"] = Field(description="kind of event")
    text: str = Field(
        min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$", description="one line"
    )

    def label(self) -> str:
        return self.text

    def carry_out(self, target: EventTarget) -> None:
        """The log has it already."""
