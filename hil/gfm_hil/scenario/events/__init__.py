"""The events of a scenario, one file each: its fields, its checks and what it does.

A new kind is a file, imported here and named in ``_KINDS``.
"""

from typing import TYPE_CHECKING, Annotated, Union, get_args

from pydantic import Field

from gfm_hil.scenario.events.base import Event
from gfm_hil.scenario.events.breaker import GridBreaker, LineBreaker
from gfm_hil.scenario.events.fault import Fault, FaultClear
from gfm_hil.scenario.events.gains import GainChange
from gfm_hil.scenario.events.grid_frequency import GridFrequency
from gfm_hil.scenario.events.grid_impedance import GridImpedance
from gfm_hil.scenario.events.grid_load import GridLoad
from gfm_hil.scenario.events.grid_profile import GridProfile
from gfm_hil.scenario.events.grid_unbalance import GridUnbalance
from gfm_hil.scenario.events.grid_voltage import GridVoltage
from gfm_hil.scenario.events.irradiance import Irradiance
from gfm_hil.scenario.events.law import LawChange
from gfm_hil.scenario.events.note import Note
from gfm_hil.scenario.events.phase_jump import PhaseJump
from gfm_hil.scenario.events.plant_reference import PlantReference
from gfm_hil.scenario.events.reference import Reference
from gfm_hil.scenario.events.reset import Reset

#: in the order in which the documentation lists them
_KINDS: tuple[type[Event], ...] = (
    Reference, LawChange, GainChange, Reset, GridFrequency, GridVoltage, GridProfile, PhaseJump,
    GridImpedance, GridLoad, GridUnbalance, Fault, FaultClear, GridBreaker, LineBreaker,
    Irradiance, PlantReference, Note,
)  # fmt: skip
EVENTS = {get_args(kind.model_fields["type"].annotation)[0]: kind for kind in _KINDS}
"""The kinds of events by what ``type`` says in a scenario."""

if TYPE_CHECKING:
    AnyEvent = Event
else:
    AnyEvent = Annotated[Union[_KINDS], Field(discriminator="type")]  # noqa: UP007
