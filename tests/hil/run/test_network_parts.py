"""Lines of travelling waves cut a network into parts, which run on one processor core or on several
with the same bits."""

from typing import Any

import numpy as np
import pytest

import gfm_plant.build
import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.engine.crew import Crew
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import load_scenario, plant_of
from gfm_plant.parted import find_places

OMEGA_B, TAU = 100 * np.pi, 1.3e-4
STEP = {"type": "breaker", "t": 0.02, "name": "step", "closed": True}
FAULT = {"type": "fault", "t": 0.04, "kind": "LL", "node": "b", "R": 0.5, "duration": 0.02}
#: in both parts a fault, a load, a converter that leaves and comes again
EVENTS = [
    STEP,
    FAULT | {"clearing": "instant"},
    FAULT | {"t": 0.08, "node": "a", "kind": "3ph", "clearing": "instant"},
    {"type": "breaker", "t": 0.12, "name": "a1", "closed": False, "clearing": "instant"},
    {"type": "breaker", "t": 0.13, "name": "a1", "closed": True,
     "check": {"V": 0.5, "f_hz": 2.0, "degrees": 60.0, "lasting_s": 0.005, "within_s": 0.1}},
]  # fmt: skip


def given(order: str = "a1 a2 b1 b2", tau: float = TAU, **changes: Any) -> dict[str, Any]:
    """Two stars, whose buses a and b a long line connects."""
    size = OMEGA_B * tau
    names = order.split()
    network = {
        "record": ["all"],
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
        place = made if key in ("duration", "events", "link", "plant", "cores") else network
        place[key] = place[key] | value if isinstance(place.get(key), dict) else value
    return made


def in_one(monkeypatch: pytest.MonkeyPatch, content: dict[str, Any]) -> NetworkRun:
    """A run whose network is one circuit."""
    with monkeypatch.context() as patched:
        patched.setattr(gfm_plant.build, "find_places", lambda wiring: [])
        return gfmhil.run_network(content)


def furthest(one: NetworkRun, other: NetworkRun) -> float:
    """The largest difference of any column, of converters and of the network."""
    pairs = [(one[name].signals, other[name].signals) for name in one]
    each = [(a[key], b[key]) for a, b in pairs for key in a if key not in ("tick", "t")]
    each += [(one.flows[key], other.flows[key]) for key in one.flows]
    assert len(each) > 100 and len(each[0][0]) == len(each[0][1])
    return max(float(np.abs(np.asarray(a, float) - b).max()) for a, b in each)


@pytest.mark.full
@pytest.mark.parametrize(
    ("more", "events"),
    [
        ({}, EVENTS),
        ({"machines": {"m": {"node": "b", "S": 2.0, "H": 3.0, "P": 0.4}}}, [STEP]),
        (
            {"grid": "far", "lines": {"tie": {"start": "b", "end": "far", "L": 0.2, "R": 0.02}}},
            [
                {"type": "grid-voltage", "t": 0.02, "V_g": 0.8, "duration": 0.03},
                {"type": "grid-phase-jump", "t": 0.07, "degrees": 10.0},
                {"type": "grid-unbalance", "t": 0.1, "retained": [0.9, 1.0, 1.0], "duration": 0.02},
                {"type": "grid-frequency", "t": 0.13, "f_hz": 50.1, "rate": 5.0},
            ],
        ),
    ],
    ids=["island", "machine", "grid"],
)
def test_parts_are_one_circuit(more, events, monkeypatch):
    """Also the frequency, which a machine or the grid of the other part sets. Poles that open as
    their currents pass zero cut a period of their own part alone: those are in the next test."""
    content = given(events=events, **more)
    assert furthest(gfmhil.run_network(content), in_one(monkeypatch, content)) < 1e-11


@pytest.mark.full
def test_poles_that_open_at_zeros(monkeypatch):
    """The line's end in the other part has longer pieces then, whose error is below 1e-3."""
    content = given(events=[STEP, FAULT])
    assert furthest(gfmhil.run_network(content), in_one(monkeypatch, content)) < 1e-3


@pytest.mark.full
def test_large_parts_are_one_circuit(monkeypatch):
    """By their series, in an unbalanced fault, with the recorded currents."""
    monkeypatch.setattr(gfm_plant.build, "MOST_BY_MODES", 1)
    content = given(events=EVENTS[:2], duration=0.1)
    parts = plant_of(load_scenario(content)).pieces
    assert [part.net[0]["sparse"] for part in parts] == [1, 1]
    assert furthest(gfmhil.run_network(content), in_one(monkeypatch, content)) < 1e-10


@pytest.mark.full
def test_two_cores_give_the_bits_of_one():
    """Three parts, of which a core has two; a converter of each end trips, and the poles open as
    the currents pass zero."""
    more = {
        "lines": {"to_c1": {"start": "at_c1", "end": "c", "L": 0.1, "R": 0.01}},
        "capacitors": {"e": {"node": "c", "Q": 0.1}},
        "bergeron_lines": {"next": {"start": "b", "end": "c", "L": 0.05, "B": 0.05}},
        "loads": {"farm": {"node": "c", "P": 0.3}},
        "converters": {"c1": {"node": "at_c1"}},
        "events": [
            STEP, FAULT,
            {"type": "reference", "t": 0.1, "converter": "a1", "P_ref": 2.0},
            {"type": "reference", "t": 0.1, "converter": "b2", "P_ref": 2.0},
        ],
        "plant": {"protection": {"over_current": {"threshold": 1.5}}},
    }  # fmt: skip
    runs = [gfmhil.run_network(given(cores=cores, **more)) for cores in (1, 2, 3)]
    assert all(runs[0][name].status == "tripped" for name in ("a1", "b2"))
    for name in runs[0]:
        assert len({run[name].digest for run in runs}) == 1
    assert all(furthest(runs[0], run) == 0.0 for run in runs[1:])


@pytest.mark.full
def test_a_run_from_a_snapshot_has_the_bits_of_the_whole(tmp_path):
    content = given(events=[STEP | {"t": 0.15}])
    first = gfmhil.run_network(content | {"snapshot": 0.1}, folder=tmp_path / "first")
    moved = content | {"events": [STEP | {"t": 0.05}], "duration": 0.1, "cores": 2}
    second = gfmhil.run_network(moved | {"start_from": str(tmp_path / "first")})
    for name in first:
        np.testing.assert_array_equal(
            first[name].signals["true_p"][1000:], second[name].signals["true_p"]
        )


@pytest.mark.processes
def test_parts_over_a_link_have_the_bits_of_a_run_in_process(tmp_path):
    content = given(events=EVENTS[:3], duration=0.1)
    linked = gfmhil.run_network(content | {"link": {"type": "shm"}}, folder=tmp_path / "linked")
    inside = gfmhil.run_network(content)
    assert furthest(inside, linked) == 0.0


@pytest.mark.parametrize(
    ("changes", "ends"),
    [
        ({}, [2, 4]),
        ({"order": "a1 b1 a2 b2"}, [4]),  # they would have to follow each other
        ({"order": "b1 a1 a2"}, [1, 3]),
        ({"order": "a1 a2"}, [2]),  # b has no converter
        ({"lines": {"tie": {"start": "a", "end": "b", "L": 0.1}}}, [4]),
        ({"lines": {"tie": {"start": "a", "end": "b", "L": 0.1, "closed": False}}}, [4]),
    ],
)
def test_what_is_a_part(changes, ends):
    wiring = plant_of(load_scenario(given(events=[], **changes))).wiring
    assert [place.end for place in find_places(wiring)] == ends


@pytest.mark.parametrize(
    ("sizes", "cores", "shares"),
    [
        ([1, 1], 2, [(0, 1), (1, 2)]),
        ([1, 1, 4], 2, [(0, 2), (2, 3)]),
        ([6, 1, 1], 3, [(0, 1), (1, 2), (2, 3)]),
        ([1, 1, 1, 9], 3, [(0, 2), (2, 3), (3, 4)]),
        ([1], 4, [(0, 1)]),
    ],
)
def test_the_shares_of_the_threads(sizes, cores, shares):
    class Part:
        def __init__(self, n: int) -> None:
            self.par = np.zeros(n)

    class Plant:
        pieces = tuple(map(Part, sizes))

    found = Crew(Plant(), cores).shares
    assert [(one.first, one.end) for one in found] == shares


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cores": 3}, r"cores = 3: at most 2: the plant has 2 parts with converters"),
        ({"cores": 2, "order": "a1 b1 a2"}, r"cores = 2: at most 1: the plant has 1 part with"),
        ({"cores": 0}, r"cores: must be greater than or equal to 1, not 0"),
        ({"cores": 2, "link": {"type": "shm"}}, r"cores = 2: with link.type = 'inproc' only"),
        ({"tau": 0.9e-4}, r"network.bergeron_lines.long: L = .*allowed is at least T_s = 0.0001"),
    ],
)
def test_cores_that_a_network_cannot_have(changes, message):
    with pytest.raises(UserError, match=message) as refused:
        load_scenario(given(events=[], **changes))
    assert "\n" not in str(refused.value)
