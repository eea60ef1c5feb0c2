"""New references."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from gfm_hil.scenario.events.base import WHOSE, ControllerEvent, EventTarget
from gfm_runtime.signals import SIGNALS

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario

_REFERENCE = {s.name: s for s in SIGNALS if s.group == "ref"}


def reference_field(name: str, default: float | None) -> Any:
    """A field for a reference, described as in the signal table."""
    s = _REFERENCE[name]
    return Field(default, description=f"{s.description}, {s.low:g} to {s.high:g} {s.unit}")


def check_reference(name: str, value: float) -> None:
    """Raise ValueError if a reference lies outside its range in the signal table."""
    s = _REFERENCE[name]
    if not s.low <= value <= s.high:
        raise ValueError(f"{name} = {value}: must lie in [{s.low:g}, {s.high:g}] {s.unit}")


class Reference(ControllerEvent):
    """New references; ``ramp_s`` spreads the change over a time instead of one tick."""

    type: Literal["reference"] = Field(description="kind of event")
    V_dcref: float | None = reference_field("V_dcref", None)
    P_ref: float | None = reference_field("P_ref", None)
    omega_g: float | None = reference_field("omega_g", None)
    Q_ref: float | None = reference_field("Q_ref", None)
    V_ref: float | None = reference_field("V_ref", None)
    converter: str | None = WHOSE
    ramp_s: float = Field(0.0, ge=0, description="spreads the change evenly over so many seconds")

    @model_validator(mode="after")
    def _in_range(self) -> Reference:
        if not self.values():
            raise ValueError(f"no reference given: use {sorted(_REFERENCE)}")
        for name, value in self.values().items():
            check_reference(name, value)
        return self

    def values(self) -> dict[str, float]:
        """The references given."""
        return {n: v for n in _REFERENCE if (v := getattr(self, n)) is not None}

    def label(self) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in self.values().items())

    def misfits(self, scenario: Scenario) -> list[str]:
        if scenario.network is None:
            return []
        ours = [self.converter] if self.converter else scenario.converters
        return [
            f"{key}: network.plant_controllers.{name} commands it; use the event plant-reference"
            for name, one in scenario.network.plant_controllers.items()
            for key in one.sent()
            if key in self.values() and {*ours} & {*(one.converters or ours)}
        ]

    def check_now(self, target: EventTarget) -> None:
        super().check_now(target)
        if problems := self.misfits(target.scenario):
            raise ValueError(problems[0])

    def carry_out(self, target: EventTarget) -> None:
        for name, value in self.values().items():
            target.controller.set(name, value, self.ramp_s)
