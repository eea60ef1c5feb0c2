"""The loops over a link match the loop in process, and follow the rules of real time.

No test depends on the machine's speed: the misses are read from the recording, and the rules must
hold for them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.drive import Share, run_loop
from gfm_hil.engine.process import compile_role
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, Port, open_link, port_function
from gfm_hil.links.frame import FrameReader, FrameWriter
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.log import read_log
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import carried
from gfm_runtime.states import LOST_PEER, REASONS, RUNNING, SAFE, STALE, STOPPED

from ...support.frames import resealed
from ...support.laws import every_law, home_plant
from ...support.links import PATIENT, PORTS, RIG, assert_same, run_pair

pytestmark = pytest.mark.processes


def three_ways(content: dict[str, Any], link: str, make: Any, run: Any, place: Path) -> Any:
    """A run over a link with a port, over one without, and in process; returns first and last.

    The logs must be the same too, except for the order in which the sides end.
    """
    scenario = make(**content)
    ported = run_pair(scenario, place / "c", link)
    pumped = run_pair(scenario, place / "p", "zmq", {"portable": True})
    together = run(**content)
    assert_same(ported.signals, together.signals)
    assert_same(pumped.signals, together.signals)
    assert ported.ends() == pumped.ends()
    events = [[e for e in pair.log if e["event"] != "end"] for pair in (ported, pumped)]
    assert events[0] == events[1]
    return ported, together


#: one law of each structure, over one link and the other in turn; the others run the same code
LAW_AND_LINK = [
    (law.values[0], PORTS[k % len(PORTS)])
    for k, law in enumerate(law for law in every_law() if not law.marks)
]


@pytest.mark.parametrize(("law", "link"), LAW_AND_LINK)
def test_every_structure_of_laws_in_lockstep(law, link, make, run, place):
    content = {
        "law": law,
        "duration": 0.03,
        "seed": 7,
        "link": PATIENT,
        "plant": {**RIG, **home_plant(law)},
        "events": [
            {"tick": 50, "type": "reference", "P_ref": 0.55},
            {"tick": 150, "type": "grid-frequency", "f_hz": 49.99},
        ],
    }
    scenario = make(**content)
    assert_same(run_pair(scenario, place, link).signals, run(**content).signals)


@pytest.mark.parametrize("link", PORTS)
def test_every_event_and_changes_of_law(link, make, run, place):
    content = {
        "law": "mimo-gfm",
        "duration": 0.08,
        "link": PATIENT,
        "plant": {"factors": {"L_g": 10.0, "R_g": 10.0}, "grid": {"load_R": 36.1, "load_L": 1e-3}},
        "events": [
            {"tick": 0, "type": "reference", "V_ref": 1.001},
            {"tick": 50, "type": "law", "law": "vsg-2"},
            {"tick": 60, "type": "reference", "P_ref": 0.6, "ramp_s": 0.01},
            {"tick": 200, "type": "grid-voltage", "V_g": 0.98, "duration": 0.005},
            {"tick": 300, "type": "grid-phase-jump", "degrees": 0.5},
            {"tick": 400, "type": "grid-impedance", "L_g": 9.0, "R_g": 9.0},
            {"tick": 420, "type": "fault", "kind": "LG", "phases": "b", "position": 0.4, "R": 1.0,
             "duration": 0.005},
            {"tick": 440, "type": "grid-unbalance", "retained": [1.0, 0.9, 1.0], "duration": 0.004},
            {"tick": 500, "type": "grid-breaker", "closed": False},
            {"tick": 600, "type": "grid-breaker", "closed": True},
            {"tick": 700, "type": "law", "law": "droop-1"},
            {"tick": 799, "type": "reference", "Q_ref": 0.01},
        ],
    }  # fmt: skip
    ported, _ = three_ways(content, link, make, run, place)
    assert [e["law"] for e in ported.log if e["event"] == "law-active"] == ["vsg-2", "droop-1"]


@pytest.mark.parametrize("link", PORTS)
@pytest.mark.parametrize(
    ("plant", "status"),
    [
        ({"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}}, "tripped"),
        ({"protection": {"over_current": {"enabled": False}}}, "safe"),
    ],
)
def test_a_trip_and_a_safe_state(plant, status, link, make, run, place):
    content = {
        "duration": 1.0,
        "link": PATIENT,
        "plant": plant,
        "events": [{"tick": 30, "type": "grid-phase-jump", "degrees": 120.0}],
    }
    ported, together = three_ways(content, link, make, run, place)
    assert together.summary["status"] == status
    ends = ported.ends()
    assert {ends[role][0] for role in ROLES} == {status}
    own = "plant" if status == "tripped" else "controller"
    assert ends[own][1] == together.summary["reason"]


@pytest.mark.parametrize("link", PORTS)
@pytest.mark.parametrize("samples", [0, 1])
def test_lockstep_tells_when_answers_came(samples, link, make, place):
    """With one sample of delay the next frame follows at once, and both share a clock reading."""
    content = {"duration": 0.03, "link": PATIENT, "plant": {"delay": {"samples": samples}}}
    content["events"] = [{"tick": 50, "type": "grid-frequency", "f_hz": 49.99}]
    times = run_pair(make(**content), place, link).timing
    sent, received = times["plant_sent"], times["plant_received"]
    assert (np.diff(sent) > 0).all()
    assert (received > sent).all()
    assert (received[:-1] <= sent[1:]).all()
    same = received[:-1] == sent[1:]
    assert same.mean() > 0.9 if samples else not same.any()


# Real time


@port_function
def _never(handle, message):
    return 0


class Deaf:
    """An end that receives nothing but still sends."""

    def __init__(self, link: Link) -> None:
        self._link, p = link, link.port
        assert p is not None
        self.port = Port(p.handle, p.send, _never, p.spins)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


def deaf(which: Role) -> Callable[[Role, Link], Any]:
    return lambda role, link: Deaf(link) if role == which else link


LIVE = {**PATIENT, "type": "shm"}
REALTIME = {"mode": "realtime", "law": "vsg-2", "link": LIVE, "duration": 1.0}


@pytest.mark.parametrize("link", PORTS)
def test_misses_are_the_ticks_whose_u_was_not_received_in_time(link, make, place):
    content = {**REALTIME, "duration": 0.2, "late_policy": {"hold": 10**6}}
    pair = run_pair(make(**content), place, link)
    due, received = pair.timing["plant_scheduled"], pair.timing["plant_received"]
    assert (np.diff(due) == 100_000).all()
    assert (pair.timing["plant_woke"] >= due).all()
    there = received >= 0
    assert (received[there] >= pair.timing["plant_sent"][there]).all()
    u = np.stack([pair.signals[f"u_{n}"] for n in carried("u", False)], axis=1)
    held = np.flatnonzero(~there[1:]) + 1
    for k in held[received[held - 1] >= 0]:  # a first miss: u of the tick before, or an older one
        assert u[k].tobytes() == u[k - 1].tobytes()


@pytest.mark.parametrize("hold", [0, 1, 37])
def test_a_plant_that_hears_nothing_blocks_after_hold_and_one_more(hold, make, place):
    content = {**REALTIME, "late_policy": {"hold": hold}}
    pair = run_pair(make(**content), place, "shm", touch=deaf("plant"))
    why = "no fresh u for longer than late_policy.hold allows"
    assert pair.ends()["plant"] == ("safe", why, hold + 1)
    assert len(pair.signals["t"]) == hold + 1
    assert (pair.timing["plant_received"] == -1).all()
    assert pair.ends()["controller"][1] in (  # it may itself have been late
        "the plant ended before the scenario did",
        REASONS[STALE],
    )


def frames(
    group: str, *ticks: int, state: int = RUNNING, reason: int = 0, inner: bool = False
) -> list[bytes]:
    """Good frames of those ticks, in sequence, with different values."""
    writer = FrameWriter(group, inner)
    width = len(carried(group, inner))
    ones = np.resize(ONES[group], width)
    return [writer.pack(k, state, reason, ones + 0.001 * k * np.arange(width)) for k in ticks]


ONES = {"y": np.array([1.0, 0.5, 1.0, 0.0, 1.0]), "u": np.array([0.3, 1.0, 1.0])}


def after(sent: list[bytes], group: str, tick: int, state: int, reason: int = 0) -> list[bytes]:
    """``sent`` and one more frame in its sequence."""
    writer = FrameWriter(group)
    writer.sequence[0] = len(sent)
    return [*sent, writer.pack(tick, state, reason, ONES[group])]


@dataclass
class Alone:
    """The results of one side's loop against a played other side."""

    faults: dict[str, int]
    part: RolePart
    log: list[dict[str, Any]]
    said: list[tuple[int, int, int]]  # tick, state, reason of each frame that it sent

    @property
    def end(self) -> tuple[str, str, int]:
        """Status, reason, tick."""
        (end,) = [e for e in self.log if e["event"] == "end"]
        return end["status"], end["reason"], end["tick"]


def alone(
    role: Role,
    scenario: Scenario,
    folder: Path,
    heard: list[bytes],
    link: str = "shm",
    stopped: Callable[[], bool] = lambda: False,
) -> Alone:
    """Run one side's loop over messages that are in the link before it starts."""
    endpoint = f"shm://{folder.name}" if link == "shm" else f"ipc://{folder}/link"
    bench = make_bench(scenario)
    part = RolePart.create(folder, role, scenario.ticks, bench.columns)
    compile_role(role, [bench], [part])
    ends = {s: open_link(link, s, endpoint) for s in ROLES}
    other: Role = "plant" if role == "controller" else "controller"
    timeline = Timeline(bench, folder / "events.jsonl", (role,))
    try:
        for message in heard:
            assert ends[other].send(message)
        assert not heard or ends[role].wait(30)
        t0 = time.monotonic_ns()
        share = Share(bench, ends[role], part, timeline)
        (reader,) = run_loop(role, [share], t0, stopped)
        answers = FrameReader("u" if role == "controller" else "y", bench.signal_set)
        values, said = np.zeros(len(carried(answers.group, bench.signal_set))), []
        while ends[other].wait(0.05):
            message = ends[other].receive()
            assert message is not None
            answers.unpack(message, values)
            said.append((answers.tick, answers.state, answers.reason))
    finally:
        for end in ends.values():
            end.close()
        timeline.close()
    return Alone(dict(reader.faults), part, read_log(folder / "events.jsonl"), said)


def answered(found: Alone) -> list[int]:
    """Ticks of the frames before the last ones, which say that the side leaves."""
    return [tick for tick, state, _ in found.said if state == RUNNING]


@pytest.mark.parametrize("inner", ["none", "virtual-stator"])
def test_extrapolation_is_a_straight_line_through_the_last_two_and_then_hold(inner, place, make):
    content = {**REALTIME, "late_policy": {"hold": 20, "extrapolate": 6}, "inner": inner}
    content["plant"] = {"protection": {"over_current": {"enabled": False}}}
    stage = inner != "none"
    plant = alone("plant", make(**content), place, frames("u", 0, 1, inner=stage))
    columns = ColumnSet(stage).signals("plant")
    u = plant.part.signals[:, [columns.index(f"u_{n}") for n in carried("u", stage)]]
    assert plant.end == ("safe", "no fresh u for longer than late_policy.hold allows", 23)
    first = np.resize(ONES["u"], 3 + stage)
    last = first + 0.001 * np.arange(3 + stage)
    assert (u[0] == first).all() and (u[1] == last).all()
    for n in range(1, 7):
        assert u[1 + n].tobytes() == (last + n * (last - first)).tobytes()
    assert (u[7:23] == u[7]).all()
    assert np.isnan(u[23:]).all()
    assert plant.said[-1] == (23, STOPPED, 1)


@pytest.mark.attack(
    "23.5", "a second u for a tick already answered, with other values",
    "the plant holds and records it in the next tick",
)  # fmt: skip
def test_the_first_u_of_a_tick_stands(place, make, attack_now):
    scenario = make(mode="lockstep", link={**LIVE, "peer_timeout_s": 0.3, "repeat_s": 0.1})
    heard = frames("u", 0, 1)
    plant = alone("plant", scenario, place, after(heard, "u", 1, RUNNING))
    u = plant.part.signals[
        :, [ColumnSet(False).signals("plant").index(f"u_{n}") for n in carried("u", False)]
    ]
    assert (u[1] == ONES["u"] + 0.001 * np.arange(3)).all()
    assert u[2].tobytes() == u[1].tobytes()  # tick 2 has no u, and the plant holds the last one
    attack_now("the plant holds and records the first one")


@pytest.mark.parametrize("hold", [0, 30])
def test_a_controller_whose_plant_falls_silent_is_safe_after_hold_and_one_more(hold, place, make):
    scenario = make(**REALTIME, late_policy={"hold": hold})
    controller = alone("controller", scenario, place, frames("y", 0, 1, 2))
    # it may have timed out before the third frame
    status, reason, tick = controller.end
    assert (status, reason) == ("safe", REASONS[STALE])
    assert controller.said[-1] == (tick, SAFE, STALE)
    assert int(controller.part.progress[0]) == tick + 1


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
@pytest.mark.parametrize("role", ROLES)
def test_silence_of_the_other_role_ends_either(role, mode, place, make):
    scenario = make(
        mode=mode, link={**LIVE, "peer_timeout_s": 0.3}, late_policy={"hold": 10**6}, duration=2
    )
    other = "plant" if role == "controller" else "controller"
    found = alone(role, scenario, place, [])
    assert found.end[:2] == ("safe", f"the {other}'s process is gone")
    if role == "controller":  # the plant has filled the link with unread frames
        assert found.said[-1][1:] == (SAFE, LOST_PEER)


@pytest.mark.parametrize("link", PORTS)
@pytest.mark.parametrize("mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.alone)])
def test_the_stop_flag_ends_both(mode, link, place, make):
    begin = time.monotonic()
    content = {"mode": mode, "law": "vsg-2", "duration": 200.0, "link": LIVE}
    scenario = make(**content, late_policy={"hold": 10**6})
    pair = run_pair(scenario, place, link, stopped=lambda: time.monotonic() - begin > 1.0)
    ends = pair.ends()
    assert {ends[role][0] for role in ROLES} == {"interrupted"}
    assert "stopped by the operator" in {ends[role][1] for role in ROLES}


def test_an_event_whose_tick_was_lost_is_carried_out_with_the_next_frame(place, make):
    content = {
        "mode": "realtime",  # in lockstep the plant asks again
        "late_policy": {"hold": 10**6},
        "link": LIVE,
        "law": "vsg-2",
        "events": [
            {"tick": 4, "type": "reference", "P_ref": 0.6},
            {"tick": 6, "type": "reference", "P_ref": 0.7},
            {"tick": 9, "type": "law", "law": "droop-1"},
        ],
    }
    heard = frames("y", 0, 1, 5, 6, 11, 12)
    heard = after(heard, "y", 13, STOPPED)
    found = alone("controller", make(**content), place, heard)
    assert found.end == ("completed", "", 12)
    happened = [(e["tick"], e["event"]) for e in found.log if "label" in e]
    assert happened == [(5, "reference"), (6, "reference"), (11, "law")]
    P_ref, law = found.part.signals[:13, 1], found.part.signals[:13, 5]
    assert np.isnan(P_ref[[2, 3, 4, 7, 8, 9, 10]]).all()
    assert P_ref[[0, 1, 5, 6, 11, 12]].tolist() == [0.5, 0.5, 0.6, 0.7, 0.7, 0.7]
    assert law[[0, 6, 11, 12]].tolist() == [0, 0, 1, 1]
    assert answered(found) == [0, 1, 5, 6, 11, 12]


def test_frames_of_another_kind_are_counted_and_never_used(place, make):
    good = frames("y", 0, 1, 2, 3)
    stop = after(good, "y", 4, STOPPED)[-1]
    foreign = frames("y", *range(2**16, 2**16 + 2))
    heard = [
        good[0],
        resealed(good[1], 2, good[1][2] + 1),  # another version
        resealed(good[1], 3, 2),  # u in place of y
        frames("u", 1)[0],
        good[0],
        good[1],
        resealed(foreign[1], 11, 0xC0),  # a much older sequence
        good[1][:20] + bytes([good[1][20] ^ 4]) + good[1][21:],
        good[2],
        good[3],
        stop,
    ]
    found = alone("controller", make(link=LIVE, law="vsg-2"), place, heard)
    counted = {fault: n for fault, n in found.faults.items() if n}
    assert counted == {
        "version": 1, "source": 1, "size": 1, "repeated": 1, "out_of_sequence": 1, "crc": 1
    }  # fmt: skip
    assert found.end[0] == "completed"
    assert answered(found) == [0, 1, 2, 3]


def test_a_tick_beyond_the_run_is_refused(place, make):
    scenario = make(link=LIVE, law="vsg-2", duration=0.001)
    heard = after(frames("y", 0, 1, 10_000_000), "y", 2, STOPPED)
    found = alone("controller", scenario, place, heard)
    assert found.faults["tick"] == 1
    assert answered(found) == [0, 1]


@pytest.mark.parametrize("link", PORTS)
def test_a_link_that_pauses_for_longer_than_hold_ends_in_safe(link, place, make):
    hold = 50
    pause = {"pause_at": 100, "pause": 20.0, "towards": "plant"}
    content = {**REALTIME, "duration": 20.0, "link": {**LIVE, "impairment": pause}}
    for attempt in range(5):
        pair = run_pair(make(**content, late_policy={"hold": hold}), place / str(attempt), link)
        if pair.ends()["plant"][1] != REASONS[STALE]:
            break  # else the machine stalled the plant for longer than hold
    *end, tick = pair.ends()["plant"]
    assert end == ["safe", "no fresh u for longer than late_policy.hold allows"]
    received = pair.timing["plant_received"]
    assert len(received) == tick  # latched: it samples nothing any more
    assert (received[-hold - 1 :] < 0).all()
    assert tick == hold + 1 or received[-hold - 2] >= 0
    status, reason, _ = pair.ends()["controller"]
    assert status in ("interrupted", "safe") and reason
