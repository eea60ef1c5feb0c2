"""Runs of several converters in one network."""

import copy
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import gfm_plant
import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.recording.log import read_log
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.runner import run_network
from gfm_hil.scenario import find_scenario, load_scenario, scenario_toml, toml_text
from gfm_runtime.signals import INNER

from ...support.page import unpacked

pytestmark = pytest.mark.full  # compiles the loop of several converters

BUS = {"node": "bus"}
LINE = {"start": "bus", "end": "far", "L": 0.2, "R": 0.02}


def content(**changes: Any) -> dict[str, Any]:
    """Two converters that feed a load, and another one that comes on at 0.2 s."""
    made: dict[str, Any] = {
        "title": "two", "duration": 2.0, "law": "droop-3", "link": {"type": "inproc"},
        "references": {"P_ref": 0.3},
        "network": {
            "converters": {"A": dict(BUS), "B": dict(BUS)},
            "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.1},
                      "step": {"node": "bus", "P": 0.4, "Q": 0.0, "closed": False}},
        },
        "events": [{"type": "breaker", "name": "step", "t": 0.2, "closed": True}],
    }  # fmt: skip
    return made | changes


def test_two_equal_ones_share_a_load_and_the_frequency():
    run = gfmhil.run_network(content())
    assert run.status == "completed"
    a, b = run["A"].signals, run["B"].signals
    assert np.abs(a["p"] - b["p"]).max() < 1e-9
    assert a["p"][-1] == pytest.approx(b["p"][-1]) and a["p"][-1] > 0.45
    assert a["omega_u"][-1] == pytest.approx(b["omega_u"][-1], abs=1e-9)
    assert a["p"][:1900] == pytest.approx(a["p"][0], abs=1e-6)  # at rest until the load comes


def test_the_connection_point_is_behind_the_transformer_or_at_the_filter():
    """Of B, without one, it is the filter itself; what A loses is its transformer's."""
    given, (L, R) = content(duration=0.3), (0.15, 0.01)
    given["network"]["converters"]["A"]["plant"] = {"lcl": {"L": L, "R": R}}
    run = gfmhil.run_network(given)
    for name in ("p", "q", "V"):
        there, here = (run["B"].signals[f"{name}{end}"] for end in ("_c", ""))
        assert there == pytest.approx(here, abs=1e-14)
    a = run["A"].signals
    i2 = (a["p"][0] ** 2 + a["q"][0] ** 2) / a["V"][0] ** 2
    assert a["p_c"][0] == pytest.approx(a["p"][0] - R * i2, abs=1e-9)
    assert a["q_c"][0] == pytest.approx(a["q"][0] - a["omega_u"][0] * L * i2, abs=1e-9)


def test_two_share_by_their_droops():
    """The change of power of each is that of the frequency over its droop."""
    given = content(duration=6.0)
    given["network"]["converters"]["B"]["law"] = "vsg-2"
    run = gfmhil.run_network(given)
    slopes = {}
    for name in "AB":
        s = run[name].signals
        slopes[name] = (s["omega_u"][-1] - s["omega_u"][0]) / (s["p"][-1] - s["p"][0])
    # what each law does alone, on a grid whose frequency steps
    for name, law in (("A", "droop-3"), ("B", "vsg-2")):
        alone = {
            "title": "alone", "duration": 6.0, "law": law, "references": {"P_ref": 0.3},
            "link": {"type": "inproc"},
            "events": [{"type": "grid-frequency", "t": 0.1, "f_hz": 49.95}],
        }  # fmt: skip
        s = gfmhil.run(alone).signals
        expected = -0.001 / (s["p"][-1] - s["p"][0])
        assert slopes[name] == pytest.approx(expected, rel=0.01)


def test_the_rig_as_a_network_of_one_has_the_bits_of_the_rig():
    rig = load_scenario("pref_step", in_process=True).model_dump(exclude_none=True)
    alone = gfmhil.run(copy.deepcopy(rig))
    rig["network"] = {"converters": {"A": {"node": "g"}}, "grid": "g"}
    (one,) = gfmhil.run_network(rig).values()
    assert set(one.columns) == set(alone.columns)
    for name in alone.columns:
        assert np.asarray(one.columns[name]) == pytest.approx(
            np.asarray(alone.columns[name]), abs=1e-9
        )


def test_one_that_trips_leaves_the_load_to_the_other():
    given = content(duration=3.0, events=[])
    given["network"]["converters"]["A"] |= {
        "plant": {"protection": {"over_current": {"threshold": 0.33}}}, "expect": "tripped",
    }  # fmt: skip
    given["events"] = [{"type": "reference", "t": 0.5, "P_ref": 0.4, "converter": "A"}]
    run = gfmhil.run_network(given)
    assert run["A"].status == "tripped" and run["B"].status == "completed"
    assert run.status == "A tripped, B completed" and run.summary["unmet"] == []
    assert "over-current" in run["A"].summary["reason"]
    a, b = run["A"].signals, run["B"].signals
    assert a["p"][-1] == pytest.approx(0.0, abs=0.01) and b["p"][-1] == pytest.approx(0.6, abs=0.03)


def with_a_reset(**changes: Any) -> dict[str, Any]:
    """A takes more than its protection allows at 0.1 s, and is reset at 0.6 s."""
    given = content(duration=5.0, after_trip="wait", law="vsg-2", **changes)
    limits = {"over_current": {"threshold": 0.9}}
    given["network"]["converters"]["A"]["plant"] = {"protection": limits}
    given["events"] = [
        {"type": "reference", "t": 0.1, "P_ref": 1.5, "converter": "A"},
        {"type": "reset", "t": 0.6, "converter": "A"},
    ]
    return given


@pytest.mark.parametrize("inner", [None, "virtual-stator"])
def test_a_reset_converter_starts_on_the_voltage_that_the_other_keeps(inner):
    """The common equilibrium is that of the start, as it is the only one; the start itself draws no
    current."""
    run = gfmhil.run_network(with_a_reset(inner=inner))
    assert run.status == "completed"
    a, b = run["A"].signals, run["B"].signals
    k = 6000  # the tick of the reset
    assert a["true_trip"][k - 1] > 0 and a["true_trip"][k + 1] == 0
    assert np.abs(a["true_i"][k - 100 : k]).max() == 0.0
    assert a["true_i"][k + 1 : k + 4].max() < 2e-3  # no inrush: others keep the voltage
    v = np.asarray(a["true_v_re"][: k + 2]) + 1j * np.asarray(a["true_v_im"][: k + 2])
    turned = 1 + np.angle(v[1:] / v[:-1]) / (2 * np.pi * 50 * 1e-4)
    part = -np.expm1(-1e-4 / 0.02)  # the blocked converter sees the speed through a low-pass
    seen = lfilter([part], [1, part - 1], turned)
    assert a["u_omega_u"][k + 1] == pytest.approx(seen[-1], abs=1e-6)
    assert a["u_E_u"][k + 1] == pytest.approx(abs(v[-1]), abs=1e-9)
    assert a["ref_P_ref"][-1] == 0.3
    for name in ("p", "q", "V", "omega_u", "v_dc"):
        for s in (a, b):
            assert s[name][-1] == pytest.approx(s[name][0], abs=2e-5), name
    assert [e["label"] for e in run["B"].summary["events"]] == []


def test_a_reset_converter_waits_for_a_voltage_that_it_can_start_on(tmp_path):
    """Without B the bus is dead; the log says what A waits for."""
    given = with_a_reset()
    given["duration"] = 0.8
    given["network"]["converters"] = {"A": given["network"]["converters"]["A"]}
    given["network"]["loads"] = {"base": {**BUS, "P": 0.3},
                                 "step": {**BUS, "P": 1.2, "Q": 0.1, "closed": False}}  # fmt: skip
    given["events"][0] = {"type": "breaker", "name": "step", "t": 0.1, "closed": True}
    run = run_network(load_scenario(given), tmp_path / "run")["A"]
    assert run.status == "tripped" and run.signals["true_trip"][-1] > 0
    log = read_log(tmp_path / "run" / "A" / "events.jsonl")
    (line,) = [e for e in log if e["event"] == "waits"]
    assert line["tick"] == 6000
    assert re.fullmatch(
        r"under-voltage: V = [\d.e-]+ p.u. at its capacitor, must be at least 0.4 p.u.",
        line["reason"],
    )


def test_events_find_their_converter_and_everyone_sees_those_of_the_network():
    given = content()
    given["events"].append({"type": "reference", "t": 0.1, "V_ref": 1.02, "converter": "B"})
    run = gfmhil.run_network(given)
    labels = {name: [e["label"] for e in one.summary["events"]] for name, one in run.items()}
    assert labels == {"A": ["step on"], "B": ["V_ref = 1.02", "step on"]}
    assert run["A"].signals["ref_V_ref"][-1] == 1.0 and run["B"].signals["ref_V_ref"][-1] == 1.02


def test_an_inner_stage_of_one_gives_all_its_signals():
    given = content(events=[])
    given["network"]["converters"]["B"] |= {"law": "vsg-2", "inner": "virtual-stator"}
    run = gfmhil.run_network(given)
    assert run.status == "completed"
    assert run["B"].signals["y_i_d"][-1] == pytest.approx(0.3, abs=0.05)
    assert "u_E_q" in run["A"].columns and "u_E_q" in run["B"].columns


def test_a_run_on_disk_is_that_in_memory(tmp_path, capsys):
    file = tmp_path / "two.toml"
    text = find_scenario("loss_of_the_last_machine").read_text("utf-8")
    text = text.replace("duration = 4.0", "duration = 1.2")
    file.write_text(text, "utf-8")
    assert main(["run", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert all(f"\n{name}\ncompleted" in said for name in "AB")
    kept = NetworkRun.load(tmp_path / "run")
    memory = gfmhil.run_network(tomllib.loads(text))
    for name in "AB":
        for column in memory[name].columns:
            there = np.asarray(kept[name].columns[column][:])
            assert (there == np.asarray(memory[name].columns[column][:])).all(), column
    assert (tmp_path / "run" / "converters.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["unmet"] == []
    again = memory.save(tmp_path / "saved")
    assert NetworkRun.load(again).status == "completed"
    assert gfmhil.load_run(tmp_path / "run" / "B").scenario.converter == "B"
    with pytest.raises(UserError, match=r"is the folder of a network; .*/A, [^;]*/B$"):
        gfmhil.load_run(tmp_path / "run")
    assert main(["run", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    # what was cut off: the summaries are not there yet
    for place in (tmp_path / "run", *(tmp_path / "run" / name for name in "AB")):
        (place / "summary.json").unlink()
    assert main(["recover", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["status"] == "completed"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": {"converters": {"A": {**BUS, "link": {"type": "shm"}}, "B": BUS}}},
         "network.converters: link.type is 'inproc' of some and not of others"),
        ({"link": {"type": "zmq", "endpoint": "ipc:///tmp/x"}},
         "network.converters: 2 have the link.endpoint 'ipc:///tmp/x'; each needs one of its own"),
        ({"network": {"converters": {"A": {**BUS, "link": {"type": "smh"}}}}},
         "network.converters.A.link: type = 'smh': must be one of"),
        ({"mode": "realtime"}, "link.type = 'inproc': runs in lockstep only"),
        ({"events": [{"type": "reset", "t": 0.1, "converter": "A"}]},
         "events.0: nothing to reset with after_trip = 'end'; use 'wait'"),
        ({"events": [{"type": "breaker", "name": "stop", "t": 0.1, "closed": True}]},
         r"events.0: name = 'stop': must be one of \['A', 'B', 'base', 'step'\]"),
        ({"events": [{"type": "reference", "t": 0.1, "P_ref": 0.1, "converter": "C"}]},
         r"events.0.converter = 'C': must be one of \['A', 'B'\]"),
        ({"events": [{"type": "fault", "t": 0.1, "R": 0.1, "node": "bsu"}]},
         r"events.0: node = 'bsu': must be one of \['bus'\]"),
        ({"events": [{"type": "fault", "t": 0.1, "R": 0.1}]}, "position, node: give one of them"),
        ({"events": [{"type": "fault", "t": 0.1, "R": 0.1, "node": "bus", "kind": "LG"}]},
         "events.0: X_0: not set, and no closed line leads from node bus to the earthed star"),
        ({"events": [{"type": "fault", "t": 0.1, "R": 0.1, "node": "bus", "kind": "GL"}]},
         "events.0.kind: must be '3ph', 'LG', 'LL' or 'LLG'"),
        ({"events": [{"type": "fault", "t": 0.1, "R": 0.1, "node": "bus", "kind": "LL",
                      "phases": "b"}]}, r"events.0: phases = 'b': must be one of \['bc', 'ca'"),
        ({"events": [{"type": "fault", "t": 0.1, "R": -0.1, "node": "bus"}]},
         "events.0.R: must be greater than or equal to 0"),
        *[({"events": [{"t": 0.1, **event}]}, "events.0: network.grid: not set; an island has no")
          for event in (
              {"type": "grid-voltage", "V_g": 0.5}, {"type": "grid-frequency", "f_hz": 49.0},
              {"type": "grid-phase-jump", "degrees": 10.0},
              {"type": "grid-unbalance", "retained": [0.0, 1.0, 1.0]})],
        ({"network": {"converters": {"A": {"node": "x", "law": "drop-1"}}, "grid": "x"},
          "events": []}, "network.converters.A.law"),
        ({"network": {"converters": {"A": {"node": "x"}}, "grid": "y"}}, "the grid is at node 'y'"),
        ({"network": {"converters": {"A": {"node": "x"}}, "lines": {"l": {**LINE, "L": 0.0}}}},
         "network.lines.l.L: must be greater than 0"),
        ({"network": {"converters": {"A": {"node": "x"}}, "transformers":
          {"t": {"start": "x", "end": "y", "S": 1.0, "X": -0.1}}}},
         "network.transformers.t.X: must be greater than 0"),
        ({"network": {"converters": {"A": {"node": "x"}}, "transformers":
          {"t": {"start": "x", "end": "y", "S": 1.0, "X": 0.1, "earthed": "delta"}}}},
         "network.transformers.t.earthed: must be 'end', 'start', 'both' or 'none'"),
        ({"network": {"converters": {"A": {"node": "x", "plant": {"lcl": {"L": 0.0}}}}}},
         "network.converters.A.plant.lcl.L: must be greater than 0"),
        ({"network": {"converters": {"A": {"node": "x", "plant": {"converter": "papr"}}}}},
         "network.converters.A.plant.converter = 'papr': must be one of paper"),
        ({"network": {"converters": {"A": {"node": "x", "plant": {"grid": {"V_g": 0.9}}}}}},
         "plant.grid: is the scenario's own"),
        ({"plant": {"grid": {"scr": 1.5, "x_over_r": 10.0}}},
         "plant.grid.scr = 1.5: is for one converter alone; network.lines say how strong the grid"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_that_names_it(change, message):
    with pytest.raises(UserError, match=message) as caught:
        load_scenario(content(**change))
    assert "\n" not in str(caught.value)


def test_what_a_converters_file_lacks_is_said_with_its_name(tmp_path):
    shipped = Path(gfm_plant.__file__).with_name("converters") / "paper.toml"
    file = tmp_path / "mine.toml"
    file.write_text(re.sub("(?m)^L_f.*$", "", shipped.read_text()))
    change = {"network": {"converters": {"A": {"node": "x", "plant": {"converter": str(file)}}}}}
    message = f"network.converters.A.plant.converter = '{file}': L_f: missing"
    with pytest.raises(UserError, match=re.escape(message)):
        load_scenario(content(**change))


def test_converter_names_the_one_that_gets_a_law(tmp_path):
    out = ["--out", str(tmp_path / "run"), "--quiet", "--no-figures"]
    with pytest.raises(UserError, match=r"law vsg-2: does not .*; set network.converters.NAME.law"):
        gfmhil.run_network("three_share_a_load", law="vsg-2")
    file = tmp_path / "short.toml"
    file.write_text(scenario_toml(load_scenario(content(duration=0.02, events=[]))))
    assert main(["run", str(file), "--converter", "B", "--law", "droop-5", *out]) == 0
    laws = json.loads((tmp_path / "run" / "summary.json").read_text())["converters"]
    assert [laws[name]["laws"] for name in "AB"] == [["droop-3"], ["droop-5"]]


def test_a_law_for_all_reaches_those_that_name_none():
    given = content()
    assert [load_scenario(given, law="vsg-2").each[name].law for name in "AB"] == ["vsg-2"] * 2
    given["network"]["converters"]["B"]["law"] = "droop-5"
    with pytest.raises(UserError, match="does not replace the own law of B"):
        load_scenario(given, law="vsg-2")
    with pytest.raises(UserError, match="does not replace the own inner of A"):
        given["network"]["converters"]["A"]["inner"] = "none"
        load_scenario(given, inner="virtual-stator")


def test_laws_are_compared_in_a_network_converter_by_converter(tmp_path, capsys):
    (tmp_path / "two.toml").write_text(toml_text(content(duration=0.4)))
    words = ["compare", str(tmp_path / "two.toml"), "--laws", "droop-3,vsg-2", "--converter", "A"]
    assert main([*words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    out = capsys.readouterr().out
    assert [line.split() for line in out.splitlines() if "vsg-2" in line] == [
        ["A", "droop-3", "vsg-2"], ["B", "droop-3", "vsg-2"]
    ]  # fmt: skip
    both = gfmhil.compare(content(duration=0.4), ["droop-3", gfmhil.Law.load("vsg-2")],
                          converter="A")  # fmt: skip
    assert [*both] == ["A: droop-3", "A: vsg-2", "B: droop-3", "B: vsg-2"]
    assert [*both.converters["B"]] == ["droop-3", "vsg-2"]
    assert [run.scenario.law for run in both.values()] == ["droop-3", "vsg-2", *["droop-3"] * 2]
    kept = gfmhil.load_run(tmp_path / "out" / "vsg-2" / "B")
    assert np.array_equal(kept.signals["p"], both["B: vsg-2"].signals["p"])
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert [*found] == [*both]
    plots = unpacked((tmp_path / "out" / "report.html").read_text("utf-8"))
    assert [*plots[0]["curves"]] == [*both] and len(plots) == 6 + 4 * 9
    with pytest.raises(UserError, match="recording: is of one converter"):
        gfmhil.compare(content(), ["vsg-2"], recording="x.csv", map="x.toml")


def test_a_campaign_in_a_network_tests_one_of_its_converters(tmp_path):
    """A trips where it may carry little; B, under the laws, has the load then."""
    given = content(duration=0.6)
    limits = {"over_current": {"threshold": 0.45, "delay_s": 0.0}}
    given["network"]["converters"]["A"] |= {"law": "droop-5", "plant": {"protection": limits}}
    (tmp_path / "two.toml").write_text(toml_text(given))
    path = "network.converters.A.plant.protection.over_current.threshold"
    campaign = {
        "title": "c", "scenario": str(tmp_path / "two.toml"), "laws": ["droop-3", "vsg-2"],
        "converter": "B", "runs": 2, "seed": 1,
        "draw": [{"path": path, "type": "choice", "values": [0.45, 3.0]}],
    }  # fmt: skip
    found = gfmhil.campaign(campaign, runs=4)
    for record in found.records:
        given["network"]["converters"]["A"]["plant"]["protection"]["over_current"] |= {
            "threshold": record["drawn"][path]
        }
        given["network"]["converters"]["B"]["law"] = record["law"]
        run = gfmhil.run_network(given)
        assert run["B"].scenario.law == record["law"] and run["A"].scenario.law == "droop-5"
        trips = record["drawn"][path] < 1.0
        assert (record["status"] == "tripped") is trips is (run["A"].status == "tripped")
        assert record["reason"].startswith("A: over-current") is trips
        assert (record["end_s"] is not None) is trips
        if trips:
            assert 0.2 < record["end_s"] < 0.3
        p_peak = run["B"].summary["events"][0]["p_peak"]
        assert record["events"][0]["p_peak"] == pytest.approx(p_peak, rel=1e-9)
    assert len({r["drawn"][path] for r in found.records}) == 2
    for wrong, says in (("C", r"must be one of \['A', 'B'\]"), (None, "must be one of")):
        with pytest.raises(UserError, match=f"converter = {wrong!r}: {says}"):
            gfmhil.campaign({k: v for k, v in (campaign | {"converter": wrong}).items() if v})
    with pytest.raises(UserError, match=r"'network\.converters\.B\.law' is the campaign's own"):
        gfmhil.campaign(campaign | {"set": {"network.converters.B.law": "vsg-2"}})


def test_what_takes_one_converter_says_so():
    with pytest.raises(UserError, match="network: this takes one converter on its own grid"):
        gfmhil.run(content())
    with pytest.raises(UserError, match="network: the scenario has none"):
        gfmhil.run_network("pref_step")
    with pytest.raises(KeyError, match="'C': must be one of A, B"):
        gfmhil.run_network(content(duration=0.01, events=[]))["C"]


def test_two_converters_keep_the_load_when_the_last_machine_is_lost():
    run = gfmhil.run_network("loss_of_the_last_machine")
    assert run.status == "completed"
    for one in run.values():
        (opened,) = one.summary["events"]
        assert opened["i_peak_cycle"] < 1.0 and opened["f_nadir_hz"] > 49.8
    a, b = run["A"].signals, run["B"].signals
    V = 0.5 * (a["true_V"][-1] + b["true_V"][-1])  # both feed the bus through the same short line
    assert a["p"][-1] + b["p"][-1] == pytest.approx(1.2 * V**2, rel=0.03)
    assert a["omega_u"][-1] == pytest.approx(b["omega_u"][-1], abs=1e-6)


def test_a_machine_and_a_converter_share_a_load_by_their_droops():
    given = content(duration=8.0)
    given["network"]["converters"] = {"A": {**BUS, "law": "vsg-2"}}
    given["network"]["machines"] = {"M": {**BUS, "S": 2.0, "H": 3.0, "P": 0.2}}
    run = gfmhil.run_network(given)["A"]
    assert run.status == "completed"
    s = run.signals
    assert s["true_omega_g"][-1] == pytest.approx(s["omega_u"][-1], abs=1e-6)
    off = s["omega_u"][-1] - s["omega_u"][0]
    V = s["true_V"][-1]
    machine = -2.0 * off / 0.05  # its rating, over its droop
    rise = s["p"][-1] - s["p"][0]
    assert off < -1e-3 and rise + machine == pytest.approx(0.4 * V**2, rel=0.05)


def test_the_scenario_in_the_folder_of_a_converter_is_that_of_the_whole():
    given = content()
    given["network"]["converters"]["B"] |= {"law": "vsg-2", "inner": "virtual-stator"}
    given["events"] = [{"t": 0.1, "type": "law", "law": "regfm-a1", "converter": "A"}]
    whole = load_scenario(given)
    part = load_scenario(tomllib.loads(scenario_toml(whole.each["B"])))
    assert part == whole.each["B"] and part.converter == "B"
    assert (part.laws(), part.each["A"].laws()) == (["vsg-2"], ["droop-3", "regfm-a1"])
    for name in "AB":
        assert part.each[name] == whole.each[name].model_copy(update={"converter": name})
    assert (part.each["A"].law, part.each["A"].inner) == ("droop-3", None)


def test_all_sides_of_a_network_carry_what_a_later_law_of_one_needs():
    """So that the frames of the other converters have their length as well."""
    later = {"t": 0.1, "type": "law", "law": "regfm-a1", "converter": "A"}
    whole = load_scenario(content(events=[later]))
    parts = [load_scenario(tomllib.loads(scenario_toml(one))) for one in whole.each.values()]
    assert {one.signal_set for one in (whole, *whole.each.values(), *parts)} == {INNER}


def test_a_load_of_constant_power_draws_it_at_any_voltage():
    """And a resistor draws with the square of it."""
    taken = {}
    for kind in ("constant_power", "loads"):
        given = content(duration=3.0, law="vsg-2", inner="virtual-stator")
        given["network"]["loads"] = {}
        given["network"]["capacitors"] = {"filter": {**BUS, "Q": 0.2}}
        given["network"][kind] = {"x": {**BUS, "P": 0.6}}
        given["events"] = [{"type": "reference", "t": 0.2, "V_ref": 0.9, "ramp_s": 0.3}]
        run = gfmhil.run_network(given)
        assert run.status == "completed"
        p = sum(np.asarray(one.signals["p"][:]) for one in run.values())
        assert p[:1900] == pytest.approx(p[0], abs=1e-6)  # at rest until then
        taken[kind] = p[0], p[-1]
    before, after = taken["constant_power"]
    assert before == pytest.approx(0.6, abs=0.01) and after == pytest.approx(before, abs=0.005)
    before, after = taken["loads"]
    assert after / before == pytest.approx(0.9**2, rel=0.03)


@pytest.mark.processes
def test_other_gains_of_one_converter_are_not_those_of_another_with_its_law(tmp_path):
    """Equal laws share their records in process; over a link each controller has its own."""
    gains = {"type": "gains", "t": 0.1, "converter": "B", "values": {"D_p": 0.02}}
    members = {name: {"node": "bus", "law": "droop-3"} for name in "ABC"}
    content = {
        "title": "three alike", "duration": 0.3, "link": {"type": "zmq"},
        "network": {
            "converters": members,
            "loads": {"base": {"node": "bus", "P": 1.2, "Q": 0.1},
                      "step": {"node": "bus", "P": 0.6, "closed": False}},
        },
        "events": [gains, {"type": "breaker", "t": 0.15, "name": "step", "closed": True}],
    }  # fmt: skip
    one = gfmhil.run_network(content)
    p = {name: run.signals["p"] for name, run in one.items()}
    np.testing.assert_allclose(p["A"], p["C"], rtol=0, atol=1e-9)
    assert abs(p["B"][-1] - p["A"][-1]) > 0.01
    over = gfmhil.run_network(content, tmp_path / "run", link__type="zmq")
    for name in "ABC":
        np.testing.assert_array_equal(over[name].signals["p"], p[name])
