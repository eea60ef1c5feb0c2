"""The synchro-check of a breaker, against phasors solved by NumPy and the closed form of a slip."""

import math
from typing import Any

import numpy as np
import pytest

from gfm_plant import Network, check_synchronism, finish_check, plant_command, plant_step
from gfm_plant.grid import line_breaker
from gfm_plant.synchro_check import AGREED, NONE, TIME_OVER, WATCHING
from gfm_plant.wiring import GRID_SOURCE

from .test_network import T_S, go, make, start

pytestmark = pytest.mark.full  # compiles the plant for several converters

W_B = 100 * math.pi
TIE = {"start": "m", "end": "far", "L": 0.1, "R": 0.01, "closed": False}


def island(slip_hz: float, E: float = 1.0, angle: float = 0.0) -> tuple[Network, np.ndarray]:
    """A converter on a capacitor bank at m, at rest at its own speed, beside the grid at far."""
    plant = make({"a": ({}, "m")}, grid="far", lines={"tie": TIE},
                 capacitors={"c": {"node": "m", "Q": 0.01}})  # fmt: skip
    return plant, start(plant, [E], [angle], 1 + slip_hz / 50)


def until(plant: Network, u: np.ndarray, ticks: int) -> int:
    """Ticks until the check says something."""
    for k in range(ticks):
        plant_command(plant.records, 0, u[0])
        plant_step(plant.records)
        if plant.now[0]["check"] != WATCHING:
            return k + 1
    return ticks


def bus(plant: Network) -> complex:
    order = plant.wiring.order
    return complex(plant.now["w"][0, order.index("c")])


@pytest.mark.parametrize("slip_hz", [0.5, -0.4])
def test_it_closes_when_the_angle_has_been_within_for_long_enough(slip_hz):
    """The angle goes from -40 or 40 degrees evenly towards zero."""
    plant, u = island(slip_hz, angle=math.copysign(math.radians(40), -slip_hz))
    first = math.degrees(np.angle(bus(plant)))
    check_synchronism(plant, "tie", 0.1, 1.0 / 50, 10.0, 0.05, 5.0)
    ticks = until(plant, u, 20000)
    reached = (abs(first) - 10.0) / (360 * abs(slip_hz))  # s, when 10 degrees are left
    assert ticks * T_S == pytest.approx(reached + 0.05, abs=2 * T_S)
    found = finish_check(plant)
    assert found is not None and found.closed and found.name == "tie"
    assert found.degrees == pytest.approx(first + 360 * slip_hz * ticks * T_S, abs=1e-6)
    assert found.omega * 50 == pytest.approx(slip_hz, abs=1e-6)
    assert pytest.approx(abs(bus(plant)) - 1.0, abs=1e-12) == found.V
    assert "tie" not in plant.wiring.opened and plant.now[0]["check"] == NONE
    go(plant, u, 10)
    assert abs(complex(plant.now["w"][0, plant.wiring.order.index("tie")])) > 1e-4


@pytest.mark.parametrize(
    ("slip_hz", "E", "limits"),
    [
        (0.5, 1.0, (0.1, 0.4 / 50, 180.0)),  # too fast
        (0.5, 1.2, (0.1, 1.0 / 50, 180.0)),  # too high
        (0.5, 1.0, (0.1, 1.0 / 50, 5.0)),  # within 5 degrees for 56 ms at a time
    ],
)
def test_it_stays_open_when_its_time_is_over(slip_hz, E, limits):
    plant, u = island(slip_hz, E)
    check_synchronism(plant, "tie", *limits, 0.06, 0.5)
    assert until(plant, u, 20000) == 5000
    assert plant.now[0]["check"] == TIME_OVER
    found = finish_check(plant)
    assert found is not None and not found.closed
    assert "tie" in plant.wiring.opened and finish_check(plant) is None
    assert plant.wiring.check is None


def test_it_does_not_close_onto_a_dead_side():
    plant, u = island(0.0, E=0.1)
    check_synchronism(plant, "tie", 2.0, 1.0, 180.0, 0.01, 0.1)
    assert until(plant, u, 2000) == 1000 and plant.now[0]["check"] == TIME_OVER


def test_a_breaker_that_is_switched_by_hand_ends_its_check():
    plant, _ = island(2.0)
    check_synchronism(plant, "tie", 0.1, 0.01, 10.0, 0.05, 5.0)
    line_breaker(plant, "tie", True)
    assert plant.now[0]["check"] == NONE and finish_check(plant) is None
    check_synchronism(plant, "tie", 0.1, 0.01, 10.0, 0.05, 5.0)  # closed: nothing to do
    assert plant.wiring.check is None
    line_breaker(plant, "tie", False)
    check_synchronism(plant, "tie", 0.1, 0.01, 10.0, 0.05, 5.0)
    with pytest.raises(ValueError, match="check: that of tie is not over yet"):
        check_synchronism(plant, "tie", 0.1, 0.01, 10.0, 0.05, 5.0)


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("tide", {}, r"name = 'tide': must be one of \['a', 'r', 'tie'\]"),
        ("r", {}, "name = 'r': a load has one side"),
        ("tie", {"V": -1.0}, "V = -1.0: must be >= 0"),
        ("tie", {"within": 0.05}, "within = 0.05: must be > 0.05 s"),
        ("", {}, "network.grid: not set"),
    ],
)
def test_impossible_checks(name, more, message):
    parts: dict[str, Any] = {"loads": {"r": {"node": "m", "P": 0.4}}, "lines": {"tie": TIE}}
    parts["lines"]["tie"] = {**TIE, "end": "n"}
    plant = make({"a": ({}, "m")}, **parts)
    given = {"V": 0.1, "omega": 0.01, "degrees": 10.0, "lasting": 0.05, "within": 5.0, **more}
    with pytest.raises(ValueError, match=message):
        check_synchronism(plant, name, *given.values())
    assert plant.wiring.check is None


def test_the_voltage_of_every_kind_of_node_is_that_of_its_phasors():
    """Of nodes with a capacitor, a resistor, branches alone, one that hangs, a dead one."""
    plant = make(
        {"a": ({}, "m"), "b": ({}, "far")},
        grid="g",
        lines={
            "one": {"start": "m", "end": "n", "L": 0.2, "R": 0.03},
            "two": {"start": "n", "end": "r", "L": 0.1, "R": 0.02},
            "three": {"start": "r", "end": "far", "L": 0.15, "R": 0.01},
            "four": {"start": "far", "end": "g", "L": 0.3, "R": 0.02},
            "spur": {"start": "n", "end": "end", "L": 0.1},
            "open": {"start": "end", "end": "dead", "L": 0.1, "closed": False},
        },
        loads={"z": {"node": "n", "P": 0.3, "Q": 0.2}, "q": {"node": "r", "P": 0.4}},
        capacitors={"c": {"node": "m", "Q": 0.05}},
    )
    u = start(plant, [1.02, 0.98], [0.1, -0.05])
    go(plant, u, 1)
    wiring, par = plant.wiring, plant.par
    # nodal analysis: known are the bridges and the grid
    names = ["a.t", "b.t", "m", "n", "r", "far"]
    Y, i = np.zeros((6, 6), complex), np.zeros(6, complex)

    def join(a: str, b: str | complex, y: complex) -> None:
        Y[names.index(a), names.index(a)] += y
        if isinstance(b, str):
            Y[names.index(b), names.index(b)] += y
            Y[names.index(a), names.index(b)] -= y
            Y[names.index(b), names.index(a)] -= y
        else:
            i[names.index(a)] += y * b

    for k, (one, node, delta) in enumerate((("a.t", "m", 0.1), ("b.t", "far", -0.05))):
        r = par[k]
        join(one, u[k, 2] * np.exp(1j * delta), 1 / complex(r["R_f"], r["L_f"]))
        join(one, 0j, 1j * r["C_f"])
        join(one, node, 1 / complex(r["R_g"], r["L_g"]))
    for line in wiring.branches:
        y = 1 / complex(line.R, line.L)
        if line.name in ("one", "two", "three"):
            join(line.start, line.end, y)
    join("far", 1.0 + 0j, 1 / (0.02 + 0.3j))
    size = 0.3**2 + 0.2**2
    join("n", 0j, 1 / complex(0.3 / size, 0.2 / size))
    join("r", 0j, 0.4)
    join("m", 0j, 0.05j)
    v = dict(zip(names, np.linalg.solve(Y, i), strict=True))
    w = plant.now["w"][0, : len(wiring.order)]
    _, sources = wiring.modes(frozenset(), None)
    s = [0.0, 0.0, 1.0]
    assert sources[2] == GRID_SOURCE
    expected = {"m": v["m"], "n": v["n"], "r": v["r"], "far": v["far"], "g": 1.0,
                "end": v["n"], "dead": 0.0}  # fmt: skip
    for node, there in expected.items():
        (by_w, _), (by_s, _), _ = wiring.voltage(node, frozenset(), None)
        assert by_w @ w + by_s @ s == pytest.approx(there, abs=1e-9), node


def test_the_watch_sees_what_the_rows_say():
    """Of a node where branches alone meet, at rest; the grid is at 1."""
    plant = make(
        {"a": ({}, "m"), "b": ({}, "m")},
        grid="far",
        lines={"tie": TIE, "stub": {"start": "m", "end": "n", "L": 0.1}},
        loads={"z": {"node": "n", "P": 0.3, "Q": 0.2}},
    )
    u = start(plant, [1.0, 1.0], [0.2, 0.2])
    check_synchronism(plant, "tie", 0.5, 0.01, 90.0, 0.01, 1.0)
    assert until(plant, u, 2000) == 101  # the second tick gives the first speed
    assert plant.now[0]["check"] == AGREED
    w = plant.now["w"][0, : len(plant.wiring.order)]
    (by_w, _), *_ = plant.wiring.voltage("m", frozenset(), None)
    V, omega, angle = plant.now[0]["check_seen"]
    assert complex(V + 1, 0) * np.exp(1j * angle) == pytest.approx(by_w @ w, abs=1e-9)
    assert omega == pytest.approx(0.0, abs=1e-6)
