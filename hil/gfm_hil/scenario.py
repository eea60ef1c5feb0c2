"""Scenario files: everything that a run needs, in TOML, checked before anything starts."""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from gfm_hil.errors import UserError
from gfm_hil.events import (
    CONTROLLER_EVENTS,
    Breaker,
    ControllerEvent,
    Event,
    LawChange,
    check_reference,
)
from gfm_plant import Plant, make_plant
from gfm_runtime import LawError, discretise, law_file, load_law
from gfm_runtime.signals import REF_NAMES, table_hash


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Link(_Model):
    """How the two sides exchange frames."""

    type: Literal["zmq", "inproc"] = Field(
        "zmq", description="zmq: two processes; inproc: one compiled loop, lockstep only"
    )
    endpoint: str | None = Field(
        None, description="ipc://… or tcp://host:port; a fresh ipc endpoint if none"
    )
    peer_timeout_s: float = Field(
        0.5, gt=0, le=60, description="silence after which the other side counts as gone"
    )
    start_timeout_s: float = Field(60.0, gt=0, description="how long to wait for it at the start")


class References(_Model):
    """Y_ref at the start, p.u."""

    V_dcref: float = 1.0
    P_ref: float = 0.5
    omega_g: float = 1.0
    Q_ref: float = 0.0
    V_ref: float = 1.0

    @model_validator(mode="after")
    def _in_range(self) -> References:
        for name in REF_NAMES:
            check_reference(name, getattr(self, name))
        return self

    def vector(self) -> list[float]:
        """In the order of the signal table."""
        return [getattr(self, name) for name in REF_NAMES]


class LatePolicy(_Model):
    """Real time: what to do about frames that are not there at their deadline."""

    hold: int = Field(200, ge=0, description="ticks in a row to hold the last value, then SAFE")


class Scenario(_Model):
    """One experiment."""

    title: str
    description: str = ""
    duration: float = Field(gt=0, le=86400, description="s")
    T_s: float = Field(1e-4, ge=1e-6, le=0.1, description="sampling time, s")
    mode: Literal["lockstep", "realtime"] = "lockstep"
    law: str = Field("mimo-gfm", description="catalogue name or path of a law file")
    seed: int = Field(0, ge=0, lt=2**63, description="of the sensors' noise")
    expect: Literal["completed", "tripped", "safe"] = Field(
        "completed", description="status with which the run counts as passed (exit code 0)"
    )
    compare: list[str] = Field(default_factory=list, description="laws that `compare` puts beside")
    references: References = References()
    link: Link = Link()
    late_policy: LatePolicy = LatePolicy()
    plant: Plant = Plant()
    events: list[Event] = Field(default_factory=list)

    @property
    def ticks(self) -> int:
        """Number of ticks of the run."""
        return round(self.duration / self.T_s)

    def laws(self) -> list[str]:
        """Names of every law that the run uses, the first one first, each once."""
        changes = [e.law for e in self.sorted_events() if isinstance(e, LawChange)]
        return list(dict.fromkeys([self.law, *changes]))

    def sorted_events(self) -> list[Event]:
        """Events in order of their tick; those of one tick in the order of the file."""
        return sorted(self.events, key=lambda e: e.at(self.T_s))

    def controller_events(self) -> list[tuple[int, ControllerEvent]]:
        """The controller's events with their ticks."""
        return [
            (e.at(self.T_s), e) for e in self.sorted_events() if isinstance(e, CONTROLLER_EVENTS)
        ]

    def plant_events(self) -> list[tuple[int, Any]]:
        """The plant's events with their ticks."""
        return [
            (e.at(self.T_s), e)
            for e in self.sorted_events()
            if not isinstance(e, CONTROLLER_EVENTS)
        ]

    def digest(self) -> str:
        """Hash over what both sides must agree on: scenario, laws' contents, signal table."""
        content = self.model_dump(exclude={"link", "title", "description", "expect", "compare"})
        laws = [law_file(name).model_dump() for name in self.laws()]
        text = json.dumps([content, laws, table_hash()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @model_validator(mode="after")
    def _fits_together(self) -> Scenario:
        problems = []
        for k, event in enumerate(self.events):
            if event.at(self.T_s) >= self.ticks:
                problems.append(
                    f"events.{k}: at {event.at(self.T_s) * self.T_s:g} s, but the run ends at "
                    f"{self.duration:g} s"
                )
            if isinstance(event, Breaker) and self.plant.grid.load_R is None:
                problems.append(f"events.{k}: the breaker needs plant.grid.load_R and load_L")
        if self.mode == "realtime" and self.link.type == "inproc":
            problems.append("link.type = 'inproc': runs in lockstep only; use zmq for real time")
        if problems:
            raise ValueError("; ".join(problems))
        return self


SCENARIO_FOLDERS = (
    Path(__file__).resolve().parent / "scenarios",  # a wheel carries them here
    Path(__file__).resolve().parents[2] / "scenarios",  # a checkout has them here
)


def find_scenario(name: str) -> Path:
    """The file of a scenario: a path, or the name of a shipped one (with or without .toml).

    Raises:
        UserError: neither exists.
    """
    given = Path(name)
    if given.is_file():
        return given
    for folder in SCENARIO_FOLDERS:
        for candidate in (folder / given.name, folder / f"{given.name}.toml"):
            if candidate.is_file():
                return candidate
    raise UserError(f"scenario {name}: no such file; shipped are {shipped_scenarios()}")


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with gfmhil."""
    return sorted({p.stem for folder in SCENARIO_FOLDERS for p in folder.glob("*.toml")})


def load_scenario(name: str, **changed: Any) -> Scenario:
    """Read, override and check a scenario, its laws and its plant.

    Args:
        name: path or shipped name.
        changed: overrides by dotted path with ``__`` for the dot, e.g. ``link__type="inproc"``;
            None leaves the file's value.

    Raises:
        UserError: one line a mistake, each with its path, the value and what is allowed.
    """
    path = find_scenario(name)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as problem:
        raise UserError(f"{path}: {problem}") from None
    for key, value in changed.items():
        if value is not None:
            table = content
            *parents, last = key.split("__")
            for parent in parents:
                table = table.setdefault(parent, {})
            table[last] = value
    return check_scenario(content, str(path))


def check_scenario(content: dict[str, Any], where: str) -> Scenario:
    """The scenario of a dict, with its laws and its plant tried out.

    Raises:
        UserError: as ``load_scenario``.
    """
    try:
        scenario = Scenario.model_validate(content)
    except ValidationError as problem:
        lines = [_line(e) for e in problem.errors()]
        raise UserError("\n".join(f"{where}: {line}" for line in lines)) from None
    try:
        for law in [*scenario.laws(), *scenario.compare]:
            for stage in load_law(law).laws:
                discretise(stage, scenario.T_s)
        make_plant(scenario.plant, scenario.T_s)
    except (LawError, ValueError) as problem:
        raise UserError(f"{where}: {problem}") from None
    return scenario


def _line(error: Any) -> str:
    path = ".".join(str(part) for part in error["loc"])
    text = error["msg"].removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{path}: {text}" if path else text
    shown = repr(error["input"])
    return f"{path}: {text}, not {shown if len(shown) < 60 else shown[:57] + '...'}"
