"""The options of one plant, as scenario files embed them; the defaults are the paper's simulation.

Everything is ideal by default: no sensor filter, noise, quantisation or delay, and all
elements at their nominal values. Channels carry the names of y and u. omega_u is the
controller's own number and passes the sensors and the A/D untouched.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.saturation import Core
from gfm_plant.names import SENSED
from gfm_plant.parameters import (
    Element,
    NonNegative,
    Options,
    Positive,
    check_factors,
    load_converter,
)
from gfm_plant.pv_array import MOST_IRRADIANCE
from gfm_plant.records import MAX_DELAY, N_OVERLOADS
from gfm_runtime.signals import (
    COUNTS,
    FULL_SCALES,
    MOST_SAMPLES,
    Y_NAMES,
    Channel,
    carried,
    names,
    quantity,
)

LINE = ("L_g", "R_g")
"""Elements of a converter's line, which ``grid.scr`` sets."""

Measured = Literal["v_dc", "p", "q", "V", "i_d", "i_q", "v_d", "v_q", "i_od", "i_oq"]
Command = Literal["i_u", "omega_u", "E_u", "E_q"]
MEASURED = cast("tuple[Measured, ...]", (*(Y_NAMES[k] for k in SENSED), *names("y_inner")))
COMMANDS = cast("tuple[Command, ...]", carried("u", COUNTS))
"""The channels, in the order of the records."""


class Battery(Options):
    """What feeds the DC source: its power and its charge limit the source's current, as the control
    of a DC/DC converter does that samples v_dc and the state of charge at each tick."""

    energy_s: Positive = Field(
        description="energy from empty to full over S_n, s: 3600 is an hour at rated power"
    )
    soc: float = Field(0.5, ge=0, le=1, description="state of charge at the start")
    soc_min: float = Field(0.05, ge=0, lt=1, description="it gives nothing at this charge or less")
    soc_max: float = Field(0.95, gt=0, le=1, description="it takes nothing at this charge or more")
    P_discharge: Positive = Field(1.0, description="power that it gives at most, p.u.")
    P_charge: Positive = Field(1.0, description="power that it takes at most, p.u.")
    R: NonNegative = Field(
        0.0, description="resistance, p.u. of V_dcref^2/S_n, whose loss its charge covers"
    )

    @model_validator(mode="after")
    def _has_room(self) -> Battery:
        if not self.soc_min < self.soc_max:
            raise ValueError(f"soc_min = {self.soc_min:g}: must be less than {self.soc_max:g}")
        if 4 * self.R * self.P_discharge >= 1:
            most = 1 / (4 * self.R)
            raise ValueError(f"P_discharge = {self.P_discharge:g}: with this R at most {most:.4g}")
        return self


class Chopper(Options):
    """A resistor across C_dc that takes what the source cannot; switched at ticks."""

    P: Positive = Field(1.0, description="what it takes at v_dc = 1, p.u.")
    v_on: Positive = Field(1.15, description="v_dc above which it is turned on, p.u.")
    v_off: Positive = Field(1.1, description="v_dc below which it is turned off, p.u.")

    @model_validator(mode="after")
    def _has_a_band(self) -> Chopper:
        if not self.v_off < self.v_on:
            raise ValueError(f"v_off = {self.v_off:g}: must be less than v_on = {self.v_on:g}")
        return self


class PvArray(Options):
    """A PV array, by four values of its data sheet at an irradiance of 1000 W/m2."""

    V_oc: Positive = Field(description="open-circuit voltage, p.u. of V_dcref")
    I_sc: Positive = Field(description="short-circuit current, p.u. of S_n/V_dcref")
    V_mp: Positive = Field(description="voltage at the point of maximum power, p.u.")
    I_mp: Positive = Field(description="current at the point of maximum power, p.u.")
    irradiance: float = Field(
        1.0, ge=0, le=MOST_IRRADIANCE, description="at the start, of 1000 W/m2"
    )

    @model_validator(mode="after")
    def _has_a_knee(self) -> PvArray:
        for most, value in (("V_oc", "V_mp"), ("I_sc", "I_mp")):
            if not 0.5 < (share := getattr(self, value) / (full := getattr(self, most))) < 0.995:
                raise ValueError(
                    f"{value} = {getattr(self, value):g}: must be more than {0.5 * full:g} and less"
                    f" than {0.995 * full:g}, by {most}; it is {share:.4g} of it"
                )
        return self


class DcSource(Options):
    """The current source that feeds C_dc, Eq. (8)."""

    mode: Literal["controlled", "regulated", "array"] = Field(
        "controlled",
        description="controlled: the law's i_u flows (the paper's simulation); regulated: the "
        "source holds v_dc = 1 with its own PI and i_u is ignored (the paper's rig); array: the PV "
        "array is straight across C_dc in place of a source, and i_u is ignored",
    )
    k_p: NonNegative = Field(90.0, description="PI of the regulated source, p.u./p.u.")
    k_i: NonNegative = Field(400.0, description="PI of the regulated source, p.u./(p.u. s)")
    i_max: Positive | None = Field(None, description="limit of |i_dc|, p.u.; unlimited if none")
    tau_s: Positive | None = Field(
        None,
        description="lag between the current that is asked for, within i_max, and the current that "
        "flows, s; none if not given",
    )
    battery: Battery | None = Field(None, description="what feeds it; no limit if none")
    pv: PvArray | None = Field(
        None,
        description="PV array: across C_dc with mode = 'array'; else behind the source, a DC/DC "
        "converter with an ideal tracker, whose power it limits to the most it gives; none if not "
        "given",
    )
    chopper: Chopper | None = Field(None, description="a brake of the DC link; none if not given")

    @model_validator(mode="after")
    def _has_one_origin(self) -> DcSource:
        if self.mode == "array":
            if self.pv is None:
                raise ValueError("mode = 'array': needs a table pv")
            for name in ("i_max", "tau_s", "battery"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name}: not with mode = 'array', which has no source")
        if self.pv is not None and self.battery is not None:
            raise ValueError("pv, battery: give one of them; the power of one source is limited")
        return self


class Grid(Options):
    """The grid simulator at the start, and the local load that its breaker can leave behind.

    ``scr`` is the short-circuit ratio of IEEE Std 1204-1997 at the point of connection, which is
    the filter capacitor: SCR = S_sc / S_n with S_sc = V_n^2 / abs(Z_g), so that
    abs(Z_g) = 1 / SCR in p.u. of the converter.
    """

    omega_g: Positive = Field(1.0, description="grid frequency, p.u.")
    V_g: NonNegative = Field(1.0, description="grid voltage, p.u.")
    scr: Positive | None = Field(
        None,
        description="short-circuit ratio S_sc/S_n at the point of connection; with x_over_r it "
        "sets the line in place of the converter file and of factors.L_g and R_g",
    )
    x_over_r: Positive | None = Field(
        None, description="X/R of the line at nominal frequency; goes with scr"
    )
    finite: FiniteGrid | None = Field(
        None, description="a grid whose frequency follows its balance of power; ideal if none"
    )
    load_R: NonNegative | None = Field(None, description="local series RL load, ohm")
    load_L: Positive | None = Field(None, description="local series RL load, H")

    @model_validator(mode="after")
    def _load_is_whole(self) -> Grid:
        if (self.load_R is None) != (self.load_L is None):
            raise ValueError(
                f"load_R = {self.load_R}, load_L = {self.load_L}: give both or neither"
            )
        return self

    @model_validator(mode="after")
    def _strength_is_whole(self) -> Grid:
        if (self.scr is None) != (self.x_over_r is None):
            raise ValueError(f"scr = {self.scr}, x_over_r = {self.x_over_r}: give both or neither")
        return self

    def line(self) -> dict[Element, float] | None:
        """L_g and R_g in p.u. by ``scr`` and ``x_over_r``; None if they are not given."""
        if self.scr is None or self.x_over_r is None:
            return None
        R = 1.0 / (self.scr * math.hypot(1.0, self.x_over_r))
        return {"L_g": self.x_over_r * R, "R_g": R}


class Sensors(Options):
    """The sensors between the true quantities and the A/D, with errors for each channel."""

    bandwidth_hz: Positive | None = Field(
        None,
        description="first-order low-pass of v_dc, p, q and V; ideal if none. The currents and "
        "voltages of an inner stage are sampled as they are",
    )
    gain: dict[Measured, float] = Field({}, description="measured over true value, default 1")
    offset: dict[Measured, float] = Field({}, description="added to the measured value, p.u.")
    noise_std: dict[Measured, NonNegative] = Field(
        {}, description="standard deviation of white Gaussian noise, p.u."
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of the noise")


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"range {list(limits)}: must be [lo, hi] with lo < hi")
    return limits


# TOML knows arrays, not tuples: strict=False admits a list, its entries stay strict.
Range = Annotated[tuple[float, float], Field(strict=False), AfterValidator(_ordered)]


class _Converter(Options):
    """A bank of A/D or D/A channels; a channel without a range is ideal."""

    bits: int | None = Field(None, ge=2, le=24, description="resolution; only clamps if none")
    range: Mapping[Any, Range] = {}

    @model_validator(mode="after")
    def _bits_need_a_range(self) -> _Converter:
        if self.bits is not None and not self.range:
            raise ValueError(f"bits = {self.bits}: range must give at least one channel")
        return self


class AnalogToDigital(_Converter):
    """The A/D converters that sample y at the tick."""

    range: dict[Measured, Range] = Field({}, description="full scale [lo, hi], p.u.")


class DigitalToAnalog(_Converter):
    """The D/A converters that hold u from tick to tick."""

    range: dict[Command, Range] = Field({}, description="full scale [lo, hi], p.u.")


DS2004 = AnalogToDigital(
    bits=16,
    range={
        **{"v_dc": (0.0, 2.0), "p": (-2.0, 2.0), "q": (-2.0, 2.0), "V": (0.0, 2.0)},
        **dict.fromkeys(MEASURED[len(SENSED) :], (-4.0, 4.0)),
    },
)
"""The rig's A/D board: 16 bit, the transducers scaled to twice the nominal value; those of an inner
stage, which the paper does not have, to four times, beyond the over-current trip."""

DS2101 = DigitalToAnalog(bits=12, range={"i_u": (-2.0, 2.0), "E_u": (0.0, 2.0), "E_q": (-2.0, 2.0)})
"""The rig's D/A board: 12 bit. omega_u is integrated to the angle before it, so never rounded."""


def _preset(boards: dict[str, Any], written: Any) -> BeforeValidator:
    """Let a field take the name of a board in place of a table; ``written`` is the type of what a
    file may have."""

    def look_up(value: Any) -> Any:
        if isinstance(value, str):
            if value not in boards:
                raise ValueError(f"{value!r}: must be {' or '.join(boards)}, or a table")
            return boards[value]
        return value

    return BeforeValidator(look_up, json_schema_input_type=written)


class Phases(Options):
    """The sensors of a converter's phases and the A/D behind them, for laws that measure; p.u.
    of a phase's nominal peak value, sqrt(2/3) V_n and sqrt(2/3) S_n/V_n."""

    bits: int = Field(12, ge=8, le=16, description="of the A/D")
    samples: int = Field(
        1,
        ge=1,
        le=MOST_SAMPLES,
        description="conversions of each channel in a period, evenly apart, the last at the tick; "
        "a count is their sum",
    )
    v_dc: Range = Field(
        FULL_SCALES["v_dc"], description="full scale [lo, hi] of the DC voltage, p.u."
    )
    i: Range = Field(FULL_SCALES["i"], description="full scale of the currents of L_f, p.u.")
    v: Range = Field(FULL_SCALES["v"], description="full scale of the voltages of C_f, p.u.")
    i_o: Range = Field(
        FULL_SCALES["i_o"], description="full scale of the currents of the line, p.u."
    )
    gain: dict[Channel, float] = Field({}, description="measured over true value, default 1")
    offset: dict[Channel, float] = Field({}, description="added to the measured value, p.u.")
    noise_std: dict[Channel, NonNegative] = Field(
        {}, description="standard deviation of white Gaussian noise, p.u."
    )
    skew_s: dict[Channel, NonNegative] = Field(
        {}, description="by how much a channel samples before the tick, s"
    )
    bandwidth_hz: Positive | None = Field(
        None, description="first-order low-pass of each channel; none if not given"
    )

    def ends(self, channel: Channel) -> tuple[float, float]:
        """Full scale of a channel, p.u."""
        low, high = getattr(self, quantity(channel))
        return low, high


class Delay(Options):
    """Time from the tick that samples y[k] to the moment when u[k] acts, in sampling periods."""

    samples: int = Field(
        0, ge=0, le=MAX_DELAY, description="whole samples from y[k] to the effect of u[k]"
    )
    fraction: float = Field(0.0, ge=0, lt=1, description="fraction of one more sample")


def _part_is_enough(schema: dict[str, Any]) -> None:
    schema.pop("required")  # ``Protection`` completes it


class BridgeOptions(Options):
    """The bridge: its average over a period, or the switches themselves."""

    kind: Literal["average", "two-level", "t-type"] = Field(
        "average",
        description="average: a voltage that follows the command; two-level: six switches with "
        "diodes, modulated by space vectors; t-type: each leg has a switch for both directions to "
        "the midpoint of C_dc besides",
    )
    carrier_hz: Positive | None = Field(
        None, description="of the symmetrical carrier, 1/T_s or 2/T_s; 1/T_s if none"
    )
    updates: Literal[1, 2] = Field(
        1, description="how often the compare values are loaded in a period of the carrier"
    )
    timer_hz: Positive = Field(200e6, description="clock of the timer that the carrier counts")
    dead_time_s: NonNegative = Field(
        0.0, description="from turning one switch of a leg off to turning the other one on, s"
    )
    min_pulse_s: NonNegative = Field(
        0.0, description="shorter pulses are left out or made as long, whichever is nearer, s"
    )
    V_switch: NonNegative = Field(0.0, description="threshold of a switch that conducts, V")
    R_switch: NonNegative = Field(0.0, description="on-state resistance of a switch, ohm")
    V_diode: NonNegative = Field(0.0, description="threshold of a diode, V")
    R_diode: NonNegative = Field(0.0, description="on-state resistance of a diode, ohm")


class SecondInductor(Options):
    """The second inductor of an LCL filter, or the leakage of the converter's own transformer,
    between filter capacitor and point of connection."""

    L: Positive = Field(description="p.u. of the converter")
    R: NonNegative = Field(0.0, description="p.u. of the converter")
    saturation: Core | None = Field(
        None, description="the core of the transformer that it is; it does not saturate if none"
    )
    earthed: bool = Field(
        False,
        description="it is a transformer with a delta on the converter's side and an earthed star "
        "point at the point of connection: a path to ground for a zero sequence there",
    )


class Trip(Options):
    """One protection: trips when its threshold stays crossed for a time."""

    model_config = ConfigDict(json_schema_extra=_part_is_enough)

    threshold: Positive = Field(description="p.u. of the protected quantity")
    delay_s: NonNegative = Field(description="how long the threshold must stay crossed, s")
    enabled: bool = Field(True, description="false takes the protection out of service")


_TRIPS = {
    "over_current": Trip(threshold=3.0, delay_s=0.0),
    "over_voltage": Trip(threshold=1.4, delay_s=0.01),
    "under_voltage": Trip(threshold=0.4, delay_s=0.3),
    "dc_over_voltage": Trip(threshold=1.4, delay_s=0.001),
    "dc_under_voltage": Trip(threshold=0.5, delay_s=0.001),
    "over_frequency": Trip(threshold=1.1, delay_s=0.1),
    "under_frequency": Trip(threshold=0.9, delay_s=0.1),
}


class Overload(Options):
    """A step of the overload profile."""

    threshold: Positive = Field(description="p.u. of the current's RMS over a cycle")
    delay_s: NonNegative = Field(description="how long the threshold must stay crossed, s")


class Protection(Options):
    """The converter's protection, on the true quantities; a table may give part of a trip."""

    over_current: Trip = Field(_TRIPS["over_current"], description="sqrt(i_d^2 + i_q^2)")
    over_voltage: Trip = Field(_TRIPS["over_voltage"], description="V")
    under_voltage: Trip = Field(_TRIPS["under_voltage"], description="V")
    dc_over_voltage: Trip = Field(_TRIPS["dc_over_voltage"], description="v_dc")
    dc_under_voltage: Trip = Field(_TRIPS["dc_under_voltage"], description="v_dc")
    over_frequency: Trip = Field(_TRIPS["over_frequency"], description="omega_u")
    under_frequency: Trip = Field(_TRIPS["under_frequency"], description="omega_u")
    frequency: Literal["command", "voltage"] = Field(
        "command",
        description="what the last two watch: omega_u, or the speed of the filter capacitor's "
        "voltage, whose angle is compared with that of one cycle before",
    )
    overload: tuple[Overload, ...] = Field(
        (),
        strict=False,
        max_length=N_OVERLOADS,
        description="steps of the overload profile: each trips when the RMS of the bridge's "
        "current over one cycle of the nominal frequency stays above its threshold for its time",
    )

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        return {
            name: {**_TRIPS[name].model_dump(), **trip}
            if name in _TRIPS and isinstance(trip, dict)
            else trip
            for name, trip in data.items()
        }


class Plant(Options):
    """Everything that makes one plant."""

    converter: str = Field("paper", description="name of a shipped converter, or a .toml file")
    factors: dict[Element, float] = Field({}, description="real over nominal value of an element")
    dc_source: DcSource = Field(DcSource(), description="the source that feeds C_dc")
    modulation: Literal["unlimited", "space-vector", "sine"] = Field(
        "unlimited",
        description="limit of the bridge's voltage by v_dc: line-to-line RMS at most "
        "v_dc / sqrt(2) (space-vector) or v_dc sqrt(3/8) (sine-triangle)",
    )
    i_peak: Positive | None = Field(
        None,
        description="peak-current limit of the bridge, p.u.: its hardware blocks pulses so that "
        "the current of L_f stays within; a switched bridge turns all off until the compare values "
        "are loaded next; none if not given",
    )
    bridge: BridgeOptions = Field(
        BridgeOptions(), description="averaged, or switched and still solved exactly"
    )
    lcl: SecondInductor | None = Field(
        None,
        description="second inductor of the filter, or the converter's own transformer; the line, "
        "and grid.scr, then begin behind it, at the point of connection, which in a network is the "
        "node; none: an LC filter",
    )
    grid: Grid = Field(Grid(), description="grid simulator at the start")
    sensors: Sensors = Field(
        Sensors(), description="what stands between the true quantities and the A/D"
    )
    adc: Annotated[
        AnalogToDigital, _preset({"DS2004": DS2004}, AnalogToDigital | Literal["DS2004"])
    ] = Field(AnalogToDigital(), description='"DS2004" (16 bit) or a table; ideal if none')
    dac: Annotated[
        DigitalToAnalog, _preset({"DS2101": DS2101}, DigitalToAnalog | Literal["DS2101"])
    ] = Field(DigitalToAnalog(), description='"DS2101" (12 bit) or a table; ideal if none')
    phases: Phases = Field(
        Phases(), description="sensors and A/D of the phases, which laws with [measure] read"
    )
    delay: Delay = Field(Delay(), description="of the loop")
    protection: Protection = Field(Protection(), description="trips of the converter")

    @model_validator(mode="after")
    def _elements_stay_physical(self) -> Plant:
        check_factors(self.factors)
        given = [f"factors.{name}" for name in LINE if name in self.factors]
        if given and self.grid.scr is not None:
            raise ValueError(
                f"grid.scr = {self.grid.scr:g}: sets the line; leave out {' and '.join(given)}"
            )
        return self

    def with_seed(self, seed: int) -> Plant:
        """The same plant with another seed of the sensors' noise."""
        return self.model_copy(update={"sensors": self.sensors.model_copy(update={"seed": seed})})

    def real_factors(self) -> dict[Element, float]:
        """Real over nominal value of the elements that are not nominal, those of the line by
        ``grid.scr`` included.

        Raises:
            ValueError: as ``load_converter``, or the converter's line has no resistance, so that
                nothing times it gives ``grid.x_over_r``.
        """
        line = self.grid.line()
        if line is None:
            return self.factors
        nominal = load_converter(self.converter).pu()
        if nominal["R_g"] == 0.0:
            raise ValueError(
                f"plant.grid.x_over_r = {self.grid.x_over_r}: needs a converter file with R_g > 0"
            )
        return {**self.factors, **{name: line[name] / nominal[name] for name in line}}
