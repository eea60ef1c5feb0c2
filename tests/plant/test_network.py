"""Several converters in one network, against SciPy and against networks that are the same."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import (
    Network,
    NetworkParts,
    Plant,
    build,
    load_converter,
    make_network,
    network,
    plant_command,
    plant_step,
    take_out,
)
from gfm_plant.circuit import Shunt
from gfm_plant.components import Machine
from gfm_plant.grid import fault, line_breaker, phase_jump
from gfm_plant.model import DELTA, V_DC
from gfm_plant.names import TRIPS, WAYS

pytestmark = pytest.mark.full  # compiles the plant for several converters

T_S = 1e-4
OFF = {name: {"enabled": False} for name, *_ in TRIPS}
"""No protection: the sources follow no law here, so that their DC links drift."""


def make(converters: dict[str, tuple[dict[str, Any], str]], **parts: Any) -> Network:
    made = {
        name: (Plant.model_validate({"protection": OFF, **options}), node)
        for name, (options, node) in converters.items()
    }
    return make_network(made, T_S, Plant().grid, NetworkParts.model_validate(parts))


def start(plant: Network, E: Any, delta: Any, omega: float = 1.0) -> np.ndarray:
    """Let all sources turn at one speed for so long that the circuit is at rest; returns u."""
    N = len(plant.par)
    u = np.zeros((N, 4))
    u[:, 1], u[:, 2] = omega, E
    x = np.zeros((N, 8))
    x[:, DELTA], x[:, V_DC] = delta, 1.0
    rests = [(np.zeros(0), omega)] * len(plant.wiring.fed)
    plant.start(x, u, rests)
    # w as the phasors have it, which `start` takes from x for the converters' own states
    modes, sources = plant.wiring.modes(frozenset(), None)
    volts = [u[k, 2] * np.exp(1j * x[k, DELTA]) for k in range(N)]
    volts += [1.0] if "grid" in sources else []
    speed = plant.wiring.omega_b * (omega - 1)
    w = modes.states @ (modes.drive @ volts / (1j * speed - modes.rates))
    for k in range(N):
        own = w[3 * k : 3 * k + 3] * np.exp(-1j * x[k, DELTA])
        own[[0, 2]] *= plant.par[k]["current"]
        x[k, 0:6:2], x[k, 1:6:2] = own.real, own.imag
        u[k, 0] = u[k, 2] * own[0].real
    plant.start(x, u, rests)
    return u


def go(plant: Network, u: np.ndarray, ticks: int) -> None:
    for _ in range(ticks):
        for k in range(len(u)):
            plant_command(plant.records, k, u[k])
        plant_step(plant.records)


@pytest.mark.parametrize(
    ("factor", "kind"), [(1.0, "none"), (1.3, "none"), (1.3, "LL"), (1.0, "LG")]
)
def test_against_an_adaptive_integrator(factor, kind):
    """Two converters, the second with other elements, at two nodes with a capacitor bank each; a
    fault connects phases c and a at the second node, or phase b and ground."""
    plant = make(
        {"a": ({}, "m"), "b": ({"factors": {"L_f": factor, "C_f": 1 / factor, "C_dc": 0.8}}, "n")},
        lines={"l": {"start": "m", "end": "n", "L": 0.2, "R": 0.03}},
        loads={"z": {"node": "n", "P": 0.8, "Q": 0.3}, "r": {"node": "m", "P": 0.4}},
        capacitors={"c": {"node": "m", "Q": 0.05}, "d": {"node": "n", "Q": 0.08}},
    )
    u = start(plant, [1.02, 0.99], [0.05, 0.0])
    x0, w0 = plant.st["x"].copy(), plant.now["w"][0].copy()
    order = plant.wiring.order
    assert order == ("a.i_f", "a.v", "a.i_o", "b.i_f", "b.v", "b.i_o", "l", "z", "c", "d")
    u[0] += [0.05, 2e-3, 0.03, 0.0]  # a step of everything
    u[1] += [-0.02, -1e-3, -0.02, 0.0]
    w_b, par = plant.wiring.omega_b, plant.par
    z = 0.8**2 + 0.3**2
    axes = np.exp(2j * np.pi / 3 * np.array([0, 1, -1]))
    R, Z_0 = 4.0, 0.1 + 0.5j
    if kind != "none":
        more = {"kind": "LL", "phases": "ca"} if kind == "LL" else {"phases": "b", "Z_0": Z_0}
        fault(plant, None, R, node="n", **{"kind": "LG", **more})

    def leak(t: float, v: complex, i_0: float) -> tuple[complex, float]:
        """The fault's current, without zero sequence, and the d/dt of its zero sequence."""
        turn = np.exp(1j * w_b * t)
        v_a, v_b, v_c = (v * turn * axes.conj()).real
        if kind == "LG":  # the current of b returns through Z_0: v_b + v_0 = 3 R i_0
            i_abc, di_0 = [0.0, 3 * i_0, 0.0], (v_b - (3 * R + Z_0.real) * i_0) / Z_0.imag
        else:
            i_abc, di_0 = [(v_a - v_c) / R, 0.0, (v_c - v_a) / R], 0.0
        return 2 / 3 * np.dot(i_abc, axes) / turn * (kind != "none"), w_b * di_0

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        i_f, v, i_o = s[0:6:3], s[1:6:3], s[2:6:3]
        i_l, i_z, v_m, v_n, v_dc = s[6], s[7], s[8], s[9], s[10:12].real
        e = u[:, 2] * np.exp(1j * (x0[:, DELTA] + w_b * (u[:, 1] - 1) * t))
        v_node = np.array([v_m, v_n])
        out = np.empty_like(s)
        out[0:6:3] = w_b / par["L_f"] * (e - v - par["R_f"] * i_f)
        out[1:6:3] = w_b / par["C_f"] * (i_f - i_o)
        out[2:6:3] = w_b / par["L_g"] * (v - v_node - par["R_g"] * i_o)
        out[6] = w_b / 0.2 * (v_m - v_n - 0.03 * i_l)
        out[7] = w_b / (0.3 / z) * (v_n - 0.8 / z * i_z)
        out[8] = w_b / 0.05 * (i_o[0] - i_l - 0.4 * v_m)
        away, out[12] = leak(t, v_n, s[12].real)
        out[9] = w_b / 0.08 * (i_o[1] + i_l - i_z - away)
        out[:10] -= 1j * w_b * s[:10]
        drawn = (e * i_f.conj()).real
        out[10:12] = w_b / par["C_dc"] * (u[:, 0] - drawn / v_dc)
        return out

    s0 = np.concatenate([w0[:10], [1.0, 1.0, 0.0]])
    exact = solve_ivp(slope, (0, 0.05), s0, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    go(plant, u, 500)
    w = plant.now["w"][0]
    assert np.abs(w[:10] - exact[:10]).max() < 1e-9
    assert plant.st["x"][:, V_DC] == pytest.approx(exact[10:12].real, abs=1e-8)


@pytest.mark.parametrize("n", [3, 14])
def test_identical_converters_at_one_bus_are_one_with_a_longer_line(n):
    """Each of n equal converters sees a shared line n times as long."""
    L, R = 0.1, 0.02
    many = make(
        {f"c{k}": ({}, "bus") for k in range(n)}, grid="far",
        lines={"l": {"start": "bus", "end": "far", "L": L, "R": R}},
    )  # fmt: skip
    one = make(
        {"c": ({}, "bus")}, grid="far",
        lines={"l": {"start": "bus", "end": "far", "L": n * L, "R": n * R}},
    )  # fmt: skip
    found = []
    for plant in (many, one):
        u = start(plant, 1.0, 0.2)
        phase_jump(plant, 20.0)
        u[:, 2] += 0.02
        go(plant, u, 9000 // n)
        found.append(plant.st["x"])
    assert np.abs(found[0] - found[1][0]).max() < 1e-10


def test_a_rating_is_as_many_converters_of_the_first_one(tmp_path):
    """A converter of twice the rating, the same in its own p.u., is two of the small one."""
    paper = load_converter("paper").model_dump()
    paper["S_n"] *= 2
    for name in ("L_f", "R_f", "L_g", "R_g"):
        paper[name] /= 2
    for name in ("C_f", "C_dc"):
        paper[name] *= 2
    file = tmp_path / "large.toml"
    file.write_text("".join(f"{k} = {v!r}\n" for k, v in paper.items() if v is not None))
    small, large = ({}, "bus"), ({"converter": str(file)}, "bus")
    line = {"l": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02}}
    found = []
    for parts in ({"a": small, "b": small, "c": small}, {"a": small, "b": large}):
        plant = make(parts, grid="far", lines=line)
        u = start(plant, 1.0, [0.3, 0.1, 0.1][: len(parts)])
        u[1:, 2] += 0.05
        go(plant, u, 500)
        found.append(plant.st["x"])
    assert found[0][1] == pytest.approx(found[0][2], abs=1e-12)
    assert found[1] == pytest.approx(found[0][:2], abs=1e-10)


def tripping(**limits: float) -> Network:
    """Two converters on a grid that trip above the currents that ``limits`` gives them."""
    converters = {}
    for name in "ab":
        trip = {"threshold": limits[name]} if name in limits else OFF["over_current"]
        converters[name] = ({"protection": {**OFF, "over_current": trip}}, "bus")
    return make(
        converters, grid="far", lines={"l": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02}}
    )


def test_a_plant_restored_from_a_copy_of_its_start_repeats_its_course():
    plant = tripping(a=10.0)
    u = start(plant, 1.0, 0.2)
    u[:, 2] *= 1.01
    kept, after = plant.copy(), []
    for _ in range(2):
        go(plant, u, 3)
        after.append(plant.st["x"].tobytes())
        plant.restore(kept)
    assert after[0] == after[1] != kept.st["x"].tobytes()


def test_one_trips_and_the_other_goes_on():
    plant = tripping(a=0.01)
    u = start(plant, 1.0, 0.2)
    alone = make(
        {"a": ({}, "bus"), "b": ({}, "bus")}, grid="far",
        lines={"l": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02}},
    )  # fmt: skip
    start(alone, 1.0, 0.2)
    go(plant, u, 1)
    assert list(plant.st["trip"]) == [1, 0] and plant.st["x"][0, 0] == 0.0
    take_out(plant)
    assert plant.wiring.blocked == {0}
    # the other one, against the same network in which a's bridge was never connected
    w = plant.now["w"][0].copy()
    alone.now["w"][0], alone.now["unit"][0] = w, plant.now["unit"][0]
    alone.st["x"], alone.st["trip"] = plant.st["x"], [1, 0]
    alone.connect(plant.wiring)
    alone.rewire(plant.wiring)
    for one in (plant, alone):
        go(one, u, 500)
    assert plant.st["x"] == pytest.approx(alone.st["x"], abs=1e-12)
    assert abs(plant.st["x"][1, 4]) > 0.3


def test_two_that_trip_at_once_trip_one_tick_apart():
    plant = tripping(a=0.01, b=0.01)
    u = start(plant, 1.0, 0.2)
    trips = []
    for _ in range(3):
        go(plant, u, 1)
        take_out(plant)
        trips.append(list(plant.st["trip"]))
    assert trips == [[1, 0], [1, 1], [1, 1]]
    assert list(plant.st["trip_tick"]) == [1, 2]
    go(plant, u, 1000)
    assert np.abs(plant.st["x"][:, :2]).max() == 0.0


def test_a_load_that_is_off_draws_nothing_and_a_line_that_opens_no_current():
    def at(closed: bool) -> Network:
        plant = make(
            {"a": ({}, "bus")}, grid="far",
            lines={"l": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02},
                   "m": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02}},
            loads={"z": {"node": "bus", "P": 0.3, "Q": 0.1, "closed": closed}},
        )  # fmt: skip
        return plant

    plant, other = at(True), at(False)
    u = start(plant, 1.0, 0.2)
    line_breaker(plant, "z", closed=False)
    go(plant, u, 20_000)
    start(other, 1.0, 0.2)
    go(other, u, 1)
    assert plant.st["x"][0, :6] == pytest.approx(other.st["x"][0, :6], abs=1e-7)
    line_breaker(plant, "m", closed=False)
    k = plant.wiring.order.index("m")
    go(plant, u, 300)  # pole by pole
    assert plant.now["w"][0, k] == 0.0


def test_what_faults_and_components_call_is_compiled_for_plants_that_have_them():
    line = {"l": {"start": "bus", "end": "far", "L": 0.3, "R": 0.02}}
    load = {
        "constant_power": {"c": {"node": "bus", "P": 0.1}},
        "capacitors": {"bank": {"node": "bus", "Q": 0.1}},
    }
    plain = make({"a": ({}, "bus")}, grid="far", lines=line)
    fed = make({"a": ({}, "bus")}, grid="far", lines=line, **load)
    assert fed.records.net is not None and go(plain, start(plain, 1.0, 0.1), 1) is None

    def called(plant: Network) -> set[str]:
        return {name for name in WAYS if plant.net[0][name]}

    assert called(plain) == {"step", "advance", "sample"}
    assert called(fed) == {"step", "advance", "sample", "components"}
    fault(plain, None, 0.01, node="bus")
    assert called(plain) == {"step", "advance", "sample", "clear", "join"}
    copied = plain.copy()
    plain.restore(copied)
    assert called(plain) == called(copied)


def test_delays_of_different_length_cut_the_period():
    delays = {"a": {"samples": 1, "fraction": 0.25}, "b": {"samples": 1, "fraction": 0.75}}
    plant = make({name: ({"delay": d}, "bus") for name, d in delays.items()}, grid="bus")
    assert plant.net[0]["n_parts"] == 3
    assert plant.net[0]["stretch"][:3] == pytest.approx([0.25e-4, 0.5e-4, 0.25e-4])
    u = start(plant, 1.0, 0.1)
    go(plant, u, 3)
    u[:, 2] = 1.1
    plant_step(plant.records)
    for k in range(2):
        plant_command(plant.records, k, u[k])
    plant_step(plant.records)  # a gets its command after a quarter of this period
    i_a, i_b = plant.st["x"][0, 0] - plant.st["x"][1, 0], plant.st["x"][1, 0]
    assert i_a > 0.0 and math.isfinite(i_b)


def test_a_fault_at_a_node_is_that_at_the_end_of_every_line_to_it():
    def ready() -> Network:
        return make(
            {"a": ({}, "bus"), "b": ({}, "bus")}, grid="far",
            lines={"l": {"start": "bus", "end": "far", "L": 0.3, "R": 0.02}},
        )  # fmt: skip

    at_node, on_line = ready(), ready()
    u = start(at_node, 1.0, 0.1)
    start(on_line, 1.0, 0.1)
    fault(at_node, None, 0.01, node="bus")
    fault(on_line, 0.0, 0.01, line="l")
    for plant in (at_node, on_line):
        go(plant, u, 300)
    assert at_node.st["x"] == pytest.approx(on_line.st["x"], abs=1e-12)


def test_a_fault_in_two_axes_is_one_in_three_phases():
    """Two phases bolted to an ideal ground hold the third one there too: with machine, load of
    constant power, delays and a trip, the circuits of two axes are as the balanced ones."""
    found = []
    for more in ({"kind": "LLG", "phases": "ab", "Z_0": 0j}, {}):
        both = {"delay": {"samples": 1, "fraction": 0.4}, "dc_source": {"mode": "regulated"}}
        trips = {**OFF, "over_current": {"threshold": 1.5}}
        plant = make(
            {"a": (both, "bus"), "b": ({**both, "protection": trips}, "bus")},
            lines={"l": {"start": "bus", "end": "far", "L": 0.3, "R": 0.02}},
            capacitors={"c": {"node": "far", "Q": 0.1}},
            constant_power={"d": {"node": "far", "P": 0.2}},
            machines={"M": {"node": "bus", "S": 2.0, "H": 3.0, "P": 0.0}},
        )
        u = np.zeros((2, 4))
        u[:, 1], u[:, 2] = 1.0, [1.0, 1.02]
        x = np.zeros((2, 8))
        x[:, DELTA], x[:, V_DC] = [0.05, 0.02], 1.0
        plant.start(x, u, [(np.zeros(1), 1.0), (np.zeros(0), 1.0)])
        go(plant, u, 20)
        fault(plant, 0.6, 0.0, duration=0.03, line="l", clearing="instant", **more)
        for _ in range(5):
            go(plant, u, 100)
            take_out(plant)
        found.append(
            (plant.st["x"].copy(), plant.of(Machine)["omega"].copy(), plant.st["trip"].copy())
        )
    assert found[0][2].tolist() == found[1][2].tolist() == [0, 1]
    for one, other in zip(found[0][:2], found[1][:2], strict=True):
        assert one == pytest.approx(other, abs=1e-9)


def test_a_transformer_is_its_leakage_and_its_magnetising_inductance():
    """In p.u. of its own rating: as a line and a load of reactive power alone."""
    converters = {"a": ({}, "m"), "b": ({"lcl": {"L": 0.1, "R": 0.02}}, "m")}
    transformer = {"start": "m", "end": "far", "S": 2.0, "X": 0.2, "R": 0.02, "X_m": 10.0}
    paper = Plant().real_factors()
    assert not paper
    nominal = load_converter("paper").pu()
    longer = {"factors": {"L_g": 0.1 / nominal["L_g"], "R_g": 0.02 / nominal["R_g"]}}
    one = make(converters, grid="far", transformers={"t": transformer})
    other = make(
        {"a": ({}, "m"), "b": (longer, "m")}, grid="far",
        lines={"t": {"start": "m", "end": "far", "L": 0.1, "R": 0.01}},
        loads={"z": {"node": "m", "P": 0.0, "Q": 0.2}},
    )  # fmt: skip
    assert one.wiring.order[-2:] == ("t", "t.m")
    assert set(one.wiring.breakers()) == {"a", "b", "t"} and not one.wiring.has_load
    for plant in (one, other):
        u = start(plant, 1.0, [0.1, 0.15])
        phase_jump(plant, 10.0)
        go(plant, u, 300)
    assert one.st["x"] == pytest.approx(other.st["x"], abs=1e-11)


@pytest.mark.parametrize("kind", ["3ph", "LL"])
def test_behind_taps_all_impedances_are_those_times_the_square_of_the_ratio(kind):
    t, found = 1.07, []
    for ratio, square in ((t, 1.0), (1.0, t**2)):
        plant = make(
            {"a": ({}, "m"), "b": ({}, "m")}, grid="far",
            lines={"feeder": {"start": "m", "end": "far", "L": 0.2, "R": 0.02}},
            transformers={
                "t": {"start": "m", "end": "n", "S": 1.0, "X": 0.1 * square, "R": 0.01 * square,
                      "ratio": ratio}
            },
            loads={"z": {"node": "n", "P": 0.4 / square, "Q": 0.2 / square}},
            capacitors={"c": {"node": "n", "Q": 0.1 / square}},
        )  # fmt: skip
        u = start(plant, 1.0, [0.1, 0.15])
        phase_jump(plant, 10.0)
        go(plant, u, 100)
        fault(plant, None, 0.3 * square, 0.005, node="n", kind=kind)
        go(plant, u, 200)
        found.append(plant.st["x"].copy())
    assert found[0] == pytest.approx(found[1], abs=1e-10)


@pytest.mark.parametrize(
    ("earthed", "node", "Z_0"),
    [
        ("end", "n", 1 / (1 / (0.005 + 0.05j) + 1 / (0.02 + 0.2j))),
        ("end", "m", None),
        ("start", "m", 0.005 + 0.05j),
        ("start", "n", 0.02 + 0.2j),
        ("both", "m", 0.005 + 0.05j + 0.02 + 0.2j),
        ("none", "n", 0.02 + 0.2j),
        ("none", "m", None),
    ],
)
def test_the_path_of_a_zero_sequence(earthed, node, Z_0):
    """Leakage and line, in series or in parallel, by hand."""
    plant = make(
        {"a": ({}, "m")}, grid="far",
        transformers={
            "t": {"start": "m", "end": "n", "S": 4.0, "X": 0.2, "R": 0.02, "earthed": earthed}
        },
        lines={"l": {"start": "n", "end": "far", "L": 0.2, "R": 0.02}},
    )  # fmt: skip
    u = start(plant, 1.0, 0.1)
    if Z_0 is None:
        with pytest.raises(ValueError, match=f"X_0: not set, and no closed line.*node {node}"):
            fault(plant, None, 0.1, node=node, kind="LG")
        return
    fault(plant, None, 0.1, node=node, kind="LG")
    assert plant.wiring.zero_sequence == pytest.approx(Z_0, abs=1e-15)
    go(plant, u, 100)
    told = make(
        {"a": ({}, "m")}, grid="far",
        lines={"t": {"start": "m", "end": "n", "L": 0.05, "R": 0.005},
               "l": {"start": "n", "end": "far", "L": 0.2, "R": 0.02}},
    )  # fmt: skip
    start(told, 1.0, 0.1)
    fault(told, None, 0.1, node=node, kind="LG", Z_0=Z_0)
    go(told, u, 100)
    assert plant.st["x"] == pytest.approx(told.st["x"], abs=1e-11)


BUS = {"a": ({}, "bus")}


@pytest.mark.parametrize("bank", [{}, {"c": {"node": "bus", "Q": 0.05}}])
def test_a_resistor_is_switched_on_beside_another_as_one_of_both_sizes(bank):
    y, z = {"node": "bus", "P": 0.4}, {"node": "bus", "P": 0.2, "closed": False}
    two = make(BUS, loads={"y": y, "z": z}, capacitors=bank)
    one = make(BUS, loads={"y": y}, capacitors=bank)
    u, _ = start(two, 1.0, 0.0), start(one, 1.0, 0.0)
    for closed, P in ((True, 0.6), (False, 0.4)):
        line_breaker(two, "z", closed)
        one.rewire(replace(one.wiring, shunts=(Shunt("y", "bus", 1 / P),)))
        for plant in (two, one):
            go(plant, u, 50)
        assert two.st["x"] == pytest.approx(one.st["x"], abs=1e-12)


def test_a_converter_alone_on_an_open_bus_feeds_its_capacitor():
    """v = E / (1 - w^2 L C + j w R C), and no current in the line."""
    plant = make(BUS)
    u = start(plant, 1.0, 0.2, 1.01)
    unit = plant.wiring.units[0]
    Z, Y = complex(unit.R_f, 1.01 * unit.L_f), 1.01j * unit.C_f
    go(plant, u, 400)
    x = plant.st["x"][0]
    assert complex(x[2], x[3]) == pytest.approx(1 / (1 + Z * Y), abs=1e-9)
    assert complex(x[0], x[1]) == pytest.approx(Y / (1 + Z * Y), abs=1e-9)
    assert complex(x[4], x[5]) == 0


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"grid": "buss"}, "the grid is at node 'buss', which has no path to a converter"),
        ({"loads": {"z": {"node": "x", "P": 0.1}}}, "z is at node 'x', which has no path"),
        ({"lines": {"l": {"start": "bus", "end": "x", "L": 0.1}}}, "node x: only l ends there"),
        ({"loads": {"a": {"node": "bus", "P": 0.1}}}, "a is the name of two parts"),
        ({"transformers": {"t": {"start": "bus", "end": "x", "S": 1.0, "X": 0.1}}},
         "node x: only t ends there"),
        ({"transformers": {"a": {"start": "bus", "end": "x", "S": 1.0, "X": 0.1}}},
         "a is the name of two parts"),
        ({"transformers": {"t": {"start": "y", "end": "x", "S": 1.0, "X": 0.1}}},
         "t is at node 'y', which has no path"),
    ],
)  # fmt: skip
def test_impossible_networks(parts, message):
    with pytest.raises(ValueError, match=message):
        make(BUS, **parts)


def test_all_converters_average_as_many_conversions():
    four, one = {"phases": {"samples": 4}}, {"phases": {}}
    assert make({"a": (four, "bus"), "b": (four, "bus")}).net["conversions"] == 4
    with pytest.raises(ValueError, match=r"phases\.samples: must be the same"):
        make({"a": (four, "bus"), "b": (one, "bus")})


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (lambda p: fault(p, None, 0.1, node="x"), r"node = 'x': must be one of \['bus', 'far'\]"),
        (lambda p: fault(p, 0.5, 0.1, line="x"), r"line = 'x': must be one of \['a', 'l'\]"),
        (lambda p: fault(p, None, 0.1, node="far"), "node = 'far': is an ideal voltage"),
        (lambda p: fault(p, 0.5, 0.1, line="l", kind="LGG"), "kind = 'LGG': must be one of"),
        (lambda p: line_breaker(p, "x", closed=False), r"name = 'x': must be one of \['a', 'l'\]"),
    ],
)
def test_impossible_events(event, message):
    plant = make(BUS, grid="far", lines={"l": {"start": "bus", "end": "far", "L": 0.1}})
    wiring, before = plant.wiring, [r.tobytes() for r in plant.memory]
    with pytest.raises(ValueError, match=message):
        event(plant)
    assert plant.wiring == wiring
    assert [r.tobytes() for r in plant.memory] == before


def ring(sparse: bool, monkeypatch: pytest.MonkeyPatch) -> Network:
    """Three converters with large DC links at a ring with taps, an earthed transformer, a machine,
    a load of constant power, and nodes of all kinds: with a capacitor, with a resistor, with both,
    with two branches and with more."""
    monkeypatch.setattr(build, "MOST_BY_MODES", 0 if sparse else 1000)
    monkeypatch.setattr(network, "_PIECE", 10.0)  # one piece a period, however fast the circuit is
    options = {"factors": {"C_dc": 50.0}}
    return make(
        {
            "a": (options, "m"), "b": ({"factors": {"C_dc": 50.0, "L_f": 1.3}}, "far"),
            "c": ({"factors": {"C_dc": 50.0}, "lcl": {"L": 0.1, "R": 0.01}}, "k"),
        },
        lines={
            "far": {"start": "far", "end": "n", "L": 0.1, "R": 0.01},
            "l": {"start": "m", "end": "n", "L": 0.2, "R": 0.03},
            "l2": {"start": "m", "end": "k", "L": 0.1, "R": 0.03},
            "l3": {"start": "k", "end": "n", "L": 0.1, "R": 0.02},
        },
        transformers={
            "t": {"start": "q", "end": "n", "S": 1.0, "X": 0.1, "R": 0.01, "ratio": 1.03},
        },
        loads={
            "z": {"node": "n", "P": 0.8, "Q": 0.3}, "r": {"node": "k", "P": 0.4},
            "s": {"node": "q", "P": 0.2},
        },
        capacitors={"d": {"node": "q", "Q": 0.3}},
        constant_power={"p": {"node": "q", "P": 0.1}},
    )  # fmt: skip


def run(plant: Network, what: str) -> np.ndarray:
    """w and the states of the converters after each tick."""
    x, u = np.zeros((3, 8)), np.zeros((3, 4))
    x[:, DELTA], x[:, V_DC] = [0.05, 0.0, 0.02], 1.0
    u[:, 1], u[:, 2] = [1.002, 1.0, 1.0], [1.05, 0.99, 1.0]
    plant.start(x, u)
    names, found = plant.wiring.order, []
    for k in range(250):
        if k == 40 and what in ("3ph", "LL"):
            fault(plant, None, 0.05, 0.006, node="k", kind=what)
        if k == 40 and what in ("LG", "LLG", "several"):
            kind = "LG" if what == "several" else what
            fault(plant, 0.3, 0.05, 0.006, line="l", kind=kind)
        if (k == 40 and what == "breaker") or (k == 60 and what == "several"):
            line_breaker(plant, "l2", closed=False)
        if k == 200 and what in ("breaker", "several"):
            line_breaker(plant, "l2", closed=True)
        go(plant, u, 1)
        named = dict(zip(plant.wiring.order, plant.now["w"][0], strict=False))
        own = [named[name] for name in names]
        found.append(np.concatenate([own, plant.st["x"].ravel(), plant.st["sensed"].ravel()]))
    return np.array(found)


@pytest.mark.parametrize("what", ["3ph", "LL", "LG", "LLG", "breaker", "several"])
def test_series_and_modes_agree(what, monkeypatch):
    """A large plant is solved by the series of its sparse equations, a small one by its modes; over
    a run with an event, whose phases open one by one."""
    by_modes, by_series = (run(ring(sparse, monkeypatch), what) for sparse in (False, True))
    assert np.abs(by_modes).max() > 1.0
    assert np.abs(by_series - by_modes).max() < 1e-11


def test_a_large_network_at_rest_stays_there():
    """At rest its series ends early, and leaves out so little that after 1,000 periods all currents
    and voltages are still the phasors of the circuit, here those of its modes."""
    n = 25
    plant = make(
        {f"c{k}": ({}, f"at{k}") for k in range(n)},
        lines={f"l{k}": {"start": f"at{k}", "end": "bus", "L": 0.1, "R": 0.3} for k in range(n)},
        loads={"z": {"node": "bus", "P": 0.4 * n, "Q": 0.1 * n}},
    )
    u = start(plant, 1.0 + 0.002 * np.arange(n), np.linspace(-0.05, 0.05, n), 1.0)
    phasors = plant.now["w"].copy()
    go(plant, u, 1000)
    assert plant.net["sparse"]
    assert np.abs(phasors).max() > 0.3
    assert np.abs(plant.now["w"] - phasors).max() < 1e-13


def test_a_large_circuit_that_is_too_stiff(monkeypatch):
    """A small load of R alone on inductors: its series had 15,000 steps a tick."""
    monkeypatch.setattr(build, "MOST_BY_MODES", 0)
    line = {"l": {"start": "bus", "end": "far", "L": 0.1}}
    message = r"z: with its R = 1e\+06 p\.u\. .* too stiff: .* 1/s; a load needs some Q"
    with pytest.raises(ValueError, match=message):
        make(BUS, grid="far", lines=line, loads={"z": {"node": "bus", "P": 1e-6}})
    by_Q = make(BUS, grid="far", lines=line, loads={"z": {"node": "bus", "P": 1e-6, "Q": 1e-6}})
    charged = make(
        BUS, grid="far", lines=line, loads={"z": {"node": "bus", "P": 1e-6}},
        capacitors={"c": {"node": "bus", "Q": 0.01}},
    )  # fmt: skip
    assert by_Q.net["sparse"] and charged.net["sparse"]


def test_a_plant_chooses_by_its_size():
    """Up to `build.MOST_BY_MODES` currents and voltages it has modes; a series needs no room that
    grows with the square of its size."""

    def star(n: int) -> Network:
        each = {f"c{k}": ({}, f"at{k}") for k in range(n)}
        lines = {f"l{k}": {"start": f"at{k}", "end": "bus", "L": 0.1} for k in range(n)}
        return make(each, lines=lines, loads={"z": {"node": "bus", "P": 0.4 * n, "Q": 0.1}})

    few, many, more = star(7), star(50), star(100)
    assert not few.net["sparse"] and many.net["sparse"] and more.net["sparse"]
    assert more.net.nbytes < 2.1 * many.net.nbytes
