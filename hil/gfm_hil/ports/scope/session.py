"""One page's connection: who may open and control, its requests, and its messages."""

import asyncio
import contextlib
import hmac
import ipaddress
import json
import logging
import re
import secrets
import socket
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import Field, TypeAdapter, ValidationError
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed

from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.identity import Identity, address
from gfm_hil.core.rate import Rate
from gfm_hil.ports.scope.picture import PageMessage, PictureRequest, ScopePicture
from gfm_hil.ports.scope.pyramid import Pyramid

#: carries out an event and returns its tick; raises UserError with the reason of a refusal
Commander = Callable[[dict[str, Any], Identity], Awaitable[dict[str, Any]]]

SEND_S = 5.0  # timeout of a page that does not read a message
ANSWER_S = 1.0  # timeout of a page's answer to a ping where another page wants its place
PER_S, BURST = 20.0, 40  # rate limit of a page's commands

_LOG = logging.getLogger("gfmhil.scope")

#: headers of every answer: no foreign content, no inline code, no embedding in frames
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:\d+)?")  # of RFC 3986, no user


class Access:
    """Access rules of one server.

    Args:
        names: host names of the server besides addresses, localhost and this machine's name.
        operators: names of the operators who may control; each gets a token.

    Attributes:
        tokens: by the name of the operator.
    """

    def __init__(self, names: Iterable[str] = (), operators: Iterable[str] = ("operator",)) -> None:
        self._names = {"localhost", socket.gethostname().lower(), *(n.lower() for n in names)}
        self.tokens = {name: secrets.token_urlsafe(16) for name in operators}

    def refusal(self, headers: Headers) -> str:
        """The reason to refuse a request; empty if it is accepted.

        A foreign page in a user's browser must not reach the scope: not from its own address (the
        origin differs), and not through DNS rebinding, a foreign name that resolves to this server
        (the host is not ours). An address in place of a name cannot be rebound.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._ours(hosts[0]):
            return f"Host = {hosts}: not a name of this scope (--name adds one)"
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return f"Origin = {origins}: not this scope's own page"
        return ""

    def _ours(self, authority: str) -> bool:
        found = _AUTHORITY.fullmatch(authority.lower())
        if found is None:
            return False
        host = found[1].strip("[]")
        try:
            ipaddress.ip_address(host)
        except ValueError:
            return host in self._names
        return True

    def operator(self, token: str) -> str:
        """The name of the operator with this token; empty if there is none."""
        given, same = token.encode(), hmac.compare_digest
        names = [n for n, known in self.tokens.items() if same(given, known.encode())]
        return names[0] if names else ""


def in_words(kind: str, **content: Any) -> str:
    """A text message (JSON), as it is sent."""
    return json.dumps({"kind": kind, **content})


class Hello(PageMessage):
    """The first message; with a valid token the page may control."""

    kind: Literal["hello"]
    token: str = Field(max_length=200)


class Play(PageMessage):
    """Replay a finished run from ``start`` [s] at ``speed`` times real time; without a speed show
    all of it again."""

    kind: Literal["play"]
    start: float = Field(0.0, ge=0, le=1e6)
    speed: float = Field(0.0, ge=0, le=100)


class Command(PageMessage):
    """An event that the run shall carry out."""

    kind: Literal["command", "tell"]  # the latter for one version
    id: int = Field(ge=-(2**53), le=2**53)  # integers that JavaScript represents
    event: dict[str, Any]


_MESSAGE: TypeAdapter[Hello | PictureRequest | Play | Command] = TypeAdapter(
    Annotated[Hello | PictureRequest | Play | Command, Field(discriminator="kind")]
)


class Session:
    """State of one connection.

    A page gets three kinds of messages, each sent so that a slow page, or one that does not read
    at all, does not delay other pages: an answer waits for the page, and only that page waits; of
    news and of pictures only the newest is kept, and ``run`` sends it when there is room. A page
    that does not read a message within ``SEND_S`` is dropped.

    Attributes:
        operator: the operator with the page's token; empty: the page may only look.
    """

    def __init__(
        self, page: ServerConnection, pyramid: Pyramid, access: Access, command: Commander
    ) -> None:
        self._socket, self._pyramid, self._access, self._command = page, pyramid, access, command
        self.operator = ""
        self._rate = Rate("this page", PER_S, BURST)
        self._shown: ScopePicture | None = None
        self._played: tuple[float, float, float] | None = None  # start [ticks], speed, begin
        self._news: dict[str, str] = {}  # by kind
        self._picture: bytes | None = None
        self._wake = asyncio.Event()

    @property
    def peer(self) -> str:
        """Address and port of the page."""
        return address(self._socket.remote_address)

    def head(self) -> int:
        """Number of ticks that this page shows as done."""
        if self._played is None:
            return self._pyramid.done
        start, speed, since = self._played
        gone = (time.monotonic() - since) * speed / self._pyramid.record.T_s
        return min(self._pyramid.done, int(start + gone))

    async def reads(self) -> bool:
        """Whether the page answers a ping, as every browser does by itself; else it is dropped."""
        try:
            async with asyncio.timeout(ANSWER_S):
                await (await self._socket.ping())
        except (TimeoutError, ConnectionClosed):
            self._socket.transport.abort()
            return False
        return True

    def picture(self) -> None:
        """Queue the next frame, unless there is none or the page has not read the last one yet: a
        slow page sees fewer pictures, never old ones. A page whose picture cannot be made is
        dropped."""
        if self._shown is None or self._picture is not None:
            return
        try:
            self._picture = self._shown.frame(self.head())
        except Exception:
            _LOG.exception("%s: its picture cannot be made: the page is dropped", self.peer)
            self._shown = None
            self._socket.transport.abort()
        if self._picture is not None:
            self._wake.set()

    def post(self, kind: str, news: str) -> None:
        """Queue a message of a kind; a newer one replaces one that has not been sent yet."""
        self._news[kind] = news
        self._wake.set()

    async def say(self, kind: str, **content: Any) -> None:
        """Send a text message at once."""
        await self._send(in_words(kind, **content))

    async def _send(self, message: str | bytes) -> None:
        try:
            async with asyncio.timeout(SEND_S):
                await self._socket.send(message)
        except TimeoutError:
            _LOG.warning(
                "%s: has not taken a message in %g s: the page is dropped", self.peer, SEND_S
            )
            self._socket.transport.abort()

    async def run(self) -> None:
        """Process messages and send queued ones until the page disconnects."""
        sending = asyncio.create_task(self._keep_sending())
        try:
            async for text in self._socket:
                await self.hear(text)
        finally:
            sending.cancel()

    async def _keep_sending(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            while await self._wake.wait():
                self._wake.clear()
                news, self._news = self._news, {}
                for text in news.values():
                    await self._send(text)
                if self._picture is not None:
                    await self._send(self._picture)
                    self._picture = None

    async def hear(self, text: str | bytes) -> None:
        """Process one message."""
        try:
            message = _MESSAGE.validate_json(text)
            match message:
                case Hello():
                    self.operator = self._access.operator(message.token)
                    await self.say("control", granted=bool(self.operator))
                case PictureRequest():
                    self._shown = ScopePicture(self._pyramid, message, self.head())
                case Play():
                    self._play(message)
                case Command():
                    await self._carry_out(message)
        except ValidationError as problem:
            await self.say("error", text="; ".join(lines(problem)).removeprefix(": "))
        except ValueError as problem:
            await self.say("error", text=str(problem))

    def _play(self, message: Play) -> None:
        if self._pyramid.record.live:
            raise ValueError("play: the run is still going on")
        start = message.start / self._pyramid.record.T_s
        self._played = (start, message.speed, time.monotonic()) if message.speed else None

    async def _carry_out(self, message: Command) -> None:
        try:
            if not self.operator:
                raise UserError("this page may look, not touch: open the address with the token")
            if message.event.get("type") != "stop":  # a stop always passes
                self._rate.take()
            by = Identity(through="scope", name=self.operator, peer=self.peer)
            done = await self._command(message.event, by)
        except UserError as problem:
            await self.say("answer", id=message.id, ok=False, text=str(problem))
        else:
            await self.say("answer", id=message.id, ok=True, **done)
