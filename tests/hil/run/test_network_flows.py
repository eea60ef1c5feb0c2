"""Currents and powers of a network's lines, loads, machines and faults in the recording."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import load_scenario
from gfm_plant import build

pytestmark = pytest.mark.full  # compiles the loop of several converters

NETWORK: dict[str, Any] = {
    "grid": "far",
    "record": ["all"],
    "converters": {
        "A": {"node": "bus"}, "B": {"node": "bus", "law": "vsg-2", "inner": "virtual-stator"}
    },
    "lines": {
        "feeder": {"start": "bus", "end": "mid", "L": 0.1, "R": 0.02},
        "cable": {"start": "bus", "end": "filter", "L": 0.05, "R": 0.01},
    },
    "transformers": {
        "step-up": {"start": "mid", "end": "far", "S": 2.0, "X": 0.1, "R": 0.01, "X_m": 50.0,
                    "ratio": 1.02, "earthed": "both"},
    },
    "loads": {
        "step": {"node": "bus", "P": 0.4, "closed": False},
        "town": {"node": "mid", "P": 0.2, "Q": 0.1},
    },
    "capacitors": {"bank": {"node": "filter", "Q": 0.1}},
    "constant_power": {"drives": {"node": "filter", "P": 0.2, "Q": 0.05}},
    "grid_following": {"wind": {"node": "filter", "S": 0.3, "P": 0.5}},
    "machines": {"sm": {"node": "mid", "S": 1.0, "H": 3.0, "P": 0.3}},
}  # fmt: skip
FAULT = {
    "type": "fault", "t": 0.1, "kind": "LG", "duration": 0.05, "line": "feeder", "position": 0.4,
    "R": 0.1,
}  # fmt: skip
#: the load comes; a fault inside a line; and, while it lasts, its breaker opens phase by phase
EVENTS = [
    {"type": "breaker", "t": 0.02, "name": "step", "closed": True},
    FAULT,
    {"type": "breaker", "t": 0.13, "name": "feeder", "closed": False},
]
#: at each node what arrives and what leaves
NODES = {
    "bus": (("A", "B"), ("feeder", "cable", "step")),
    "mid": (("feeder.end", "sm"), ("step-up", "town")),
    "far": (("step-up.end", "grid"), ()),
}


def given(**changes: Any) -> dict[str, Any]:
    made = {
        "title": "flows", "duration": 0.25, "law": "droop-3", "link": {"type": "inproc"},
        "references": {"P_ref": 0.3}, "network": copy.deepcopy(NETWORK), "events": EVENTS,
    }  # fmt: skip
    return made | changes


def current(run: NetworkRun, part: str) -> np.ndarray:
    return np.asarray(run.flows[f"{part}.i_re"] + 1j * run.flows[f"{part}.i_im"])


@pytest.fixture(scope="module")
def run() -> NetworkRun:
    return gfmhil.run_network(given())


@pytest.mark.parametrize("large", [False, True])
def test_currents_and_powers_of_every_node_add_up_to_nothing(large, monkeypatch):
    """By the modes of the circuit, and by its series as in a large network."""
    if large:
        monkeypatch.setattr(build, "MOST_BY_MODES", 0)
    run = gfmhil.run_network(given())
    assert run["A"].ticks == 2500
    for arrives, leaves in NODES.values():
        for read, least in ((current, 0.1), (lambda r, n: r.flows[f"{n}.P"], 0.1)):
            each = [read(run, n) for n in arrives] + [-read(run, n) for n in leaves]
            assert np.abs(sum(each)).max() < 1e-12
            assert max(np.abs(x).max() for x in each) > least


def test_a_machine_turns_as_its_power_asks(run):
    """The swing equation and the governor by SciPy, driven by the recorded power; the energy of the
    machine's reactance, 1e-4 of its speed, is between that power and the rotor's."""
    f, one = run.flows, NETWORK["machines"]["sm"]
    t, P = run["A"].signals["t"], f["sm.P"]

    def slopes(now: float, x: np.ndarray) -> list[float]:
        omega, turbine = x
        torque = (turbine - np.interp(now, t, P)) / (2 * one["H"])
        return [torque, (one["P"] - (omega - 1.0) / 0.05 - turbine) / 0.5]

    omega = solve_ivp(slopes, (0, t[-1]), [1.0, P[0]], t_eval=t, max_step=2e-4).y[0]
    assert np.ptp(f["sm.omega"]) > 1e-3
    assert np.abs(f["sm.omega"] - omega).max() < 1e-4
    assert f["wind.omega"][0] == pytest.approx(1.0, abs=1e-12) and np.ptp(f["wind.omega"]) > 1e-3
    assert "step.omega" not in f


def test_a_branch_loses_what_its_resistance_does(run):
    """At rest the power at both ends of a line differs by R |i|^2, the reactive one by X |i|^2, and
    the voltages by Z i, here against the grid's, which is 1."""
    still = slice(0, 100)
    line = NETWORK["lines"]["feeder"]
    f, i = run.flows, current(run, "feeder")[still]
    lost = [(f[f"feeder.{x}"] - f[f"feeder.end.{x}"])[still] for x in "PQ"]
    assert lost[0] == pytest.approx(line["R"] * np.abs(i) ** 2, abs=1e-9)
    assert lost[1] == pytest.approx(line["L"] * np.abs(i) ** 2, abs=1e-9)
    at_grid = current(run, "grid")[still]
    assert f["grid.P"][still] == pytest.approx(at_grid.real, abs=1e-14)  # V_g = 1, at angle 0
    trafo = NETWORK["transformers"]["step-up"]
    Z = complex(trafo["R"], trafo["X"]) / trafo["S"]
    v = trafo["ratio"] * (1.0 - Z * at_grid)  # of mid, from the grid's side
    S = v * np.conj(current(run, "sm")[still])
    assert f["sm.P"][still] == pytest.approx(S.real, abs=1e-9)
    assert f["sm.Q"][still] == pytest.approx(S.imag, abs=1e-9)
    load = NETWORK["loads"]["town"]
    assert f["town.P"][still] == pytest.approx(load["P"] * np.abs(v) ** 2, abs=1e-9)


def test_what_is_controlled_is_recorded_as_it_is_set(run):
    at = 90
    assert run.flows["drives.P"][at] == pytest.approx(0.2, abs=1e-3)
    assert run.flows["wind.P"][at] == pytest.approx(0.3 * 0.5, abs=1e-3)
    assert run.flows["step.P"][at] == 0.0
    a = run["A"].signals  # less what its line loses
    assert run.flows["A.P"][at] == pytest.approx(a["p"][at], abs=2e-3)


def test_the_current_of_a_fault_is_what_its_line_loses(run):
    """From phase a to ground; its space vector is 2/3 of that, on the axis of phase a."""
    t, f = run.flows["t"], run.flows
    during = (t > 0.1001) & (t < 0.125)
    turn = np.exp(2j * np.pi * 50.0 * t)
    lost = (current(run, "feeder") - current(run, "feeder.end")) * turn
    assert np.abs(f["fault.i_a"][during]).max() > 1.0
    assert lost.real[during] == pytest.approx(2 / 3 * f["fault.i_a"][during], abs=1e-12)
    assert np.abs(lost.imag[during]).max() < 1e-12
    for phase in "bc":
        assert np.abs(f[f"fault.i_{phase}"]).max() < 1e-9
    assert np.abs(f["fault.i_a"][t > 0.18]).max() == 0.0


def test_recording_changes_no_bit_and_a_link_records_the_same(run, tmp_path):
    without = gfmhil.run_network(given(network=NETWORK | {"record": []}))
    assert len(without.flows) == 1
    for name, one in without.items():
        for column, values in one.columns.items():
            assert np.array_equal(values, run[name].columns[column][:], equal_nan=True), column
    over = gfmhil.run_network(given(link={"type": "shm"}), folder=tmp_path / "r")
    for name in run.scenario.flows:
        assert np.array_equal(over.flows[name], run.flows[name]), name


def test_a_folder_its_report_and_its_exports_have_them(tmp_path, capsys):
    folder = tmp_path / "r"
    network = NETWORK | {"record": ["feeder", "loads"]}
    made = gfmhil.run_network(given(network=network), folder=folder)
    names = [f"{n}.{x}" for n in ("feeder", "feeder.end", "step", "town")
             for x in ("P", "Q", "i_re", "i_im")]  # fmt: skip
    assert [*made.flows][1:] == names
    again = NetworkRun.load(folder)
    assert np.array_equal(again.flows["town.Q"], made.flows["town.Q"])
    assert again["A"].units["feeder.i_re"] == "p.u. (S_n/V_n)"
    assert "feeder.P" not in again["B"].columns
    assert "Lines, loads and machines" in (folder / "report.html").read_text()
    axes = again.plot("feeder.P", "p")
    assert [len(a.lines) for a in axes] == [1, 2]
    assert main(["export", str(folder / "A"), "--format", "csv", "--out", str(tmp_path / "c")]) == 0
    exported = next(Path(tmp_path).glob("c*"))
    head = (exported if exported.is_file() else next(exported.glob("*.csv"))).read_text()[:9000]
    assert "feeder.end.Q" in head


@pytest.mark.parametrize("name", ["feedr", "bank", "capacitors", ""])
def test_a_wrong_name_is_one_line(name):
    with pytest.raises(UserError) as caught:
        load_scenario(given(network=NETWORK | {"record": [name]}))
    text = str(caught.value)
    assert f"network.record = {name!r}: must be one of ['A', 'B', 'cable'" in text
    assert "\n" not in text and "'lines'" in text
