"""Power-flow cases as networks, against the power flow of pandapower."""

import copy
import re

import numpy as np
import pytest

import gfmhil
from gfm_hil.api.dyr_machines import read_machines
from gfm_hil.api.network_case import _joined
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_plant.components import SynchronousMachine

pandapower = pytest.importorskip("pandapower")
networks = pytest.importorskip("pandapower.networks")
pytestmark = pytest.mark.filterwarnings("ignore:tap_dependency_table")  # of its own cases


def small():
    """A slack and a generator behind taps and a line, with a load and a capacitor."""
    net = pandapower.create_empty_network(f_hz=60.0, sn_mva=100.0)
    a, b, c = (pandapower.create_bus(net, 110.0, name=name) for name in "abc")
    pandapower.create_ext_grid(net, a, vm_pu=1.02, max_p_mw=100.0)
    pandapower.create_gen(net, b, p_mw=40.0, vm_pu=1.01, sn_mva=60.0)
    pandapower.create_line_from_parameters(net, a, b, 30.0, 0.1, 0.4, 9.0, 1.0)
    pandapower.create_line_from_parameters(net, b, c, 20.0, 0.1, 0.4, 9.0, 1.0)
    pandapower.create_load(net, c, p_mw=50.0, q_mvar=20.0)
    pandapower.create_shunt(net, c, q_mvar=-10.0, p_mw=1.0)
    return net


@pytest.mark.parametrize(
    ("case", "converters"),
    [
        ("case9", {"2": "droop-3", "3": "mimo-gfm"}),
        ("case24_ieee_rts", {"14": "vsg-2"}),  # in place of a condenser, which has no max_p_mw
        ("case30", {"13": "droop-3"}),  # a branch to a bus without anything
        # a negative reactance in a path, and iron losses, which make a circuit stiff
        pytest.param("case300", {"8": "droop-3"}, marks=pytest.mark.full),
        pytest.param("case89pegase", {"912": "droop-3"}, marks=pytest.mark.full),
        ("case14", {"1": "vsg-2"}),  # taps, and a converter at the slack
        ("case9", {"2": ("droop-3", 0.4), "1": ("vsg-2", 0.5)}),  # beside machines
        ("case9", {"1": "vsg-2", "2": "grid-following"}),  # which takes no V_ref
        pytest.param("case39", {"30": "droop-3", "38": "vsg-2"}, marks=pytest.mark.full),
        pytest.param("case118", {"69": "droop-3"}, marks=pytest.mark.full),
    ],
)
def test_the_steady_state_is_the_power_flow(case, converters, tmp_path):
    slack = "grid" if "3" in converters else "machine"
    made = gfmhil.network_from(case, converters, slack)
    assert made.distance(made.save(tmp_path / "net")) < 1e-8
    net = getattr(networks, case)()
    # trafo_model "pi", as MATPOWER has it: "t" moves case118 by 2.4e-5 p.u.
    pandapower.runpp(
        net, tolerance_mva=1e-9, numba=False, trafo_model="pi", calculate_voltage_angles=False
    )
    published = dict(zip(net.bus.name.astype(str), net.res_bus.vm_pu, strict=True))
    own = {node.removeprefix("bus"): abs(v) for node, v in made.voltages.items()}
    gone = {
        bus for note in made.ignored if "left out" in note or "are one" in note
        for bus in re.findall(r"\d+", note)
    }  # fmt: skip
    assert published.keys() - gone == own.keys()
    assert own == pytest.approx({bus: published[bus] for bus in own}, abs=1e-8)


@pytest.mark.full
def test_a_run_stays_there_until_a_line_opens(tmp_path):
    case = gfmhil.network_from("case9", {"2": "droop-3", "3": "vsg-2"})
    case.content["events"] = [{"type": "breaker", "t": 0.5, "name": "line4-5", "closed": False}]
    case.content["duration"] = 1.0
    run = gfmhil.run_network(case.save(tmp_path / "net"))
    for name, bus in (("C2", "2"), ("C3", "3")):
        p, omega = (run[name].signals[n] for n in ("p", "omega_u"))
        assert np.ptp(p[:4999]) < 1e-9 and np.ptp(p[5001:]) > 0.01, bus
        assert abs(omega[:4999] - 1).max() < 1e-9


def test_of_python_a_net_of_ones_own(tmp_path):
    net = small()
    case = gfmhil.network_from(net, {"b": "droop-3"}, title="mine")
    assert case.distance(case.save(tmp_path / "net")) < 1e-8
    network = case.content["network"]
    assert case.content["title"] == "mine" and [*network["converters"]] == ["Cb"]
    assert case.converters["converterb.toml"]["S_n"] == 60e6
    assert network["synchronous_machines"]["Ga"]["S"] == pytest.approx(100 / 60)
    # the load draws at its voltage what the case says: 50 MW of 60 MVA
    assert network["loads"]["loadc"]["P"] * abs(case.voltages["busc"]) ** 2 == pytest.approx(5 / 6)


def test_branches_that_no_circuit_can_have():
    """Two in a row that lead nowhere; and X = 0.3 - 0.1 p.u. over a bus without anything."""
    net = small()
    a, b, c = net.bus.index
    d, e, f = (pandapower.create_bus(net, 110.0, name=name) for name in "def")
    for start, end, X in ((c, d, 0.1), (d, e, 0.1), (a, f, 0.3), (f, b, -0.1)):
        pandapower.create_impedance(net, start, end, 0.0, X, 100.0)
    made = gfmhil.network_from(net, {"b": "droop-3"})
    assert made.voltages.keys() == {"busa", "busb", "busc"}
    assert made.content["network"]["lines"]["linea-b-2"]["L"] == pytest.approx(0.2 * 0.6)
    assert made.ignored == [
        "What leads to buses e, d alone is left out: nothing stands there.",
        "The branches at bus f are one: a reactance there is negative.",
    ]


@pytest.mark.full
def test_what_stands_at_a_bus_out_of_service_is_left_out():
    net = copy.deepcopy(small())
    bus = pandapower.create_bus(net, 110.0, name="d", in_service=False)
    pandapower.create_sgen(net, bus, p_mw=10.0)
    pandapower.create_gen(net, bus, p_mw=10.0, sn_mva=20.0)
    network = gfmhil.network_from(net, {"b": "droop-3"}).content["network"]
    assert [*network["synchronous_machines"]] == ["Ga"] and "grid_following" not in network


def test_static_generators_follow_the_grid(tmp_path):
    """They bring what the power flow says, from under what a load draws there, and a converter may
    take a share of them."""
    net = small()
    pandapower.create_sgen(net, 2, p_mw=60.0, q_mvar=5.0, sn_mva=80.0, scaling=0.5)
    pandapower.create_storage(net, 1, p_mw=10.0, max_e_mwh=1.0)
    for converters, left in (({"b": "droop-3"}, 1.0), ({"b": "droop-3", "c": ("vsg-2", 0.4)}, 0.6)):
        case = gfmhil.network_from(net, converters, title="mine")
        case.content["network"]["record"] = ["grid_following"]
        run = gfmhil.run_network(case.save(tmp_path / f"{left}"), duration=0.02)
        assert case.distance(tmp_path / f"{left}" / "network.toml") < 1e-8
        flows = {x: run.flows[x][:] * 60.0 for x in ("Fc.P", "Fc.Q", "Fb.P")}  # MW of 60 MVA
        filters = 0.05 * 80 * left * abs(case.voltages["busc"]) ** 2
        assert flows["Fc.P"] == pytest.approx(left * 30.0, abs=1e-6)
        assert flows["Fc.Q"] + filters == pytest.approx(left * 2.5, abs=1e-6)
        assert flows["Fb.P"] == pytest.approx(-10.0, abs=1e-6)
        assert case.content["network"]["grid_following"]["Fc"]["S"] == pytest.approx(left * 80 / 60)


@pytest.mark.full
def test_the_distribution_grid_of_cigre_with_a_converter_in_place_of_its_wind_turbine(tmp_path):
    """CIGRE's medium-voltage grid, TF C6.04.02: cables that end at open switches, eight PV plants,
    and taps."""
    net = networks.create_cigre_network_mv(with_der="pv_wind")
    case = gfmhil.network_from(net, {"Bus 7": "vsg-2"}, "grid", title="CIGRE MV")
    run = gfmhil.run_network(case.save(tmp_path / "net"), duration=0.1)
    assert case.distance(tmp_path / "net" / "network.toml") < 1e-8
    assert [*case.content["network"]["grid_following"]] == [
        *(f"F{k}" for k in (3, 4, 5, 6, 8, 9, 10, 11))
    ]
    assert run.status == "completed" and np.ptp(run["C7"].signals["p"]) < 1e-9


def test_notes_that_say_the_same_of_several_buses_are_one():
    made = _joined(
        ["SEXS at bus 3: a", "SEXS at bus 14: a", "SEXS at bus 3: b", "60 Hz.", "Bus 7: c"]
    )
    assert made == ["SEXS at buses 3, 14: a", "SEXS at bus 3: b", "60 Hz.", "Bus 7: c"]


def without_slack(net):
    net.ext_grid.in_service = False


def island(net):
    net.line.loc[1, "in_service"] = False


def without_rating(net):
    net.gen["sn_mva"] = np.nan


def slack_without_rating(net):
    net.ext_grid["max_p_mw"] = float("nan")


def too_much(net):
    net.load["p_mw"] = 5000.0


def generates(net):
    net.load["p_mw"] = -6.0


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (without_slack, "mine: has no slack: an ext_grid, or a gen with slack"),
        (island, "mine: bus c has no path to the slack"),
        (without_rating, "mine: bus b: its generator has no rating: give sn_mva, max_p_mw or"),
        (
            slack_without_rating,
            "mine: bus a: its generator has no rating: give sn_mva, max_p_mw or"
            " max_q_mvar, or stand a grid there: slack = grid",
        ),
        (too_much, "mine: its power flow does not converge: "),
        (generates, "mine: bus c: its loads draw -0.06 p.u.; make them static generators"),
    ],
)
def test_what_no_network_can_be_made_of(change, line):
    net = copy.deepcopy(small())
    change(net)
    with pytest.raises(UserError) as problem:
        gfmhil.network_from(net, {"b": "droop-3"}, title="mine")
    assert str(problem.value).startswith(line)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["case8", "--converter", "2=droop-3"], "'case8': must be one of case118, "),
        (["case9"], "case9: name a bus for a converter; 1, 2, 3 have generators"),
        (["case9", "--converter", "2=droop-3:1.5"], "case9: bus 2: share = 1.5: must lie"),
        (["case9", "--converter", "2=droop-3:h"], "--converter 2=droop-3:h: 'h' must be a number"),
        (["case9", "--converter", "5=droop-3"], "case9: bus 5: has no generator; 1, 2, 3 have one"),
        (["case9", "--converter", "99=droop-3"], "case9: bus 99: is no bus of the case; 1, 2, 3"),
        (["case9", "--converter", "2=no-law"], "no-law"),
        (["case9", "--converter", "2"], "--converter 2: must be BUS=LAW or BUS=LAW:SHARE, each"),
    ],
)
def test_wrong_input_is_one_line(arguments, line, tmp_path, capsys):
    assert main(["network", "import", *arguments, "-o", str(tmp_path / "net")]) == 2
    said = capsys.readouterr()
    assert line in said.err and len(said.err.splitlines()) == 1 and not said.out
    assert not (tmp_path / "net").exists()
    assert not (tmp_path / "net").exists()


def test_from_the_command_line(tmp_path, capsys):
    assert main(["network", "import", "case9", "--converter", "2=droop-3", "--slack", "grid",
                 "-o", str(tmp_path / "net")]) == 0  # fmt: skip
    said = capsys.readouterr().out
    assert "1 converter, 9 lines" in said and "p.u. from the power flow" in said
    assert (tmp_path / "net" / "network.toml").is_file()


#: in the format of PSS/E, its numbers in the order of its manual
DYNAMICS = """\
1 'GENROU' 1 8.96 0.04 0.31 0.06 23.64 0.0 1.46 0.969 0.3608 0.569 0.2 0.0836 0.0 0.0 / the slack
1 'IEEET1' 1 0.0 20.0 0.2 5.0 -5.0 1.0 0.314 0.063 0.35 0 3.0 0.2 4.0 0.5 /
1 'TGOV1' 1 0.05 0.5 1.2 0.0 2.0 7.0 0.0 /
2 'GENROU' 1 6.0 0.04 0.535 0.06
  6.4 0.0 0.8958 0.8645 0.1198 0.1969 0.089 0.0521 0.1 0.2 /
2 'SEXS' 1 0.1 10.0 100.0 0.05 0.0 5.0 /
2 'IEEEST' 1 1 0 0 0 0 0 0 0 0.05 0.02 3.0 5.4 10.0 5.0 20.0 0.2 -0.2 0 0 /
2 'HYGOV' 1 0.05 0.5 5.0 0.05 0.2 0.2 1.0 0.0 1.0 1.2 0.5 0.08 /
2 'AC8B' 1 0 0 /
"""


#: of ANDES's ieee14.dyr and kundur_full.dyr
PUBLISHED = """\
1 'GENROU' 1 6.5 0.06 0.2 0.05 6.5 0.0 1.8 1.75 0.6 0.8 0.28 0.15 0.09 0.38 /
1 'EXDC2 ' 1 0.02 20.0 0.02 1.0 1.0 5.2 -4.16 1.0 0.83 0.0754 1.246 0.0 0.0 0.0 1.0 1.0 /
1 'IEEEG1' 1 0 0 20.0 0.1 0.0 0.2 1.0 -1.0 0.95 0.0 0.1 0.0 0.0 0.0 0.0 0.0 0.0 0.3 0.0 8.72 0.7 0.0 /
"""  # noqa: E501


@pytest.mark.parametrize(
    ("record", "known", "notes"),
    [
        # of ANDES's ieee14.dyr
        (
            "EXST1 ' 1 0.02 99.0 -99.0 0.0 0.02 50.0 0.02 9999.0 -9999.0 0.0 0.01 1.0 /",
            {"V_Imin": -99.0, "T_B": 0.02, "K_A": 50.0, "V_Rmax": 9999.0, "K_F": 0.01, "T_F": 1.0},
            [],
        ),
        # of the IEEE's benchmark system VII (Benchmark_4ger_33_2015.dyr of PowerSystems.jl)
        (
            "ESST1A' 1 1 1 0.01 99 -99 1 10 1 1 200 0 4 -4 4 -4 0 0 1 0 3 /",
            {
                "type": "EXST1",
                "T_R": 0.01,
                "T_C": 1.0,
                "T_B": 10.0,
                "K_A": 200.0,
                "T_A": 1e-3,
                "V_Rmax": 4.0,
                "V_Rmin": -4.0,
                "K_C": 0.0,
                "T_F": 1.0,
            },
            ["T_A = 0.001 s instead of 0"],
        ),
        # of ANDES's npcc_full.dyr, N44_BC.dyr and wecc_full.dyr
        (
            "IEEEX1' 1 0 50 0.06 0 0 1 -1 -0.04 0.5 0.08 1 0 2 0.0016 3 1.45 /",
            {"type": "IEEET1", "K_A": 50.0, "K_E": -0.04, "T_F": 1.0, "E_2": 3.0, "S_E2": 1.45},
            ["T_R = 0.001 s instead of 0"],
        ),
        (
            "IEEET2' 1 0.02 729 0.04 5.32 -4.05 1 0.44 0.0667 2 0.44 6.5 0.054 8 0.202 /",
            {"type": "IEEET1", "V_Rmin": -4.05, "K_F": 0.0667, "T_F": 2.44, "S_E1": 0.054},
            ["its feedback has one lag, T_F = 2.44 s"],
        ),
        (
            "SCRX' 1 0.25385 13 31 0.05 0 4 0 0 /",
            {"type": "EXST1", "T_B": 13.0, "K_A": 31.0, "T_A": 0.05, "V_Rmax": 4.0, "K_F": 0.0},
            ["T_R = 0.001 s instead of 0", "its gain does not follow the voltage"],
        ),
        (
            "ESDC2A' 1 0.02 50 0.05 0.02 0 0 -3 0 0.512 0.07 1.3 0 3.9825 0.5 5.31 1.049 /",
            {"type": "EXDC2", "T_B": 0.02, "V_Rmax": 99.0, "V_Rmin": -3.0, "K_E": 0.0},
            ["V_Rmax = 99: it names none"],
        ),
        # of GridPACK's kundur-twoarea_esst4b.dyr
        (
            "ESST4B' 1 0.05 10.75 10.75 1 -0.87 0.02 1 0.05 99 -99 0 9.3 0.05 11.63 .113 .124 0 /",
            {"K_IR": 10.75, "V_Rmin": -0.87, "T_A": 0.02, "V_Mmax": 99.0, "K_G": 0.0, "X_L": 0.124},
            [],
        ),
    ],
)
def test_published_controls(record, known, notes, tmp_path):
    file = tmp_path / "published.dyr"
    file.write_text(f"{PUBLISHED.splitlines()[0]}\n1 '{record}\n")
    tables, ignored, _ = read_machines(file)
    one = SynchronousMachine(node="a", S=1.0, P=0.5, **tables["synchronous_machines"]["1"])
    assert {name: getattr(one.avr, name) for name in known} == known
    assert [line.rstrip(".").partition(": ")[2] for line in ignored] == notes


def test_published_governors_of_gas_turbines(tmp_path):
    """GAST of the WECC's 240 buses, and GGOV1 of ACTIVSg2000, by MW, as far as a case asks for."""
    file = tmp_path / "published.dyr"
    first, machine = (DYNAMICS.splitlines()[k] for k in (0, 3))
    file.write_text(
        f"{first}\n1 'GAST' 1 0.08 0.3 0.3 3.0 1.0 2.0 1.0 0.0 0.0 /\n{machine}\n"
        f"{DYNAMICS.splitlines()[4]}\n2 'GGOV1' 1 1 1 0.04 1 0.05 -0.05 21.071 0.0553 0 1 1 0.15"
        " 0.2767 1.5 0.2 0.5 0 0 3 2 1 1 0 1 -1 0 0.01 10 0.1 107.28 0 4 5 99 -99 /\n"
    )
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    one, two = (case.content["network"]["synchronous_machines"][f"G{k}"] for k in "12")
    assert one["governor"] == {
        "type": "GAST", "R": 0.08, "T1": 0.3, "T2": 0.3, "T3": 3.0, "A_T": 1.0, "K_T": 2.0,
        "V_max": 1.0, "V_min": 0.0, "D_turb": 0.0,
    }  # fmt: skip
    own = SynchronousMachine.model_validate(two).governor
    known = {"flag": True, "K_igov": 0.0553, "T_b": 0.5, "T_c": 0.0, "R_close": -1.0, "T_sb": 5.0}
    assert {name: getattr(own, name) for name in known} == known
    # 163 MW of 300 MVA, and a little for its winding; by its valve 107.28 MW are the most
    assert own.T_rate * 300.0 == pytest.approx(1.05 * 163.0, rel=0.1) and own.T_rate > 0.5433
    for line in (
        "GGOV1 at bus 2: its limit by the acceleration is left out.",
        f"GGOV1 at bus 2: T_rate = {own.T_rate:.4g} instead of 0.3576, for the power that the case"
        " has there.",
    ):
        assert line in case.ignored
    assert case.distance(case.save(tmp_path / "net")) < 1e-8


def test_a_published_stabiliser_with_three_leads(tmp_path):
    """Of ANDES's ieee14.dyr, which has one without a gain too."""
    times = "0.0 0.0 3.0 3.0 0.15 0.05 0.15 0.05 0.15 0.05 0.05 -0.05 0 0 /"
    file = tmp_path / "published.dyr"
    for K1, known in (("10.0", True), ("0.0", False)):
        stabiliser = f"1 'ST2CUT' 1 1 0 0 0 {K1} 0.0 {times}"
        file.write_text("\n".join([*PUBLISHED.splitlines()[:2], stabiliser]))
        tables, ignored, _ = read_machines(file)
        one = SynchronousMachine(node="a", S=1.0, P=0.5, **tables["synchronous_machines"]["1"])
        assert (one.pss is not None) == known
        left_out = "ST2CUT at bus 1: K1 and K2, or T3, are 0, and it is left out."
        assert (left_out in ignored) != known
        if known:
            assert (one.pss.K1, one.pss.T3, one.pss.T9, one.pss.L_Smin) == (10.0, 3.0, 0.15, -0.05)


def test_a_stabiliser_by_power_is_left_out(tmp_path):
    """Its gain, which is negative in ieee14.dyr, is none of a speed."""
    file = tmp_path / "published.dyr"
    stabiliser = "1 'IEEEST' 1 3 0 0 0 0 0 0 0 0 0 0 0.75 1.0 4.2 -2.0 0.1 -0.1 0 0 /"
    file.write_text("\n".join([*PUBLISHED.splitlines()[:2], stabiliser]))
    tables, ignored, _ = read_machines(file)
    assert "pss" not in tables["synchronous_machines"]["1"]
    assert "IEEEST at bus 1: its input, mode 3, is no speed, and it is left out." in ignored


def test_a_published_machine_with_salient_poles(tmp_path):
    file = tmp_path / "published.dyr"
    file.write_text(  # of ANDES's N44_BC.dyr
        "3115 'GENSAL' 1 7.57 0.045 0.1 4.741 0.0 0.946 0.565 0.29 0.23 0.11077 0.10239 0.2742 /"
    )
    values = read_machines(file).tables["synchronous_machines"]["3115"]
    one = SynchronousMachine(node="a", S=1.0, P=0.5, **values)
    assert (one.T_d10, one.T_d20, one.T_q20, one.H, one.X_l) == (7.57, 0.045, 0.1, 4.741, 0.11077)
    assert (one.X_d, one.X_q, one.X_q1, one.X_d1, one.X_2) == (0.946, 0.565, 0.565, 0.29, 0.23)
    assert (one.S_10, one.S_12, one.saturates_by) == (0.10239, 0.2742, "E_q1")


def test_governors_and_machines_of_gridpack_and_sienna(tmp_path):
    """WSIEG1 of GridPACK's tamu_500bus_detail.dyr, and GENROE of the IEEE's system VII."""
    file = tmp_path / "published.dyr"
    file.write_text(
        "1 'GENROE' 1 8 0.03 0.4 0.05 6.5 0 1.8 1.7 0.3 0.55 0.25 0.2 0.0392 0.2672 /\n"
        f"1 'WSIEG1' 1 0 0 25 0 3.3 0.3 0.25 -3.3 51 0 0.086 1 {'0 ' * 24} /"
    )
    tables, ignored, _ = read_machines(file)
    one = SynchronousMachine(node="a", S=1.0, P=0.5, **tables["synchronous_machines"]["1"])
    assert (one.X_q, one.S_10, one.S_12, one.saturates_by) == (1.7, 0.0392, 0.2672, "psi_2")
    own = one.governor
    assert (own.type, own.K, own.T2, own.T4, own.K1, own.P_max) == ("IEEEG1", 25, 0, 0.086, 1, 51)
    assert ignored == [
        "GENROE at bus 1: a parabola saturates it, through the same two points.",
        "WSIEG1 at bus 1: T2 is left out, for T1 = 0.",
    ]


def test_a_commutator_exciter_and_a_governor_of_one_shaft(tmp_path):
    file = tmp_path / "published.dyr"
    file.write_text(PUBLISHED)
    tables, ignored, _ = read_machines(file)
    one = SynchronousMachine(node="a", S=1.0, P=0.5, **tables["synchronous_machines"]["1"])
    assert (one.avr.T_B, one.avr.V_Rmin, one.avr.T_F, one.avr.saturation()) == (
        1.0, -4.16, 1.246, (0.0, 0.0),
    )  # fmt: skip
    assert one.governor.gain() == 1.0 and (one.governor.T7, one.governor.P_max) == (8.72, 0.95)
    assert (one.S_10, one.S_12) == (0.09, 0.38)
    assert ignored == ["EXDC2 at bus 1: its saturation has no first point and is left out."]


#: a PV plant in the format of PSS/E, the second record as one of a user's library
FOLLOWING = """\
1 'GENROU' 1 8.96 0.04 0.31 0.06 23.64 0.0 1.46 0.969 0.3608 0.569 0.2 0.0836 0.0 0.0 /
2 'REGCA1' 1 1 0.02 10.0 0.9 0.5 1.22 1.2 0.8 0.4 -1.3 0.02 0.7 99.0 -99.0 0.7 /
2 'USRMDL' 1 'REECB1' 102 0 5 25 6 4 0 0 1 1 0
  -99.0 99.0 0.01 -0.02 0.02 2.0 1.05 -1.05 1.0 0.02 0.4 -0.4 1.1 0.9 0.0 0.1 0.0 40.0
  0.02 99.0 -99.0 1.0 0.0 1.1 0.04 /
"""


def test_converters_of_a_dynamics_file_follow_the_grid(tmp_path):
    """With the support of the voltage, which is beyond the dead band in the power flow."""
    file = tmp_path / "pv.dyr"
    file.write_text(FOLLOWING)
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    network = case.content["network"]
    assert [*network["synchronous_machines"]] == ["G1"] and [*network["grid_following"]] == ["F2"]
    own = network["grid_following"]["F2"]
    assert {key: own[key] for key in ("T_i", "I_max", "k_V", "band", "T_V")} == {
        "T_i": 0.02, "I_max": 1.1, "k_V": 2.0, "band": 0.02, "T_V": 0.01,
    }  # fmt: skip
    assert any("REECB1 at bus 2: its loops" in line for line in case.ignored)
    run = gfmhil.run_network(case.save(tmp_path / "net"), duration=0.2)
    assert run.status == "completed" and np.ptp(run["C3"].signals["p"]) < 1e-6
    alone = FOLLOWING.split("\n", 1)[1]  # without the machine
    file.write_text(alone.replace("2 '", "1 '"))
    with pytest.raises(UserError, match="bus 1: REGCA1 follows the grid, and this is the slack"):
        gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)


#: in the order of GridPACK's case9_REGCA1_REECA1_REPCA1.dyr, which has bands of 1 p.u.
PARK = """\
2 'REPCA1' '1 ' 0 2 8 '1 ' 0 1 1
  0.02 0.5 2.0 0.03 0.05 0.7 0.0 0.0 0.02 0.1 -0.1 -0.002 0.002 0.43 -0.43
  0.2 2.0 0.05 -0.0006 0.0004 99.0 -99.0 1.0 0.0 0.1 10.0 20.0 /
"""


def test_a_plant_controller_of_a_dynamics_file(tmp_path):
    """Nothing moves at the start; it brings the power at its branch to a new reference."""
    file = tmp_path / "pv.dyr"
    file.write_text(FOLLOWING + PARK)
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    park = case.content["network"]["plant_controllers"]["P2"]
    assert park == {
        "line": "line8-2", "node": "bus2", "converters": ["F2"], "control": "V", "sends": "Q_ref",
        "period_s": 0.001, "delay_s": 0.0, "T_fltr": 0.02, "T_p": 0.05, "K_p": 0.5, "K_i": 2.0,
        "T_ft": 0.03, "T_fv": 0.05, "V_frz": 0.7, "K_c": 0.02, "e_max": 0.1, "dbd": 0.002,
        "Q_max": 0.43, "Q_min": -0.43, "K_pg": 0.2, "K_ig": 2.0, "fdbd": 0.0006, "fe_max": 99.0,
        "fe_min": -99.0, "P_max": 1.0, "P_min": 0.0, "T_g": 0.1, "D_dn": 10.0, "D_up": 20.0,
    }  # fmt: skip
    assert "REPCA1 at bus 2: fdbd = 0.0006 on both sides." in case.ignored
    S, P = (case.content["network"]["grid_following"]["F2"][key] for key in "SP")
    case.content["events"] = [{"type": "plant-reference", "t": 0.5, "name": "P2", "P_ref": P - 0.1}]
    run = gfmhil.run_network(case.save(tmp_path / "net"), duration=6.0)
    power, V = run.flows["P2.P"][:] / S, run.flows["P2.V"][:]
    assert np.ptp(power[:4999]) < 1e-6 and np.ptp(V[:4999]) < 1e-6
    # the frequency that falls meanwhile calls for more
    lacks = 1.0 - run.flows["P2.omega"][-1] - 0.0006
    assert power[-1] == pytest.approx(P - 0.1 + 20.0 * max(lacks, 0.0), abs=2e-3)
    for branch, others, note in (
        ("0 2 9", {}, "REPCA1 at bus 2 is left out: there is no branch 2-9."),
        ("0 2 8", {"2": "grid-following"}, "REPCA1 at bus 2 is left out with its generator."),
    ):
        file.write_text(FOLLOWING + PARK.replace("0 2 8", branch))
        case = gfmhil.network_from("case9", {"3": "droop-3", **others}, dynamics=file)
        assert note in case.ignored and "plant_controllers" not in case.content["network"]
    for branch, node in (("0 0 0", "bus2"), ("0 8 2", "bus8")):
        file.write_text(FOLLOWING + PARK.replace("0 2 8", branch))
        case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
        park = case.content["network"]["plant_controllers"]["P2"]
        assert (park["line"], park["node"], park.get("plant_end", node)) == (
            "line8-2", node, "bus2"
        )  # fmt: skip
    file.write_text(FOLLOWING + PARK.replace("1.0 0.0 0.1 10.0", "0.0 1.0 0.1 10.0"))
    with pytest.raises(UserError, match="line 6: REPCA1 at bus 2: P_min = 1, P_max = 0: must rise"):
        gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)


def test_classical_machines_of_a_dynamics_file(tmp_path):
    """Their voltage stands behind ZSOURCE where the case has it; nothing moves at the start, and an
    infinite bus does not later."""
    file = tmp_path / "classical.dyr"
    file.write_text(
        "1 'GENCLS' 1 0.0 0.0 /\n2 'GENCLS' 1 6.4 1.5 /\n2 'SEXS' 1 0.1 10 100 0.05 0 5 /"
    )
    net = networks.case9()
    net.gen["sn_mva"], net.gen["xdss_pu"] = [200.0, 100.0], [0.12, 0.18]
    case = gfmhil.network_from(net, {"3": "droop-3"}, dynamics=file)
    one, two = (case.content["network"]["machines"][f"G{k}"] for k in "12")
    assert (one["X"], two["X"], two["H"], two["D"], one["H"]) == (0.3, 0.12, 6.4, 1.5, 1e6)
    i = complex(163.0, float(net.res_gen.q_mvar[0])) / 200.0  # at 1 p.u.
    assert two["E"] == pytest.approx(abs(1.0 + 0.12j * i.conjugate()), abs=1e-9)
    for line in (
        "controls at bus 2 are left out",
        "GENCLS at bus 1: X' = 0.3 p.u., our assumption",
    ):
        assert sum(line in said for said in case.ignored) == 1, line
    case.content["network"]["record"] = ["machines"]
    case.content["events"] = [{"type": "breaker", "t": 0.1, "name": "load5", "closed": False}]
    run = gfmhil.run_network(case.save(tmp_path / "net"), duration=1.0)
    speeds = np.array([run.flows[f"G{k}.omega"][:] for k in "12"]) - 1.0
    assert np.abs(speeds[:, :999]).max() < 1e-9
    assert np.abs(speeds[0]).max() < 1e-6 < 1e-4 < np.abs(speeds[1]).max()


def test_machines_of_a_dynamics_file_run(tmp_path):
    file = tmp_path / "case9.dyr"
    file.write_text(DYNAMICS)
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    one, two = (case.content["network"]["synchronous_machines"][f"G{k}"] for k in "12")
    known = {"H": 23.64, "T_d10": 8.96, "T_q20": 0.06, "X_q1": 0.569, "X_2": 0.2, "X_l": 0.0836}
    assert {key: one[key] for key in known} == known and "pss" not in one
    assert one["avr"] == {
        "type": "IEEET1", "T_R": 1e-3, "K_A": 20.0, "T_A": 0.2, "V_Rmax": 5.0, "V_Rmin": -5.0,
        "K_E": 1.0, "T_E": 0.314, "K_F": 0.063, "T_F": 0.35, "E_1": 3.0, "S_E1": 0.2, "E_2": 4.0,
        "S_E2": 0.5,
    }  # fmt: skip
    assert one["governor"] == {
        "type": "TGOV1", "R": 0.05, "T1": 0.5, "V_max": 1.2, "V_min": 0.0, "T2": 2.0, "T3": 7.0,
        "D_t": 0.0,
    }  # fmt: skip
    assert (one["S_12"], two["S_10"], two["S_12"]) == (0.0, 0.1, 0.2)
    assert (two["avr"]["T_A"], two["avr"]["K"]) == (1.0, 100.0)
    assert [two["governor"][key] for key in ("type", "T_W", "q_NL")] == ["HYGOV", 1.0, 0.08]
    # its washout 20 · 10 s/(1 + 5 s), as ours is written
    assert (two["pss"]["K_S"], two["pss"]["T5"], two["pss"]["T6"]) == (40.0, 5.0, 0.0)
    for line in ("T_R = 0.001 s instead of 0", "AC8B at bus 2 is"):
        assert sum(line in said for said in case.ignored) in (1, 2), line
    run = gfmhil.run_network(case.save(tmp_path / "net"), duration=0.5)
    p = run["C3"].signals["p"]
    assert run.status == "completed" and np.ptp(p) < 1e-6


def test_a_dynamics_file_of_more_buses_or_of_others(tmp_path):
    file = tmp_path / "more.dyr"
    machine = "'GENROU' 1 8.96 0.04 0.31 0.06 23.64 0.0 1.46 0.969 0.3608 0.569 0.2 0.0 0.0 0.0 /\n"
    file.write_text(f"77 {machine}1 {machine}")
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    assert "bus 77 of the dynamic data is none of the case." in case.ignored
    assert case.content["network"]["synchronous_machines"]["G1"]["X_l"] == 0.0
    file.write_text(f"77 {machine}")
    with pytest.raises(UserError, match="bus 77: is no bus of case9"):
        gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)


def test_a_governor_opens_as_far_as_the_case_asks_for(tmp_path):
    """The generator of bus 2 brings 163 MW of 300 MVA, and a little for its winding."""
    file = tmp_path / "small.dyr"
    file.write_text(
        DYNAMICS.replace("0.2 1.0 0.0 1.0 1.2 0.5 0.08", "0.2 0.5 0.0 1.0 1.2 0.5 0.08")
    )
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    opened = case.content["network"]["synchronous_machines"]["G2"]["governor"]["G_max"]
    assert opened == pytest.approx(1.05 * (163.0 / 300.0 / 1.2 + 0.08), rel=2e-3)
    assert sum("HYGOV at bus 2: G_max = 0.5" in line for line in case.ignored) == 1
    assert case.distance(case.save(tmp_path / "net")) < 1e-8


def test_a_machine_beside_a_converter_stands_for_both_at_the_slack(tmp_path):
    file = tmp_path / "beside.dyr"
    both = FOLLOWING.replace("2 '", "1 '")
    file.write_text(both)
    case = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file)
    assert "grid_following" not in case.content["network"]
    assert case.content["network"]["synchronous_machines"]["G1"]["H"] == 23.64
    assert "REGCA1 at bus 1 is left out beside the slack's machine." in case.ignored
    file.write_text(both.replace("1 '", "2 '"))
    network = gfmhil.network_from("case9", {"3": "droop-3"}, dynamics=file).content["network"]
    assert [*network["grid_following"]] == ["F2"] and [*network["synchronous_machines"]] == ["G1"]


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("1.2 0.0 2.0 7.0 0.0 /", "1.2 /", "line 3: TGOV1 has 7 numbers, not 3"),
        ("8.96", "8.9x6", "line 1, T_d10: '8.9x6' is no number from -1e6 to 1e6"),
        ("0.0 0.0 / the", "0.0 0.0 the", "line 1: GENROU has 14 numbers, not 33"),
        ("GENROU", "GENTPJ", "no record of GENROU, GENROE, GENSAL, GENSAE, GENCLS or REGCA1"),
        # refused by its own part, by a machine at this sampling period, and at the start
        ("0.05 0.0 5.0", "0.05 5.0 0.0", "line 6: SEXS at bus 2: E_min = 5: must be less than E_m"),
        ("0.1198", "0.9", "line 4: GENROU at bus 2: X_d = 0.8958: must be above that before it"),
        ("23.64", "1e-6", "wrong.dyr, bus 1: it swings at 30699.8 rad/s; allowed are 1000 rad/s"),
        ("0.05 0.0 5.0", "0.05 0.0 0.5", "wrong.dyr, bus 2: its avr, SEXS, needs E_fd = 1.249"),
    ],
)
def test_a_dynamics_file_that_is_none_is_one_line(old, new, line, tmp_path, capsys):
    file = tmp_path / "wrong.dyr"
    file.write_text(DYNAMICS.replace(old, new))
    command = ["network", "import", "case9", "--converter", "3=droop-3", "--dynamics", str(file)]
    assert main([*command, "-o", str(tmp_path / "net")]) == 2
    said = capsys.readouterr()
    assert line in said.err and len(said.err.splitlines()) == 1 and not said.out
    assert not (tmp_path / "net").exists()
