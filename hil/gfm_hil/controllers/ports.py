"""Which signal each port of a controller is: by their names, or by a map in a TOML file.

Beside the signals of the table a port may be a phase of what is measured, ``v_a`` to ``i_o_c``, or
of the bridge's voltage, ``e_a`` to ``e_c``, which ``Frame`` turns into u; or ``enable``.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gfm_hil.controllers.phases import MEASURED
from gfm_hil.core.errors import UserError
from gfm_hil.core.schema import StrictSchema, read_model
from gfm_plant import Bases
from gfm_runtime.signals import COUNTS, SIGNALS, carried, command_rows, names

#: the groups that an FMU of ours puts before its names
_GROUP = re.compile(r"^(ref|y|u)\.")
#: an output of our own controllers: 0, or why the bridge must be blocked
REASON = "reason"
ENABLE = "enable"  # 0 while the controller sees the start rise from zero, then 1
#: phases at the ports, measured and commanded
PHASES = [f"{name}_{phase}" for name in MEASURED for phase in "abc"]
BRIDGE = ["e_a", "e_b", "e_c"]
_OF_BRIDGE = {"omega_u", "E_d", "E_q"}  # what of u the bridge's phases give
V_DC_HALF = "v_dc/2"  # the unit of the bridge's phases as modulation: half the measured DC voltage
NO_PHASES, VOLTAGES, MODULATION = range(3)  # how the outputs are the bridge's voltage
_STEADY = {"V_dcref", "omega_g", "v_dc", "omega_u"}  # not zero in a converter that is off
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6}
#: units of signals by their base in the table
_SI = {"S_n": "W var VA", "V_n": "V", "V_dcref": "V", "S_n/V_dcref": "A"}


class ScaledSignal(StrictSchema):
    """A signal and its scale."""

    signal: str  # by its name in the signal table
    scale: float = 1.0  # the port's value at 1 p.u.
    unit: str | None = None  # of the port, in place of the scale


_Asked = str | float | ScaledSignal


class PortMap(StrictSchema):
    """What a map file holds."""

    # by port, a signal of the references or measurements, or a constant
    inputs: dict[str, _Asked] = Field({})
    outputs: dict[str, str | ScaledSignal] = Field({})  # by port, a signal of u
    fixed: dict[str, float] = Field({})  # by signal of u that no port gives, its value, p.u.
    parameters: dict[str, float] = Field({})  # by parameter of the controller, its value
    # by output that is read when the controller starts, what inputs has
    initial: dict[str, _Asked] = Field({})
    blocks: str | None = None  # an output that is not 0 when the bridge must be blocked
    enables: str | None = None  # one that is 0 then
    angle_deg: float | None = None  # of the voltage's phase a at the first step; cos is the peak
    # before tick 0 the controller sees what is measured there, without effect: rising from zero,
    # and then held, s
    ramp_s: float = Field(0.0, ge=0, le=60)
    hold_s: float = Field(0.0, ge=0, le=60)
    # what a published test leaves it to settle in its loop before the test begins, s
    settle_s: float = Field(0.0, ge=0, le=60)
    # time between two steps of the controller, s; by default what it says itself; a published test
    # runs at a T_s that is no longer
    step_s: float | None = Field(None, gt=0)


def read_map(file: Path | None) -> PortMap:
    """The map in a file; an empty one without a file. Raises UserError: the file cannot be read, or
    a key or value is wrong."""
    return PortMap() if file is None else read_model(file, PortMap)


Vector = NDArray[np.float64]
#: of some ports, each with a signal: their places among the controller's, the signals' places, and
#: the ports' values at 1 p.u.
_Wires = tuple[NDArray[np.int64], NDArray[np.int64], Vector]


class PortWiring(NamedTuple):
    """The map of a controller's ports, made for a run."""

    constants: Vector  # shape (inputs,), what a port gets that has no signal
    # into, out: of the inputs, the signals being references, measurements and phases, and of the
    # outputs, the signals being those of u and the phases of the bridge
    into: _Wires
    out: _Wires
    # what the outputs have when the controller starts, and where they do not begin at u
    begin: Vector
    begins: _Wires
    fixed: Vector  # shape (3,) or (4,): values of u that no port gives
    blocks: int  # place of the output that blocks the bridge, or -1
    enables: int  # place of the output that does where it is 0, or -1
    phases: bool  # whether a port is a phase of what is measured
    bridge: int  # how the outputs are the bridge's voltage: by no phases, by phases, or MODULATION
    angle: float | None  # of the voltage's phase a at the first step, rad
    ramp_s: float  # ramp_s, hold_s: how long it sees the start before tick 0
    hold_s: float
    rises: Vector  # of references, measurements and phases, 1 for those that rise in ramp_s, else 0

    @property
    def waits(self) -> bool:
        """Whether it is the first measurement that says where the controller starts."""
        return self.phases or len(self.begins[0]) > 0

    def inputs(self, known: Vector) -> Vector:
        """The values of all inputs, from references, measurements and phases in p.u."""
        values, (ports, signals, scales) = self.constants.copy(), self.into
        values[ports] = known[signals] * scales
        return values

    def outputs(self, u: Vector, known: Vector) -> Vector:
        """The values of all outputs at which u, with the bridge's phases at its end, comes out."""
        values, (ports, signals, scales) = self.begin.copy(), self.out
        values[ports] = u[signals] * scales
        ports, signals, scales = self.begins
        values[ports] = known[signals] * scales
        return values

    def take(self, outputs: Vector, u: Vector) -> None:
        """Set u, with the bridge's phases at its end, p.u., from the values of all outputs."""
        ports, signals, scales = self.out
        u[: len(self.fixed)] = self.fixed
        u[signals] = outputs[ports] / scales


def wire(
    where: str,
    ports: PortMap,
    inputs: Sequence[str],
    outputs: Sequence[str],
    signal_set: int,
    bases: Bases,
) -> PortWiring:
    """Map a controller's ports, which are in its order, to the signals of a run. Raises UserError:
    a port or a signal that is not there, a port without a signal, or a signal of u that comes from
    nowhere or twice."""
    known = [*names("ref"), *carried("y", signal_set), ENABLE]
    u = [s.name for s in command_rows(signal_set)]
    phases = signal_set not in (0, COUNTS)
    known += PHASES if phases else ()
    u += names("compare") if signal_set == COUNTS else ()
    commands = [*u, *(BRIDGE if phases else ())]
    for table, there in (("inputs", inputs), ("outputs", outputs), ("initial", outputs)):
        for port in getattr(ports, table):
            if port not in there:
                raise UserError(
                    f"{where}: {table}.{port} in its map: it has {', '.join(there) or 'none'}"
                )

    def place(
        what: str, of: Mapping[str, _Asked], all_: Sequence[str], signals: Sequence[str]
    ) -> tuple[Vector, list[tuple[int, int, float]]]:
        constants, rows = np.zeros(len(all_)), list[tuple[int, int, float]]()
        for k, port in enumerate(all_):
            if isinstance(asked := of.get(port), (int, float)):
                constants[k] = asked
            elif asked is not None:
                rows.append((k, *_place(f"{where}: {what} {port}", asked, signals, bases)))
        return constants, rows

    plain = {port: _GROUP.sub("", port) for port in (*inputs, *outputs)}
    constants, into = place(
        "input", {**{p: plain[p] for p in inputs}, **ports.inputs}, inputs, known
    )
    own = {p: plain[p] for p in outputs if plain[p] in commands}
    _, out = place("output", {**own, **ports.outputs}, outputs, commands)
    begin, begins = place("initial", ports.initial, outputs, known)
    fixed = np.zeros(len(u))
    for name, value in ports.fixed.items():
        fixed[_place(f"{where}: fixed", name, u, bases)[0]] = value
    sources = [*(commands[place] for _, place, _ in out), *ports.fixed]
    bridge = any(name in sources for name in BRIDGE)
    for name in (*BRIDGE, *(s for s in u if s not in _OF_BRIDGE)) if bridge else u:
        if sources.count(name) != 1:
            how = "comes from no output" if name not in sources else "comes twice"
            raise UserError(f"{where}: {name} {how}; name its port in the map file, or fix it")
    measured = any(known[place] in PHASES for _, place, _ in (*into, *begins))
    if measured and not bridge:
        raise UserError(f"{where}: measures phases, so its outputs must be e_a, e_b and e_c")
    if bridge and (twice := sorted(_OF_BRIDGE.intersection(sources))):
        raise UserError(f"{where}: {twice[0]} comes twice: e_a, e_b, e_c give it")
    halves = {
        _of(of).unit == V_DC_HALF for of in ports.outputs.values() if _of(of).signal in BRIDGE
    }
    if len(halves) > 1:
        raise UserError(f"{where}: e_a, e_b, e_c must all have the unit {V_DC_HALF}, or none")
    blocks = ports.blocks or (REASON if REASON in outputs else None)
    for key, port in (("blocks", blocks), ("enables", ports.enables)):
        if port is not None and port not in outputs:
            raise UserError(
                f"{where}: {key} = {port!r} in its map: must be one of {', '.join(outputs)}"
            )
    return PortWiring(
        constants, _columns(into), _columns(out), begin, _columns(begins), fixed,
        -1 if blocks is None else list(outputs).index(blocks),
        -1 if ports.enables is None else list(outputs).index(ports.enables),
        measured,
        NO_PHASES if not bridge else VOLTAGES if halves == {False} else MODULATION,
        None if ports.angle_deg is None else math.radians(ports.angle_deg),
        ports.ramp_s, ports.hold_s, np.array([float(name not in _STEADY) for name in known]),
    )  # fmt: skip


def _columns(rows: list[tuple[int, int, float]]) -> _Wires:
    first, second, scales = zip(*rows, strict=True) if rows else ((), (), ())
    return np.array(first, np.int64), np.array(second, np.int64), np.array(scales, np.float64)


def _of(asked: str | ScaledSignal) -> ScaledSignal:
    return ScaledSignal(signal=asked) if isinstance(asked, str) else asked


def _place(
    where: str, asked: str | ScaledSignal, known: Sequence[str], bases: Bases
) -> tuple[int, float]:
    """Where a signal is among the known ones, and its port's value at 1 p.u."""
    wanted = _of(asked)
    name = wanted.signal
    if name not in known:
        if name in (*carried("y", True), *(s.name for s in command_rows(True)), *PHASES, *BRIDGE):
            raise UserError(
                f"{where}: only a run with an inner stage and without counts carries {name!r}: "
                "choose one by --inner"
            )
        raise UserError(
            f"{where}: signal {name!r} must be one of {', '.join(known)}; name it in the map file"
        )
    if wanted.scale == 0:
        raise UserError(f"{where}: scale = {wanted.scale:g} must not be 0")
    scale = wanted.scale
    if wanted.unit is not None:
        units = _units(name, bases)
        if wanted.unit not in units or "scale" in wanted.model_fields_set:
            allowed = f"must be one of {', '.join(units)}, and no scale beside it"
            raise UserError(f"{where}: unit = {wanted.unit!r} of {name}: {allowed}")
        scale = units[wanted.unit]
    return list(known).index(name), scale


def _units(name: str, bases: Bases) -> dict[str, float]:
    """The units that a signal's port may have, each with its value at 1 p.u."""
    if name in (*PHASES, *BRIDGE):
        base, units = ("peak V", "V") if name[0] in "ve" else ("peak A", "A")
    else:
        base = next((s.base for s in (*SIGNALS, *command_rows(True)) if s.name == name), "")
        units = _SI.get(base, "")
    one = {
        "peak V": bases.V_peak, "peak A": bases.I_peak, "S_n": bases.S_n, "V_n": bases.V_n,
        "V_dcref": bases.V_dcref, "S_n/V_dcref": bases.S_n / bases.V_dcref,
        "omega_n": bases.omega_n,
    }.get(base, 1.0)  # fmt: skip
    found = {"p.u.": 1.0}
    for unit in units.split():
        found |= {prefix + unit: one / factor for prefix, factor in _PREFIXES.items()}
    if base == "omega_n":
        found |= {"rad/s": one, "Hz": one / (2 * math.pi)}
    if name in BRIDGE:
        found[V_DC_HALF] = 2 * bases.V_peak / bases.V_dcref
    return found
