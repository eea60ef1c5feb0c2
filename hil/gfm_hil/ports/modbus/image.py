"""The register image: SunSpec models from address 40000, with the layout of pysunspec2's files.

A register belongs to one point; a point is identified by its path, such as ``704.WSet`` or
``705.Crv2.Pt1.V``. Scale factors are set once, here, and never change.
"""

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

import sunspec2.device as sunspec
from sunspec2 import mb

BASE = 40000
VENDOR = 64901

Value = float | str | None


@dataclass(frozen=True)
class SunSpecPoint:
    """One point of a model."""

    path: str  # e.g. ``"704.WSet"``
    # address, length: its registers
    address: int
    length: int
    definition: Mapping[str, Any]  # of pysunspec2's model file: label, desc, units, symbols, access
    exponent: int  # of its constant scale factor; 0 if it has none

    @property
    def type(self) -> str:
        """SunSpec's name for its type."""
        return str(self.definition["type"])

    @property
    def name(self) -> str:
        """Its path within its model."""
        return self.path.partition(".")[2]

    @property
    def standard_access(self) -> str:
        """``R`` or ``RW``, from its definition."""
        return str(self.definition.get("access", "R"))

    def encode(self, value: Value) -> list[int]:
        """Registers of a value in the point's units; a value out of range is saturated.

        None and NaN become SunSpec's "not implemented".
        """
        if value is None or (isinstance(value, float) and math.isnan(value)):
            data = mb.create_unimpl_value(self.type, 2 * self.length)
        elif isinstance(value, str):
            text = value.encode("ascii", "replace")[: 2 * self.length]
            data = text.ljust(2 * self.length, b"\0")
        elif self.type.startswith("float"):
            data = struct.pack(">f", value)
        else:
            low, high = self.limits()
            whole = round(value * 10**-self.exponent)
            data = mb.point_type_info[self.type].to_data(min(max(whole, low), high))
        return list(struct.unpack(f">{self.length}H", data))

    def decode(self, registers: Sequence[int]) -> Value:
        """The value of registers in the point's units; None for "not implemented"."""
        data = struct.pack(f">{self.length}H", *registers)
        if self.type.startswith("float"):
            number = float(struct.unpack(">f", data)[0])
            return None if math.isnan(number) else number
        if data == mb.create_unimpl_value(self.type, 2 * self.length):
            return None
        if self.type == "string":
            return data.rstrip(b"\0").decode("ascii", "replace")
        whole = mb.point_type_info[self.type].data_to(data)
        return whole / 10**-self.exponent if self.exponent < 0 else whole * 10**self.exponent

    def limits(self) -> tuple[int, int]:
        """Smallest and largest integer of its type, without "not implemented"."""
        bits = 16 * self.length
        if self.type.startswith(("int", "sunssf")):
            return -(2 ** (bits - 1)) + 1, 2 ** (bits - 1) - 1
        return 0, 2**bits - 2

    def check(self, value: Value) -> None:
        """Raise ValueError for a value that the definition of an enumeration does not list."""
        symbols = self.definition.get("symbols")
        if symbols and self.type.startswith("enum"):
            allowed = {s["value"]: s["name"] for s in symbols}
            if value not in allowed:
                raise ValueError(f"{self.path} = {value}: must be one of {allowed}")


class Image:
    """All registers of a device.

    Args:
        models: number and content of every model, in order; the content holds the points that
            determine the layout (counts, scale factors) and lists for repeating groups.
    """

    def __init__(self, models: Mapping[int, Mapping[str, Any]]) -> None:
        self.points: dict[str, SunSpecPoint] = {}
        self._written: dict[str, object] = {}  # newest value of each path
        self.registers: list[int] = [*struct.unpack(">2H", b"SunS")]
        for number, content in models.items():
            layout = {"ID": number, **content}
            model = sunspec.Model(number, model_def=definition(number), data=layout)
            if model.error_info:
                raise ValueError(f"model {number}: {model.error_info}")
            start = BASE + len(self.registers)
            model.points["L"].value = len(model.get_mb()) // 2 - 2
            data = model.get_mb()
            self.registers += struct.unpack(f">{len(data) // 2}H", data)
            for path, point in _walk(model, str(number)):
                self.points[path] = SunSpecPoint(
                    path, start + point.offset, int(point.len), point.pdef, _exponent(point, model)
                )
        self.registers += [0xFFFF, 0]
        self._by_address = {p.address: p for p in self.points.values()}

    def set(self, path: str, value: Value) -> None:
        """Write a value to a point's registers."""
        if self._written.get(path, self) == value:  # most values do not change between refreshes
            return
        self._written[path] = value
        point = self.points[path]
        self.registers[self._registers_of(point)] = point.encode(value)

    def get(self, path: str) -> Value:
        """The value that a point's registers hold."""
        point = self.points[path]
        return point.decode(self.registers[self._registers_of(point)])

    def _registers_of(self, point: SunSpecPoint) -> slice:
        return slice(point.address - BASE, point.address - BASE + point.length)

    def split(
        self, address: int, registers: Sequence[int]
    ) -> list[tuple[SunSpecPoint, Sequence[int]]] | None:
        """The points of the registers from an address on, each with its registers; None if the
        first or last one is within a point, or a register belongs to none."""
        points, at = [], 0
        while at < len(registers):
            point = self._by_address.get(address + at)
            if point is None or at + point.length > len(registers):
                return None
            points.append((point, registers[at : at + point.length]))
            at += point.length
        return points


def definition(number: int) -> dict[str, Any]:
    """A model's definition, from this package if it has one, else from pysunspec2."""
    if number not in own_models():
        return dict(sunspec.get_model_def(number))
    model: dict[str, Any] = json.loads(own_models()[number].read_text(encoding="utf-8"))
    sunspec.add_mappings(model["group"])
    return model


def own_models() -> dict[int, Traversable]:
    """The files of the models that pysunspec2 does not ship, by number; clients need them too."""
    folder = files("gfm_hil.ports.modbus").joinpath("models").iterdir()
    return {int(f.name[len("model_") : -len(".json")]): f for f in folder}


def _walk(group: Any, path: str) -> Iterator[tuple[str, Any]]:
    for name, point in group.points.items():
        yield f"{path}.{name}", point
    for name, inner in group.groups.items():
        if isinstance(inner, list):
            for k, one in enumerate(inner, 1):
                yield from _walk(one, f"{path}.{name}{k}")
        else:
            yield from _walk(inner, f"{path}.{name}")


def _exponent(point: Any, model: Any) -> int:
    return int((point.sf_value if point.sf is None else model.points[point.sf].value) or 0)
