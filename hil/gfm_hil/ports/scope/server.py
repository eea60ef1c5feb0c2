"""The scope's server: one port for page and WebSocket; it polls the run 30 times a second."""

import asyncio
import contextlib
import http
import logging
import ssl
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from gfm_hil.core.errors import UserError
from gfm_hil.core.supervised import supervised
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.scope.flows import Flows
from gfm_hil.ports.scope.recording import Recording
from gfm_hil.ports.scope.session import HEADERS, SEND_S, Access, Session, in_words
from gfm_hil.ports.scope.watched import WatchedRun
from gfm_runtime import LawError

FRAMES_PER_S = 30
_LOG_S = 0.25  # poll interval of the event log
_LARGEST = 16384  # bytes of a message from a page
_PAGES = 16  # most pages that look, and as many that control
WAITING = 64  # most connections that are not a page yet or fetch a file
HALF_OPEN_S = 10.0  # timeout for a connection to become a page
_PING_S = 10.0  # interval and timeout of pings: a dead page is dropped

_STATIC = Path(__file__).resolve().parent / "static"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_SOCKET = "/socket"
_CONVERTER = "of"  # query of a page that looks at one converter of a network, with its name
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
    """A server for one run, or for those of a network's converters.

    Args:
        records: of the runs; a page that asks for none by its converter's name gets the first.
        access: who may look and control.
    """

    def __init__(self, records: Sequence[Recording], access: Access) -> None:
        self.access, self._static = access, static_files()
        names = [record.scenario.converter or "" for record in records]
        others = names if len(names) > 1 else []
        self._runs = {
            name: WatchedRun(record, others) for name, record in zip(names, records, strict=True)
        }

        self._flows: Flows | None = None
        with contextlib.suppress(LawError):  # its file may be gone
            self._flows = Flows(self._runs) if others else None

    @property
    def _sessions(self) -> list[Session]:
        return [session for run in self._runs.values() for session in run.sessions]

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
                    supervised("the scope's poll of the events", self._follow_log),
                    supervised("the scope's connections", reap),
                )

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to a request for a file; None for the WebSocket."""
        refusal = self.access.refusal(request.headers)
        if refusal:
            return _response(http.HTTPStatus.FORBIDDEN, "text/plain; charset=utf-8", refusal)
        path, _, query = request.path.partition("?")
        if path == _SOCKET:
            asked = parse_qs(query, keep_blank_values=True)
            if _CONTROL in asked or not (full := await self._full(control=False)):
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
        gone = {s for s, reads in zip(same, read, strict=True) if not reads}
        for run in self._runs.values():
            run.sessions -= gone
        if not all(read):
            return ""
        return f"{_PAGES} pages {'control' if control else 'look'} already"

    async def _page(self, listener: Listener, connection: ServerConnection) -> None:
        """Serve one page's connection to its end. A page that announces that it will control
        takes no place of the pages that look: until its token is accepted it counts as waiting,
        and the listener drops the oldest waiting connection."""
        request = connection.request
        asked = parse_qs("" if request is None else request.path.partition("?")[2], True)
        run = self._runs.get(asked.get(_CONVERTER, [""])[0]) or next(iter(self._runs.values()))
        session = Session(connection, run.pyramid, self.access, run.command)
        with contextlib.suppress(ConnectionClosed):
            if _CONTROL in asked:
                await session.hear(await connection.recv())
            if full := await self._full(bool(session.operator)):
                await connection.close(CloseCode.TRY_AGAIN_LATER, full)
                return
            listener.exempt(connection.transport.get_extra_info("socket").fileno())
            run.sessions.add(session)
            try:
                await session.say("about", **run.about())
                await session.say("events", **run.happened())
                if self._flows is not None:
                    await session.say("network", **self._flows.diagram)
                    await session.say("flows", **self._flows.now())
                await session.run()
            finally:
                run.sessions.discard(session)

    async def _frames(self) -> None:
        """Read new ticks and send pictures, at a constant rate."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            for run in self._runs.values():
                while not run.pyramid.update():
                    await asyncio.sleep(0)
                for session in list(run.sessions):
                    session.picture()
            due = max(due + 1 / FRAMES_PER_S, loop.time())
            await asyncio.sleep(due - loop.time())

    async def _follow_log(self) -> None:
        """Send new events, and what a network does, to the pages; detect the ends of the runs."""
        while True:
            for run in self._runs.values():
                await run.follow_log()
            if self._flows is not None and (sessions := self._sessions):
                now = in_words("flows", **self._flows.now())
                for session in sessions:
                    session.post("flows", now)
            await asyncio.sleep(_LOG_S)


def _listen(host: str, ports: list[int]) -> Listener:
    for port in ports:
        try:
            return Listener(host, port, WAITING, HALF_OPEN_S, HALF_OPEN_S)
        except OSError as problem:
            reason = problem.strerror or str(problem)
    raise UserError(f"--host {host} --port {ports[0]}: {reason}")


def _response(status: http.HTTPStatus, kind: str, content: str | bytes) -> Response:
    body = content.encode() if isinstance(content, str) else content
    headers = Headers(HEADERS)
    headers["Content-Type"], headers["Content-Length"] = kind, str(len(body))
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)
