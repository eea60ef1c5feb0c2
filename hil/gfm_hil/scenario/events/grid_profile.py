"""A course of the grid's frequency and voltage over time, from a CSV file.

A file has the column t [s], and f_hz [Hz] or omega_g [p.u.], V_g [p.u.], degrees, or several of
them; lines that begin with # are for people. Between its lines a course is straight, and at a line
the grid's angle jumps ahead by its degrees.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import PurePath
from typing import Any, Literal, NamedTuple

from pydantic import Field

import gfm_plant
from gfm_hil.core.errors import UserError
from gfm_hil.scenario.events.base import EventTarget, GridEvent, nominal_hz
from gfm_runtime.errors import printable
from gfm_runtime.regular import read_regular
from gfm_runtime.signals import SIGNALS

_COLUMNS = ("t", "f_hz", "omega_g", "V_g", "degrees")
#: of omega_g and V_g, p.u.
RANGES = {s.name: (s.low, s.high) for s in SIGNALS if s.group == "d"}
MOST_LINES = 100_000
LARGEST_FILE = 64 << 20


class GridProfile(GridEvent):
    """The grid's frequency and voltage follow a CSV file: t [s after the event], and f_hz [Hz] or
    omega_g [p.u.], V_g [p.u.], or both; straight between its lines, and at the end they stay. By
    what a column degrees says, the grid's angle jumps ahead at each line."""

    type: Literal["grid-profile"] = Field(description="kind of event")
    file: str = Field(
        min_length=1, description="path, from the scenario's folder or where you run the command"
    )

    def lasts(self) -> float:
        try:
            return read_profile(self.file, None).t[-1]
        except UserError:  # its file is gone
            return 0.0

    def label(self) -> str:
        return f"grid profile {PurePath(self.file).stem}"

    def course(self, plant: gfm_plant.Network) -> Iterator[tuple[int, ProfilePoint]]:
        return read_profile(self.file, nominal_hz(plant)).points(float(plant.net[0]["T_s"]))

    def try_on(self, plant: gfm_plant.Network) -> None:
        next(self.course(plant))[1].apply(plant)

    def apply(self, plant: gfm_plant.Network) -> None:
        """Its points follow."""

    def check_now(self, target: EventTarget) -> None:
        raise ValueError("grid-profile: must be in the scenario, which reads it at the start")


class ProfilePoint(NamedTuple):
    """What the plant does from a tick of a course on: go to these values, in a line."""

    # omega_g, V_g: p.u.; None: it stays as it is
    omega_g: float | None
    V_g: float | None
    ticks: int  # how long that takes; 0: a step
    degrees: float = 0.0  # by which the angle jumps ahead before

    def apply(self, plant: gfm_plant.Network) -> None:
        """Carry it out on the plant's records, between two ticks. Raises ValueError: the grid is
        finite and has its own frequency."""
        if self.degrees:
            gfm_plant.phase_jump(plant, self.degrees)
        if self.omega_g is not None:
            gfm_plant.grid_frequency(
                plant, self.omega_g, self._rate(self.omega_g, plant, "omega_g")
            )
        if self.V_g is not None:
            gfm_plant.grid_voltage(plant, self.V_g, self._rate(self.V_g, plant, "V_g"))

    def _rate(self, value: float, plant: gfm_plant.Network, name: str) -> float | None:
        """p.u./s from where the grid is now; None for a step."""
        way = abs(value - float(plant.now[0][name]))
        return way / (self.ticks * float(plant.net[0]["T_s"])) if self.ticks and way else None


@dataclass(frozen=True)
class Profile:
    """A course."""

    t: list[float]  # s after its event, each larger than the one before
    # omega_g, V_g: p.u., as many as of t; None without such a column
    omega_g: list[float] | None
    V_g: list[float] | None
    degrees: list[float] | None = None

    def points(self, T_s: float) -> Iterator[tuple[int, ProfilePoint]]:
        """What the plant does, each with its tick after the event. Lines that fall on the same
        tick count as the last of them."""
        last = {round(t / T_s): k for k, t in enumerate(self.t)}

        def to(k: int, ticks: int, jump: int | None) -> ProfilePoint:
            omega_g, V_g = (x[k] if x is not None else None for x in (self.omega_g, self.V_g))
            degrees = self.degrees[jump] if self.degrees is not None and jump is not None else 0.0
            return ProfilePoint(omega_g, V_g, ticks, degrees)

        ticks = [*last]
        yield ticks[0], to(last[ticks[0]], 0, last[ticks[0]])
        for now, then in pairwise(ticks):
            yield now, to(last[then], then - now, last[now] if now != ticks[0] else None)
        if self.degrees is not None and len(ticks) > 1:
            yield ticks[-1], to(last[ticks[-1]], 0, last[ticks[-1]])


def read_profile(file: str, f_n: float | None) -> Profile:
    """Read and check a course. Raises UserError: one line that names the file, and the line,
    column, value and what is allowed.

    Args:
        file: path.
        f_n: nominal frequency, Hz; None leaves f_hz aside.
    """
    try:
        return _profile(read_regular(file, LARGEST_FILE), file, f_n)
    except (OSError, ValueError) as problem:  # a name with a zero byte, bytes that are no text
        reason = getattr(problem, "strerror", None) or str(problem)
        raise UserError(printable(f"{file}: {reason}")) from None
    except csv.Error as problem:
        raise UserError(printable(f"{file}: {problem}")) from None


@lru_cache(maxsize=4)  # each run of a study asks for it several times
def _profile(content: bytes, file: str, f_n: float | None) -> Profile:
    """The course in a file's content; arguments and UserError as of ``read_profile``."""
    t, columns = [], dict[str, list[float]]()
    for number, cells in _lines(io.StringIO(content.decode(), newline=""), file):
        if not columns:
            columns = {name: [] for name in _head([c.strip() for c in cells], file)}
            continue
        if len(cells) != len(columns):
            raise UserError(f"{file}, line {number}: has {len(cells)} fields, but the first"
                            f" line has {len(columns)}")  # fmt: skip
        for (name, values), cell in zip(columns.items(), cells, strict=True):
            values.append(_value(name, cell, f_n, f"{file}, line {number}"))
        t = columns["t"]
        if len(t) > 1 and not t[-1] > t[-2]:
            raise UserError(f"{file}, line {number}: t = {t[-1]:g}: must be larger than in"
                            f" the line before, {t[-2]:g}")  # fmt: skip
    if not t:
        raise UserError(f"{file}: has no line with numbers; it needs one with t and values")
    omega_g = columns.get("omega_g")
    if "f_hz" in columns and f_n is not None:
        omega_g = [f / f_n for f in columns["f_hz"]]
    return Profile(t, omega_g, columns.get("V_g"), columns.get("degrees"))


def _lines(text: Any, file: str) -> Iterator[tuple[int, list[str]]]:
    """The lines that are not for people, with their numbers."""
    reader = csv.reader(text)
    for found, cells in enumerate(c for c in reader if c and not c[0].lstrip().startswith("#")):
        if found > MOST_LINES:
            raise UserError(f"{file}: more than {MOST_LINES} lines; thin it out")
        yield reader.line_num, cells


def _head(names: list[str], file: str) -> list[str]:
    """The names of the columns, checked."""
    ok = names[0] == "t" and len(names) > 1 and len({*names}) == len(names)
    if not ok or {*names} - {*_COLUMNS} or {"f_hz", "omega_g"} <= {*names}:
        raise UserError(
            printable(f"{file}: columns {','.join(names)}: must be t, then f_hz (Hz) or omega_g "
                      "(p.u.), V_g (p.u.), degrees, or several")
        )  # fmt: skip
    return names


def _value(name: str, cell: str, f_n: float | None, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise UserError(printable(f"{where}: {name} = {cell!r:.80}: must be a number")) from None
    low, high = (-360.0, 360.0) if name == "degrees" else RANGES.get(name, (0.0, 86400.0))
    if name == "f_hz":
        low, high = (limit * f_n for limit in RANGES["omega_g"]) if f_n else (0.0, math.inf)
    if not (math.isfinite(value) and low <= value <= high):
        raise UserError(f"{where}: {name} = {value:g}: must lie in [{low:g}, {high:g}]")
    return value
