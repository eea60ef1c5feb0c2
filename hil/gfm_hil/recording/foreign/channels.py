"""The map of a recording: which of its channels is what, in which unit and on which base."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gfm_hil.core.schema import StrictSchema
from gfm_hil.recording.foreign.files import TIME

_PREFIX = {"": 1.0, "k": 1e3, "M": 1e6}
#: what a unit measures, and its size in SI; p.u. is on the base of the map
_UNITS = {
    **{f"{k}{unit}": (what, size) for unit, what in (("W", "power"), ("var", "power"),
       ("V", "voltage"), ("A", "current")) for k, size in _PREFIX.items()},
    "Hz": ("frequency", 1.0), "rad": ("angle", 1.0), "deg": ("angle", math.pi / 180),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6),
}  # fmt: skip
#: what each signal measures
MEASURES = {
    "t": "time", "p": "power", "q": "power", "V": "voltage", "i": "current", "f": "frequency",
    "f_grid": "frequency", "delta": "angle", "v_dc": "DC voltage", "trip": "state",
}  # fmt: skip


class Channel(StrictSchema):
    """A channel, and what its numbers mean."""

    channel: str = Field(min_length=1, description="its name in the file")
    unit: str = Field("p.u.", description="p.u. or one with k or M before it; of angles rad or deg")
    scale: float = Field(
        1.0, description="factor on its values, such as -1 for the other direction"
    )


class PhaseChannels(StrictSchema):
    """Instantaneous values of three phases, to neutral, or a phasor of the positive sequence."""

    phases: tuple[str, str, str] | None = Field(
        None, strict=False, description="channels of a, b, c, in the order in which they follow"
    )
    magnitude: str | None = Field(None, description="channel of the phasor's magnitude, RMS")
    angle: str | None = Field(None, description="channel of its angle")
    angle_unit: Literal["deg", "rad"] = Field("deg", description="of the angle")
    unit: str = Field("p.u.", description="as of a channel; p.u. of phases is of their peak value")
    scale: float = Field(1.0, description="as of a channel")

    @model_validator(mode="after")
    def _one_of_both(self) -> PhaseChannels:
        if (self.phases is None) == (self.magnitude is None) or (
            (self.magnitude is None) != (self.angle is None)
        ):
            raise ValueError("phases, magnitude, angle: give phases, or magnitude and angle")
        return self


class Meter(StrictSchema):
    """What the instrument did before it recorded p, q, V, i and f."""

    window_s: float = Field(0.0, ge=0, description="its mean or its phasor is over so many s")
    lag_s: float = Field(0.0, ge=0, description="its lag of first order, s")


class RecordingMap(StrictSchema):
    """The whole file."""

    S_n: float = Field(gt=0, description="base of power, VA: the converter's rating")
    V_n: float = Field(gt=0, description="base of voltage, V RMS between phases")
    V_dc: float | None = Field(None, gt=0, description="base of the DC voltage, V")
    rate_hz: float | None = Field(None, gt=0, description="samples in a second, without channel t")
    event_s: float | None = Field(
        None, description="when the event is, by the recording's clock; found if not given"
    )
    meter: Meter = Field(Meter(), description="filter of the recorded values; none by default")
    v: PhaseChannels | None = Field(None, description="voltages at the connection point")
    i: PhaseChannels | None = Field(None, description="currents into the grid")
    channels: dict[str, Channel | str] = Field(
        {}, description=f"by signal, {', '.join(MEASURES)}, its channel"
    )

    @model_validator(mode="after")
    def _known(self) -> RecordingMap:
        if wrong := [name for name in self.channels if name not in MEASURES]:
            raise ValueError(f"channels.{wrong[0]}: must be one of {', '.join(MEASURES)}")
        if (self.v is None) != (self.i is None):
            raise ValueError("v, i: give both or none")
        if self.v is not None and self.i is not None and bool(self.v.phases) != bool(self.i.phases):
            raise ValueError("v, i: give phases of both, or magnitude and angle of both")
        lacking = [n for n in ("p", "q", "V") if self.v is None and n not in self.channels]
        if lacking:
            raise ValueError(f"channels.{lacking[0]}: missing; give p, q and V, or v and i")
        for name, channel in self.each().items():
            _size(name, channel.unit, MEASURES[name], self)
        for name, three in (("v", self.v), ("i", self.i)):
            if three is not None:
                _size(name, three.unit, "voltage" if name == "v" else "current", self)
        return self

    def each(self) -> dict[str, Channel]:
        """The channels by signal; of formats with a clock of their own, and of files that have a
        column t, the time too."""
        found = {
            n: Channel(channel=c) if isinstance(c, str) else c for n, c in self.channels.items()
        }
        if "t" not in found and self.rate_hz is None:
            found["t"] = Channel(channel=TIME, unit="s")
        return {n: c.model_copy(update={"unit": "s"}) if n == "t" and c.unit == "p.u." else c
                for n, c in found.items()}  # fmt: skip

    def scalar(self, name: str, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        """A signal in p.u., rad, s, Hz, or as it is, shape (samples,)."""
        channel = self.each()[name]
        size = _size(name, channel.unit, MEASURES[name], self)
        return columns[channel.channel] * (channel.scale * size)

    def vector(self, name: str, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.complex128]:
        """v or i in p.u., shape (samples,): the space vector of its phases, which turns, or its
        phasor."""
        three = self.v if name == "v" else self.i
        assert three is not None
        measures = "voltage" if name == "v" else "current"
        size = three.scale * _size(name, three.unit, measures, self)
        if three.phases is not None:
            if three.unit != "p.u.":  # the base is that between phases, RMS
                size *= math.sqrt(1.5)
            turns = np.exp(2j * math.pi / 3 * np.arange(3))
            a, b, c = (columns[n] for n in three.phases)
            return 2 / 3 * size * (a * turns[0] + b * turns[1] + c * turns[2])
        assert three.magnitude is not None and three.angle is not None
        if three.unit != "p.u.":  # RMS to neutral
            size *= math.sqrt(3.0)
        turn = columns[three.angle] * _UNITS[three.angle_unit][1]
        return size * columns[three.magnitude] * np.exp(1j * turn)

    def names(self) -> list[str]:
        """Every channel that it names."""
        found = [c.channel for c in self.each().values()]
        for three in filter(None, (self.v, self.i)):
            found += three.phases or [n for n in (three.magnitude, three.angle) if n]
        return found


def _size(name: str, unit: str, measures: str, of: RecordingMap) -> float:
    """What 1 of a unit is in p.u., or in s, rad or Hz. Raises ValueError: it is none of these."""
    base = {"power": of.S_n, "voltage": of.V_n, "current": of.S_n / of.V_n, "DC voltage": of.V_dc}
    if unit == "p.u." and measures in (*base, "state"):
        return 1.0
    kind = "voltage" if measures == "DC voltage" else measures
    what, size = _UNITS.get(unit, ("", 0.0))
    if what != kind:
        known = [u for u, (w, _) in _UNITS.items() if w == kind]
        more = ["p.u."] if measures in base else []
        raise ValueError(f"{name}: unit = {unit!r}: must be one of {', '.join([*more, *known])}")
    divisor = base.get(measures, 1.0)
    if divisor is None:
        raise ValueError(f"{name}: unit = {unit!r}: needs the base V_dc")
    return size / divisor
