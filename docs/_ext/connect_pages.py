"""Foreign controllers: frames, greeting and shared memory, from the code that reads and writes."""

from __future__ import annotations

import json
import re
import struct
import threading
import zlib
from queue import Empty, Queue

import numpy as np

from gfm_hil.core.terminal import markdown
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.links import ring
from gfm_hil.links.frame import DATA_IDS, MAGIC, FrameWriter, frame_dtype
from gfm_hil.links.shm import segment
from gfm_hil.scenario import load_scenario
from gfm_runtime.signals import TABLE_VERSION, VectorName, group, table_hash
from gfm_runtime.states import REASONS, RUNNING, STATES

_KINDS = {"u1": "uint8", "<u2": "uint16", "<u4": "uint32", "<u8": "uint64", "<f8": "float64"}
_MEANING = {
    "magic": f"`0x{MAGIC:04X}`",
    "version": f"of the signal table, {TABLE_VERSION}",
    "data_id": f"{DATA_IDS['y']} in a frame of $y$, {DATA_IDS['u']} in a frame of $u$",
    "state": "of the sender, see below",
    "reason": "of the sender, see below",
    "spare": "0",
    "sequence": "0 in the first frame, then one more each frame, modulo $2^{32}$",
    "tick": "$k$; a frame of $u$ has the tick of the $y$ that it answers",
    "crc": "CRC-32 over all bytes before it",
}
_EXAMPLES: dict[VectorName, tuple[float, ...]] = {
    "y": (1.0, 0.5, 1.0, 0.0, 1.0),
    "u": (0.5, 1.0, 1.0),
}
_BOOT, _T0 = "b0c1d2e3-0123-4567-89ab-cdef01234567", 81234567890123
_RUN = "0123456789abcdef"


def frame_layout() -> str:
    """Both frames side by side, and those of a run with an inner stage, a row a field."""
    layouts = {(name, inner): frame_dtype(name, inner) for inner in (False, True) for name in "yu"}
    rows = []
    names = dict.fromkeys(n for d in layouts.values() for n in (d.names or ())[:-1])
    for name in (*names, "crc"):
        places = {g: d.fields[name] for g, d in layouts.items() if d.fields and name in d.fields}
        kind = next(iter(places.values()))[0].str.lstrip("|")
        cells = [str(places[g][1]) if g in places else "–" for g in layouts]
        rows.append([f"`{name}`", _KINDS[kind], *cells, _MEANING.get(name, "p.u.")])
    rows.append(["size", "", *(str(d.itemsize) for d in layouts.values()), "bytes"])
    heads = [f"at byte of ${n}$" + ", inner stage" * inner for n, inner in layouts]
    return markdown(["field", "type", *heads, ""], rows)


def frame_examples() -> str:
    """One frame of each kind as hexadecimal bytes, with what is in it."""
    parts = []
    for name, values in _EXAMPLES.items():
        state = RUNNING if name == "u" else 0
        message = FrameWriter(name).pack(0, state, 0, np.array(values))
        assert zlib.crc32(message[:-4]) == int.from_bytes(message[-4:], "little")
        listed = ", ".join(f"{value:g}" for value in values)
        lines = [f"{at:3d}  {message[at : at + 16].hex(' ')}" for at in range(0, len(message), 16)]
        head = f"${name}[0]$ = ({listed}), state {state}, reason 0, sequence 0:"
        parts += [head, "", "```text", *lines, "```", ""]
    return "\n".join(parts)


def codes(what: str) -> str:
    """The codes of ``states`` or ``reasons``."""
    texts = STATES if what == "states" else ("none", *REASONS[1:])
    return markdown(("code", ""), [(str(k), text) for k, text in enumerate(texts)])


def signals() -> str:
    """The signal table, a row a signal."""
    rows = [
        [
            f"`{s.group}`", f"`{s.name}` (${s.symbol}$)", f"`{s.base}`", f"{s.low:g} … {s.high:g}",
            f"{s.scale:g}", s.description,
        ]
        for vector in ("y", "y_inner", "u", "u_inner", "ref", "d")
        for s in group(vector)
    ]  # fmt: skip
    heads = ["vector", "signal", "base", "range, p.u.", "on CAN, p.u. a count", ""]
    version = f"The table has version {TABLE_VERSION} and hash `{table_hash()}`."
    return f"{markdown(heads, rows)}\n\n{version}"


class _Wire:
    """One end of a link between two threads, which keeps what it has sent."""

    port = None

    def __init__(self, into: Queue[bytes], out: Queue[bytes]) -> None:
        self._into, self._out, self.sent = into, out, list[bytes]()

    def send(self, message: bytes) -> bool:
        self.sent.append(message)
        self._out.put(message)
        return True

    def receive(self) -> bytes | None:
        try:
            return self._into.get_nowait()
        except Empty:
            return None

    def wait(self, seconds: float) -> bool:
        threading.Event().wait(min(seconds, 0.001))
        return not self._into.empty()

    def close(self) -> None:
        """There is nothing to close."""


def handshake() -> str:
    """The greeting of a scenario as both sides send it; boot id, run and time are examples."""
    scenario = load_scenario("rig_pref_step", law="droop-5")
    there, back = Queue[bytes](), Queue[bytes]()
    plant, controller = _Wire(back, there), _Wire(there, back)

    def run(role, link):
        shake_hands(role, link, scenario, lambda: False, lambda text: None)

    answering = threading.Thread(target=run, args=("controller", controller), daemon=True)
    answering.start()
    run("plant", plant)
    answering.join()
    said = (
        ("plant, HELLO", plant.sent[0]),
        ("controller, HELLO", controller.sent[0]),
        ("plant, START", plant.sent[-1]),
    )
    parts = []
    for who, message in said:
        content = json.loads(message.partition(b" ")[2])
        text = message.decode("ascii")
        if "boot" in content:
            text = text.replace(json.dumps(content["boot"]), json.dumps(_BOOT))
        text = re.sub(r'("t0": )\d+', rf"\g<1>{_T0}", text)
        text = re.sub(r'("run": ")\w+', rf"\g<1>{_RUN}", text)
        text = re.sub(r"(.{1,88})(?: |$)", r"\1\n", text).rstrip()
        parts += [f"{who} ({len(message)} bytes):", "", "```text", text, "```", ""]
    return "\n".join(parts)


def shm_layout() -> str:
    """Every field of the memory with its place."""
    identity = ("process number", "its start, in clock ticks since boot", "its PID namespace")
    owner = struct.calcsize(segment._OWNER.format) - segment._PLANT.size
    rows = [
        (0, 8, "bytes", f"`{segment.MAGIC.decode()}`, eight letters"),
        (8, 8, "int64", f"layout, {segment.VERSION}"),
        *((owner + 8 * k, 8, "int64", f"controller: {what}") for k, what in enumerate(identity)),
        *(
            (segment._PLANT_AT + 8 * k, 8, "int64", f"plant: {what}; 0 if there is none")
            for k, what in enumerate(identity)
        ),
        (segment.HEADS[0], 8, "int64", "head of the first ring; the controller writes it"),
        (segment.HEADS[1], 8, "int64", "head of the second ring; the plant writes it"),
        (
            segment.BELLS[0],
            8,
            "int64",
            "bell of the first ring; the controller sets it before it sleeps",
        ),
        (
            segment.BELLS[1],
            8,
            "int64",
            "bell of the second ring; the plant sets it before it sleeps",
        ),
        (segment.RINGS[0], ring.RING, "ring", "the first ring: plant to controller"),
        (segment.RINGS[1], ring.RING, "ring", "the second ring: controller to plant"),
    ]
    assert sum(rows[-1][:2]) == segment.SIZE
    cells = [[str(cell) for cell in row] for row in (*rows, ("size", segment.SIZE, "", ""))]
    return markdown(("at byte", "bytes", "type", ""), cells)


def shm_slot() -> str:
    """A ring and its slots."""
    rows = (
        ("slots of a ring", ring.SLOTS),
        ("bytes of a slot", ring.SLOT),
        ("bytes of the stamp, at the slot's beginning", ring.WORD),
        ("longest message in bytes, right behind the stamp", ring.LONGEST),
        ("low bits of the stamp that hold the message's length", ring.LENGTH_BITS),
    )
    return markdown(("", ""), [(text, str(number)) for text, number in rows])
