"""Which signal each port of a controller is: by their names, or by a map in a TOML file."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_runtime.signals import carried, command_rows, names

_Number = Annotated[float, Field(allow_inf_nan=False)]
#: the groups that an FMU of ours puts before its names
_GROUP = re.compile(r"^(ref|y|u)\.")
#: an output of our own controllers: 0, or why the bridge must be blocked
REASON = "reason"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Scaled(_Strict):
    """A signal and its scale.

    Attributes:
        signal: by its name in the signal table.
        scale: the port's value at 1 p.u.
    """

    signal: str
    scale: _Number = 1.0


class PortMap(_Strict):
    """What a map file holds.

    Attributes:
        inputs: by port, a signal of the references or measurements, or a constant.
        outputs: by port, a signal of u.
        fixed: by signal of u that no port gives, its value, p.u.
        parameters: by parameter of the controller, its value.
        blocks: an output that is not 0 when the bridge must be blocked.
        step_s: time between two steps of the controller, s; by default what it says itself.
    """

    inputs: dict[str, str | _Number | Scaled] = {}
    outputs: dict[str, str | Scaled] = {}
    fixed: dict[str, _Number] = {}
    parameters: dict[str, _Number] = {}
    blocks: str | None = None
    step_s: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None


def read_map(file: Path | None) -> PortMap:
    """The map in a file; an empty one without a file.

    Raises:
        UserError: the file cannot be read, or a key or value is wrong.
    """
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


@dataclass(frozen=True)
class PortWiring:
    """The map of a controller's ports, made for a run.

    Attributes:
        constants: shape (inputs,), what a port gets that has no signal.
        ports, signals, scales: for each input with a signal: its place among the inputs, the
            signal's place among references and measurements, and the port's value at 1 p.u.
        sources, targets, units: for each output that is a signal of u: its place among the
            outputs, the signal's place in u, and the port's value at 1 p.u.
        fixed: shape (3,) or (4,): values of u that no port gives.
        blocks: place of the output that blocks the bridge, or -1.
    """

    constants: NDArray[np.float64]
    ports: NDArray[np.int64]
    signals: NDArray[np.int64]
    scales: NDArray[np.float64]
    sources: NDArray[np.int64]
    targets: NDArray[np.int64]
    units: NDArray[np.float64]
    fixed: NDArray[np.float64]
    blocks: int

    def inputs(self, ref: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values of all inputs, from references and measurements in p.u."""
        values = self.constants.copy()
        values[self.ports] = np.concatenate((ref, y))[self.signals] * self.scales
        return values

    def outputs(self, u: NDArray[np.float64], count: int) -> NDArray[np.float64]:
        """The values of all ``count`` outputs at which u comes out; 0 where there is no signal."""
        values = np.zeros(count)
        values[self.sources] = u[self.targets] * self.units
        return values

    def take(self, outputs: NDArray[np.float64], u: NDArray[np.float64]) -> None:
        """Set u, p.u., from the values of all outputs."""
        u[:] = self.fixed
        u[self.targets] = outputs[self.sources] / self.units


def wire(
    where: str, ports: PortMap, inputs: Sequence[str], outputs: Sequence[str], inner: bool
) -> PortWiring:
    """Map a controller's ports, which are in its order, to the signals of a run.

    Raises:
        UserError: a port or a signal that is not there, a port without a signal, or a signal of u
            that comes from nowhere or twice.
    """
    known, u = [*names("ref"), *carried("y", inner)], [s.name for s in command_rows(inner)]
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
    (ports_in, signals, scales), (sources, targets, units) = map(_columns, (into, out))
    place = -1 if blocks is None else list(outputs).index(blocks)
    return PortWiring(constants, ports_in, signals, scales, sources, targets, units, fixed, place)


_Column = NDArray[np.int64]


def _columns(rows: list[tuple[int, int, float]]) -> tuple[_Column, _Column, NDArray[np.float64]]:
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
    if wanted.scale == 0 or not math.isfinite(wanted.scale):
        raise UserError(f"{where}: scale = {wanted.scale:g} must not be 0")
    return list(known).index(wanted.signal), wanted.scale
