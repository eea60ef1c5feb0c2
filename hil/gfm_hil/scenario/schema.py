"""The keys of a scenario, with all checks that need no plant."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import cached_property
from typing import Any, Literal

from pydantic import Field, model_validator

from gfm_hil.core.schema import StrictSchema
from gfm_hil.links import link_kind, link_names
from gfm_hil.links.impaired import Impairment
from gfm_hil.scenario.events import AnyEvent
from gfm_hil.scenario.events.base import Event
from gfm_hil.scenario.events.grid_profile import LARGEST_FILE
from gfm_hil.scenario.events.reference import check_reference, reference_field
from gfm_hil.scenario.expectation import check_expectation
from gfm_plant import BATTERY, CONNECTION, NetworkParts, Plant, load_converter
from gfm_runtime import LawError, law_file
from gfm_runtime.counts import named_counts
from gfm_runtime.errors import meant
from gfm_runtime.inner_file import named_inner
from gfm_runtime.regular import read_regular
from gfm_runtime.signals import COUNTS, INNER, PLAIN, REF_NAMES, SET_POINTS, table_hash

#: default of ``link.peer_timeout_s`` by mode: real time cannot wait; in lockstep simulated time
#: stands still, and a busy machine may delay a side by seconds
PEER_TIMEOUT_S = {"realtime": 0.5, "lockstep": 20.0}
_WITH_MORE = ("shm", "zmq")  # links whose frames have room for counts and set-points
_MOST_FLOWS = 3500  # columns of a network, in a file of signals
INPROC = "inproc"  # no link: both sides in one compiled loop


class LinkSettings(StrictSchema):
    """How the two sides exchange frames."""

    type: str = Field("zmq", description="name of a link; inproc: one compiled loop, lockstep only")
    endpoint: str | None = Field(
        None, description="where the sides meet, in the form of the link; a fresh one if none"
    )
    options: dict[str, Any] = Field(default_factory=dict, description="the link's own options")
    peer_timeout_s: float | None = Field(
        None,
        gt=0,
        le=60,
        description="silence after which the other side counts as gone, s; by default "
        + " and ".join(f"{wait:g} in {mode}" for mode, wait in PEER_TIMEOUT_S.items()),
    )
    repeat_s: float = Field(
        0.002, gt=0, le=60, description="lockstep: silence after which the plant sends y[k] again"
    )
    impairment: Impairment | None = Field(None, description="faults on purpose")
    start_timeout_s: float = Field(
        60.0, gt=0, le=604800, description="how long to wait for it at the start"
    )

    @model_validator(mode="after")
    def _known(self) -> LinkSettings:
        if self.type == INPROC:  # ignore endpoint and options: another link may need them
            return self
        if self.type not in link_names():
            known = sorted([INPROC, *link_names()])
            raise ValueError(
                f"type = {self.type!r}: must be one of {known}{meant(self.type, known)}"
            )
        link_kind(self.type).checked(self.endpoint, self.options)
        return self


def file_hash(file: str) -> str:
    """Hash of the content of a file, wherever it lies."""
    return hashlib.sha256(read_regular(file, LARGEST_FILE)).hexdigest()[:16]


def laws_digest(laws: Iterable[str], inner: str | None, counts: str | None = None) -> str:
    """Hash of the content of laws, by name or path, with their bases, and of the inner stage and of
    measurement and modulation that replace theirs unless they are None."""
    own = (None if inner is None else named_inner(inner)), counts and named_counts(counts)
    others = [[name is not None, one and one.model_dump()]
              for name, one in zip((inner, counts), own, strict=True)]  # fmt: skip
    return _hash([others, *(law_file(name).model_dump() for name in laws)])


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


class References(StrictSchema):
    """Y_ref at the start, p.u."""

    V_dcref: float = reference_field("V_dcref", 1.0)
    P_ref: float = reference_field("P_ref", 0.5)
    omega_g: float = reference_field("omega_g", 1.0)
    Q_ref: float = reference_field("Q_ref", 0.0)
    V_ref: float = reference_field("V_ref", 1.0)

    @model_validator(mode="after")
    def _in_range(self) -> References:
        for name in REF_NAMES:
            check_reference(name, getattr(self, name))
        return self

    def vector(self) -> list[float]:
        """The references in the order of the signal table."""
        return [getattr(self, name) for name in REF_NAMES]


class LatePolicy(StrictSchema):
    """Real time: what to do if a frame misses its deadline."""

    hold: int = Field(
        200, ge=0, le=10**9, description="ticks in a row to hold the last value, then SAFE"
    )
    extrapolate: int = Field(
        0,
        ge=0,
        le=100,
        description="the first of them, over which the plant goes on along u's trend",
    )

    @model_validator(mode="after")
    def _within_hold(self) -> LatePolicy:
        if self.extrapolate > self.hold:
            raise ValueError(
                f"extrapolate = {self.extrapolate}: must be at most hold = {self.hold}"
            )
        return self


class NetworkConverter(StrictSchema):
    """One converter of a network; a key that it leaves out has the scenario's value."""

    node: str = Field(min_length=1, description="where its line ends")
    law: str | None = Field(None, description="catalogue name or path of a law file")
    inner: str | None = Field(None, description="inner stage of its laws")
    references: References | None = Field(None, description="references Y_ref at the start")
    link: LinkSettings | None = Field(None, description="between the plant and its controller")
    late_policy: LatePolicy | None = Field(
        None, description="real time: what happens to late frames"
    )
    plant: Plant | None = Field(None, description="converter and instruments, without a grid")
    expect: Literal["completed", "oscillating", "tripped", "safe"] | None = Field(
        None, description="status with which its part of the run counts as passed"
    )

    @model_validator(mode="after")
    def _has_no_grid(self) -> NetworkConverter:
        if self.plant is not None and self.plant.grid != Plant().grid:
            raise ValueError("plant.grid: is the scenario's own; its node is network.grid")
        return self


class NetworkSettings(NetworkParts):
    """Several converters and what connects them."""

    converters: dict[str, NetworkConverter] = Field(min_length=1, description="by name")


class Scenario(StrictSchema):
    """One experiment."""

    title: str = Field(description="of figures and reports")
    description: str = Field("", description="for people")
    duration: float = Field(gt=0, le=86400, description="s")
    T_s: float = Field(1e-4, ge=1e-6, le=0.1, description="sampling time, s")
    mode: Literal["lockstep", "realtime"] = Field(
        "lockstep", description="lockstep: simulated time; realtime: the clock"
    )
    law: str = Field("mimo-gfm", description="catalogue name or path of a law file")
    inner: str | None = Field(
        None,
        description="inner stage of every law, in place of its own: a shipped name (gfmhil laws), "
        "the path of a file, or none",
    )
    counts: str | None = Field(
        None,
        description="measurement and modulation of every law, in place of its own: a shipped name, "
        "the path of a file, or none",
    )
    seed: int = Field(0, ge=0, lt=2**63, description="of the sensors' noise")
    expect: Literal["completed", "oscillating", "tripped", "safe"] = Field(
        "completed", description="status with which the run counts as passed (exit code 0)"
    )
    expect_ripple: float = Field(
        0.02,
        gt=0,
        le=1000,
        description="p.u.; a run that lasts to its end but whose p, V, omega_u or abs(i) then "
        "still oscillates by more, peak to peak, ends as oscillating",
    )
    expect_reason: str | None = Field(
        None,
        description="name of the trip or safe reason, which must be the cause of the end; any if "
        "none",
    )
    expect_after: float | None = Field(
        None, gt=0, description="s; the trip or safe state must not come before; any time if none"
    )
    after_trip: Literal["end", "wait"] = Field(
        "end",
        description="wait: a trip or a safe state does not end the run; the plant stays blocked "
        "until an event, or an operator, resets both sides to the scenario's start; of a network "
        "the converter that tripped waits for its reset",
    )
    prevent_idle: Literal["auto", "always", "never"] = Field(
        "auto",
        description="real time: a thread of idle priority keeps each side's processor busy; auto: "
        "on a virtual machine, whose host may return an idle processor late",
    )
    waveforms: tuple[float, float] | None = Field(
        None,
        strict=False,
        description="[from, to], s: the window of the figure of the three phases; from 3 cycles "
        "before the first event to 7 after it if none",
    )
    cores: int | None = Field(
        None,
        ge=1,
        le=64,
        description="in process: lines of travelling waves cut the network into parts, a thread "
        "each, which so many processor cores run; the results do not depend on how many; if none, "
        "the network is solved as one circuit",
    )
    snapshot: float | None = Field(
        None, gt=0, description="s: when both sides keep their state in the run folder, before the "
        "events of that tick; lockstep only",
    )  # fmt: skip
    start_from: str | None = Field(
        None,
        description="run folder with the snapshot at which this run starts; tick 0 is its tick",
    )
    ready_laws: list[str] = Field(
        default_factory=list,
        description="further laws to make ready for an operator, besides those of the events",
    )
    compare: list[str] = Field(default_factory=list, description="laws for `gfmhil compare`")
    references: References = Field(References(), description="references Y_ref at the start")
    link: LinkSettings = Field(LinkSettings(), description="how the two sides exchange frames")
    late_policy: LatePolicy = Field(
        LatePolicy(), description="real time: what happens to late frames"
    )
    plant: Plant = Field(Plant(), description="converter, grid and instruments")
    network: NetworkSettings | None = Field(
        None, description="several converters in one network; one on its line to the grid if none"
    )
    converter: str | None = Field(
        None, description="in the folder of a converter of a network: which one it is"
    )
    events: list[AnyEvent] = Field(
        default_factory=list,
        max_length=10_000,
        description="what happens in the run, each at its time",
    )

    @property
    def ticks(self) -> int:
        """Number of ticks of the run."""
        return round(self.duration / self.T_s)

    @property
    def converters(self) -> list[str]:
        """Names of the converters of the network; none without one."""
        return [] if self.network is None else list(self.network.converters)

    @property
    def parts(self) -> list[str]:
        """Names of the converters that have a run folder of their own within the run's."""
        return self.converters if self.converter is None else []

    @cached_property
    def each(self) -> dict[str, Scenario]:
        """The scenario as each converter of the network sees it, with its law, references and
        plant; none without a network."""
        if self.network is None:
            return {}
        keys = ("law", "inner", "references", "link", "late_policy", "plant", "expect")
        plant = self.plant.model_copy(update={"grid": Plant().grid})

        def with_defaults(member: NetworkConverter) -> NetworkConverter:
            if self.converter is not None:  # a folder's scenario.toml has all its keys
                return member
            own = {key: getattr(self, key) for key in keys if getattr(member, key) is None}
            return member.model_copy(update=own | ({"plant": plant} if "plant" in own else {}))

        members = {name: with_defaults(member) for name, member in self.network.converters.items()}
        network = self.network.model_copy(update={"converters": members})

        def member_view(name: str, member: NetworkConverter) -> Scenario:
            own = {key: getattr(member, key) for key in keys}
            own["plant"] = own["plant"].model_copy(update={"grid": self.plant.grid})
            return self.model_copy(update={**own, "network": network, "converter": name})

        return {name: member_view(name, member) for name, member in members.items()}

    def __copy__(self) -> Scenario:
        """A copy without the cached properties, since the fields of a copy may be changed."""
        copy = super().__copy__()
        for derived in copy.__dict__.keys() - type(self).model_fields.keys():
            del copy.__dict__[derived]
        return copy

    @property
    def survives_trips(self) -> bool:
        """Whether plant and controllers go on after a trip; they wait for a reset, or there may be
        other converters."""
        return self.after_trip == "wait" or self.network is not None

    @property
    def peer_timeout_s(self) -> float:
        """Silence after which the other side counts as gone, s."""
        return self.link.peer_timeout_s or PEER_TIMEOUT_S[self.mode]

    @property
    def answer_timeout_s(self) -> float:
        """How long an external controller may take for u, s, which is half of the peer's time, so
        that its side can still report what has failed."""
        return self.peer_timeout_s / 2

    @property
    def in_process(self) -> bool:
        """Whether plant and controllers run in one compiled loop, without a link."""
        return all(link.type == INPROC for link in self.links)

    @property
    def links(self) -> list[LinkSettings]:
        """The link of each converter that runs here."""
        return [self.each[name].link for name in self.parts] or [self.link]

    def laws(self) -> list[str]:
        """Names of all laws that the run uses, each once, the initial law first."""
        changes = [vars(e)["law"] for e in self.sorted_events() if "law" in vars(e)]
        return list(dict.fromkeys([self.law, *changes, *self.ready_laws]))

    def sorted_events(self) -> list[Event]:
        """Events in order of their tick; within a tick in the order of the file. As a converter
        sees them, those of the network and its own."""
        others = {*self.converters} - {self.converter} if self.converter is not None else ()
        ours = [e for e in self.events if getattr(e, "converter", None) not in others]
        return sorted(ours, key=lambda e: e.at(self.T_s))

    def shifted(self, by_s: float) -> Scenario:
        """This scenario with its events ``by_s`` later (s; earlier if negative), and as much
        longer."""
        events = [
            event.model_copy(update={"t": event.at(self.T_s) * self.T_s + by_s, "tick": None})
            for event in self.events
        ]
        return self.model_copy(update={"duration": self.duration + by_s, "events": events})

    def digest(self) -> str:
        """Hash of all that both sides must agree on: scenario, signal table, and the content of
        the law and converter files, wherever each machine keeps them."""
        differ = {"link", "title", "description", "compare", "waveforms"}
        differ |= {"expect", "expect_ripple", "expect_reason", "expect_after"}
        content = self.model_dump(
            exclude={*differ, "law", "inner", "counts", "events", "ready_laws"}
        )
        if self.network is not None:
            members = content["network"]["converters"]
            for name, member in members.items():
                own = self.each[name]
                for key in ("link", "expect", "law", "inner"):
                    del member[key]
                if member["plant"] is not None:
                    converter = load_converter(own.plant.converter)
                    member["plant"]["converter"] = converter.model_dump()
                member["laws"] = own.laws_digest()
        content["plant"]["converter"] = load_converter(self.plant.converter).model_dump()
        names = self.laws()
        events = []
        for e in self.sorted_events():
            by_content: dict[str, Any] = {}
            if hasattr(e, "law"):
                by_content["law"] = names.index(e.law)
            if hasattr(e, "file"):
                by_content["file"] = file_hash(e.file)
            events.append({**e.model_dump(), **by_content})
        return _hash([content, events, self.laws_digest(), table_hash()])

    def laws_digest(self) -> str:
        """Hash of the content of every law that the run uses."""
        return laws_digest(self.laws(), self.inner, self.counts)

    @cached_property
    def signal_set(self) -> int:
        """The signals of frames and recording beside y and u of Phi. ``PLAIN``, none; ``INNER``,
        those of an inner stage, if a law has one; ``COUNTS``, those and the counts of A/D and
        modulator, if a law measures and modulates."""
        each = [*self.each.values()] or [self]
        files = [(one, law_file(name)) for one in each for name in one.laws()]
        counts = named_counts(self.counts) if self.counts is not None else None
        if any(counts if self.counts is not None else file.counts for _, file in files):
            return COUNTS
        inner = (file.behind(one.inner).inner for one, file in files)
        return INNER if any(stage is not None for stage in inner) else PLAIN

    @property
    def frame_signals(self) -> int:
        """The signals of frames, ``signal_set`` and with a plant controller ``SET_POINTS``."""
        each = {} if self.network is None else self.network.plant_controllers
        followers = {n for one in each.values() for n in one.converters or self.converters}
        return self.signal_set + SET_POINTS * (not followers.isdisjoint(self.converters))

    @property
    def optional_signals(self) -> tuple[str, ...]:
        """The signals that options of a plant add to the recording, power and voltage at the
        connection point behind a transformer, and the charge of a battery."""
        plants = [one.plant for one in self.each.values()] or [self.plant]
        connection = any(one.lcl is not None for one in plants)
        battery = any(one.dc_source.battery is not None for one in plants)
        return (CONNECTION if connection else ()) + (BATTERY if battery else ())

    @property
    def flows(self) -> tuple[str, ...]:
        """Columns of the network's parts, which the recording of its first converter has too."""
        if self.network is None:
            return ()
        nodes = {name: member.node for name, member in self.network.converters.items()}
        return tuple(name for one in self.network.recorded(nodes) for name in one.columns)

    def _problems_of_record(self) -> list[str]:
        try:
            names = self.flows
        except ValueError as problem:
            return [f"network.{problem}"]
        if len(names) <= _MOST_FLOWS:
            return []
        return [f"network.record: {len(names)} columns; at most are {_MOST_FLOWS}; name fewer"]

    def _problems_of_links(self) -> list[str]:
        problems = []
        own = dict(zip(self.parts or [""], self.links, strict=True))
        kinds = {link.type for link in own.values()}
        if INPROC in kinds and len(kinds) > 1:
            problems.append(
                f"network.converters: link.type is {INPROC!r} of some and not of others; choose"
                " links for all, or for none"
            )
        if self.cores is not None and self.network is None:
            problems.append(f"cores = {self.cores}: goes with a network, whose parts they run")
        elif self.cores is not None and kinds != {INPROC}:
            problems.append(
                f"cores = {self.cores}: with link.type = {INPROC!r} only; over links each loop has"
                " a processor of its own"
            )
        if self.cores is not None and self.network and self.network.plant_controllers:
            problems.append(f"cores = {self.cores}: cannot go with network.plant_controllers")
        if kinds == {INPROC} and self.mode == "realtime":
            problems.append("link.type = 'inproc': runs in lockstep only; use zmq or shm")
        places = [link.endpoint for link in own.values() if link.endpoint is not None]
        for place in {place for place in places if places.count(place) > 1}:
            problems.append(
                f"network.converters: {places.count(place)} have the link.endpoint {place!r}; each"
                " needs one of its own"
            )
        for name, link in own.items():
            if link.type == INPROC:
                continue
            kind = link_kind(link.type)
            options = kind.options.model_validate(link.options)
            where = f"network.converters.{name}.link" if name else "link"
            try:
                more = {
                    "counts, which laws with [measure] and [modulate] exchange": COUNTS,
                    "set-points, which network.plant_controllers send": SET_POINTS,
                }
                lacks = [what for what, bit in more.items() if self.frame_signals & bit]
                if lacks and link.type not in _WITH_MORE:
                    problems.append(
                        f"{where}.type = {link.type!r}: carries no {lacks[0]}; use"
                        f" {', '.join(_WITH_MORE)} or {INPROC}"
                    )
                    continue
                kind.check(options.of_run(self.signal_set), self.T_s)
            except LawError:
                pass  # ``check_scenario`` says what is wrong with the laws
            except ValueError as problem:
                problems.append(f"{where}.options: {problem}")
        return problems

    def _problems_of_snapshot(self) -> list[str]:
        problems = []
        if self.snapshot is not None and not 0 < round(self.snapshot / self.T_s) < self.ticks:
            problems.append(
                f"snapshot = {self.snapshot:g} s: must lie within the run of {self.duration:g} s"
            )
        if self.cores is not None and (self.snapshot or self.start_from):
            problems.append(f"cores = {self.cores}: not with snapshot or start_from")
        if self.snapshot is not None and self.mode == "realtime":
            problems.append(f"snapshot = {self.snapshot:g} s: needs mode = 'lockstep'")
        key = "start_from" if self.snapshot is None else "snapshot"
        if self.snapshot is not None or self.start_from is not None:
            for link in self.links:
                if link.impairment is not None and link.impairment.trace is not None:
                    problems.append(f"{key}: cannot be combined with link.impairment.trace")
                if int(link.options.get("every", 1)) > 1:  # the link has u of several ticks then
                    problems.append(f"{key}: needs link.options.every = 1")
        return problems

    @model_validator(mode="after")
    def _fits_together(self) -> Scenario:
        problems = check_expectation(
            self.expect, self.expect_reason, self.expect_after, self.duration
        )
        if self.ticks < 1:
            problems.append(f"duration = {self.duration:g} s: not one tick of T_s = {self.T_s:g} s")
        if self.waveforms and not 0 <= self.waveforms[0] < min(self.waveforms[1], self.duration):
            problems.append(
                f"waveforms = {list(self.waveforms)}: must be [from, to] with 0 <= from < to, and "
                f"from before the end of the run at {self.duration:g} s"
            )
        for k, event in enumerate(self.events):
            if event.at(self.T_s) >= self.ticks:
                problems.append(
                    f"events.{k}: at {event.at(self.T_s) * self.T_s:g} s, but the run ends at "
                    f"{self.duration:g} s"
                )
            problems += [f"events.{k}: {line}" for line in event.misfits(self)]
            name = getattr(event, "converter", None)
            if name is not None and name not in self.converters:
                problems.append(
                    f"events.{k}.converter = {name!r}: must be one of {self.converters}"
                    f"{meant(name, self.converters)}"
                )
        problems += self._problems_of_record() + self._problems_of_snapshot()
        if self.network is not None and self.plant.grid.load_R is not None:
            problems.append("plant.grid.load_R: a load of a network is one of network.loads")
        if self.network is not None and self.plant.grid.scr is not None:
            problems.append(
                f"plant.grid.scr = {self.plant.grid.scr:g}: is for one converter alone;"
                " network.lines say how strong the grid of a network is"
            )
        problems += self._problems_of_links()
        if problems:
            raise ValueError("; ".join(problems))
        return self
