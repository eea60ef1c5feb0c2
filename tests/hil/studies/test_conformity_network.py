"""Published tests laid over a network: against the same converter alone, and closed forms."""

import json
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.run.runner import run_in_memory, run_network_in_memory
from gfm_hil.scenario import load_scenario, toml_text
from gfm_hil.studies.conformity.in_network import NetworkUnderTest
from gfm_hil.studies.conformity.sets import load_cases
from gfm_hil.studies.conformity.verdict import CANNOT, PASS
from gfm_plant import load_converter

from ...support.files import text_of


def laid(network, test, part="", folder=Path(), judged=None, law="vsg-2"):
    """The scenario of a part of a shipped test over a network, by its name or file."""
    case = load_cases([test])[0]
    chosen = next(one for one in case.test.runs() if one.name == part)
    return NetworkUnderTest.load(network, judged).scenario_of(case, chosen, law, None, folder)


@pytest.fixture
def alone(tmp_path):
    """A network of one converter, whose own line has 0.14 p.u. and 0.004 p.u."""
    line = load_converter("paper").pu()
    content = {
        "title": "alone", "duration": 1.0, "inner": "virtual-stator", "link": {"type": "inproc"},
        "plant": {"factors": {"L_g": 0.14 / line["L_g"], "R_g": 0.004 / line["R_g"]}},
        "network": {"grid": "poc", "converters": {"A": {"node": "poc"}}},
    }  # fmt: skip
    path = tmp_path / "alone.toml"
    path.write_text(toml_text(content))
    return path


@pytest.mark.full  # compiles the loops of networks
def test_a_network_of_one_answers_as_its_converter_behind_both_lines(alone, tmp_path):
    scenario = laid(alone, "ercot/2-phase-jump", "-10", tmp_path)
    found = run_network_in_memory(scenario)["A"]
    line, far = load_converter("paper").pu(), 1 / 3 / np.hypot(1, 6)  # SCR 3, X/R 6
    factors = {"L_g": (0.14 + 6 * far) / line["L_g"], "R_g": (0.004 + far) / line["R_g"]}
    content = {
        "title": "alone", "duration": 7.0, "law": "vsg-2", "inner": "virtual-stator",
        "references": {"P_ref": 0.5}, "link": {"type": "inproc"},
        "plant": {"factors": factors, "converter": scenario.each["A"].plant.converter},
        "events": [{"t": 2.0, "type": "grid-phase-jump", "degrees": -10.0}],
    }  # fmt: skip
    same = run_in_memory(load_scenario(content))
    for name in ("true_p", "true_omega_u", "true_V"):
        assert np.ptp(same.signals[name]) > 1e-3
        # two branches in series are one: the same circuit but for rounding
        np.testing.assert_allclose(found.signals[name], same.signals[name], rtol=0, atol=1e-9)


def test_the_short_circuit_ratio_is_over_all_ratings_and_steps_by_breakers(tmp_path):
    scenario = laid("plant_of_two", "aemo/6-scr-steps", folder=tmp_path)
    assert scenario.network is not None
    lines = {n: x for n, x in scenario.network.lines.items() if n != "cable"}
    closed = {name: line.closed for name, line in lines.items()}
    ratios = {}
    for event in [*scenario.events, None]:
        if event is None or event.type == "fault":
            admittance = sum(1 / complex(x.R, x.L) for name, x in lines.items() if closed[name])
            ratios[scenario.duration if event is None else event.t] = abs(admittance)
        else:
            assert event.type == "breaker" and closed[event.name] != event.closed
            closed[event.name] = event.closed
    # in p.u. of the first of two equal converters: twice the ratio of the file
    assert [*ratios.values()] == pytest.approx([2 * x for x in (20, 10, 3, 2, 1.5, 1.25)])
    faults = [event for event in scenario.events if event.type == "fault"]
    assert {event.node for event in faults} == {"connection"}
    assert [event.R for event in faults] == pytest.approx([0.0075, 0.015, 0.05, 0.075, 0.1])


def test_all_converters_get_the_references_and_the_frequency_of_the_test(tmp_path):
    scenario = laid("plant_of_two", "miso/3-phase-jump", folder=tmp_path, judged="B", law="vsg-1")
    assert [scenario.each[name].laws()[0] for name in "AB"] == ["vsg-2", "vsg-1"]
    asked = load_cases(["miso/3-phase-jump"])[0].test.scenario["references"]["P_ref"]
    assert {scenario.each[name].references.P_ref for name in "AB"} == {asked}
    for name in "AB":
        nominal = load_converter(scenario.each[name].plant.converter)
        assert nominal.omega_n == pytest.approx(2 * np.pi * 60)


@pytest.mark.parametrize(
    ("test", "why"),
    [
        ("ercot/3-loss-of-machine", "has a network of its own"),
        ("rte/1-phase-jump", "an envelope is that of a converter alone"),
        ("esig/1-stiffness", "the frequency scan of a converter alone"),
    ],
)
def test_what_cannot_be_laid_over_a_network_says_why(test, why):
    found = gfmhil.conform(against=test, network="plant_of_two")
    assert found.verdict == CANNOT
    assert all(why in part.reason and part.status == "none" for part in found.parts)


@pytest.mark.full  # compiles the loops of networks
def test_the_command_judges_one_converter_and_says_which(tmp_path, capsys):
    folder = tmp_path / "report"
    argv = ["conform", "--network", "plant_of_two", "--judged", "B", "--against"]
    assert main([*argv, "fingrid/1-phase-jump", "-o", str(folder), "--workers", "1"]) == 0
    said = "B of plant_of_two.toml, beside A"
    assert said in capsys.readouterr().out
    found = json.loads((folder / "results.json").read_text())
    assert found["network"] == said and [*found["laws"]] == ["droop-3"]
    assert found["laws"]["droop-3"]["fingrid/1-phase-jump"]["verdict"] == PASS
    assert "network plant_of_two.toml" in found["hashes"]
    assert said in text_of(folder / "report.html")


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ({"network": "pref_step"}, "--network pref_step: has no network"),
        ({"network": "three_share_a_load"}, "--network three_share_a_load: has no network.grid"),
        ({"network": "plant_of_two", "judged": "C"}, r"--judged C: must be one of \['A', 'B'\]"),
        ({"law": "vsg-2", "judged": "A"}, "--judged A: is of a --network, and none is given"),
        ({"network": "plant_of_two", "controller": "dll:x.so"}, "--controller dll:x.so: is one"),
    ],
)
def test_wrong_networks_are_told_in_one_line(asked, says):
    with pytest.raises(UserError, match=says) as problem:
        gfmhil.conform(against="miso", **asked)
    assert "\n" not in str(problem.value)
