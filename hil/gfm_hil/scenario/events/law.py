"""Change to another law."""

from typing import ClassVar, Literal

from pydantic import Field

import gfm_runtime
from gfm_hil.scenario.events.base import WHOSE, ControllerEvent, EventTarget
from gfm_runtime.errors import meant


class LawChange(ControllerEvent):
    """Change to another law, without a bump."""

    changes_law: ClassVar[bool] = True
    type: Literal["law"] = Field(description="kind of event")
    law: str = Field(description="catalogue name or law file")
    converter: str | None = WHOSE

    def label(self) -> str:
        # lazy: an operator's command loads no law, and so no compiler
        return f"law {gfm_runtime.law_titles([self.law])[self.law]}"

    def label_in(self, target: EventTarget) -> str:
        return f"law {target.controller.titles[self.law]}"

    def check_now(self, target: EventTarget) -> None:
        if self.law not in target.controller.sets:
            ready = sorted(target.controller.sets)
            known = f"ready are {ready}{meant(self.law, ready)}"
            raise ValueError(f"law = {self.law!r}: not made ready for this run; {known}")
        super().check_now(target)

    def carry_out(self, target: EventTarget) -> None:
        target.controller.select(self.law)
