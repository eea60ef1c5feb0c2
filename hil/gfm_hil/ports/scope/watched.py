"""One run that a scope watches, of a network that of one converter: what pages learn of it."""

import asyncio
import contextlib
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.scope.channels import make_channels, si_bases
from gfm_hil.ports.scope.pyramid import Pyramid
from gfm_hil.ports.scope.recording import Recording
from gfm_hil.ports.scope.session import Session, in_words
from gfm_hil.recording.run import bases
from gfm_hil.scenario import INPROC, Scenario
from gfm_hil.scenario.events import EVENTS
from gfm_hil.scenario.events.base import Event, GridEvent
from gfm_runtime import LawError, law_file, law_titles
from gfm_runtime.states import STATES

_EVENTS = 500  # newest events that are sent to pages


class WatchedRun:
    """A run and the pages that look at it.

    Args:
        record: of the run.
        others: names of all converters that the scope watches, of a network.
    """

    def __init__(self, record: Recording, others: list[str]) -> None:
        self.record, self.others = record, others
        self.pyramid = Pyramid(record, make_channels(record.T_s, record.f_b))
        self.sessions: set[Session] = set()
        self._events = record.events()
        self._ended = record.ended()
        self._said = self.happened()
        self._operator: Operator | None = None
        self._commands = asyncio.Lock()

    async def follow_log(self) -> None:
        """Look for new events and for the end of the run, and tell the pages."""
        self._events = await asyncio.to_thread(self.record.events)
        self._ended = self.record.ended()
        if self._ended and self.record.live:
            self.record.finish()
        self.record.look_up_laws()
        now = self.happened()
        if now != self._said:
            news = in_words("events", **now)
            for session in list(self.sessions):
                session.post("events", news)
        self._said = now

    def happened(self) -> dict[str, Any]:
        events = self._events[-_EVENTS:]
        return {"events": events, "summary": self._ended, "labels": self.record.laws}

    def about(self) -> dict[str, Any]:
        """The run's data that a page needs; no file names, only the scenario's title."""
        s = self.record.scenario
        return {
            "title": s.title,
            "converter": s.converter or "",
            "converters": self.others,
            "live": self.record.live,
            "commands": self.record.live and s.link.type != INPROC,
            "mode": s.mode,
            "link": s.link.type,
            "T_s": self.record.T_s,
            "capacity": self.record.capacity,
            "f_b": self.record.f_b,
            "channels": [channel.about() for channel in self.pyramid.channels],
            "states": STATES,
            "labels": self.record.laws,
            "laws": [*law_titles(s.laws()).items()],
            "bases": si_bases(bases(s)),
            "events": {name: kind.model_json_schema() for name, kind in _events_of(s).items()},
            "choices": _choices(s),
        }

    async def command(self, event: dict[str, Any], by: Identity) -> dict[str, Any]:
        async with self._commands:
            return await asyncio.to_thread(self._command_now, event, by)

    def _command_now(self, event: dict[str, Any], by: Identity) -> dict[str, Any]:
        if not self.record.live:
            raise UserError("the run is over")
        if self._operator is None:
            if self.record.scenario.link.type == INPROC:
                raise UserError(
                    "a run in one process (link inproc) takes no commands; start it with --link shm"
                )
            self._operator = Operator(self.record.folder)
        return self._operator.command(event, by)


def _events_of(scenario: Scenario) -> dict[str, type[Event]]:
    """The kinds of events of a run, by their names; none of the grid for an island."""
    island = scenario.network is not None and scenario.network.grid is None
    return {k: kind for k, kind in EVENTS.items() if not (island and issubclass(kind, GridEvent))}


def _choices(scenario: Scenario) -> dict[str, list[str]]:
    """What fields of events may name, by the field; none of what the run has not."""
    network = scenario.network
    dumped = {} if network is None else network.model_dump(exclude_none=True)
    tables = {key: table for key, table in dumped.items() if isinstance(table, dict)}
    parts = {name: part for table in tables.values() for name, part in table.items()}
    nodes = {
        part[end] for part in parts.values() for end in ("node", "start", "end") if end in part
    }
    gains: set[str] = set()
    for law in scenario.laws():
        with contextlib.suppress(LawError):  # its file may be gone
            gains |= law_file(law).parameters.keys()
    lines = [*tables.get("lines", {}), *scenario.converters]
    return {
        "converter": scenario.converters, "name": [*parts], "line": lines, "node": sorted(nodes),
        "values": sorted(gains),
    }  # fmt: skip
