"""The XCP slave: commands in, responses out (ASAM MCD-1 XCP 1.x, part 2; UDP/IP of part 3).

It has the commands with which a tool measures by polling and calibrates; DAQ lists, seed and key,
pages and programming are not there, and are answered by ERR_CMD_UNKNOWN. One master at a time.
"""

import struct
import time
from collections.abc import Callable
from typing import Any

from gfm_hil.core.identity import Identity, address
from gfm_hil.ports.port import Refusal
from gfm_hil.ports.xcp.memory import NOT_NOW, OUT_OF_RANGE, WRITE_PROTECTED, Memory

MOST = 255  # bytes of a command and of a response, at most: MAX_CTO
_HEADER = struct.Struct("<HH")  # LEN and CTR of XCP on Ethernet
_LARGEST, _SHORT = 65507, 32  # bytes: what UDP carries, and a few short answers
_MOST_PRINTED = 1000  # lines about refusals
_IDLE_S = 30.0  # after so long without a command another master may connect

CONNECT, DISCONNECT, GET_STATUS, SYNCH, GET_COMM_MODE_INFO, GET_ID = range(0xFF, 0xF9, -1)
SET_MTA, UPLOAD, SHORT_UPLOAD, DOWNLOAD, SHORT_DOWNLOAD = 0xF6, 0xF5, 0xF4, 0xF0, 0xED
_RES, _ERR = 0xFF, 0xFE
CMD_SYNCH, CMD_UNKNOWN, CMD_SYNTAX = 0x00, 0x20, 0x21

_CAL = 1  # RESOURCE: calibration
_GET_COMM_MODE_INFO_IS_THERE = 0x80  # COMM_MODE_BASIC: little-endian, addresses count bytes
_VERSION, _DRIVER = 1, 0x10
# types of GET_ID: ASCII, name of the A2L file, the file itself, what the memory is of
_TEXT, _NAME, _FILE, _EPK = 0, 1, 4, 5
_A2L = 1  # address extension of the A2L file
_LEAST = {  # bytes of a command, by its code
    CONNECT: 2, DISCONNECT: 1, GET_STATUS: 1, SYNCH: 1, GET_COMM_MODE_INFO: 1, GET_ID: 2,
    SET_MTA: 8, UPLOAD: 2, SHORT_UPLOAD: 8, DOWNLOAD: 2, SHORT_DOWNLOAD: 8,
}  # fmt: skip


class Slave:
    """One slave.

    Args:
        memory: what the master reads and writes.
        name: of the A2L file, and what the slave calls itself.
        a2l: the A2L file.
        writes: whether the master may write.
        notice: gets a line for each refusal, of the first ``_MOST_PRINTED``.
        clock: monotonic time, s.
        most: bytes of a command and of a response on its line.
    """

    def __init__(
        self,
        memory: Memory,
        name: str,
        a2l: str,
        writes: bool,
        notice: Callable[[str], None] = lambda text: None,
        clock: Callable[[], float] = time.monotonic,
        most: int = MOST,
    ) -> None:
        self._memory, self._name, self._a2l = memory, name, a2l.encode()
        self._writes, self._notice, self._clock, self._most = writes, notice, clock, most
        self._master: Any = None
        self._heard = 0.0
        self._counter = self._printed = 0
        self._at = (0, 0)  # MTA: extension and address

    def take(self, datagram: bytes, peer: Any) -> bytes:
        """The answer to a datagram from a peer's socket address; empty for none.

        That to a datagram which connects is no longer than the datagram, or than a few short
        answers: its sender's address may be forged, and belong to a machine that asked nothing.
        """
        out, rest = b"", datagram
        room = _LARGEST if peer == self._master else max(len(datagram), _SHORT)
        while len(rest) >= _HEADER.size:
            length, _ = _HEADER.unpack_from(rest)
            packet = rest[_HEADER.size : _HEADER.size + length]
            rest = rest[_HEADER.size + length :]
            whole = 1 <= length <= self._most and len(packet) == length
            response = self.packet(packet if whole else b"", peer)
            if len(out) + _HEADER.size + len(response) > room:
                break
            if response:
                out += _HEADER.pack(len(response), self._counter) + response
                self._counter = (self._counter + 1) % 2**16
            if not whole:
                break  # nobody knows where the next packet begins
        return out

    def packet(self, packet: bytes, peer: Any) -> bytes:
        """The answer to a packet from a peer; empty for none."""
        now = self._clock()
        if self._master is not None and now - self._heard > _IDLE_S:
            self._master = None
        connects = packet[:1] == bytes([CONNECT]) and len(packet) >= 2
        if self._master != peer:
            if not connects:
                return b""  # as the standard wants it of a slave that is not connected
            if self._master is not None:
                return bytes([_ERR, NOT_NOW])
        self._master, self._heard = peer, now
        try:
            if not packet or len(packet) < _LEAST.get(packet[0], 1):
                raise Refusal(CMD_SYNTAX, "a packet is not as its length or its command wants it")
            return bytes([_RES]) + self._execute(packet, peer)
        except Refusal as problem:
            if problem.code != CMD_SYNCH:
                self._print_refusal(f"refused: {problem}")
            return bytes([_ERR, problem.code])

    def _print_refusal(self, text: str) -> None:
        self._printed += 1
        if self._printed <= _MOST_PRINTED:
            last = "; further refusals are not told" if self._printed == _MOST_PRINTED else ""
            self._notice(text + last)

    def _execute(self, packet: bytes, peer: Any) -> bytes:
        """What follows the code of a positive response. Raises Refusal: the response is an
        error."""
        command, count = packet[0], packet[1] if len(packet) > 1 else 0
        if command == CONNECT:
            self._at = (0, 0)
            resource = _CAL if self._writes else 0
            sizes = struct.pack("<BH", self._most, self._most)
            return bytes([resource, _GET_COMM_MODE_INFO_IS_THERE]) + sizes + bytes([_VERSION] * 2)
        if command == DISCONNECT:
            self._master = None
            return b""
        if command == GET_STATUS:  # no session flags, nothing protected
            return bytes(5)
        if command == SYNCH:
            raise Refusal(CMD_SYNCH, "")
        if command == GET_COMM_MODE_INFO:
            return bytes([0, 0, 0, 0, 0, 0, _DRIVER])
        if command == GET_ID:
            return self._identification(count)
        if command in (SET_MTA, SHORT_UPLOAD, SHORT_DOWNLOAD):
            extension, at = struct.unpack_from("<BI", packet, 3)
            self._at = (extension, at)
        if command in (UPLOAD, SHORT_UPLOAD):
            return self._read(count)
        if command in (DOWNLOAD, SHORT_DOWNLOAD):
            data = packet[2 if command == DOWNLOAD else 8 :]
            if len(data) < count:
                raise Refusal(CMD_SYNTAX, "a command is too short")
            self._write(data[:count], peer)
        elif command != SET_MTA:
            raise Refusal(CMD_UNKNOWN, f"command {command:#x} is not there")
        return b""

    def _identification(self, kind: int) -> bytes:
        texts = {_TEXT: self._name, _NAME: self._name, _EPK: self._memory.epk}
        text = texts.get(kind, "").encode()
        if kind == _FILE:
            self._at = (_A2L, 0)
            return struct.pack("<BHI", 0, 0, len(self._a2l))  # the master reads it by UPLOAD
        return struct.pack("<BHI", 1, 0, len(text)) + text

    def _read(self, count: int) -> bytes:
        extension, at = self._at
        if not 1 <= count < self._most:
            raise Refusal(OUT_OF_RANGE, f"{count} bytes must be 1 to {self._most - 1}")
        if extension == _A2L:
            found = self._a2l[at : at + count]
        elif extension == 0:
            found = self._memory.read(at, count)
        else:
            raise Refusal(OUT_OF_RANGE, f"address extension {extension} is not there")
        if len(found) < count:
            raise Refusal(OUT_OF_RANGE, f"{at:#x}: there is no such memory")
        self._at = (extension, at + count)
        return found

    def _write(self, data: bytes, peer: Any) -> None:
        extension, at = self._at
        if extension or not self._writes:
            raise Refusal(WRITE_PROTECTED, "is served to be read; --write lets tools write")
        self._memory.write(at, data, Identity(through="xcp", peer=address(peer)))
        self._at = (extension, at + len(data))
