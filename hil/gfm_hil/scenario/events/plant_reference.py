"""New references of a plant controller, and its link to the converters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import PlantEvent
from gfm_hil.scenario.events.reference import check_reference, reference_field

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario

_NAMES = ("P_ref", "Q_ref", "V_ref", "omega_ref")


class PlantReference(PlantEvent):
    """New references of a plant controller, or a failure of its link: the converters then keep the
    last set-points that they have, and those under way still arrive."""

    type: Literal["plant-reference"] = Field(description="kind of event")
    name: str = Field(min_length=1, description="of the plant controller")
    P_ref: float | None = reference_field("P_ref", None)
    Q_ref: float | None = reference_field("Q_ref", None)
    V_ref: float | None = reference_field("V_ref", None)
    omega_ref: float | None = reference_field("omega_g", None)
    sends: bool | None = Field(None, description="false: its link fails; true: it works again")

    @model_validator(mode="after")
    def _in_range(self) -> PlantReference:
        if not self.values() and self.sends is None:
            raise ValueError(f"nothing changes: give one of {[*_NAMES, 'sends']}")
        for name, value in self.values().items():
            check_reference(name.replace("omega_ref", "omega_g"), value)
        return self

    def values(self) -> dict[str, float]:
        """The references that change."""
        return {n: v for n in _NAMES if (v := getattr(self, n)) is not None}

    def label(self) -> str:
        link = {True: ["link works"], False: ["link fails"], None: []}[self.sends]
        said = [*(f"{name} = {value:g}" for name, value in self.values().items()), *link]
        return f"{self.name}: {', '.join(said)}"

    def misfits(self, scenario: Scenario) -> list[str]:
        each = {} if scenario.network is None else scenario.network.plant_controllers
        if not each:
            return ["there are no network.plant_controllers"]
        one = each.get(self.name)
        if one is None or (unused := one.unused()) not in self.values():
            return []
        return [f"{unused}: has no effect, {self.name} has control = {one.control!r}"]

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.set_plant_reference(plant, self.name, self.values(), self.sends)
