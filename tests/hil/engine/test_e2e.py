"""Frames with a good CRC and wrong content: the reader refuses and counts each, and uses none."""

import time

import numpy as np
import pytest

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.engine.loop_records import limited_reader, make_loop
from gfm_hil.engine.plant_ticks import _acts
from gfm_hil.links.frame import FrameError, FrameReader, judge
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import names
from gfm_runtime.states import REASONS, SAFE, STOPPED

from ...support.frames import FAR, REALTIME, T_NS, Forger

by_role = pytest.mark.parametrize("role", ROLES)


def limited(role: Role, scenario: Scenario) -> FrameReader:
    """The reader of a side in real time, the plant's at tick 100, after a good frame of tick 90."""
    reader = limited_reader(role, scenario, scenario.late_policy.hold)
    if role == "plant":
        reader.record["newest"] = 100
    reader.unpack(Forger(reader.group).forge(90, 0), np.zeros(len(names(reader.group))))
    return reader


def fault_of(reader: FrameReader, sequence: int, tick: int, state: int = 0, reason: int = 0) -> str:
    """Fault of a frame with a good CRC, "" if the reader accepts it; checks that a refused frame
    is not used."""
    message = Forger(reader.group, sequence).forge(tick, state, reason)
    values = np.full(len(names(reader.group)), 7.0)
    faults = ("faults", "fault")
    before = {n: reader.record[n].tobytes() for n in reader.record.dtype.names if n not in faults}
    try:
        reader.unpack(message, values)
    except FrameError as problem:
        assert (values == 7.0).all()
        assert before == {n: reader.record[n].tobytes() for n in before}
        return problem.fault
    return ""


@pytest.mark.attack("1.1", "a good CRC, and a frozen, far, old or skipped tick", "used")
@by_role
@pytest.mark.parametrize("tick", [90, 89, FAR, 90 + 5_002, 2**63 + 91, 2**64 - 1])
def test_a_tick_at_which_the_peer_cannot_be_is_refused(role, tick, make):
    reader = limited(role, make(**REALTIME))
    assert fault_of(reader, 1, tick) == "tick"
    assert fault_of(reader, 1, 91) == ""  # as if the refused one had never come


@pytest.mark.attack("1.2", "a u from the future, or older than late_policy.hold", "acts")
def test_u_is_taken_from_k_minus_hold_to_k_and_no_other(make, attack_now):
    scenario, taken = make(**{**REALTIME, "late_policy": {"hold": 50}}), []
    for tick in range(91, 300):
        reader = limited("plant", scenario)
        reader.record["newest"] = 200
        taken += [tick] if not fault_of(reader, 1, tick) else []
    assert taken == list(range(150, 201))
    attack_now(f"of u[91] to u[299], the plant at k = 200 takes k − {200 - taken[0]} to k")


@pytest.mark.attack("1.3", "a state byte of 99 or a reason byte of 200", "running; IndexError")
@by_role
@pytest.mark.parametrize(("state", "reason"), [(5, 0), (99, 0), (255, 0), (SAFE, 8), (0, 200)])
def test_a_state_or_reason_without_a_meaning_is_refused(role, state, reason, make):
    reader = limited(role, make(**REALTIME))
    assert fault_of(reader, 1, 91, state, reason) == "state"
    assert fault_of(reader, 1, 91, SAFE, len(REASONS) - 1) == ""


@pytest.mark.attack("1.4", "a frame replayed after the sequence has wrapped", "used")
@by_role
def test_a_replay_after_the_wrap_is_refused_for_its_tick(role, make):
    reader = limited(role, make(**REALTIME))
    reader.record["next"] = 5  # the sequence has wrapped; 7 once belonged to tick 7
    assert fault_of(reader, 7, 7) == "tick"
    assert fault_of(reader, 5, 91) == ""


@pytest.mark.attack("1.5", "a sequence that jumps by two thousand million", "used")
@by_role
def test_a_jump_of_the_sequence_is_bounded(role, make, attack_now):
    reader = limited(role, make(**REALTIME))
    jump = int(reader.record["jump"][0])
    assert fault_of(reader, 2 + jump, 91) == "out_of_sequence"
    assert fault_of(reader, 2**31, 91) == "out_of_sequence"
    assert fault_of(reader, 1 + jump, 91) == ""
    assert reader.faults["lost"] == jump
    attack_now(f"refused beyond {jump} missing frames")


@by_role
def test_a_peer_that_leaves_is_heard_under_its_last_tick_and_the_next(role, make):
    for tick, fault in ((90, ""), (101, ""), (89, "tick"), (2**62, "tick")):
        reader = limited(role, make(**REALTIME))
        reader.record["newest"] = 100
        assert fault_of(reader, 1, tick, STOPPED) == fault
        assert (reader.state >= reader.record["leaving"][0]) == (not fault)
    late = limited(role, make(**REALTIME, after_trip="wait"))
    assert fault_of(late, 1, 90, SAFE) == "tick"  # in this scenario a safe side keeps running


def test_in_lockstep_a_tick_comes_again_as_often_as_the_plant_may_ask(make):
    link = {"type": "inproc", "peer_timeout_s": 0.1, "repeat_s": 0.01}
    reader = limited_reader("controller", make(link=link))
    assert [fault_of(reader, n, 0) for n in range(13)] == [""] * 11 + ["tick"] * 2
    assert fault_of(reader, 13, 1) == ""  # a newer tick may repeat as often
    assert [fault_of(reader, 14 + n, 1) for n in range(11)] == [""] * 10 + ["tick"]


def test_the_states_of_the_protection(make):
    reader = limited_reader("controller", make(**REALTIME))
    assert reader.e2e == "initial"
    assert (fault_of(reader, 0, FAR), reader.e2e) == ("tick", "initial")
    assert (fault_of(reader, 0, 0), reader.e2e) == ("", "valid")
    judge(reader.record, False, False)
    assert reader.e2e == "valid"
    judge(reader.record, True, False)
    assert reader.e2e == "invalid"
    assert (fault_of(reader, 1, 1), reader.e2e) == ("", "invalid")  # a frame alone does not re-arm
    judge(reader.record, False, True)
    assert reader.e2e == "invalid"
    judge(reader.record, False, False)  # the safe state was reset
    assert reader.e2e == "initial"
    assert (fault_of(reader, 2, 2), reader.e2e) == ("", "valid")


class Played:
    """A link that delivers given messages and stores sent ones."""

    port = None

    def __init__(self, *messages: bytes) -> None:
        self.messages, self.said = list(messages), list[bytes]()

    def receive(self) -> bytes | None:
        return self.messages.pop(0) if self.messages else None

    def send(self, message: bytes) -> bool:
        self.said.append(message)
        return True

    def wait(self, seconds: float) -> bool:
        return bool(self.messages)


@pytest.mark.attack("1.16", "START is lost, and the first y has a far tick", "tick 0 is years ago")
def test_a_far_first_tick_does_not_set_the_clock(make, attack_now):
    scenario, plant, forger = make(**REALTIME), Played(), Forger("y")
    with pytest.raises(PeerLost, match="interrupted"):
        shake_hands("plant", plant, scenario, lambda: bool(plant.said), print)
    far, good = (forger.forge(tick, 0) for tick in (2**62, 7))
    link = Played(plant.said[0], far, good)
    begin = time.monotonic_ns()
    start = shake_hands("controller", link, scenario, lambda: False, print)
    assert begin <= start.t0_ns + 7 * T_NS <= time.monotonic_ns()
    attack_now("the next good y says when tick 0 was")


@pytest.mark.attack("1.17", "CAN, every = 4: a u for tick 16 comes at tick 0", "acts at tick 20")
def test_a_command_from_the_future_is_not_kept_until_it_fits(make, attack_now):
    reader = limited_reader("plant", make(**REALTIME), hold=10, every=4)
    reader.record["newest"] = 0
    assert fault_of(reader, 0, 16) == "tick"
    reader.record["newest"] = 23
    assert fault_of(reader, 0, 16 - 10) == ""  # a late one, and the next one acts from tick 20 on
    assert fault_of(reader, 4, 16) == ""
    assert reader.faults["lost"] == 0  # the sequence counts ticks
    attack_now("refused")


def test_over_a_slow_link_u_acts_n_ticks_late(make):
    """In real time, with an exchange every 4 ticks: u[8] is lost, and u[20] comes 2 ticks late."""
    loop, u, n = make_loop(make(**REALTIME), 0, 0, 10, 4), np.zeros(3), 4
    queue = [(tick, tick) for tick in (0, 4, 12, 16)] + [(20, 26), (24, 26), (28, 28)]
    acts: dict[int, float | None] = {}
    for k in range(32):
        found = _acts(loop[0], u, k)
        while not found and queue and queue[0][1] <= k:  # as the loop looks at the link
            loop["ahead"] = loop["u_ahead"] = queue.pop(0)[0]
            found = _acts(loop[0], u, k)
        acts[k] = float(u[0]) if found else None
    expected = {k: max(0, k // n - 1) * n for k in range(32)}
    assert acts == {**expected, **dict.fromkeys((12, 13, 14, 15, 24, 25))}
