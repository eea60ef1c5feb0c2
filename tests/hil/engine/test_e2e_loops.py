"""A peer that sends good CRCs and wrong content: no loop, on any link, stays alive or acts on it.

One side runs its real loop; a lying peer plays the other side.
"""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine import drive
from gfm_hil.engine.drive import Share, run_loop
from gfm_hil.engine.process import compile_role
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, link_kind, open_link
from gfm_hil.links.frame import FrameReader
from gfm_hil.recording.log import read_log
from gfm_hil.recording.parts import RolePart
from gfm_hil.run.run_folder import finish
from gfm_hil.scenario import Scenario, scenario_toml
from gfm_plant import NO_FRESH_U
from gfm_runtime.signals import NU, Group, names
from gfm_runtime.states import LOST_PEER, REASONS, RUNNING, SAFE, STALE, STOPPED

from ...support.frames import FAR, HOLD, REALTIME, T_NS, Forger
from ...support.links import LINKS

pytestmark = pytest.mark.processes

BAD = np.array([0.9, 1.05, 0.8])  # a u that no honest frame of these tests carries
GROUPS: dict[Role, Group] = {"plant": "u", "controller": "y"}  # what each side hears
OTHER: dict[Role, Role] = {"plant": "controller", "controller": "plant"}
LIMIT_S = 20.0
LOCKSTEP = {"mode": "lockstep", "duration": 4.0}


@pytest.fixture(autouse=True)
def _leaves_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """No loop waits long for a last word, which most liars do not say."""
    monkeypatch.setattr(drive, "_LAST_NS", 100_000_000)


by_link = pytest.mark.parametrize("link", LINKS)


class Liar:
    """The other side's end of the link, and its received frames: time, tick, state, reason."""

    def __init__(self, link: Link, role: Role) -> None:
        self._link, self.over = link, threading.Event()
        self.usual = 0 if role == "plant" else RUNNING
        self.forger = Forger("y" if role == "plant" else "u")
        self.reader = FrameReader(GROUPS[role])
        self.heard: list[tuple[int, int, int, int]] = []

    def say(self, tick: int, state: int | None = None, reason: int = 0, values: Any = None) -> None:
        state = self.usual if state is None else state
        message = self.forger.forge(tick, state, reason, values)
        while not self._link.send(message) and not self.over.wait(0.001):
            self.listen()  # ZeroMQ has no room before the other side has connected

    def listen(self) -> None:
        """Read the received frames."""
        unused = np.zeros(len(names(self.reader.group)))
        while (message := self._link.receive()) is not None:
            self.reader.unpack(message, unused)
            r = self.reader
            self.heard.append((time.monotonic_ns(), r.tick, r.state, r.reason))

    def keep_saying(self, tick: int, pause_s: float = 0.0005) -> None:
        """Send the same tick under new sequence numbers until the other side has ended."""
        give_up = time.monotonic() + LIMIT_S
        while not self.over.wait(pause_s) and time.monotonic() < give_up:
            self.say(tick)
            self.listen()

    def keep_listening(self) -> None:
        """Make room for what the other side sends, until it has ended."""
        while not self.over.wait(0.001):
            self.listen()

    def heard_the_end(self) -> bool:
        return bool(self.heard) and self.heard[-1][2] in (SAFE, STOPPED)

    def last_words(self) -> tuple[int, int, int, int]:
        return next(words for words in self.heard if words[2] in (SAFE, STOPPED))


@dataclass
class Found:
    """The results of the side under test."""

    reader: FrameReader
    part: RolePart
    liar: Liar
    end: tuple[str, str, int]
    took_s: float

    @property
    def refused(self) -> dict[str, int]:
        """Its counters apart from ``lost``, which counts the gaps that refused frames leave."""
        return {f: n for f, n in self.reader.faults.items() if n and f != "lost"}


def lied_to(
    role: Role, scenario: Scenario, folder: Path, link: str, lie: Callable[[Liar], None]
) -> Found:
    """Run one side over one of ``LINKS`` against a peer that runs ``lie``."""
    name, options = LINKS[link]
    endpoint = link_kind(name).fresh(folder)
    bench, part = make_bench(scenario), RolePart.create(folder, role, scenario.ticks)
    compile_role(role, [bench], [part])
    ends = {s: open_link(name, s, endpoint, options) for s in ROLES}
    liar = Liar(ends[OTHER[role]], OTHER[role])
    timeline = Timeline(bench, folder / "events.jsonl", (role,))
    thread = threading.Thread(target=lie, args=(liar,))
    begin = time.monotonic()

    def stopped() -> bool:
        return time.monotonic() - begin > LIMIT_S

    try:
        thread.start()
        assert ends[role].wait(30)
        t0 = time.monotonic_ns()
        share = Share(bench, ends[role], part, timeline)
        (reader,) = run_loop(role, [share], t0, stopped)
        liar.over.set()
        thread.join()
        give_up = time.monotonic() + LIMIT_S
        while not liar.heard_the_end() and time.monotonic() < give_up:
            ends[OTHER[role]].wait(0.1)
            liar.listen()
        assert liar.heard_the_end()
    finally:
        liar.over.set()
        for end in ends.values():
            end.close()
        timeline.close()
    (end,) = [e for e in read_log(folder / "events.jsonl") if e["event"] == "end"]
    how = end["status"], end["reason"], end["tick"]
    return Found(reader, part, liar, how, time.monotonic() - begin)


def then_keeps(tick: int) -> Callable[[Liar], None]:
    """It is honest for three ticks, and then says one tick for ever."""

    def lie(liar: Liar) -> None:
        for k in range(3):
            liar.say(k)
        liar.keep_saying(tick)

    return lie


@pytest.mark.attack("1.6", "a plant whose tick stands still", "RUNNING for ever")
@by_link
def test_a_frozen_plant_leads_to_safe_in_real_time(link, make, place, attack_now):
    scenario = make(**REALTIME)
    found = lied_to("controller", scenario, place, link, then_keeps(2))
    status, reason, tick = found.end
    assert (status, reason) == ("safe", REASONS[STALE])
    assert set(found.refused) <= {"tick"}
    assert found.reader.e2e == "invalid"
    faults = found.reader.faults
    end = {"role": "controller", "faults": faults, "e2e": found.reader.e2e}
    (place / "link_controller.json").write_text(json.dumps(end), encoding="utf-8")
    (place / "scenario.toml").write_text(scenario_toml(scenario), encoding="utf-8")
    summary = finish(scenario, place, [scenario.law], 0.0).summary
    assert summary["e2e"] == {"controller": "invalid"}
    assert summary["faults"] == {"controller": {f: n for f, n in faults.items() if n}}
    when, _, state, code = found.liar.last_words()
    assert (state, code) == (SAFE, STALE)
    ticks = (when - int(found.part.times[tick, 1])) / T_NS
    assert ticks > HOLD
    attack_now(f"{link}: SAFE {ticks:.0f} ticks after the last newer tick, hold = {HOLD}")


@pytest.mark.attack("1.7", "the same in lockstep", "RUNNING for ever")
@by_link
def test_a_frozen_plant_leads_to_safe_in_lockstep(link, make, place, attack_now):
    timeout = {"type": "inproc", "peer_timeout_s": 0.3}
    found = lied_to("controller", make(**LOCKSTEP, link=timeout), place, link, then_keeps(2))
    assert found.end == ("safe", REASONS[LOST_PEER], 2)
    assert found.reader.e2e == "invalid"
    when, _, state, code = found.liar.last_words()
    assert (state, code) == (SAFE, LOST_PEER)
    took = (when - int(found.part.times[2, 1])) * 1e-9
    attack_now(f"{link}: SAFE {took:.2f} s after the last newer tick, peer_timeout_s = 0.3")


@pytest.mark.attack("1.8", "one y with a far tick", "every later y counts as asked again, RUNNING")
@by_link
def test_one_far_tick_does_not_stop_the_controller(link, make, place, attack_now):
    def lie(liar: Liar) -> None:
        for tick in (0, 1, 2, FAR, -1, 2**63 + 2**30, 3, 4, 5):
            liar.say(tick)
        liar.say(6, STOPPED)

    found = lied_to("controller", make(**LOCKSTEP), place, link, lie)
    assert found.end == ("completed", "", 5)
    assert found.refused == {"tick": 3}
    assert [tick for _, tick, state, _ in found.liar.heard if state == RUNNING] == [*range(6)]
    attack_now(f"{link}: refused ({found.refused['tick']} ticks); y[3] to y[5] are answered")


@pytest.mark.attack("1.9", "every y has a far tick", "RUNNING on the held u")
@by_link
def test_a_plant_that_is_far_ahead_leads_to_safe(link, make, place, attack_now):
    found = lied_to("controller", make(**REALTIME), place, link, then_keeps(FAR))
    status, reason, tick = found.end
    assert (status, reason) == ("safe", REASONS[STALE]) and tick <= 2
    when, *_ = found.liar.last_words()
    ticks = (when - int(found.part.times[tick, 1])) / T_NS
    attack_now(f"{link}: SAFE {ticks:.0f} ticks after the last newer tick, hold = {HOLD}")


@pytest.mark.attack("1.10", "u of ticks −100, +1000 and beyond 2**63", "acts, uncounted")
@by_link
def test_u_of_another_time_never_acts(link, make, place, attack_now):
    def lie(liar: Liar) -> None:
        for tick in range(30):
            liar.say(tick)
        for tick in (1_030, -70, 2**63 + 2**30, 5):
            liar.say(tick, values=BAD)
        liar.keep_listening()

    found = lied_to("plant", make(**{**REALTIME, "late_policy": {"hold": 300}}), place, link, lie)
    u = found.part.signals[: found.part.progress[0], 5 : 5 + NU]
    assert not np.isclose(u, BAD, atol=1e-3).all(axis=1).any()
    assert found.end[:2] == ("safe", NO_FRESH_U)
    if link == "shm":  # all frames arrive before the first tick ends
        assert found.refused == {"tick": 4}
    attack_now(f"{link}: none acts in {len(u)} ticks; refused: {found.refused.get('tick', 0)}")


@pytest.mark.attack("1.11", "a controller that answers with one tick for ever", "uncounted")
@by_link
@pytest.mark.parametrize("tick", [2, FAR])
def test_a_frozen_or_far_controller_leads_to_safe_in_real_time(tick, link, make, place, attack_now):
    found = lied_to("plant", make(**REALTIME), place, link, then_keeps(tick))
    assert found.end[:2] == ("safe", NO_FRESH_U)
    assert found.reader.e2e == "invalid"
    received = found.part.times[: found.part.progress[0], 3]
    late = int(np.argmax(received[::-1] >= 0)) if (received >= 0).any() else len(received)
    assert late == HOLD + 1
    attack_now(f"{link}: safe after {late} ticks without a fresh u, hold = {HOLD}")


@pytest.mark.attack("1.12", "the same in lockstep, in a flood", "uncounted")
@by_link
def test_a_flood_of_an_old_u_ends_the_plant_in_lockstep(link, make, place, attack_now):
    def lie(liar: Liar) -> None:
        liar.say(0)
        liar.keep_saying(0, pause_s=0.0)

    timeout = {"type": "inproc", "peer_timeout_s": 0.3}
    found = lied_to("plant", make(**LOCKSTEP, link=timeout), place, link, lie)
    assert found.end == ("safe", "the controller's process is gone", 1)
    assert found.reader.e2e == "invalid"
    attack_now(f"{link}: safe; {found.refused.get('tick', 0)} frames refused")


@pytest.mark.attack("1.13", "u with state 99, or SAFE for reason 200", "runs on it; IndexError")
@by_link
def test_a_state_without_a_meaning_does_not_move_the_plant(link, make, place, attack_now):
    def lie(liar: Liar) -> None:
        liar.say(0)
        liar.say(1, 99, values=BAD)
        liar.say(1, SAFE, 200, values=BAD)
        liar.say(1)
        liar.say(1, SAFE, STALE)
        liar.over.wait(LIMIT_S)

    found = lied_to("plant", make(**LOCKSTEP), place, link, lie)
    assert found.end == ("safe", REASONS[STALE], 2)
    assert found.refused["state"] >= 1 and set(found.refused) == {"state"}
    attack_now(f"{link}: both refused; the good answer is used")


@pytest.mark.attack("1.14", "a tripped plant beyond the end", "memory is overwritten")
@by_link
def test_a_tripped_plant_beyond_the_end_is_refused(link, make, place):
    def lie(liar: Liar) -> None:
        for tick in (0, 1, 12, 2):
            liar.say(tick, SAFE if tick == 12 else None)
        liar.say(3, STOPPED)

    scenario = make(**{**LOCKSTEP, "duration": 0.001}, after_trip="wait")
    found = lied_to("controller", scenario, place, link, lie)
    assert found.refused == {"tick": 1}
    assert found.end[0] == "completed"


@pytest.mark.attack("1.15", "newer ticks after SAFE, without a reset", "SAFE is latched")
@by_link
def test_newer_ticks_alone_do_not_end_safe(link, make, place, attack_now):
    def lie(liar: Liar) -> None:
        for tick in range(3):
            liar.say(tick)
        give_up = time.monotonic() + LIMIT_S
        while not any(words[2] == SAFE for words in liar.heard) and time.monotonic() < give_up:
            time.sleep(2 * HOLD * T_NS * 1e-9)  # silence, and then one newer tick
            liar.say(3 + len(liar.heard))
            time.sleep(0.01)
            liar.listen()
        first = liar.heard[-1][1] + 1
        for tick in range(first, first + 20):
            liar.say(tick)
        liar.say(first + 20, STOPPED)
        while liar.heard[-1][2] != STOPPED and time.monotonic() < give_up:
            time.sleep(0.01)
            liar.listen()

    patient = {"type": "shm", "peer_timeout_s": 5.0}
    scenario = make(**{**REALTIME, "link": patient}, after_trip="wait")
    found = lied_to("controller", scenario, place, link, lie)
    states = [state for *_, state, _ in found.liar.heard]
    since = states[states.index(SAFE) :]
    assert set(since) == {SAFE, STOPPED} and since.count(SAFE) >= 20
    assert found.reader.e2e == "invalid"
    attack_now(f"{link}: SAFE in all {since.count(SAFE)} later answers")
