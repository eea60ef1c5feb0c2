"""Which signal each port of a controller is: by their names, or by a map in a TOML file."""

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.schema import StrictSchema
from gfm_runtime.signals import COUNTS, carried, command_rows, names

#: the groups that an FMU of ours puts before its names
_GROUP = re.compile(r"^(ref|y|u)\.")
#: an output of our own controllers: 0, or why the bridge must be blocked
REASON = "reason"


class Scaled(StrictSchema):
    """A signal and its scale."""

    signal: str  # by its name in the signal table
    scale: float = 1.0  # the port's value at 1 p.u.


class PortMap(StrictSchema):
    """What a map file holds."""

    # by port, a signal of the references or measurements, or a constant
    inputs: dict[str, str | float | Scaled] = Field({})
    outputs: dict[str, str | Scaled] = Field({})  # by port, a signal of u
    fixed: dict[str, float] = Field({})  # by signal of u that no port gives, its value, p.u.
    parameters: dict[str, float] = Field({})  # by parameter of the controller, its value
    blocks: str | None = None  # an output that is not 0 when the bridge must be blocked
    # time between two steps of the controller, s; by default what it says itself
    step_s: float | None = Field(None, gt=0)


def read_map(file: Path | None) -> PortMap:
    """The map in a file; an empty one without a file. Raises UserError: the file cannot be read, or
    a key or value is wrong."""
    if file is None:
        return PortMap()
    try:
        return PortMap.model_validate(tomllib.loads(file.read_text(encoding="utf-8")))
    except OSError as problem:
        raise UserError(f"{file}: {problem.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as problem:
        raise UserError(f"{file}: {problem}") from None
    except ValidationError as problem:
        raise UserError("\n".join(f"{file}: {line}" for line in lines(problem))) from None


Vector = NDArray[np.float64]
#: of some ports, each with a signal: their places among the controller's, the signals' places, and
#: the ports' values at 1 p.u.
_Wires = tuple[NDArray[np.int64], NDArray[np.int64], Vector]


class PortWiring(NamedTuple):
    """The map of a controller's ports, made for a run."""

    constants: Vector  # shape (inputs,), what a port gets that has no signal
    # into, out: of the inputs, the signals being references and measurements, and of the outputs,
    # the signals being those of u
    into: _Wires
    out: _Wires
    fixed: Vector  # shape (3,) or (4,): values of u that no port gives
    blocks: int  # place of the output that blocks the bridge, or -1

    def inputs(self, ref: Vector, y: Vector) -> Vector:
        """The values of all inputs, from references and measurements in p.u."""
        values, (ports, signals, scales) = self.constants.copy(), self.into
        values[ports] = np.concatenate((ref, y))[signals] * scales
        return values

    def outputs(self, u: Vector, count: int) -> Vector:
        """The values of all ``count`` outputs at which u comes out; 0 where there is no signal."""
        values, (ports, signals, scales) = np.zeros(count), self.out
        values[ports] = u[signals] * scales
        return values

    def take(self, outputs: Vector, u: Vector) -> None:
        """Set u, p.u., from the values of all outputs."""
        ports, signals, scales = self.out
        u[:] = self.fixed
        u[signals] = outputs[ports] / scales


def wire(
    where: str, ports: PortMap, inputs: Sequence[str], outputs: Sequence[str], inner: int
) -> PortWiring:
    """Map a controller's ports, which are in its order, to the signals of a run. Raises UserError:
    a port or a signal that is not there, a port without a signal, or a signal of u that comes from
    nowhere or twice."""
    known, u = [*names("ref"), *carried("y", inner)], [s.name for s in command_rows(inner)]
    u += names("compare") if inner == COUNTS else ()
    for table, there in (("inputs", inputs), ("outputs", outputs)):
        for port in getattr(ports, table):
            if port not in there:
                raise UserError(
                    f"{where}: {table}.{port} in its map: it has {', '.join(there) or 'none'}"
                )
    constants = np.zeros(len(inputs))
    into: list[tuple[int, int, float]] = []
    for k, port in enumerate(inputs):
        asked = ports.inputs.get(port, _GROUP.sub("", port))
        if isinstance(asked, (int, float)):
            constants[k] = asked
            continue
        into.append((k, *_place(f"{where}: input {port}", asked, known)))
    out: list[tuple[int, int, float]] = []
    for k, port in enumerate(outputs):
        name = _GROUP.sub("", port)
        found = ports.outputs.get(port, name if name in u else None)
        if found is not None:
            out.append((k, *_place(f"{where}: output {port}", found, u)))
    fixed = np.zeros(len(u))
    for name, value in ports.fixed.items():
        fixed[_place(f"{where}: fixed", name, u)[0]] = value
    given = [*(u[place] for _, place, _ in out), *ports.fixed]
    for name in u:
        if given.count(name) != 1:
            how = "comes from no output" if name not in given else "comes twice"
            raise UserError(f"{where}: {name} {how}; name its port in the map file, or fix it")
    blocks = ports.blocks or (REASON if REASON in outputs else None)
    if blocks is not None and blocks not in outputs:
        raise UserError(
            f"{where}: blocks = {blocks!r} in its map: must be one of {', '.join(outputs)}"
        )
    place = -1 if blocks is None else list(outputs).index(blocks)
    return PortWiring(constants, _columns(into), _columns(out), fixed, place)


def _columns(rows: list[tuple[int, int, float]]) -> _Wires:
    first, second, scales = zip(*rows, strict=True) if rows else ((), (), ())
    return np.array(first, np.int64), np.array(second, np.int64), np.array(scales, np.float64)


def _place(where: str, asked: str | Scaled, known: Sequence[str]) -> tuple[int, float]:
    """Where a signal is among the known ones, and its scale."""
    wanted = Scaled(signal=asked) if isinstance(asked, str) else asked
    if wanted.signal not in known:
        if wanted.signal in (*carried("y", True), *(s.name for s in command_rows(True))):
            raise UserError(
                f"{where}: only a run with an inner stage carries {wanted.signal!r}: choose one "
                "by --inner"
            )
        raise UserError(
            f"{where}: signal {wanted.signal!r} must be one of {', '.join(known)}; "
            "name it in the map file"
        )
    if wanted.scale == 0:
        raise UserError(f"{where}: scale = {wanted.scale:g} must not be 0")
    return list(known).index(wanted.signal), wanted.scale
