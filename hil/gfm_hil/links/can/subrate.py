"""Exchange every n-th tick only, for a bus that cannot carry more; what is held in between.

At tick k, a multiple of n, the plant sends y[k] and the controller answers u[k], which has n ticks
to arrive and is in force from k + n on (before, u[0] is): a delay of n ticks, in lockstep as in
real time. The controller steps at every tick, those in between with the y before them, just before
the next one. Frames for the ticks in between are made here, numbered so that the reader counts n
lost ones for one that the bus lost. A word of a side that leaves goes at once.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from gfm_hil.codec import buffer, crc32
from gfm_hil.frames import DATA_IDS
from gfm_hil.links.base import Side
from gfm_hil.links.can.dbc import SENDERS
from gfm_runtime.controller import RUNNING
from gfm_runtime.signals import Group, names

_CRC_BYTES = 4
_WORDS = {"plant": 0, "controller": RUNNING}  # the state of a side that is running
_KEPT = 4  # commands at hand: the one in force, its successor, and those that came early


class Frame:
    """A frame of the bench, read and written field by field.

    Args:
        group: whose.
    """

    def __init__(self, group: Group) -> None:
        self._frame, self._bytes = buffer(len(names(group)), DATA_IDS[group])
        self._head = self._bytes[:4].tobytes()
        self.ordinary = _WORDS[SENDERS[group]]

    def read(self, message: bytes) -> bool:
        """Take a message; False if it is not an undamaged frame of the vector."""
        if len(message) != len(self._bytes) or message[:4] != self._head:
            return False
        self._bytes[:] = np.frombuffer(message, np.uint8)
        return int(self._frame["crc"][0]) == crc32(self._bytes, len(message) - _CRC_BYTES)

    @property
    def tick(self) -> int:
        """Of the frame taken."""
        return int(self._frame["tick"][0])

    @property
    def sequence(self) -> int:
        """Of the frame taken."""
        return int(self._frame["sequence"][0])

    @property
    def leaves(self) -> bool:
        """Whether its sender has anything to say but values."""
        return int(self._frame["state"][0]) != self.ordinary

    def under(self, tick: int, sequence: int) -> bytes:
        """The frame taken under another tick and sequence."""
        self._frame["tick"], self._frame["sequence"] = tick, sequence & 0xFFFF_FFFF
        self._frame["crc"] = crc32(self._bytes, len(self._bytes) - _CRC_BYTES)
        return self._bytes.tobytes()


class Subrate:
    """What one side's link sends on, and what it makes of what it receives.

    Args:
        side: ours.
        every: n.
        receive: the next message of the bus.
    """

    def __init__(self, side: Side, every: int, receive: Callable[[], bytes | None]) -> None:
        self._every, self._receive = every, receive
        self._mine: Frame
        if side == "plant":
            self._mine, self._theirs, self._next = Frame("y"), Frame("u"), self._command
        else:
            self._mine, self._theirs, self._next = Frame("u"), Frame("y"), self._measurement
        self._made: deque[bytes] = deque()  # ready to be given out
        self._held, self._last = Frame("y"), b""  # measurement received last
        self._due = -1  # tick for which the plant wants a command
        # by the tick they answer: commands and their sequences but for those sent again
        self._commands: dict[int, tuple[bytes, int]] = {}
        self._again = 0
        self._given = -1  # sequence given out last

    def goes(self, message: bytes) -> bool:
        """Whether a message of ours is to be sent; asked of every one."""
        if not self._mine.read(message):
            return True
        self._due = self._mine.tick
        return self._mine.tick % self._every == 0 or self._mine.leaves

    def receive(self) -> bytes | None:
        """The next message, from the bus or made here."""
        if self._made:
            return self._made.popleft()
        return self._next()

    def _measurement(self) -> bytes | None:
        message = self._receive()
        if message is None or not self._theirs.read(message):
            return message
        tick, sequence = self._theirs.tick, self._theirs.sequence
        held = self._held
        if held.read(self._last):
            missing = min(self._every - 1, tick - held.tick - 1)
            self._made += [held.under(tick - k, sequence - k) for k in range(missing, 0, -1)]
        self._last = message
        self._made.append(message)
        return self._made.popleft()

    def _command(self) -> bytes | None:
        while True:
            message = self._receive()
            if message is None:
                break
            if not self._theirs.read(message):
                return message  # damaged: for the reader to count
            if self._theirs.tick in self._commands:  # sent again: likewise
                self._again += 1
                return self._theirs.under(self._theirs.tick, self._given)
            if self._theirs.leaves:
                return self._theirs.under(self._theirs.tick, self._given + 1)
            self._commands[self._theirs.tick] = message, self._theirs.sequence - self._again
            if len(self._commands) > _KEPT:
                del self._commands[min(self._commands)]
        in_force = max(0, (self._due // self._every - 1) * self._every)
        message, sequence = self._commands.get(in_force, (b"", 0))
        if self._due < 0 or not self._theirs.read(message):
            return None
        due, self._due = self._due, -1
        self._given = sequence + due - in_force
        return self._theirs.under(due, self._given)
