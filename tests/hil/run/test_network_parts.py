"""Lines of travelling waves cut a network into parts, which run in threads of their own, on one
processor core or on several, with the same bits."""

from typing import Any

import numpy as np
import pytest

import gfm_plant.build
import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.engine import inproc
from gfm_hil.engine.setup import make_benches
from gfm_hil.engine.timeline import TimelineInMemory
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.runner import make_room
from gfm_hil.scenario import load_scenario, plant_of
from gfm_hil.scenario.events.fault import Fault
from gfm_plant.parted import find_places

OMEGA_B, TAU = 100 * np.pi, 1.3e-4
STEP = {"type": "breaker", "t": 0.02, "name": "step", "closed": True}
FAULT = {"type": "fault", "t": 0.04, "kind": "LL", "node": "b", "R": 0.5, "duration": 0.02}
#: in both parts a fault, a load, a converter that leaves and comes again
EVENTS: list[dict[str, Any]] = [
    STEP,
    FAULT | {"clearing": "instant"},
    FAULT | {"t": 0.08, "node": "a", "kind": "3ph", "clearing": "instant"},
    {"type": "breaker", "t": 0.12, "name": "a1", "closed": False, "clearing": "instant"},
    {"type": "breaker", "t": 0.13, "name": "a1", "closed": True,
     "check": {"V": 0.5, "f_hz": 2.0, "degrees": 60.0, "lasting_s": 0.005, "within_s": 0.1}},
]  # fmt: skip


TOP = ("duration", "events", "link", "plant", "cores", "snapshot")


def given(order: str = "a1 a2 b1 b2", tau: float = TAU, **changes: Any) -> dict[str, Any]:
    """Two stars, whose buses a and b a long line connects."""
    size = OMEGA_B * tau
    names = order.split()
    network = {
        "record": ["converters", "lines", "loads"],
        "converters": {name: {"node": f"at_{name}"} for name in names},
        "lines": {f"to_{name}": {"start": f"at_{name}", "end": name[0], "L": 0.1, "R": 0.01}
                  for name in names},
        "loads": {"town": {"node": "a", "P": 1.0, "Q": 0.2}, "mill": {"node": "b", "P": 0.8},
                  "step": {"node": "b", "P": 0.4, "closed": False}},
        "capacitors": {"c": {"node": "a", "Q": 0.1}, "d": {"node": "b", "Q": 0.1}},
        "bergeron_lines": {"long": {"start": "a", "end": "b", "L": size, "B": size, "R": 0.01}},
    }  # fmt: skip
    made = {
        "title": "parts", "duration": 0.2, "law": "vsg-2", "link": {"type": "inproc"},
        "network": network, "events": EVENTS,
    }  # fmt: skip
    for key, value in changes.items():
        place = made if key in TOP else network
        place[key] = place[key] | value if isinstance(place.get(key), dict) else value
    return made


def furthest(one: NetworkRun, other: NetworkRun) -> float:
    """The largest difference of any column, of converters and of the network."""
    pairs = [(one[name].signals, other[name].signals) for name in one]
    each = [(a[key], b[key]) for a, b in pairs for key in a if key not in ("tick", "t")]
    each += [(one.flows[key], other.flows[key]) for key in one.flows]
    assert len(each) > 100 and len(each[0][0]) == len(each[0][1])
    return max(float(np.abs(np.asarray(a, float) - b).max()) for a, b in each)


GRID_EVENTS = [
    {"type": "grid-voltage", "t": 0.02, "V_g": 0.8, "duration": 0.03},
    {"type": "grid-phase-jump", "t": 0.07, "degrees": 10.0},
    {"type": "grid-unbalance", "t": 0.1, "retained": [0.9, 1.0, 1.0], "duration": 0.02},
    {"type": "grid-frequency", "t": 0.13, "f_hz": 50.1, "rate": 5.0},
]
LOAD = {"type": "grid-load", "t": 0.02, "change": 0.1}
TO_GRID = {"grid": "far", "lines": {"tie": {"start": "b", "end": "far", "L": 0.2, "R": 0.02}}}
MACHINE = {"machines": {"m": {"node": "b", "S": 2.0, "H": 3.0, "P": 0.4}}}


@pytest.mark.full
@pytest.mark.parametrize(
    ("more", "events"),
    [
        ({}, EVENTS),
        (MACHINE, [STEP]),
        (TO_GRID, GRID_EVENTS),
        (TO_GRID | {"plant": {"grid": {"finite": {"S": 5.0, "H": 4.0}}}}, [LOAD, STEP]),
        ({"plant": {"delay": {"samples": 1, "fraction": 0.5}}}, EVENTS),
    ],
    ids=["island", "machine", "grid", "finite grid", "delay"],
)
def test_parts_are_one_circuit(more, events):
    """Also the frequency, which a machine or the grid of the other part sets. Poles that open as
    their currents pass zero cut a period of their own part alone: those are in the next test."""
    content = given(events=events, **more)
    one, two = (gfmhil.run_network(content | cores) for cores in ({}, {"cores": 2}))
    assert furthest(one, two) < 1e-11


@pytest.mark.full
def test_poles_that_open_at_zeros():
    """The line's end in the other part has longer pieces then, whose error is below 1e-3; and the
    currents of a fault are recorded where it is."""
    content = given(events=[STEP, FAULT], record=["fault", "town"])
    one, two = (gfmhil.run_network(content | cores) for cores in ({}, {"cores": 2}))
    assert furthest(one, two) < 1e-3
    assert np.ptp(two.flows["fault.i_b"]) > 0.5


@pytest.mark.full
def test_large_parts_are_one_circuit(monkeypatch):
    """By their series, in an unbalanced fault."""
    monkeypatch.setattr(gfm_plant.build, "MOST_BY_MODES", 1)
    content = given(events=EVENTS[:2], duration=0.1)
    one, two = (gfmhil.run_network(content | cores) for cores in ({}, {"cores": 2}))
    assert furthest(one, two) < 1e-10


THIRD = {
    "lines": {"to_c1": {"start": "at_c1", "end": "c", "L": 0.1, "R": 0.01}},
    "capacitors": {"e": {"node": "c", "Q": 0.1}},
    "bergeron_lines": {"next": {"start": "b", "end": "c", "L": 0.05, "B": 0.05}},
    "loads": {"farm": {"node": "c", "P": 0.3}},
    "converters": {"c1": {"node": "at_c1"}},
}


@pytest.mark.full
def test_two_cores_give_the_bits_of_one(tmp_path):
    """Three parts; a converter of two of them trips, and the poles open as the currents pass
    zero. A run folder has what a run in memory has."""
    over = {"type": "reference", "t": 0.1, "P_ref": 2.0}
    events = [STEP, FAULT, over | {"converter": "a1"}, over | {"converter": "b2"}]
    trips = {"protection": {"over_current": {"threshold": 1.5}}}
    content = given(events=events, plant=trips, **THIRD)
    runs = [gfmhil.run_network(content | {"cores": cores}) for cores in (1, 2, 3)]
    assert all(runs[0][name].status == "tripped" for name in ("a1", "b2"))
    for name in runs[0]:
        assert len({run[name].digest for run in runs}) == 1
    runs.append(gfmhil.run_network(content | {"cores": 2}, folder=tmp_path / "run"))
    assert all(furthest(runs[0], run) == 0.0 for run in runs[1:])


@pytest.mark.full
def test_what_a_part_that_diverged_sends(monkeypatch):
    """The others go on, and the recording has all ticks."""
    monkeypatch.setattr(Fault, "apply", lambda self, plant: plant.now["w"].__setitem__((0, 0), 1e9))
    run = gfmhil.run_network(given(events=[FAULT | {"node": "a"}], cores=2, duration=0.05))
    assert any("diverged" in run[name].summary["reason"] for name in ("a1", "a2"))
    assert all(run[name].status == "completed" for name in ("b1", "b2"))
    for one in run.values():
        assert np.isfinite(one.signals["true_p"]).all() and len(one.signals["true_p"]) == 500


@pytest.mark.full
def test_all_parts_stop_with_the_same_tick():
    class Stop:
        asked = 0

        def __call__(self, ticks: int) -> bool:
            self.asked = ticks
            return ticks < 6000

    content = load_scenario(given(events=[], cores=2, duration=2.0))
    benches = make_benches(content)
    plants, controllers = zip(*make_room(benches), strict=True)
    timelines = [TimelineInMemory(bench) for bench in benches]
    done = inproc.run_inproc(benches, plants, controllers, timelines, stop := Stop())
    assert done == stop.asked == 6000
    assert {one.outcome.status for one in timelines} == {"interrupted"}


@pytest.mark.full
def test_what_one_thread_raises_ends_the_run(monkeypatch):
    def fail(plant: Any) -> None:
        if "b" in plant.elsewhere:
            raise RuntimeError("no memory")

    monkeypatch.setattr(inproc, "follow_trips", fail)
    with pytest.raises(RuntimeError, match="no memory"):
        gfmhil.run_network(given(events=[], cores=2))


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({}, [(0, 1), (2, 3)]),
        ({"order": "a1 b1 a2 b2"}, [(0, 2), (1, 3)]),
        ({"order": "a1 a2"}, [(0, 1)]),  # b has no converter
        ({"lines": {"tie": {"start": "a", "end": "b", "L": 0.1}}}, [(0, 1, 2, 3)]),
        ({"lines": {"tie": {"start": "a", "end": "b", "L": 0.1, "closed": False}}}, [(0, 1, 2, 3)]),
    ],
)
def test_what_is_a_part(changes, parts):
    assert find_places(plant_of(load_scenario(given(events=[], **changes))).wiring) == parts


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cores": 3}, r"cores = 3: at most 2: the network has 2 parts with converters"),
        ({"cores": 2, "order": "a1 a2"}, r"cores = 2: at most 1: the network has 1 part with"),
        ({"cores": 0}, r"cores: must be greater than or equal to 1, not 0"),
        ({"cores": 2, "link": {"type": "shm"}}, r"cores = 2: with link.type = 'inproc' only"),
        ({"cores": 2, "snapshot": 0.1}, r"cores = 2: not with snapshot or start_from"),
    ],
)
def test_cores_that_a_network_cannot_have(changes, message):
    with pytest.raises(UserError, match=message) as refused:
        load_scenario(given(events=[], **changes))
    assert "\n" not in str(refused.value)


def test_cores_go_with_a_network():
    with pytest.raises(UserError, match="cores = 1: goes with a network"):
        load_scenario("pref_step", cores=1)
