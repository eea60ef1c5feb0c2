"""The values held between two exchanges, and the count of faults."""

from __future__ import annotations

import numpy as np
import pytest

from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_runtime.signals import Group, names
from gfm_runtime.states import RUNNING, SAFE, STOPPED

from ..support.can import Subrate

EVERY = 4


class Role:
    """One side's stage, its incoming messages, and the reader behind it."""

    def __init__(self, group: Group) -> None:
        self.inbox: list[bytes] = []
        role = "plant" if group == "u" else "controller"
        self.stage = Subrate(role, EVERY, lambda: self.inbox.pop(0) if self.inbox else None)
        self.reader = FrameReader(group)
        self.values = np.zeros(len(names(group)))

    def heard(self) -> list:
        """(tick, value) of accepted frames, or the fault."""
        out: list = []
        while (message := self.stage.receive()) is not None:
            try:
                out.append((self.reader.unpack(message, self.values), self.values[0]))
            except FrameError as problem:
                out.append(problem.fault)
        return out

    def faults(self) -> dict[str, int]:
        return {fault: count for fault, count in self.reader.faults.items() if count}


def frame(group: Group, tick: int, sequence: int, state: int | None = None) -> bytes:
    writer = FrameWriter(group)
    writer.sequence[0] = sequence
    ordinary = RUNNING if group == "u" else 0
    values = np.full(len(names(group)), float(tick))
    return writer.pack(tick, ordinary if state is None else state, 0, values)


def test_what_goes_is_every_nth_and_the_last_word():
    stage = Role("u").stage
    went = [tick for tick in range(12) if stage.goes(frame("y", tick, tick))]
    assert went == [0, 4, 8]
    assert stage.goes(frame("y", 9, 13, STOPPED))
    assert stage.goes(b"a message of the handshake")


def test_the_controller_gets_what_is_between_before_the_next():
    role = Role("y")
    role.inbox = [frame("y", tick, tick) for tick in (0, 4, 8)]
    assert role.heard() == [(0, 0), *((t, 0) for t in (1, 2, 3)), (4, 4),
                            *((t, 4) for t in (5, 6, 7)), (8, 8)]  # fmt: skip
    role.inbox = [frame("y", 8, 9)]  # a repeat
    assert role.heard() == [(8, 8)]
    role.inbox = [frame("y", 12, 13), frame("y", 14, 15, STOPPED)]
    assert role.heard() == [*((t, 8) for t in (9, 10, 11)), (12, 12), (13, 12), (14, 14)]
    assert (role.faults(), role.reader.state) == ({}, STOPPED)


def test_a_lost_measurement_counts_as_every_tick_that_it_stood_for():
    role = Role("y")
    role.inbox = [frame("y", 0, 0), frame("y", 8, 8)]
    assert role.heard() == [(0, 0), *((t, 0) for t in (5, 6, 7)), (8, 8)]
    assert role.faults() == {"lost": EVERY}


def test_the_plant_gets_a_command_a_tick_n_ticks_late():
    role = Role("u")
    found = []
    for tick in range(16):
        role.stage.goes(frame("y", tick, tick))
        if tick % EVERY == 0:
            role.inbox.append(frame("u", tick, tick))
        found += role.heard()
    assert found == [(t, max(0, t // EVERY - 1) * EVERY) for t in range(16)]
    assert role.faults() == {}


def test_a_lost_command_is_missed_for_n_ticks_and_one_sent_again_is_not():
    role = Role("u")
    found: dict[int, list] = {}
    for tick in range(32):
        role.stage.goes(frame("y", tick, tick))
        if tick % EVERY == 0 and tick != 8:
            role.inbox.append(frame("u", tick, tick + (tick > 16)))
        if tick == 16:
            role.inbox.append(frame("u", tick, tick + 1))
        found[tick] = role.heard()
    assert [tick for tick, heard in found.items() if not heard] == [12, 13, 14, 15]
    assert "repeated" in found[16] or "repeated" in found[17]
    assert role.faults() == {"lost": EVERY, "repeated": 1}


def test_damage_and_the_last_word_come_through_at_once():
    role = Role("u")
    role.stage.goes(frame("y", 0, 0))
    role.inbox = [frame("u", 0, 0)]
    assert role.heard() == [(0, 0)]
    role.inbox = [frame("u", 4, 4)[:-1] + b"?", frame("u", 2, 3, SAFE)]
    assert role.heard() == ["crc", (2, 2)]
    assert role.reader.state == SAFE


@pytest.mark.attack("1.17", "CAN, every = 4: a u for tick 16 comes at tick 0", "acts at tick 20")
def test_a_command_from_the_future_is_not_kept_until_it_fits(attack_now):
    role = Role("u")
    found, lie = [], 16
    for tick in range(28):
        role.stage.goes(frame("y", tick, tick))
        role.reader.record["newest"] = tick  # as the plant's loop does
        if tick == 0:
            role.inbox += [frame("u", 0, 0), frame("u", lie, 1)]
        elif tick % EVERY == 0 and tick != lie:
            role.inbox.append(frame("u", tick, tick))
        found += role.heard()
    assert found.count("tick") == 1
    taken = [heard for heard in found if heard != "tick"]
    assert [tick for tick, _ in taken] == [t for t in range(28) if not 20 <= t < 24]
    assert lie not in [value for _, value in taken]
    attack_now("refused; ticks 20 to 23 hold u")
