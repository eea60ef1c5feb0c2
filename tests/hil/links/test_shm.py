"""The shared-memory link in this process: the same runs, its ring, refused peers."""

import ctypes
import errno
import os
import platform
import re
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from numba import njit

from gfm_hil.core.errors import UserError
from gfm_hil.links import link_kind, open_link, ring
from gfm_hil.links.port import PORT_CALL
from gfm_hil.links.shm import segment
from gfm_hil.links.shm.link import ShmLink

from ...support.shm import endpoint, header, segment_of

__all__ = ["endpoint"]

Pair = tuple[ShmLink, ShmLink]


@pytest.fixture
def pair(endpoint: str) -> Iterator[Pair]:
    controller, plant = ShmLink("controller", endpoint), ShmLink("plant", endpoint)
    yield controller, plant
    plant.close()
    controller.close()


@pytest.mark.parametrize("back", [False, True])
def test_messages_arrive_whole_and_in_order_round_the_ring(back, pair):
    sender, receiver = reversed(pair) if back else pair
    for k in range(5 * ring.SLOTS):
        message = struct.pack("<q", k) * (1 + k % 63)
        assert sender.send(message)
        assert receiver.receive() == message
    assert receiver.receive() is None


@pytest.mark.parametrize("back", [False, True])
def test_a_full_ring_drops_what_comes_and_keeps_what_it_has(back, pair):
    sender, receiver = reversed(pair) if back else pair
    for lap in range(3):
        sent = [sender.send(b"%d.%d" % (lap, k)) for k in range(ring.SLOTS + 9)]
        assert sent == [True] * ring.SLOTS + [False] * 9
        heard = [receiver.receive() for _ in range(ring.SLOTS + 1)]
        assert heard == [b"%d.%d" % (lap, k) for k in range(ring.SLOTS)] + [None]


def test_what_was_sent_last_is_there_after_the_controller_has_gone(pair, endpoint):
    controller, plant = pair
    assert controller.send(b"last")
    controller.close()
    assert not segment_of(endpoint).exists()
    assert plant.receive() == b"last"
    assert plant.receive() is None


def test_the_next_plant_goes_on_where_the_last_one_stopped(endpoint, opened):
    controller, plant = opened(ShmLink("controller", endpoint)), ShmLink("plant", endpoint)
    for k in range(100):
        assert plant.send(b"%d" % k)
        assert controller.send(b"%d" % k)
        assert (controller.receive(), plant.receive()) == (b"%d" % k,) * 2
    plant.send(b"by the first")
    plant.close()
    plant = opened(ShmLink("plant", endpoint))
    assert plant.send(b"by the second")
    assert [controller.receive() for _ in range(3)] == [b"by the first", b"by the second", None]
    assert controller.send(b"x")
    assert plant.receive() == b"x"


@pytest.mark.parametrize("name", ["", "a/b", "../x", "a b", "ä", "x" * 201, "x\n"])
@pytest.mark.parametrize("role", ["controller", "plant"])
def test_a_name_that_is_none(role, name):
    with pytest.raises(UserError, match="must be shm://name, the name of 1 to 200 letters"):
        open_link("shm", role, f"shm://{name}")


def test_the_longest_name_and_a_fresh_one_are_good(tmp_path):
    kind = link_kind("shm")
    for name in ("shm://" + "x" * 200, kind.fresh(tmp_path)):
        kind.checked(name, {})
        open_link("shm", "controller", name).close()
        assert not segment_of(name).exists()


def test_a_memory_of_another_layout_is_refused(endpoint):
    path = segment_of(endpoint)
    path.write_bytes(header(segment.VERSION + 1, segment.myself()))
    with pytest.raises(UserError, match=r"another version \(layout 2, ours is 1\)"):
        ShmLink("plant", endpoint)
    with pytest.raises(UserError, match="occupied by another run"):
        ShmLink("controller", endpoint)
    path.unlink()


def test_a_file_that_is_none_of_ours_is_refused_and_kept(endpoint):
    path = segment_of(endpoint)
    path.write_bytes(b"somebody's")
    for role in ("controller", "plant"):
        with pytest.raises(UserError, match="is no link of ours"):
            ShmLink(role, endpoint)
    assert path.read_bytes() == b"somebody's"
    path.unlink()


@pytest.mark.parametrize("shift", [(0, 1, 0), (2**30, 0, 0)])
def test_an_owner_is_known_by_its_start_too(shift, endpoint):
    """The kernel reuses process ids."""
    owner = tuple(np.add(segment.myself(), shift).tolist())
    segment_of(endpoint).write_bytes(header(segment.VERSION, owner))
    ShmLink("controller", endpoint).close()


def test_an_owner_in_another_container_counts_as_alive(endpoint):
    pid, start, namespace = segment.myself()
    segment_of(endpoint).write_bytes(header(segment.VERSION, (pid, start, namespace + 1)))
    with pytest.raises(UserError, match="occupied"):
        ShmLink("controller", endpoint)
    segment_of(endpoint).unlink()


def test_a_maker_that_was_killed_at_it_is_no_hindrance(endpoint):
    segment_of(endpoint).write_bytes(b"")
    ShmLink("controller", endpoint).close()


def test_no_room_is_told_and_leaves_nothing(endpoint, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(UserError, match="cannot be created: No space left on device"):
        ShmLink("controller", endpoint)
    assert not segment_of(endpoint).exists()


def test_of_many_that_replace_a_dead_one_at_a_time_one_wins(endpoint):
    pid, start, namespace = segment.myself()
    segment_of(endpoint).write_bytes(header(segment.VERSION, (pid, start + 1, namespace)))
    won: list[ShmLink] = []
    lost: list[UserError] = []

    def one() -> None:
        try:
            won.append(ShmLink("controller", endpoint))
        except UserError as problem:
            lost.append(problem)

    threads = [threading.Thread(target=one) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(won), len(lost)) == (1, 7)
    won[0].close()


@pytest.mark.skipif(not ring.HAS_BELLS, reason="no futex(2) here")
def test_a_message_wakes_a_reader_that_sleeps(pair):
    sender, receiver = pair
    handle, bell = receiver.port.handle, np.zeros(1, np.int64)
    message, own = np.zeros(8, np.uint8), int(handle[ring.IN_BELL])
    assert ring.patient(handle, message) == 0  # nothing comes while it sleeps
    ctypes.memmove(own, np.ones(1, np.int64).ctypes.data, 8)  # as one that sleeps
    assert sender.send(b"awake")
    ctypes.memmove(bell.ctypes.data, own, 8)
    assert bell[0] == 0
    assert ring.patient(handle, message) == 5
    heard: list[int] = []

    def listen() -> None:
        while len(heard) < 3000:
            if ring.patient(handle, message):
                heard.append(int(message.view(np.int64)[0]))

    thread = threading.Thread(target=listen)
    thread.start()
    for k in range(3000):
        while not sender.send(struct.pack("<q", k)):
            time.sleep(1e-5)
    thread.join()
    assert heard == list(range(3000))


def emitted(function: object) -> tuple[str, str]:
    """LLVM's optimised code and the machine code of a newly compiled function: cached ones cannot
    be inspected."""
    fresh = njit(PORT_CALL)(function.py_func)  # type: ignore[attr-defined]
    (signature,) = fresh.signatures
    return fresh.inspect_llvm(signature), fresh.inspect_asm(signature)


@pytest.mark.parametrize("function", [ring.put, ring.take])
def test_the_emitted_code_keeps_the_order(function):
    code, machine = emitted(function)
    load = re.search(r"load atomic i64, .* acquire, align 8", code)
    copy = re.search(r"call void @llvm\.memcpy", code)
    store = re.search(r"store atomic i64 %.* release, align 8", code)  # not of the bell: 0
    assert load
    assert copy
    assert store
    assert copy.start() < store.start()
    assert "cmpxchg" not in code.split("define")[1]
    if platform.machine() == "x86_64":
        own = machine.split(".Lfunc_end0")[0]
        assert "NRT_" not in own  # no reference counting
        assert "mfence" not in own
        assert "lock" not in own  # both orders are plain moves on x86
        after_copy = own[own.index("callq") :]
        assert re.search(r"movq\s+%r\w+, (0\(|\(%)", after_copy)
        assert "pause" not in own  # the loop that waits pauses between two looks
