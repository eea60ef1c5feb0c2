"""The loop of a network: against the loop of one converter, against the same network drawn in
another way, and against the nonlinear bench."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfm_plant
from gfm_design.margins.all_margins import loop_margins
from gfm_design.model.closed_loop import INPUTS, ClosedLoop
from gfm_design.model.network import LINES, NetworkLoop
from gfm_hil.core.errors import UserError
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import make_benches
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.scenario import Scenario, check_scenario, plant_of, toml_text
from gfm_plant import NoEquilibrium
from gfm_runtime import discretise, load_law

RIG: dict[str, Any] = {
    "delay": {"samples": 1, "fraction": 0.25},
    "sensors": {"bandwidth_hz": 300.0, "gain": {"p": 1.02}},
    "factors": {"R_f": 3.0, "R_g": 3.0},
}
PV = {"dc_source": {"mode": "array", "pv": {"V_oc": 1.25, "I_sc": 1.08, "V_mp": 1.0, "I_mp": 1.0}}}
FINITE = {"finite": {"S": 2.0, "H": 3.0, "D": 1.0}}


def scenario(network: dict[str, Any], **changes: Any) -> Scenario:
    content = {"title": "", "duration": 1.0, "link": {"type": "inproc"}, "network": network}
    return check_scenario(copy.deepcopy(content | changes), "test")


def loop(of: Scenario) -> NetworkLoop:
    each = [*of.each.values()]
    laws = [discretise(load_law(one.law, one.inner).laws[0], of.T_s) for one in each]
    return NetworkLoop.of(plant_of(of), laws, [one.references.vector() for one in each])


def poles(of: ClosedLoop | NetworkLoop) -> np.ndarray:
    """z of all poles but those of the delay lines."""
    assert of.T_s is not None
    z = np.exp(of.poles() * of.T_s)
    return z[np.abs(z) > 1e-3]


def closest(found: np.ndarray, among: np.ndarray) -> float:
    """The largest distance of one of ``found`` from the closest of ``among``."""
    return float(np.abs(found[:, None] - among[None, :]).min(axis=1).max())


def are_equal(found: np.ndarray, wanted: np.ndarray) -> bool:
    """Whether poles are the same, in any order."""
    both = closest(found, wanted), closest(wanted, found)
    return len(found) == len(wanted) and max(both) < 1e-9


@pytest.mark.parametrize(
    ("law", "inner", "plant"),
    [
        ("vsg-2", None, {}),
        ("mimo-gfm-deployable", None, RIG),
        ("vsg-2", "virtual-stator", RIG),
        ("matching-2", None, PV),
        ("vsg-5", None, {**RIG, "dc_source": {"mode": "regulated", "tau_s": 3e-3}, "grid": FINITE}),
    ],
)
def test_a_network_of_one_is_the_loop_of_one_converter(law, inner, plant):
    of = scenario({"converters": {"A": {"node": "g"}}, "grid": "g"}, law=law, plant=plant,
                  **({} if inner is None else {"inner": inner}))  # fmt: skip
    one = ClosedLoop.of(load_law(law, inner).laws[0], of.plant, of.references.vector())
    network = loop(of)
    view = network.converter("A")
    for found in (network, view):
        assert are_equal(poles(found), poles(one))
    omega = np.geomspace(0.1, 2e4, 20)
    expected = one.frequency_response(omega)
    scale = np.abs(expected).max(axis=0)
    for found in (network, view):
        assert (np.abs(found.frequency_response(omega) - expected) <= 1e-8 * scale + 1e-9).all()
    late = np.array([3e-5, 1.7e-4, 2e-4, 0.0])[: len(one.u_delay)]
    assert are_equal(poles(view.later(late)), poles(one.later(late)))
    assert sum(network.modes()[0].participation.values()) == pytest.approx(1.0)


THREE = {
    "converters": {
        "A": {"node": "bus", "law": "vsg-2", "inner": "virtual-stator", "plant": RIG},
        "B": {"node": "bus", "law": "droop-3", "plant": {"delay": {"samples": 1}}},
        "C": {"node": "far", "law": "mimo-gfm-deployable", "references": {"P_ref": 0.2},
              "plant": {"dc_source": {"mode": "regulated"}, "converter": "paper"}},
    },
    "lines": {"feeder": {"start": "bus", "end": "far", "L": 0.1, "R": 0.02}},
    "loads": {"base": {"node": "bus", "P": 0.5, "Q": 0.2}, "other": {"node": "far", "P": 0.2},
              "off": {"node": "far", "P": 0.2, "Q": 0.1, "closed": False}},
}  # fmt: skip
MACHINE = {
    "machines": {"M": {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "D": 1.0}},
    "capacitors": {"bank": {"node": "far", "Q": 0.1}},
    "constant_power": {"drive": {"node": "far", "P": 0.2, "Q": 0.05}},
}


def island(place: Path | None = None, **changes: Any) -> Scenario:
    return scenario({**THREE, **changes}, references={"P_ref": 0.3})


def with_machine(place: Path | None = None) -> Scenario:
    return island(**MACHINE)


def with_synchronous_machine(place: Path | None = None) -> Scenario:
    controls = {"avr": {"type": "EXDC2", "T_B": 1.0, "T_C": 0.5}, "governor": {"type": "HYGOV"}}
    machine = {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "D": 1.0, **controls}
    core = {"core": {"node": "far", "S": 1.0}}
    parts = {"machines": {}, "synchronous_machines": {"M": machine}, "saturations": core}
    return island(**{**MACHINE, **parts})


def with_controls(place: Path | None = None) -> Scenario:
    saturated = {"E_1": 1.0, "S_E1": 0.04, "E_2": 2.0, "S_E2": 0.33}
    controls = {"avr": {"type": "IEEET1", **saturated}, "governor": {"type": "IEEEG1"}, "pss": {}}
    machine = {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "D": 1.0, "S_10": 0.1, "S_12": 0.3}
    return island(**MACHINE | {"machines": {}, "synchronous_machines": {"M": machine | controls}})


def with_static_exciter(place: Path | None = None) -> Scenario:
    machine = {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "avr": {"type": "EXST1", "K_C": 0.1}}
    machine |= {"pss": {"type": "ST2CUT", "T1": 0.02}, "governor": {"type": "GAST"}}
    return island(**MACHINE | {"machines": {}, "synchronous_machines": {"M": machine}})


def with_gas_turbine(place: Path | None = None) -> Scenario:
    machine = {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "governor": {"type": "GGOV1"}}
    machine |= {"avr": {"type": "ESST4B", "K_C": 0.2, "T_A": 0.0}}
    return island(**MACHINE | {"machines": {}, "synchronous_machines": {"M": machine}})


def with_salient_poles(place: Path | None = None, T_q10: float = 1.0) -> Scenario:
    poles = {"X_q": 1.1, "X_q1": 1.1, "T_q10": T_q10, "saturates_by": "E_q1"}
    machine = {"node": "far", "S": 1.5, "H": 2.0, "P": 0.4, "S_10": 0.1, "S_12": 0.3}
    machine |= {"avr": {"type": "ESST3A", "K_C": 0.2}}
    return island(**MACHINE | {"machines": {}, "synchronous_machines": {"M": machine | poles}})


def with_following(place: Path | None = None) -> Scenario:
    neighbour = {"G": {"node": "far", "S": 0.8, "P": 0.4, "Q": 0.1, "k_V": 3.0, "band": 0.0}}
    banks = {"bank": {"node": "far", "Q": 0.1}}
    return island(grid_following=neighbour, capacitors=banks)


def with_motor(place: Path | None = None) -> Scenario:
    load = {"node": "far", "P": 0.2, "Q": 0.05, "share_I": 0.4, "share_Z": 0.3}
    motor = {"M": {"node": "far", "S": 0.5, "H": 0.4}}
    banks = {"bank": {"node": "far", "Q": 0.1}}
    return island(induction_motors=motor, constant_power={"zip": load}, capacitors=banks)


def with_waves(place: Path | None = None) -> Scenario:
    line = {"start": "bus", "end": "far", "L": 0.1, "R": 0.02, "B": 0.1}
    banks = {"b": {"node": "bus", "Q": 0.1}, "f": {"node": "far", "Q": 0.1}}
    return island(lines={}, bergeron_lines={"feeder": line}, capacitors=banks)


def with_finite_grid(place: Path) -> Scenario:
    return scenario({**THREE, "grid": "far"}, plant={"grid": {**FINITE, "V_g": 1.02}})


def with_pll(place: Path) -> Scenario:
    stage = place / "stage.toml"
    stage.write_text('type = "cascaded"\nk_ci = 5.0\nf_pll = 10.0\n')
    given = copy.deepcopy(THREE)
    given["converters"]["B"] = {"node": "bus", "law": "vsg-5", "inner": str(stage)}
    return scenario({**given, "grid": "far"}, plant={"grid": {"omega_g": 0.999}})


def two_islands(place: Path | None = None) -> Scenario:
    """A alone, and B and C beyond an open line."""
    given = copy.deepcopy(THREE)
    given["converters"]["B"]["node"] = "far"
    given["lines"]["feeder"]["closed"] = False
    return scenario(given, references={"P_ref": 0.3})


def recorded(of: Scenario, ticks: int, **changed: float) -> dict[str, dict[str, np.ndarray]]:
    """The plant's columns of each converter, from the start, with references of the first one
    changed by so much."""
    benches = make_benches(of)
    for name, by in changed.items():
        benches[0].controller.set(name, getattr(of.each[of.converters[0]].references, name) + by)
    inner = benches[0].signal_set
    names, others = (ColumnSet(inner).signals(role) for role in ("plant", "controller"))
    rows = np.full((len(benches), ticks, len(names)), np.nan)
    other = np.empty((len(benches), ticks, len(others)))
    assert run_ticks(benches[0].plant.records, stack(benches), rows, other, 0, ticks) == ticks
    return {b.scenario.converter: dict(zip(names, row.T, strict=True))
            for b, row in zip(benches, rows, strict=True)}  # fmt: skip


@pytest.mark.full  # compiles the loop of several converters
@pytest.mark.parametrize(
    "of",
    [
        island,
        two_islands,
        with_machine,
        with_synchronous_machine,
        with_controls,
        with_static_exciter,
        with_gas_turbine,
        with_salient_poles,
        with_following,
        with_motor,
        with_waves,
        with_finite_grid,
        with_pll,
    ],
)
@pytest.mark.parametrize("reference", ["P_ref", "V_ref"])
def test_a_step_is_that_of_the_nonlinear_bench(of, reference, tmp_path):
    # 1e-4 p.u.: nonlinear terms are of the order of 1e-8. The tolerance is that of one converter.
    size, ticks, given = 1e-4, 3000, of(tmp_path)
    rest, moved = recorded(given, ticks), recorded(given, ticks, **{reference: size})
    _, y = loop(given).step_response(f"A.{reference}", ticks * given.T_s)
    for name in given.converters:
        for column, k in (("true_v_dc", 0), ("true_p", 1), ("true_q", 3), ("true_V", 4)):
            found = (moved[name][column] - rest[name][column]) / size
            largest = max(np.abs(y["A"][:, k]).max(), np.abs(y[name][:, k]).max())
            assert np.abs(found - y[name][:ticks, k]).max() < 2e-3 * largest, (name, column)


@pytest.mark.full
def test_salient_poles_have_no_mode_of_a_second_damper():
    assert are_equal(poles(loop(with_salient_poles())), poles(loop(with_salient_poles(T_q10=3.0))))


@pytest.mark.full
def test_lines_in_series_and_in_parallel_are_one_line():
    whole = loop(with_machine())
    split = {"f1": {"start": "bus", "end": "mid", "L": 0.04, "R": 0.008},
             "f2": {"start": "mid", "end": "far", "L": 0.06, "R": 0.012}}  # fmt: skip
    series = loop(island(**MACHINE, lines=split))
    assert are_equal(poles(series), poles(whole))
    twice = {name: {"start": "bus", "end": "far", "L": 0.2, "R": 0.04} for name in ("f1", "f2")}
    parallel = loop(island(**MACHINE, lines=twice))
    # and the current that circulates in the two: it decays with R/L, seen from a frame that turns
    omega = parallel.members[0].op.u[1]
    more = np.exp((-0.04 / 0.2 + omega * np.array([1j, -1j])) * 100 * np.pi * 1e-4)
    assert are_equal(poles(parallel), np.concatenate([poles(whole), more]))


@pytest.mark.full
def test_two_converters_of_half_the_size_are_one(tmp_path):
    whole = tomllib.loads((Path(gfm_plant.__file__).parent / "converters/paper.toml").read_text())
    halved = {"S_n": 0.5, "C_f": 0.5, "C_dc": 0.5, "L_f": 2.0, "R_f": 2.0, "L_g": 2.0, "R_g": 2.0}
    half = tmp_path / "half.toml"
    half.write_text(toml_text({k: v * halved.get(k, 1.0) if isinstance(v, float | int) else v
                               for k, v in whole.items()}))  # fmt: skip
    line = {"start": "bus", "end": "far", "L": 0.2, "R": 0.02}
    one = scenario({"converters": {"A": {"node": "bus"}}, "lines": {"l": line}, "grid": "far"},
                   law="vsg-2", plant=RIG)  # fmt: skip
    line = {**line, "L": 0.1, "R": 0.01}  # p.u. of a base of half the power
    two = scenario({"converters": {n: {"node": "bus"} for n in "AB"}, "lines": {"l": line},
                    "grid": "far"}, law="vsg-2", plant={**RIG, "converter": str(half)})  # fmt: skip
    a, b = loop(one), loop(two)
    assert closest(poles(a), poles(b)) < 1e-9
    _, alone = a.step_response("A.P_ref", 0.2)
    _, first = b.step_response("A.P_ref", 0.2)
    _, second = b.step_response("B.P_ref", 0.2)
    for name in "AB":  # both step
        together = first[name] + second[name]
        np.testing.assert_allclose(together, alone["A"], atol=1e-7 * np.abs(alone["A"]).max())


@pytest.mark.full
def test_participations_say_who_oscillates():
    """Two equal converters at one bus swing against each other, and both against a third one."""
    given = scenario({"converters": {n: {"node": "bus"} for n in "AB"} | {"C": {"node": "far"}},
                      "lines": {"l": {"start": "bus", "end": "far", "L": 0.3, "R": 0.03}},
                      "loads": {"l2": {"node": "far", "P": 0.5}}}, law="vsg-2")  # fmt: skip
    modes = loop(given).modes()
    for mode in modes:
        assert sum(mode.participation.values()) == pytest.approx(1.0)
        assert set(mode.participation) == {"A", "B", "C", LINES}
        assert mode.participation["A"] == pytest.approx(mode.participation["B"], abs=1e-5)
    between = [m for m in modes if 2.0 < m.frequency_hz < 6.0 and m.participation["C"] < 1e-6]
    assert len(between) == 1 and between[0].participation["A"] == pytest.approx(0.5, abs=1e-5)
    # of two masses on a spring the participation of one is the other's share of the mass: C has a
    # third of the inertia
    apart = [m for m in modes if 0.5 < m.frequency_hz < 2.0]
    assert len(apart) == 1 and apart[0].participation["C"] == pytest.approx(2 / 3, abs=0.01)


@pytest.mark.full
def test_islands_have_their_own_speed_and_their_own_modes():
    network = loop(two_islands())
    a, b, c = (member.op.u[1] for member in network.members)
    assert b == pytest.approx(c, abs=1e-12) and abs(a - b) > 1e-3
    for mode in network.modes():
        assert (
            min(mode.participation["A"], mode.participation["B"] + mode.participation["C"]) < 1e-6
        )
    _, y = network.step_response("A.P_ref", 0.1)
    assert np.abs(y["A"]).max() > 1e-3 and max(np.abs(y[name]).max() for name in "BC") < 1e-9


@pytest.mark.full
def test_a_view_has_the_modes_and_the_response_of_the_network():
    network, omega = loop(with_machine()), np.geomspace(0.1, 2e4, 20)
    whole = network.frequency_response(omega)
    for k, name in enumerate(network.names):
        view = network.converter(name)
        assert are_equal(poles(view), poles(network))
        inputs = [*(network.inputs.index(f"{name}.{ref}") for ref in INPUTS[:5]), -2, -1]
        part = whole[:, 5 * k : 5 * k + 5][:, :, inputs]
        np.testing.assert_allclose(view.frequency_response(omega), part, rtol=1e-6, atol=1e-7)


@pytest.mark.full
def test_margins_of_a_converter_are_those_of_the_network():
    """With 0.99 of the delay margin of one converter the network is stable, with 1.01 it is not,
    and so with each of its gains (``confirmed``)."""
    network = loop(with_finite_grid(Path()))
    for name in ("A", "B"):
        found = loop_margins(network.converter(name))
        assert all(c.confirmed for c in (*found.u, *found.y))
        places = next(m.u for m in network.members if m.name == name)
        sigma = []
        for share in (0.99, 1.01):
            late = network.u_delay.copy()
            late[places] += share * found.delay.seconds
            changed = NetworkLoop(network.network, network.members, network.T_s, late)
            sigma.append(changed.sigma())
        assert sigma[0] < 0.0 < sigma[1]


def test_what_cannot_be():
    one = loop(scenario({"converters": {"A": {"node": "g"}}, "grid": "g"}, law="vsg-2"))
    assert repr(one) == "<NetworkLoop A (vsg-2), T_s = 0.0001 s, A (11, 11)>"
    assert repr(one.converter("A")) == "<ClosedLoop A (vsg-2), T_s = 0.0001 s, A (11, 11)>"
    with pytest.raises(ValueError, match="'B' is no converter of the network"):
        one.converter("B")
    with pytest.raises(ValueError, match=r"'P_ref' is no input of the network; use one of \['A.V_"):
        one.step_response("P_ref")
    with pytest.raises(ValueError, match=r"A \(vsg-2\): is one of a network"):
        one.converter("A").output_impedance([1.0])
    far = scenario({"converters": {"A": {"node": "g"}}, "grid": "g"}, references={"P_ref": 1.5},
                   plant={"factors": {"L_g": 100.0}})  # fmt: skip
    with pytest.raises(NoEquilibrium):
        loop(far)


def test_an_island_of_converters_that_follow_is_refused():
    """Also a part of a network behind an open line, beside one that the grid holds."""
    network = {
        "grid": "g",
        "converters": {"A": {"node": "a"}, "B": {"node": "b", "law": "grid-following"}},
        "lines": {
            "near": {"start": "g", "end": "a", "L": 0.2, "R": 0.02},
            "far": {"start": "a", "end": "b", "L": 0.2, "R": 0.02, "closed": False},
        },
        "loads": {"house": {"node": "b", "P": 0.3}},
    }  # fmt: skip
    content = {"title": "", "duration": 0.1, "law": "vsg-2", "network": network}
    with pytest.raises(UserError, match=r"B \(grid-following\): nothing forms the voltage of b"):
        make_benches(check_scenario(content, "test"))
