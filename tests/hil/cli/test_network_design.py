"""The design commands on a scenario with several converters, and the same from Python."""

import json
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_design.norms.performance import PAPER_WEIGHTS
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_hil.cli.main import main
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import toml_text, write_scenario
from gfm_runtime.inner_file import named_inner

pytestmark = pytest.mark.full  # compiles the start of several converters

Capture = pytest.CaptureFixture[str]
THREE = "three_share_a_load"


def said(capsys: Capture, *arguments: str, code: int = 0) -> dict[str, Any]:
    assert main(["design", *arguments, "--json"]) == code
    return dict(json.loads(capsys.readouterr().out))


def test_modes_with_their_participations(capsys, tmp_path):
    figure = tmp_path / "poles.svg"
    found = said(capsys, "poles", "--scenario", THREE, "--out", str(figure))
    loop = gfmhil.design.network_loop(THREE)
    assert found["modes"] == [mode.plain() for mode in loop.modes()]
    assert found["law"] == "A (vsg-2), B (droop-3), C (mimo-gfm-deployable)" and found["stable"]
    swing = next(m for m in found["modes"] if 3.0 < m["frequency_hz"] < 4.0)
    assert swing["participation"]["A"] == pytest.approx(0.5, abs=0.01)
    assert figure.read_text("utf-8").startswith("<?xml")
    assert main(["design", "poles", "--scenario", THREE]) == 0
    assert "A 50 %, B 50 %" in capsys.readouterr().out


def test_who_swings_against_whom_is_what_a_run_shows(tmp_path, capsys):
    """The speeds after a small step of a load, fitted by the exponentials of the slow modes."""
    content = {
        "title": "machine", "duration": 6.0, "link": {"type": "inproc"},
        "references": {"P_ref": 0.4},
        "network": {
            "converters": {"A": {"node": "bus", "law": "vsg-2"},
                           "B": {"node": "far", "law": "droop-3"}},
            "lines": {"line": {"start": "bus", "end": "far", "L": 0.2, "R": 0.02}},
            "loads": {"town": {"node": "bus", "P": 1.2, "Q": 0.3},
                      "small": {"node": "bus", "P": 0.01, "closed": False}},
            "machines": {"M": {"node": "bus", "S": 1.0, "H": 3.0, "X": 0.3, "P": 0.4}},
            "record": ["M"],
        },
        "events": [{"type": "breaker", "t": 0.5, "name": "small", "closed": True}],
    }  # fmt: skip
    modes = gfmhil.design.network_loop(content).modes()
    number, mode = next((k, m) for k, m in enumerate(modes, 1) if 1.0 < m.frequency_hz < 4.0)
    run = gfmhil.run_network(content)
    speeds = {x: run[x].signals["omega_u"][5_100:] for x in "AB"}
    speeds["M"] = run.flows["M.omega"][5_100:]
    t = 1e-4 * np.arange(len(speeds["M"]))
    slow = [mode, *(m for m in modes if m.sigma > -12.0 and m is not mode)]
    own = [complex(m.sigma, sign * 2 * np.pi * m.frequency_hz) for m in slow for sign in (1, -1)]
    parts = np.exp(np.outer(t, own))
    parts = np.concatenate([parts, np.ones((len(t), 1))], axis=1)
    fit = {
        x: np.linalg.lstsq(parts, v.astype(complex), rcond=1e-9)[0][0] for x, v in speeds.items()
    }
    assert mode.shape["M"] == 1.0 and abs(mode.shape["A"]) > 0.1
    for name, z in fit.items():
        assert abs(z / fit["M"] - mode.shape[name]) < 0.02
    file, figure = tmp_path / "network.toml", tmp_path / "shape.svg"
    file.write_text(toml_text(content), "utf-8")
    asked = ["design", "poles", "--scenario", str(file), "--shape", str(number)]
    assert main([*asked, "--out", str(figure)]) == 0
    assert f"mode {number}" in figure.read_text("utf-8").replace("-->", "")
    for more, problem in (
        ([], "--shape: takes a scenario with a network, and --out"),
        (["--out", "x.png", "--shape", "999"], "mode 999: must be one of 1 to "),
    ):
        assert main([*asked, *more]) == 2
        assert problem in capsys.readouterr().err


def test_a_step_of_all_and_of_one(capsys, tmp_path):
    arguments = "step", "--scenario", THREE, "--seconds", "8"
    whole = said(capsys, *arguments, "--of", "C.P_ref", "--out", str(tmp_path / "step.png"))
    own = said(capsys, *arguments, "--converter", "C")
    assert own["of"] == "P_ref"
    for name, row in own["y"].items():
        assert row == pytest.approx(whole["y"]["C"][name], rel=1e-6, abs=1e-9)
    # the loads take no more: what C gives more, A and B give less, and so does the frequency
    ends = {name: y["p"]["end"] for name, y in whole["y"].items()}
    assert ends["A"] == pytest.approx(ends["B"], abs=1e-3) and ends["A"] < 0.0 < ends["C"]
    assert abs(sum(ends.values())) < 0.02


def test_margins_are_those_of_one_with_the_others_closed(capsys, tmp_path):
    found = said(capsys, "margins", "--scenario", THREE, "--converter", "C")
    margins = gfmhil.design.loop_margins(gfmhil.design.network_loop(THREE).converter("C"))
    assert found["law"] == "C (mimo-gfm-deployable)"
    assert found["delay_us"] == pytest.approx(1e6 * margins.delay.seconds)
    assert set(found["u"]) == {"i_u", "omega_u", "E_u"} and "elements" not in found
    figure = str(tmp_path / "bode.png")
    drawn = said(capsys, "bode", "--scenario", THREE, "--converter", "C", "--out", figure)
    assert drawn["at"] == found["u"]


def test_another_law_for_one_converter(capsys):
    other = said(capsys, "poles", "--scenario", THREE, "--converter", "C", "--law", "vsg-2")
    assert other["law"] == "A (vsg-2), B (droop-3), C (vsg-2)"
    loop = gfmhil.Law.load("vsg-2").closed_loop(THREE, converter="C")
    assert other["modes"][0]["sigma"] == pytest.approx(loop.sigma())
    np.testing.assert_allclose(
        gfmhil.design.network_loop(THREE, network__converters__C__law="vsg-2").A,
        gfmhil.design.network_loop(THREE, {"C": gfmhil.Law.load("vsg-2").built()}).A,
    )


def test_an_unstable_network_has_modes_and_no_margins(capsys):
    """A load of constant power whose negative conductance outweighs all damping of its node."""
    load = {"node": "bus", "P": 1.5, "tau_s": 0.0005}
    loop = gfmhil.design.network_loop(
        THREE, network__constant_power={"drive": load},
        network__capacitors={"filter": {"node": "bus", "Q": 0.02}},
        network__loads__base__P=0.1,
    )  # fmt: skip
    worst = loop.modes()[0]
    assert worst.sigma > 0.0 and worst.participation["drive"] > 0.01
    with pytest.raises(gfmhil.design.UnstableLoop):
        gfmhil.design.loop_margins(loop.converter("A"))


#: the printed MIMO-GFM, one sample late, in parallel to a VSG: an LC mode at 1.2 kHz grows
PAIR: dict[str, Any] = {
    "title": "pair", "duration": 4.0, "law": "vsg-2", "link": {"type": "inproc"},
    "references": {"P_ref": 0.3}, "plant": {"delay": {"samples": 1}},
    "network": {
        "grid": "far",
        "converters": {"A": {"node": "bus"}, "B": {"node": "bus", "law": "mimo-gfm"}},
        "lines": {"feeder": {"start": "bus", "end": "far", "L": 0.2, "R": 0.02}},
        "loads": {"base": {"node": "bus", "P": 0.4}},
    },
    "events": [{"type": "reference", "converter": "B", "t": 0.1, "P_ref": 0.5}],
}  # fmt: skip


def test_tuning_one_converter_damps_the_network_as_the_bench_shows(tmp_path):
    on = gfmhil.load_scenario(PAIR)
    worst = gfmhil.design.network_loop(on).modes()[0]
    assert worst.sigma > 0.0 and 1100.0 < worst.frequency_hz < 1250.0
    run = gfmhil.run_network(PAIR)
    assert run["B"].status == "tripped"
    # at its new references the bench grows as the mode there says: by exp(sigma) in a second, seen
    # in V without its slow part
    there = gfmhil.design.network_loop(PAIR, network__converters__B__references={"P_ref": 0.5})
    fast = np.abs(np.diff(run["B"].signals["V"], 2))
    grown = np.log(fast[20000:22000].max() / fast[10000:12000].max())
    assert grown == pytest.approx(there.sigma(), rel=0.02)

    more = {"only": ("k_31", "k_34"), "evaluations": 40, "starts": 1}
    found = gfmhil.design.tune("mimo-gfm", "tuned", on=on, converter="B", **more)
    loop = gfmhil.design.network_loop(on, {"B": found.law.built()})
    assert loop.sigma() < -0.5
    assert gfmhil.design.gamma(found.law, on=on, converter="B").value == pytest.approx(
        found.gamma.value, rel=1e-6
    )
    assert found.gamma.value == pytest.approx(loop.converter("B").gamma(), rel=1e-6)
    file = str(found.law.save(tmp_path / "tuned.toml"))
    assert gfmhil.run_network(PAIR, network__converters__B__law=file).status == "completed"


def test_a_decay_is_that_of_all_modes_of_the_network(tmp_path):
    """The slowest mode of the island is almost C's own. Tuned with a decay of 2.5 1/s none is
    slower, which leaves the swing of A against B, and the bench comes to rest sooner."""
    weights = [w for w in PAPER_WEIGHTS if (w.i, w.j) != (1, 1)]  # the loads decide p, not P_ref
    before = gfmhil.design.network_loop(THREE).modes()[0]
    assert before.sigma > -2.0 and before.participation["C"] > 0.9
    found = gfmhil.design.tune(
        "mimo-gfm-deployable", "c", on=THREE, converter="C", weights=weights, decay=2.5,
        evaluations=60, starts=2,
    )  # fmt: skip
    worst = gfmhil.design.network_loop(THREE, {"C": found.law.built()}).modes()[0]
    assert worst.sigma < -2.5 and worst.participation["C"] < 0.9
    file = str(found.law.save(tmp_path / "c.toml"))
    rest = []
    for changed in ({}, {"network__converters__C__law": file}):
        p = gfmhil.run_network(THREE, **changed)["C"].signals["p"]
        rest.append(np.abs(p[20000:] - p[-1]).max())  # from 1.5 s after the load step on
    assert rest[1] < 0.2 * rest[0]


@pytest.mark.parametrize("stage", [None, "virtual-stator"])
def test_a_norm_with_a_decay_is_that_beside_the_axis(stage):
    """Of the continuous and of the sampled loop, against the transfer function on a line of
    complex frequencies."""
    file = gfmhil.Law.load("vsg-2").file
    if stage is not None:
        file = file.model_copy(update={"inner": named_inner(stage)})
    problem = PaperProblem(file, free_gains(file), decay=1.5)
    values = np.array([gain.start for gain in problem.gains])
    loop = problem.closed_loop(values)
    A, B, C, D = loop.performance()
    for channel, weight in zip(problem.channels(values), problem.weights, strict=True):
        if not 0.0 < channel.omega < 1e4:
            continue
        s = 1j * channel.omega
        T_s, at = loop.T_s, s - problem.decay
        z = at if T_s is None else np.exp(at * T_s)
        T = (C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D)[weight.i - 1, weight.j - 1]
        if T_s is not None:  # weights by Tustin
            s = 2j / T_s * np.tan(channel.omega * T_s / 2)
        assert abs(weight(np.array([s]))[0] * T) == pytest.approx(channel.norm, rel=1e-4)
    assert problem(values) == pytest.approx(max(c.norm for c in problem.channels(values)), rel=1e-3)


def test_the_command_tunes_one_converter(capsys, tmp_path):
    scenario, law = tmp_path / "pair.toml", tmp_path / "tuned.toml"
    write_scenario(tmp_path, gfmhil.load_scenario(PAIR))
    (tmp_path / "scenario.toml").rename(scenario)
    where = "--scenario", str(scenario), "--converter", "B", "--law"
    found = said(capsys, "tune", *where, "mimo-gfm", "--only", "k_31,k_34", "--evaluations", "40",
                 "--starts", "1", "--out", str(law), "--quiet")  # fmt: skip
    assert said(capsys, "gamma", *where, str(law))["gamma"] == pytest.approx(found["gamma"])
    assert "of the paper's weights on converter B of 'pair', sampled" in law.read_text()
    none = said(capsys, "gamma", *where, "mimo-gfm", code=3)
    assert none["gamma"] is None and "unstable" in none["reason"]


def test_gamma_on_a_scenario_of_one_converter_is_that_of_its_sampled_loop():
    law = gfmhil.Law.load("mimo-gfm-deployable")
    loop = law.closed_loop("rig_pref_step")
    assert loop.T_s is not None
    assert gfmhil.design.gamma(law, on="rig_pref_step").value == loop.gamma()


def test_python_refuses_in_one_line():
    law = gfmhil.Law.load("vsg-2")
    for call, words in (
        (lambda: law.closed_loop(THREE), "converter = None: must be one of"),
        (lambda: law.closed_loop("pref_step", converter="A"), "must be left out"),
        (lambda: law.closed_loop(THREE, converter="A", ideal=True), "ideal: not of a converter"),
        (lambda: gfmhil.design.margins(law, THREE, converter="A"), "ranges of elements"),
        (lambda: gfmhil.design.network_loop("pref_step"), "network: the scenario has none"),
        (lambda: gfmhil.Law.load("vsg-2").closed_loop(THREE, converter="D"), "must be one of"),
        (lambda: gfmhil.plot.step(gfmhil.design.network_loop(THREE), "P"), "'P' is no input"),
    ):
        with pytest.raises(UserError, match=words):
            call()
