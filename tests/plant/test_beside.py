"""One switched bridge in a network of averaged ones, and beside what has states of its own: against
DOP853 with the same edges, and each converter against itself alone."""

import cmath

import numpy as np
import pytest

from gfm_plant import (
    Plant,
    fault,
    grid_load,
    make_network,
    make_plant,
    plant_command,
    plant_equilibrium,
    plant_step,
)
from gfm_plant.components import ConstantPowerLoad, FiniteGrid, Machine, NetworkParts
from gfm_plant.model import V_DC
from gfm_plant.options import Grid
from gfm_plant.protection import trip

from ..support.switched import AtABus, OnASwingingGrid, WithMoving

pytestmark = pytest.mark.full  # compiles the plant for several converters

T_S = 1e-4
Z_B = 380**2 / 4000
DROPS = {"V_switch": 1.5, "V_diode": 1.2, "R_switch": 0.03, "R_diode": 0.02}
KINDS = "average", "two-level"
SOURCE = {"dc_source": {"mode": "regulated"}}
OTHERS = ({}, {"factors": {"L_f": 1.3, "C_f": 0.8, "C_dc": 0.7}}, {"factors": {"L_g": 2.0}})
CASES = {
    "ideal": ({}, {}),
    "dead time": ({"dead_time_s": 2e-6}, {"dead": 2e-6}),
    "drops": (
        {"dead_time_s": 2e-6, "carrier_hz": 20e3, "updates": 2, **DROPS},
        {"dead": 2e-6, "carriers": 2, "updates": 2, "counts": 5000,
         "drops": (1.5 / 700, 1.2 / 700, 0.03 / Z_B, 0.02 / Z_B)},
    ),
    "fault": ({"dead_time_s": 2e-6}, {"dead": 2e-6, "R_fault": 1.5}),
}  # fmt: skip


def command(plant, u):
    for k in range(len(u)):
        plant_command(plant.records, k, u[k])
    plant_step(plant.records)


@pytest.mark.parametrize("name", CASES)
def test_four_converters_are_exact(name):
    """The switched one is the second. Its own states and the circuit are exact to rounding; the DC
    links of the averaged ones see parabolas."""
    bridge, changes = CASES[name]
    own = [{"bridge": {"kind": "two-level", **bridge}}, *OTHERS]
    own[0], own[1] = own[1], own[0]
    plants = [Plant.model_validate({**SOURCE, **one}) for one in own]
    parts = {
        "grid": "far",
        "lines": {"tie": {"start": "bus", "end": "far", "L": 0.15, "R": 0.02}},
        "loads": {"r": {"node": "bus", "P": 1.5}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}},
    }
    plant = make_network(
        {f"c{k}": (one, "bus") for k, one in enumerate(plants)},
        T_S, Grid(), NetworkParts.model_validate(parts),
    )  # fmt: skip
    at = [
        plant_equilibrium(make_plant(one, T_S).par, P, 1.0)
        for one, P in zip(plants, (0.2, 0.8, 0.4, 0.3), strict=True)
    ]
    x, u = np.array([x for x, _ in at]), np.array([[*u, 0.0] for _, u in at])
    u[:, 2] *= [1.01, 0.99, 1.02, 1.0]
    u[:, 1] += [1e-3, 0.0, -2e-3, 0.0]
    plant.start(x, u)
    assert plant.net["port_powers"][0, 0] > 0  # the network goes on behind a port, without a fault
    if name == "fault":
        fault(plant, None, 1.5, node="bus", kind="LL", phases="ca")
    order, par, st = plant.wiring.order, plant.par, plant.st
    others, places = [0, 2, 3], [order.index(w) for w in ("c", "tie")]

    def states():
        w, tick = plant.now["w"][0], int(st["tick"][0])
        w = w * cmath.exp(1j * par[0]["omega_b"] * T_S * tick)
        each = [[*w[3 * k : 3 * k + 3], st["x"][k, V_DC], st["i_reg"][k]] for k in range(4)]
        return np.array([*each[1], *w[places], *(z for k in others for z in each[k])])

    turn = np.exp(1j * x[:, 6])
    reference = AtABus(
        par[1], states(), others=par[others], E=u[others, 2] * turn[others], u=u[others],
        conductance=1.5, susceptance=0.1, L_tie=0.15, R_tie=0.02, **changes,
    )  # fmt: skip
    worst = np.zeros(len(reference.z))
    for k in range(30):
        command(plant, u)
        reference.period(
            u[1, 2] * turn[1] * cmath.exp(1j * par[1]["omega_b"] * u[1, 1] * k * T_S), u[1]
        )
        worst = np.maximum(worst, np.abs(states() - reference.z))
    links = [7 + 5 * k + j for k in range(3) for j in (3, 4)]
    assert np.delete(worst, links).max() < 1e-10
    assert worst[links].max() < 1e-8
    assert (reference.zeros > 0) == ("dead" in changes)


def start_beside_moving(samples, kind):
    """An averaged and a switched converter at a bus with a machine and a load of constant power,
    after a step of both commands, and with a fault of a ``kind``; ``samples`` a period cut it into
    as many pieces. Returns the plant, x at the start and the commands."""
    own = ({}, {"bridge": {"kind": "two-level", "dead_time_s": 2e-6}})
    plants = [Plant.model_validate({**SOURCE, "phases": {"samples": samples}, **x}) for x in own]
    parts = {
        "grid": "far",
        "lines": {"tie": {"start": "bus", "end": "far", "L": 0.15, "R": 0.02}},
        "loads": {"r": {"node": "bus", "P": 1.0}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}},
        "constant_power": {"d": {"node": "bus", "P": 0.4, "Q": 0.1}},
        "machines": {"m": {"node": "bus", "S": 2.0, "H": 2.0, "P": 0.3, "R": 0.01, "D": 1.0}},
    }
    plant = make_network(
        {f"c{k}": (one, "bus") for k, one in enumerate(plants)},
        T_S, Grid(), NetworkParts.model_validate(parts),
    )  # fmt: skip
    at = [
        plant_equilibrium(make_plant(one, T_S).par, P, 1.0)
        for one, P in zip(plants, (0.2, 0.8), strict=True)
    ]
    x, u = np.array([x for x, _ in at]), np.array([[*u, 0.0] for _, u in at])
    u[:, 1:3] += [[1e-3, 0.01], [0.0, -0.01]]
    plant.start(x, u, [(np.array([0.1]), 1.0), (np.empty(0), 1.0)])
    if kind:
        fault(plant, None, 1.5, node="bus", kind=kind, phases="ca")
    return plant, x, u


def states_beside_moving(plant):
    """What the reference has, in the frame at rest."""
    order, par, st = plant.wiring.order, plant.par, plant.st
    places, ((one,), (load,)) = [order.index(w) for w in ("c", "tie")], map(plant.of, MOVING)
    turn = cmath.exp(1j * par[0]["omega_b"] * T_S * int(st["tick"][0]))
    w, rotor = plant.now["w"][0] * turn, plant.now["unit"][0, one["source"]] * turn
    each = [[*w[3 * k : 3 * k + 3], st["x"][k, V_DC], st["i_reg"][k]] for k in range(2)]
    own = load["v_f"] * turn, w[order.index("m")], rotor, one["omega"] - 1, one["P_turbine"]
    return np.array([*each[1], *w[places], *each[0], *own])


def errors_beside_moving(kind):
    """The largest errors in 60 periods of plants with 1, 2 and 4 samples a period."""
    made = [start_beside_moving(samples, kind) for samples in (1, 2, 4)]
    plant, x, u = made[0]
    par, ((one,), (load,)) = plant.par, map(plant.of, MOVING)
    turn = np.exp(1j * x[:, 6])
    reference = WithMoving(
        par[1], states_beside_moving(plant), others=par[:1], E=u[:1, 2] * turn[:1], u=u[:1],
        conductance=1.0, susceptance=0.1, L_tie=0.15, R_tie=0.02, dead=2e-6,
        R_fault=1.5 if kind else np.inf, load=load.copy(), machine=one.copy(), X=0.15, R_m=0.005,
    )  # fmt: skip
    reference.z[-3] = cmath.phase(reference.z[-3])
    worst = np.zeros((len(made), len(reference.z)))
    for k in range(60):
        reference.period(
            u[1, 2] * turn[1] * cmath.exp(1j * par[1]["omega_b"] * u[1, 1] * k * T_S), u[1]
        )
        z = reference.z.copy()
        z[-3] = cmath.exp(1j * z[-3].real)
        for (own, *_), error in zip(made, worst, strict=True):
            command(own, u)
            np.maximum(error, np.abs(states_beside_moving(own) - z), out=error)
    return worst


MOVING = Machine, ConstantPowerLoad


@pytest.mark.parametrize("kind", ["", "LL"])
def test_machines_and_loads_beside_a_switched_bridge_are_of_second_order(kind):
    """Half as long pieces have a quarter of the error, of currents and voltages of a network that
    starts far from rest."""
    one, two, four = errors_beside_moving(kind)[:, :12].max(axis=1)
    assert one < 2e-4
    assert one / two == pytest.approx(4.0, rel=0.15)
    assert two / four == pytest.approx(4.0, rel=0.15)


def test_a_grid_that_reacts_to_a_switched_bridge():
    options = Plant.model_validate(
        {
            **SOURCE,
            "bridge": {"kind": "two-level", "dead_time_s": 2e-6},
            "grid": {"finite": {"S": 2.0, "H": 3.0, "D": 1.0, "droop": 0.05, "T_gov": 0.4}},
        }
    )
    plant = make_plant(options, T_S)
    x, u = plant_equilibrium(plant.par, 0.5, 1.0)
    u = np.array([*u, 0.0])
    u[2] *= 1.01
    plant.start(x, u)
    grid_load(plant, 0.05)
    (one,), st, turn = plant.of(FiniteGrid), plant.st, np.exp(1j * x[6])

    def states():
        now, r = plant.now[0], plant.par[0]
        frame = cmath.exp(1j * r["omega_b"] * T_S * int(st["tick"][0]))
        links = st["x"][0, V_DC], st["i_reg"][0]
        swings = now["unit"][1] * frame, now["omega_g"] - 1, one["P_turbine"]
        return np.array([*(now["w"][:3] * frame), *links, *swings])

    reference = OnASwingingGrid(plant.par[0], states(), dead=2e-6, swings=one.copy())
    reference.z[5] = cmath.phase(reference.z[5])
    for k in range(60):
        command(plant, u[None])
        E = u[2] * turn * cmath.exp(1j * plant.par[0]["omega_b"] * u[1] * k * T_S)
        reference.period(E, u)
        z = reference.z.copy()
        z[5] = cmath.exp(1j * z[5].real)
        assert np.abs(states() - z).max() < 5e-7
    assert one["P_turbine"] > 0.0 and abs(plant.now["omega_g"][0] - 1) > 2e-4


def on_a_stiff_grid(*each, **more):
    """A network of converters at an ideal grid, by which nothing passes between them, and each of
    them alone; all in their equilibria."""
    options = [Plant.model_validate({**SOURCE, **one, **more}) for one in each]
    names = {f"c{k}": (one, "bus") for k, one in enumerate(options)}
    network = make_network(names, T_S, Grid(), NetworkParts(grid="bus"))
    alone = [make_plant(one, T_S) for one in options]
    starts = [plant_equilibrium(one.par, P, 1.0) for one, P in zip(alone, (0.6, 0.3), strict=False)]
    for one, (x, u) in zip(alone, starts, strict=True):
        one.start(x, u)
    network.start(*(np.array(column) for column in zip(*starts, strict=True)))
    return network, alone


def go_on(network, alone, ticks):
    """The largest difference between the network and each converter alone after some ticks."""
    for _ in range(ticks):
        for plant in (network, *alone):
            plant_step(plant.records)
    return max(np.abs(network.st["x"][k] - one.st["x"][0]).max() for k, one in enumerate(alone))


def test_a_network_of_one_switched_converter_is_that_converter():
    network, alone = on_a_stiff_grid({"bridge": {"kind": "two-level", "dead_time_s": 2e-6}})
    assert go_on(network, alone, 100) < 1e-12


def test_currents_that_others_give_add_up():
    """Without a capacitor at the bus, a load has the currents of both converters."""
    plants = [Plant.model_validate({**SOURCE, "bridge": {"kind": k}}) for k in KINDS]
    parts = NetworkParts.model_validate({"loads": {"r": {"node": "bus", "P": 0.8, "Q": 0.2}}})
    names = {f"c{k}": (one, "bus") for k, one in enumerate(plants)}
    plant = make_network(names, T_S, Grid(), parts)
    starts = [plant_equilibrium(make_plant(one, T_S).par, 0.4, 1.0) for one in plants]
    plant.start(*(np.array(column) for column in zip(*starts, strict=True)))
    for _ in range(20):
        plant_step(plant.records)
    a, b, load = (plant.now["w"][0][plant.wiring.order.index(x)] for x in ("c0.i_o", "c1.i_o", "r"))
    assert plant.net["port_powers"][0, 0] > 0
    assert abs(a + b - load) < 1e-12 and abs(load) > 0.5


@pytest.mark.parametrize("kind", ["two-level", "t-type"])
def test_an_averaged_bridge_trips_beside_a_switched_one(kind):
    """Its current ends at once, its DC source turns off, and the switched one goes on."""
    network, alone = on_a_stiff_grid({}, {"bridge": {"kind": kind, "dead_time_s": 2e-6}})
    assert go_on(network, alone, 20) < 1e-8
    trip(network.records, 0, 1, 0.0)
    trip(alone[0].records, 0, 1, 0.0)
    assert go_on(network, alone, 50) < 1e-8
    assert network.now[0]["w"][0] == 0.0


@pytest.mark.parametrize("which", [0, 1])
def test_either_bridge_takes_compare_counts(which):
    """Legs of 0.7, 0.4 and 0.45 of v_dc in each period. The power then swings by several p.u., and
    the parabolas of an averaged bridge in the network are shorter than those of one alone."""
    network, alone = on_a_stiff_grid({}, {"bridge": {"kind": "two-level"}})
    for plant, k in ((network, which), (alone[which], 0)):
        plant.st["u"][k, :, 4:] = np.array([0.7, 0.4, 0.45]) * plant.par[k]["counts"]
    assert go_on(network, alone, 10) < 1e-6
    assert np.abs(network.st["x"][which]).max() > 1.5  # nothing that a law would command


def test_sensors_of_both_see_what_they_see_alone():
    network, alone = on_a_stiff_grid(
        {}, {"bridge": {"kind": "two-level"}},
        sensors={"bandwidth_hz": 300.0}, phases={"samples": 4},
    )  # fmt: skip
    assert go_on(network, alone, 50) < 1e-8
    for k, one in enumerate(alone):
        assert network.st["sensed"][k] == pytest.approx(one.st["sensed"][0], abs=1e-8)
        assert np.abs(network.st["phase_sums"][k] - one.st["phase_sums"][0]).max() <= 1


@pytest.mark.parametrize(
    ("others", "words"),
    [
        ({"bridge": {"kind": "two-level", "updates": 2}}, "one carrier_hz and one updates"),
        ({"i_peak": 1.5}, "c0: plant.i_peak = 1.5: an averaged bridge beside a switched one"),
        ({"delay": {"fraction": 0.5}}, "c0: plant.delay.fraction = 0.5: compare values"),
    ],
)
def test_what_does_not_go_together_is_refused(others, words):
    with pytest.raises(ValueError, match=words) as refused:
        on_a_stiff_grid(others, {"bridge": {"kind": "two-level"}})
    assert "\n" not in str(refused.value)
