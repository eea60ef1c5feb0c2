"""The scope's server: one port for page and WebSocket; it polls the run 30 times a second."""

import asyncio
import contextlib
import http
import logging
import os
import socket
import ssl
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity
from gfm_hil.core.supervised import supervised
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.scope.channels import make_channels, si_bases
from gfm_hil.ports.scope.pyramid import Pyramid
from gfm_hil.ports.scope.recording import Recording
from gfm_hil.ports.scope.session import HEADERS, SEND_S, Access, Session, in_words
from gfm_hil.recording.run import bases
from gfm_hil.scenario import INPROC, Scenario
from gfm_hil.scenario.events import EVENTS
from gfm_runtime import LawError, law_file, law_titles
from gfm_runtime.signals import group
from gfm_runtime.states import STATES

FRAMES_PER_S = 30
_LOG_S = 0.25  # poll interval of the event log
_LARGEST = 16384  # bytes of a message from a page
_PAGES = 16  # most pages that look, and as many that control
WAITING = 64  # most connections that are not a page yet or fetch a file
HALF_OPEN_S = 10.0  # timeout for a connection to become a page
_PING_S = 10.0  # interval and timeout of pings: a dead page is dropped
_EVENTS = 500  # newest events that are sent to pages

_STATIC = Path(__file__).resolve().parent / "static"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_SOCKET = "/socket"
_CONTROL = "control"  # query of a page that sends its token first and waits for the answer

_LOG = logging.getLogger("gfmhil.scope")  # clients other than browsers are no error
_LOG.addFilter(lambda record: "handshake" not in record.getMessage())


def static_files() -> dict[str, tuple[str, bytes]]:
    """All served files by path: content type and content."""
    found = {
        f"/{path.relative_to(_STATIC).as_posix()}": (_TYPES[path.suffix], path.read_bytes())
        for path in _STATIC.rglob("*")
        if path.suffix in _TYPES
    }
    return {**found, "/": found["/index.html"]}


class Scope:
    """A server for one run."""

    def __init__(self, record: Recording, access: Access) -> None:
        self.record, self.access = record, access
        self._pyramid = Pyramid(record, make_channels(record.T_s, record.f_b))
        self._sessions: set[Session] = set()
        self._events = record.events()
        self._ended = record.ended()
        self._static = static_files()
        self._operator: Operator | None = None
        self._commands = asyncio.Lock()

    async def serve(
        self,
        host: str,
        ports: list[int],
        encryption: ssl.SSLContext | None,
        ready: Callable[[int], None],
    ) -> None:
        """Serve until cancelled, by https if there is a TLS context, at the first of the ports that
        can be bound (0: any free one); ``ready`` is called with it. Raises UserError: none of the
        ports can be bound."""
        with _listen(host, ports) as listener:

            async def reap() -> None:
                while True:
                    listener.reap()
                    await asyncio.sleep(_LOG_S)

            async with serve(
                partial(self._page, listener), sock=listener, ssl=encryption,
                process_request=self._answer, compression=None, max_size=_LARGEST, max_queue=8,
                server_header=None, logger=_LOG, ping_interval=_PING_S, ping_timeout=_PING_S,
                close_timeout=SEND_S,
            ):  # fmt: skip
                ready(listener.port)
                await asyncio.gather(
                    supervised("the scope's pictures", self._frames),
                    supervised("the scope's look at events", self._follow_log),
                    supervised("the scope's connections", reap),
                )

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request for a file; None for the WebSocket."""
        refusal = self.access.refusal(request.headers)
        if refusal:
            return _response(http.HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", refusal)
        path, _, query = request.path.partition("?")
        if path == _SOCKET:
            if query == _CONTROL or not (full := await self._full(control=False)):
                return None
            return _response(http.HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", full)
        if path not in self._static:
            return _response(http.HTTPStatus.NOT_FOUND, "text/plain", "not found")
        kind, content = self._static[path]
        return _response(http.HTTPStatus.OK, kind, content)

    async def _full(self, control: bool) -> str:
        """What leaves no room for another page that controls, or that only looks; or "". Pages
        that do not read make room."""
        same = [s for s in self._sessions if bool(s.operator) == control]
        if len(same) < _PAGES:
            return ""
        read = await asyncio.gather(*(session.reads() for session in same))
        self._sessions -= {s for s, reads in zip(same, read, strict=True) if not reads}
        if not all(read):
            return ""
        return f"{_PAGES} pages {'control' if control else 'look'} already"

    async def _page(self, listener: Listener, connection: ServerConnection) -> None:
        """Serve one page's connection to its end. A page that announces that it will control
        takes no place of the pages that look: until its token is accepted it counts as waiting,
        and the listener drops the oldest waiting connection."""
        session = Session(connection, self._pyramid, self.access, self._command)
        with contextlib.suppress(ConnectionClosed):
            request = connection.request
            if request is not None and request.path.partition("?")[2] == _CONTROL:
                await session.hear(await connection.recv())
            if full := await self._full(bool(session.operator)):
                await connection.close(CloseCode.TRY_AGAIN_LATER, full)
                return
            listener.keep(connection.transport.get_extra_info("socket").fileno())
            self._sessions.add(session)
            try:
                await session.say("about", **self._about())
                await session.say("events", **self._happened())
                await session.run()
            finally:
                self._sessions.discard(session)

    async def _frames(self) -> None:
        """Read new ticks and send pictures, at a constant rate."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            while not self._pyramid.update():
                await asyncio.sleep(0)
            for session in list(self._sessions):
                session.picture()
            due = max(due + 1 / FRAMES_PER_S, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _follow_log(self) -> None:
        """Send new events to the pages, and detect the end of the run."""
        said = self._happened()
        while True:
            self._events = await asyncio.to_thread(self.record.events)
            self._ended = self.record.ended()
            if self._ended and self.record.live:
                self.record.finish()
            self.record.look_up_laws()
            now = self._happened()
            if now != said:
                news = in_words("events", **now)
                for session in list(self._sessions):
                    session.post(news)
            said = now
            await asyncio.sleep(_LOG_S)

    def _happened(self) -> dict[str, Any]:
        events = self._events[-_EVENTS:]
        return {"events": events, "summary": self._ended, "labels": self.record.laws}

    def _about(self) -> dict[str, Any]:
        """The run's data that a page needs; no file names, only the scenario's title."""
        s = self.record.scenario
        return {
            "title": s.title,
            "live": self.record.live,
            "commands": self.record.live and s.link.type != INPROC,
            "mode": s.mode,
            "link": s.link.type,
            "T_s": self.record.T_s,
            "capacity": self.record.capacity,
            "f_b": self.record.f_b,
            "channels": [channel.about() for channel in self._pyramid.channels],
            "states": STATES,
            "labels": self.record.laws,
            "laws": [*law_titles(s.laws()).items()],
            "limits": {r.name: [r.low, r.high] for r in group("ref")},
            "bases": si_bases(bases(s)),
            "events": {name: kind.model_json_schema() for name, kind in EVENTS.items()},
            "choices": _choices(s),
        }

    async def _command(self, event: dict[str, Any], by: Identity) -> dict[str, Any]:
        async with self._commands:
            return await asyncio.to_thread(self._command_now, event, by)

    def _command_now(self, event: dict[str, Any], by: Identity) -> dict[str, Any]:
        if not self.record.live:
            raise UserError("the run is over")
        if self._operator is None:
            if self.record.scenario.link.type == INPROC:
                raise UserError("a run in one process (link inproc) takes no commands")
            self._operator = Operator(self.record.folder)
        return self._operator.command(event, by)


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


def _listen(host: str, ports: list[int]) -> Listener:
    for port in ports:
        try:
            return Listener(host, port, WAITING, HALF_OPEN_S, HALF_OPEN_S)
        except socket.gaierror as problem:
            reason = problem.strerror
        except OSError as problem:
            reason = os.strerror(problem.errno) if problem.errno else str(problem)
    raise UserError(f"--host {host} --port {ports[0]}: {reason}")


def _response(status: http.HTTPStatus, kind: str, content: str | bytes) -> Response:
    body = content.encode() if isinstance(content, str) else content
    headers = Headers(HEADERS)
    headers["Content-Type"], headers["Content-Length"] = kind, str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
