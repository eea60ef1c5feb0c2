"""One page's connection: what it asks for, what it is told, and what it may do."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from gfm_hil.errors import UserError, lines
from gfm_hil.scope.access import Access
from gfm_hil.scope.pyramid import Pyramid
from gfm_hil.scope.view import Look, View

#: carries an event out, says at which tick; raises UserError with the reason of a refusal
Teller = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Hello(_Message):
    """The first message: with the right token the page may control."""

    kind: Literal["hello"]
    token: str = Field(max_length=200)


class Play(_Message):
    """A run that is over goes on as it did, from ``start`` [s] at ``speed`` times real time; with
    no speed all of it is there again."""

    kind: Literal["play"]
    start: float = Field(0.0, ge=0, le=1e6)
    speed: float = Field(0.0, ge=0, le=100)


class Tell(_Message):
    """An event for the run."""

    kind: Literal["tell"]
    id: int
    event: dict[str, Any]


_MESSAGE: TypeAdapter[Hello | Look | Play | Tell] = TypeAdapter(
    Annotated[Hello | Look | Play | Tell, Field(discriminator="kind")]
)


class Session:
    """State of one connection.

    Args:
        socket: to the page.
        pyramid: of the recording.
        access: the rules.
        tell: for commands.
    """

    def __init__(
        self, socket: ServerConnection, pyramid: Pyramid, access: Access, tell: Teller
    ) -> None:
        self._socket, self._pyramid, self._access, self._tell = socket, pyramid, access, tell
        self.control = False
        self._view: View | None = None
        self._played: tuple[float, float, float] | None = None  # start [ticks], speed, since when
        self._sending: asyncio.Task[None] | None = None

    def head(self) -> int:
        """Ticks that this page considers done."""
        if self._played is None:
            return self._pyramid.done
        start, speed, since = self._played
        gone = (time.monotonic() - since) * speed / self._pyramid.record.T_s
        return min(self._pyramid.done, int(start + gone))

    def picture(self) -> None:
        """Send the next frame, unless there is none or the page has not taken the last one yet:
        a slow page sees fewer pictures, never older ones."""
        if self._view is None or (self._sending is not None and not self._sending.done()):
            return
        frame = self._view.frame(self.head())
        if frame is not None:
            self._sending = asyncio.create_task(self._send(frame))

    async def say(self, kind: str, **content: Any) -> None:
        """A message in words."""
        await self._send(json.dumps({"kind": kind, **content}))

    async def _send(self, message: str | bytes) -> None:
        with contextlib.suppress(ConnectionClosed):
            await self._socket.send(message)

    async def listen(self) -> None:
        """Deal with messages until the page has gone."""
        async for text in self._socket:
            try:
                message = _MESSAGE.validate_json(text)
                match message:
                    case Hello():
                        self.control = self._access.may_control(message.token)
                        await self.say("control", granted=self.control)
                    case Look():
                        self._view = View(self._pyramid, message, self.head())
                    case Play():
                        self._play(message)
                    case Tell():
                        await self._command(message)
            except ValidationError as problem:
                await self.say("error", text="; ".join(lines(problem)).removeprefix(": "))
            except ValueError as problem:
                await self.say("error", text=str(problem))

    def _play(self, message: Play) -> None:
        if self._pyramid.record.live:
            raise ValueError("play: the run is still going on")
        start = message.start / self._pyramid.record.T_s
        self._played = (start, message.speed, time.monotonic()) if message.speed else None

    async def _command(self, message: Tell) -> None:
        try:
            if not self.control:
                raise UserError("this page may look, not touch: open the address with the token")
            done = await self._tell(message.event)
        except UserError as problem:
            await self.say("answer", id=message.id, ok=False, text=str(problem))
        else:
            await self.say("answer", id=message.id, ok=True, **done)
