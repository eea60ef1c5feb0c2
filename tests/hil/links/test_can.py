"""Both sides over a CAN bus on the loopback device, in two threads of this process."""

import errno
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numba import njit

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.links import Link, link_kind, open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.can.dbc import write_dbc
from gfm_hil.links.can.loopback import LoopbackBus
from gfm_hil.links.frame import FrameWriter
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import Group, names

from ...support.can_reference import quantised_run
from ...support.links import PATIENT, Tampering, in_threads, run_pair

pytestmark = pytest.mark.processes

KIND = link_kind("can")
RIG = {
    "delay": {"samples": 1, "fraction": 0.3},
    "adc": "DS2004",
    "dac": "DS2101",
    "sensors": {"bandwidth_hz": 300.0, "noise_std": {"p": 1e-4, "V": 1e-4}},
}
EVENTS = [
    {"tick": 50, "type": "reference", "P_ref": 0.55},
    {"tick": 150, "type": "grid-frequency", "f_hz": 49.99},
]


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return KIND.fresh(tmp_path)


@pytest.fixture
def stranger(endpoint: str) -> Iterator[LoopbackBus]:
    """A third node on the same bus."""
    bus = LoopbackBus(endpoint.partition("://")[2])
    yield bus
    bus.shutdown()


def both_roles(
    scenario: Scenario,
    folder: Path,
    endpoint: str,
    touch: Callable[[Role, Link], Link] = lambda role, link: link,
    **options: Any,
) -> tuple[dict[str, np.ndarray], dict[Role, tuple[dict, dict]]]:
    """Run a scenario over CAN: the signals, and each side's faults and counters."""
    pair = run_pair(scenario, folder, "can", options, touch, endpoint=endpoint)
    return pair.signals, {role: (pair.faults[role], pair.counters[role]) for role in ROLES}


def as_in_process(
    scenario: Scenario, folder: Path, endpoint: str, *may: str, **options: Any
) -> tuple[dict[str, np.ndarray], list[dict]]:
    """Run a scenario over CAN and see that its bits are those of a run in process in counts, and
    that it has no faults but those that there may be, and repeated ticks, as on a busy machine;
    returns the signals, and each side's counters."""
    apart, found = both_roles(scenario, folder, endpoint, **options)
    for name, column in quantised_run(scenario, folder, options.get("every", 1)).items():
        assert apart[name].tobytes() == column.tobytes(), name
    for faults, _ in found.values():
        assert not {f: n for f, n in faults.items() if n and f not in ("repeated", *may)}
    return apart, [counters for _, counters in found.values()]


BOTH_WAYS = pytest.mark.parametrize("portable", [True, False])


@BOTH_WAYS
@pytest.mark.parametrize(
    ("law", "plant"), [("mimo-gfm", {}), ("vsg-2", {}), ("mimo-gfm-deployable", RIG)]
)
def test_lockstep_over_can_is_a_run_in_process_in_counts(
    law, plant, portable, make, run, tmp_path, endpoint
):
    content = {"law": law, "plant": plant, "duration": 0.03, "seed": 7}
    content |= {"link": PATIENT, "events": EVENTS}
    apart, counters = as_in_process(make(**content), tmp_path, endpoint, portable=portable)
    assert np.ptp(apart["true_p"]) > 0 and not any(any(of.values()) for of in counters)
    if not plant:  # a rig's 12-bit D/A is coarser, and both roundings add up
        exact = run(**content).signals
        assert 0 < np.abs(exact["true_p"] - apart["true_p"]).max() < 2e-3


JUMP = {"tick": 100, "type": "grid-phase-jump", "degrees": -25.0}


@BOTH_WAYS
@pytest.mark.parametrize(("every", "fd"), [(1, True), (2, True), (8, False)])
def test_with_an_inner_stage(every, fd, portable, make, run, tmp_path, endpoint):
    content = {"law": "vsg-2", "plant": {"grid": {"scr": 3.0, "x_over_r": 10.0}}}
    content |= {"inner": "virtual-stator", "duration": 0.0304, "link": PATIENT}
    content["events"] = [*EVENTS, JUMP]
    if every > 1:  # the current loop does not stand that delay: end before the plant trips
        content |= {"duration": 0.008, "events": EVENTS[:1]}
    options = {"every": every, "fd": fd, "portable": portable}
    apart, counters = as_in_process(make(**content), tmp_path, endpoint, "lost", **options)
    assert "y_i_oq" in apart and (apart["u_E_q"] != 0).all()
    assert not any(any(of.values()) for of in counters)
    if every == 1:
        exact = run(**content).signals
        assert 0 < np.abs(exact["true_p"] - apart["true_p"]).max() < 2e-2


def test_one_side_alone_with_an_inner_stage_is_named(make, endpoint):
    """Both sides compare the definitions of the frames that they use."""

    def meet(role: Role) -> Exception | None:
        inner = role == "plant"
        end = open_link("can", role, endpoint, {}, inner)
        try:
            scenario = make(law="vsg-2", inner="cascaded" if inner else "none", link=PATIENT)
            shake_hands(role, end, scenario, lambda: False, lambda text: None)
        finally:
            end.close()

    for problem in in_threads(meet).values():
        assert isinstance(problem, PeerLost)
        assert "or one side alone has an inner stage" in str(problem)


@BOTH_WAYS
@pytest.mark.parametrize(("every", "fd"), [(2, True), (4, False), (7, True)])
def test_every_nth_tick_only_is_a_hold_and_a_delay(every, fd, portable, make, tmp_path, endpoint):
    content = {"duration": 0.0302, "law": "vsg-2", "link": PATIENT, "events": EVENTS}
    options = {"every": every, "fd": fd, "portable": portable}
    as_in_process(make(**content), tmp_path, endpoint, **options)


def test_any_backend_of_python_can(make, tmp_path):
    """With python-can's virtual bus for tests, classic CAN: a vector in two frames."""
    scenario = make(duration=0.02, law="vsg-2", link=PATIENT, events=EVENTS)
    options = {"interface": "virtual", "fd": False, "every": 4}
    apart, _ = both_roles(scenario, tmp_path, "can://test", **options)
    assert apart["true_p"].tobytes() == quantised_run(scenario, tmp_path, 4)["true_p"].tobytes()


@BOTH_WAYS
def test_a_flood_of_frames_of_others_changes_nothing(portable, make, tmp_path, endpoint, stranger):
    scenario = make(duration=0.05, link=PATIENT, events=EVENTS)
    over = threading.Event()
    others = [n for n in range(0, 0x700, 7) if not 0x100 <= n <= 0x120]

    def send(number: int) -> None:
        stranger.send(can.Message(arbitration_id=number, is_extended_id=False, data=b"?"))

    def flood() -> None:
        for number in itertools.cycle(others):
            if over.wait(1e-4):  # a real bus carries no more
                return
            send(number)

    thread = threading.Thread(target=flood)

    def touch(role: Role, link: Link) -> Link:
        if role == "controller":  # both are on the bus, after the handshake
            send(others[0])  # at least one, even if the other thread hardly runs
            thread.start()
        return link

    try:
        apart, found = both_roles(scenario, tmp_path, endpoint, touch, portable=portable)
    finally:
        over.set()
        if thread.is_alive():
            thread.join()
    assert apart["true_p"].tobytes() == quantised_run(scenario, tmp_path)["true_p"].tobytes()
    for faults, counters in found.values():
        assert not {f: n for f, n in faults.items() if n and f != "repeated"}
        assert counters["foreign"] > 0


@BOTH_WAYS
def test_frames_in_our_name_without_our_check_are_refused(
    portable, make, tmp_path, endpoint, stranger
):
    """Each fault counts under its name; good frames are still accepted, and the run continues."""
    scenario = make(duration=0.02, link=PATIENT, events=EVENTS)
    bad = 20
    disturbance = can.Message(
        arbitration_id=0x120, is_extended_id=False, is_fd=True, data=bytes(12)
    )
    late = can.Message(  # a greeting between the frames
        arbitration_id=0x700, is_extended_id=False, is_fd=True, data=b"\0\7GFMHIL "
    )

    def touch(role: Role, link: Link) -> Link:
        if role == "controller":  # after the handshake: later frames go to the loops
            for _ in range(bad):
                stranger.send(disturbance)
            stranger.send(late)
        return link

    apart, found = both_roles(scenario, tmp_path, endpoint, touch, portable=portable)
    assert apart["true_p"].tobytes() == quantised_run(scenario, tmp_path)["true_p"].tobytes()
    faults, _ = found["controller"]
    assert faults["crc"] == bad
    assert sum(faults.values()) - faults["repeated"] == bad
    # for the plant they are frames of the vector that it sends itself
    assert found["plant"][1]["foreign"] == bad + 1


@pytest.fixture
def portable() -> bool:
    """Whether python-can carries the frames; to be parametrized."""
    return False


@pytest.fixture
def pair(endpoint: str, portable: bool) -> Iterator[dict[Role, Any]]:
    """Both ends of a link."""
    ends = {role: open_link("can", role, endpoint, {"portable": portable}) for role in ROLES}
    yield ends
    for end in ends.values():
        end.close()


def frame(name: Group, tick: int) -> bytes:
    writer = FrameWriter(name)
    writer.sequence[0] = tick
    return writer.pack(tick, 2, 0, np.array([1.0] * len(names(name))))


def greet(pair: dict[Role, Any], text: bytes) -> bytes | None:
    """Send a message of the handshake from the plant to the controller."""
    found = in_threads(
        lambda role: pair[role].send(text) if role == "plant" else received(pair[role])
    )
    return found["controller"] if found["plant"] is True else None


def received(end: Link) -> bytes | None:
    until = time.monotonic() + 5
    while (message := end.receive()) is None and time.monotonic() < until:
        end.wait(0.01)
    return message


@pytest.mark.parametrize("fd", [True, False])
@BOTH_WAYS
def test_messages_of_the_handshake_arrive_whole(portable, fd, endpoint):
    options = {"portable": portable, "fd": fd, "every": 4}
    pair = {role: open_link("can", role, endpoint, options) for role in ROLES}
    try:
        assert not pair["plant"].send(bytes(300))  # nobody takes it
        for text in (b"", b"x", bytes(range(256)), b"\7" * LONGEST):
            assert greet(pair, text) == text
        assert not any(end.counters["damaged_messages"] for end in pair.values())
    finally:
        for end in pair.values():
            end.close()


def test_a_damaged_message_of_the_handshake_is_counted(pair, stranger):
    """A second part under a number that is not the next one."""
    for data in (b"\x10\x50" + bytes(62), b"\x25" + bytes(63)):
        stranger.send(
            can.Message(arbitration_id=0x700, is_extended_id=False, is_fd=True, data=data)
        )
        assert pair["controller"].wait(5)
        assert pair["controller"].receive() is None
    assert pair["controller"].counters["damaged_messages"] == 1
    assert greet(pair, b"next") == b"next"


@pytest.mark.parametrize("every", [1, 4])
def test_exchanges_lost_in_lockstep_are_asked_for_again(every, make, tmp_path, endpoint):
    scenario = make(duration=0.0302, law="vsg-2", link=PATIENT, events=EVENTS)

    def touch(role: Role, link: Link) -> Any:
        lost = (5, 6, 20) if role == "plant" else (11, 30)
        return Tampering(link, lambda k, message: None if k in lost else message)

    apart, found = both_roles(scenario, tmp_path, endpoint, touch, every=every)
    expected = quantised_run(scenario, tmp_path, every)
    for name, column in expected.items():
        assert apart[name].tobytes() == column.tobytes(), name
    assert found["controller"][0]["lost"] >= 3 and found["plant"][0]["lost"] >= 2


@BOTH_WAYS
def test_bus_off_ends_it(pair, stranger):
    stranger.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False))
    stranger.send(can.Message(arbitration_id=0x04, is_error_frame=True, is_extended_id=False))
    for end in pair.values():
        with pytest.raises(PeerLost, match=r"the CAN controller of 127\.0\.0\.1:\d+ went bus off"):
            while end.wait(5):
                end.receive()
        until = time.monotonic() + 30
        while end.counters["error_frames"] < 2 and time.monotonic() < until:
            assert end.receive() is None
        assert end.counters["error_frames"] == 2


@pytest.mark.parametrize("portable", [True])
def test_a_bus_that_goes_away_ends_it(pair, monkeypatch):
    def down(*arguments: Any) -> None:
        raise can.CanOperationError("Network is down", errno.ENETDOWN)

    end = pair["plant"]
    monkeypatch.setattr(end._bus._bus, "recv", down)
    for call in (end.receive, lambda: end.wait(5), lambda: end.send(frame("y", 0))):
        with pytest.raises(PeerLost, match=r"the CAN bus 127.* is gone: Network is down"):
            while True:
                call()


def test_a_socket_that_goes_away_ends_it(pair):
    """The kernel's error: here of a closed socket."""
    end, said = pair["plant"], r"the CAN bus 127.* is gone: Bad file descriptor"
    end._node.sockets["fd"] = -1
    for call in (end.receive, lambda: end.wait(1)):
        with pytest.raises(PeerLost, match=said):
            call()
    message = np.zeros(100, np.uint8)
    for _ in range(2):  # until ``receive`` raises the reason
        assert call_port(end.port.receive, end.port.handle, message) == -1
    with pytest.raises(PeerLost, match=said):
        end.receive()
    end._node.sockets["others"] = -1
    with pytest.raises(PeerLost, match=said):
        end.send(frame("y", 0))


@njit
def call_port(function, handle, message):
    """Call it as the loops do."""
    return function(handle, message)


def test_a_bus_that_goes_away_ends_a_compiled_run(make, tmp_path, endpoint, stranger):
    off = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False)

    def touch(role: Role, link: Link) -> Link:
        stranger.send(off)
        return link

    with pytest.raises(PeerLost, match="went bus off"):
        both_roles(make(duration=10.0, link=PATIENT), tmp_path, endpoint, touch)


@pytest.mark.parametrize("portable", [True])
@pytest.mark.parametrize("number", [errno.ENOBUFS, None])
def test_a_full_buffer_is_said_and_counted(pair, monkeypatch, number):
    def full(message: can.Message) -> None:
        raise can.CanOperationError("full", number)

    end = pair["plant"]
    monkeypatch.setattr(end._bus._bus, "send", full)
    end.send(frame("y", 0))
    until = time.monotonic() + 30
    while end.counters["dropped"] < 2 and time.monotonic() < until:
        time.sleep(1e-3)
    assert end.counters["dropped"] == 2  # the state and the values
    assert not end.send(bytes(300))


def test_another_dbc_is_refused_on_both_roles(make, tmp_path, endpoint):
    other = tmp_path / "other.dbc"
    other.write_text(write_dbc(True).replace("(0.0002,0.0)", "(0.0004,0.0)"))

    def call(role: Role) -> None:
        link = open_link("can", role, endpoint, {"dbc": str(other)} if role == "plant" else {})
        try:
            shake_hands(role, link, make(link=PATIENT), lambda: False, lambda text: None)
        finally:
            link.close()

    found = in_threads(call)
    assert "the plant uses another DBC" in str(found["controller"])
    assert "the controller uses another DBC" in str(found["plant"])
    assert all(isinstance(problem, PeerLost) for problem in found.values())


@BOTH_WAYS
def test_an_emulated_bus_changes_when_and_not_what(portable, make, tmp_path, endpoint):
    scenario = make(duration=0.005, law="vsg-2", link={**PATIENT, "repeat_s": 5.0})
    began = time.monotonic()
    apart, _ = both_roles(scenario, tmp_path, endpoint, emulate=True, portable=portable)
    assert time.monotonic() - began > scenario.ticks * 90e-6  # of 97.1 µs an exchange
    assert apart["true_p"].tobytes() == quantised_run(scenario, tmp_path)["true_p"].tobytes()
