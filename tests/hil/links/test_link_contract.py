"""What every link of the registry keeps: ours, one behind impairments, one of another package."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numba import njit, types

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.drive import send_last
from gfm_hil.links import Link, LinkKind, link_kind, link_names, open_link, registry
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameReader, FrameWriter
from gfm_hil.links.impaired import Impairment
from gfm_hil.links.impaired.link import ImpairedLink
from gfm_hil.links.port import PORT_CALL
from gfm_hil.links.pump import with_port
from gfm_runtime.signals import NU, NY
from gfm_runtime.states import RUNNING, SAFE

from ...support.laws import home_plant, slow_but
from ...support.links import PATIENT, RIG, Tampering, assert_same, in_threads, run_pair
from ...support.processes import free_port

PATIENCE_S = 30


class QueueLink:
    """A link of another package: two lists in this process, and no port."""

    port = None
    ends: ClassVar[dict[str, dict[Role, list[bytes]]]] = {}

    def __init__(self, role: Role, endpoint: str, options: Any) -> None:
        queues = self.ends.setdefault(endpoint, {one: [] for one in ROLES})
        self._into, self._out = queues[role], queues[ROLES[1 - ROLES.index(role)]]
        self._open = True

    def send(self, message: bytes) -> bool:
        fits = self._open and 0 < len(message) <= LONGEST and len(self._out) < 64
        if fits:
            self._out.append(message)
        return fits

    def receive(self) -> bytes | None:
        return self._into.pop(0) if self._open and self._into else None

    def wait(self, seconds: float) -> bool:
        until = time.monotonic() + seconds
        while not self._into and time.monotonic() < until:
            time.sleep(1e-4)
        return bool(self._into)

    def close(self) -> None:
        self._open = False


QUEUE = LinkKind(
    "queue", "two lists", r"queue://.+", "queue://name", lambda place: f"queue://{place}", QueueLink
)


class Point:
    """An entry point as ``importlib.metadata`` has it."""

    name, value = "queue", "elsewhere:QUEUE"

    @staticmethod
    def load() -> LinkKind:
        return QUEUE


@pytest.fixture(autouse=True)
def queue_is_installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    def entry_points(group: str, name: str = "queue") -> list[type[Point]]:
        return [Point] if name == "queue" else []

    monkeypatch.setattr(registry, "entry_points", entry_points)
    registry.link_kind.cache_clear()
    yield
    registry.link_kind.cache_clear()


#: every way over each link of the registry: its name, options, and where it is, if not a fresh one
WAYS: dict[str, tuple[str, dict[str, Any], Callable[[], str] | None]] = {
    "shm": ("shm", {}, None),
    "zmq": ("zmq", {}, None),
    "zmq-tcp": ("zmq", {}, lambda: f"tcp://127.0.0.1:{free_port()}"),
    "zmq-portable": ("zmq", {"portable": True}, None),
    "serial": ("serial", {}, None),
    "can": ("can", {}, None),
    "can-classic": ("can", {"fd": False, "every": 4}, None),
    "can-portable": ("can", {"portable": True}, None),
    "queue": ("queue", {}, None),
    "impaired": ("shm", {}, None),
}
WHOLE = [way for way in WAYS if not way.startswith("can")]  # a CAN link quantises frames
#: the others compile a link of their own, and are of the tier full
FAST = [way for way in WAYS if not way.startswith(("can", "serial", "impaired"))]
Ends = dict[Role, Link]


@pytest.fixture(params=slow_but(FAST, WAYS))
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def ends(way: str, place: Path) -> Iterator[Ends]:
    """Both ends; a message has gone from the plant to the controller."""
    name, options, where = WAYS[way]
    endpoint = where() if where else link_kind(name).fresh(place)
    links: Ends = {role: open_link(name, role, endpoint, options) for role in ROLES}
    if way == "impaired":
        links = {r: ImpairedLink(x, Impairment(delay=1e-5), r) for r, x in links.items()}

    def meet(role: Role) -> None:  # the plant may have to wait for its peer
        if role == "plant":
            while not links["plant"].send(b"GFMHIL"):
                links["plant"].wait(1e-3)
        else:
            assert take(links["controller"]) == b"GFMHIL"

    assert in_threads(meet) == dict.fromkeys(ROLES)
    yield links
    for link in links.values():
        link.close()


def take(link: Link) -> bytes | None:
    """The next message, if it comes within a time."""
    until = time.monotonic() + PATIENCE_S
    while (message := link.receive()) is None and time.monotonic() < until:
        link.wait(0.05)
    return message


def test_all_links_of_the_registry_are_here():
    assert {name for name, _, _ in WAYS.values()} == set(link_names())


def test_a_link_that_cannot_be_loaded_is_named(monkeypatch):
    for found, said in ((lambda: 1 / 0, "cannot be loaded: division"), (int, "not a LinkKind")):
        monkeypatch.setattr(Point, "load", staticmethod(found))
        registry.link_kind.cache_clear()
        with pytest.raises(UserError, match=said):
            open_link("queue", "plant", "queue://x")
    with pytest.raises(UserError, match=r"'pigeon': must be one of \[.*'queue'.*'zmq'"):
        open_link("pigeon", "plant", "ipc://x")


FRAMES: dict[Role, bytes] = {
    "plant": FrameWriter("y").pack(0, RUNNING, 0, np.arange(NY) / 16),
    "controller": FrameWriter("u").pack(0, RUNNING, 0, np.arange(NU) / 16),
}


@pytest.mark.parametrize("ways", [ROLES, ROLES[::-1]])
def test_messages_arrive_whole_and_in_order(way, ends, ways):
    sender, receiver = (ends[role] for role in ways)
    sizes = (1, 68, 84, 255, LONGEST) if way in WHOLE else ()
    sent = [FRAMES[ways[0]], *(bytes(k % 251 for k in range(size)) for size in sizes)]
    for message in sent:
        assert sender.send(message)
    for message in sent:
        came = take(receiver)
        assert came is not None and len(came) == len(message)
        if way in WHOLE:
            assert came == message
    assert receiver.receive() is None
    assert not receiver.wait(1e-3)


def test_a_message_that_no_link_carries_is_dropped(way, ends):
    assert not ends["plant"].send(bytes(LONGEST + 1))
    assert ends["plant"].send(FRAMES["plant"])
    assert len(take(ends["controller"]) or b"") == len(FRAMES["plant"])


def test_a_reader_that_stalls_costs_a_bounded_memory_and_no_time(ends):
    """What it has not read is limited; then the newest are dropped."""
    begin = time.monotonic()
    writer = FrameWriter("y")
    for k in range(5000):
        ends["plant"].send(writer.pack(k, RUNNING, 0, np.ones(NY)))
    assert time.monotonic() - begin < PATIENCE_S
    count, begin = 0, time.monotonic()
    while ends["controller"].wait(0.2) or (count < 60 and time.monotonic() - begin < PATIENCE_S):
        count += ends["controller"].receive() is not None
    assert 60 <= count < 3000


def test_the_last_frame_waits_for_room(way, ends):
    """It must, if the peer is many frames behind at the end of a run."""
    plant, controller, reader = ends["plant"], ends["controller"], FrameReader("y")
    if way == "impaired":
        pytest.skip("a stage drops what its queue cannot keep")
    writer, values = FrameWriter("y"), np.zeros(NY)
    for tick in range(100):
        plant.send(writer.pack(tick, 0, 0, values))

    def listen() -> None:
        until = time.monotonic() + PATIENCE_S
        while reader.state != SAFE and time.monotonic() < until:
            message = controller.receive()
            if message is None:
                controller.wait(0.01)
            else:
                reader.unpack(message, np.zeros(NY))

    thread = threading.Thread(target=listen)
    thread.start()
    send_last(plant, writer, 100, SAFE, 0, values)
    until = time.monotonic() + PATIENCE_S
    while thread.is_alive() and time.monotonic() < until:
        plant.receive()  # a line goes on with what it has begun
        thread.join(0.01)
    assert reader.tick == 100 and reader.state == SAFE


def test_what_was_sent_last_arrives_after_its_sender_has_closed(way, ends):
    if way == "serial":
        pytest.skip("a pseudo terminal ends with its last descriptor")
    assert ends["plant"].send(FRAMES["plant"])
    ends["plant"].close()
    assert len(take(ends["controller"]) or b"") == len(FRAMES["plant"])


_FUNCTION = types.FunctionType(PORT_CALL)


@njit(types.int64(_FUNCTION, types.int64[::1], types.uint8[::1]), nogil=True)
def call(function, handle, message):
    """Call it as the loops do."""
    return function(handle, message)


def test_the_port_sends_and_receives_the_same(way, ends):
    """Directly, or by a thread that pumps the messages of a link without a port."""
    links = {role: with_port(link) for role, link in ends.items()}
    for link in links.values():
        getattr(link, "start", lambda: None)()
    try:
        for role, other in zip(ROLES, ROLES[::-1], strict=True):
            message = np.frombuffer(bytearray(FRAMES[role]), np.uint8)
            room, port = np.zeros(LONGEST, np.uint8), links[other].port
            until = time.monotonic() + PATIENCE_S
            assert call(port.receive, port.handle, room) == 0
            assert call(links[role].port.send, links[role].port.handle, message) == 1
            size = 0
            while size == 0 and time.monotonic() < until:
                size = call(port.patient or port.receive, port.handle, room)
            assert size == len(message)
            if way in WHOLE:
                assert room[:size].tobytes() == FRAMES[role]
    finally:
        for link in links.values():
            getattr(link, "stop", lambda: None)()


def test_a_pumped_link_sends_what_comes_while_it_is_told_to_stop():
    """Between the thread's look for a message of the loop and its look whether to stop."""

    class Late(QueueLink):
        def receive(self) -> None:
            if not pumped._stopping.is_set():
                assert pumped.send(b"the last")
                pumped._stopping.set()

    pumped = with_port(Late("plant", "late", {}))
    pumped.start()
    assert pumped._stopping.wait(PATIENCE_S)
    pumped.stop()
    assert QueueLink.ends["late"]["controller"] == [b"the last"]


def test_a_closed_end_does_nothing(way, ends):
    link = ends["plant"]
    link.close()
    if way in ("zmq", "zmq-tcp", "shm", "can", "can-classic", "impaired"):
        room = np.zeros(LONGEST, np.uint8)
        assert call(link.port.send, link.port.handle, room[:60]) == 0
        assert call(link.port.receive, link.port.handle, room) == 0


CONTENT = {
    "law": "vsg-2",
    "duration": 0.03,
    "seed": 3,
    "link": PATIENT,
    "plant": {**RIG, **home_plant("vsg-2")},
    "events": [{"tick": 50, "type": "reference", "P_ref": 0.55}],
}


@pytest.mark.parametrize("lossy", slow_but([True], [False, True]))
@pytest.mark.parametrize("way", slow_but(["shm"], WHOLE), indirect=True)
def test_a_run_in_lockstep_has_the_bits_of_the_run_in_process(way, lossy, make, run, place):
    """Also if frames are lost or repeated: the plant asks for them again."""
    name, options, where = WAYS[way]

    def touch(role: Role, link: Link) -> Any:
        dropped = (20, 21, 40) if role == "plant" else (30, 60)
        return Tampering(link, lambda k, m: None if k in dropped else m) if lossy else link

    content = dict(CONTENT)
    if way == "impaired":
        impairment = {"duplicate": 0.05, "reorder": 0.05, "corrupt": 0.05}
        content["link"] = {**PATIENT, "impairment": impairment}
    found = run_pair(
        make(**content), place, name, options, touch, endpoint=where() if where else None
    )
    assert np.ptp(found.signals["true_p"]) > 0
    assert_same(found.signals, run(**CONTENT).signals)
    if not lossy and way != "impaired":
        assert not any(n for f in found.faults.values() for k, n in f.items() if k != "repeated")
        assert not any(n for counts in found.counters.values() for n in counts.values())
