"""Inner stages from the command line and from Python: chosen, shown, changed, refused."""

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.scenario import load_scenario, scenario_toml
from gfm_runtime import law_file, load_law

VSG_2 = files("gfm_runtime").joinpath("laws", "vsg-2.toml").read_text(encoding="utf-8")
JUMP = {
    "title": "jump",
    "duration": 0.06,
    "law": "vsg-2",
    "plant": {"grid": {"scr": 3.0, "x_over_r": 10.0}},
    "events": [{"t": 0.01, "type": "grid-phase-jump", "degrees": -25.0}],
}


def file(folder: Path, text: str, name: str = "stage.toml") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


def test_an_option_gives_every_law_the_stage(tmp_path, capsys):
    folder = tmp_path / "run"
    options = ["--inner", "cascaded", "--link", "inproc", "--duration", "1.1", "--no-figures"]
    assert main(["run", "pref_step", *options, "--out", str(folder), "--quiet"]) == 0
    assert "inner stage cascaded" in capsys.readouterr().out
    assert 'inner = "cascaded"' in (folder / "scenario.toml").read_text("utf-8")
    assert gfmhil.load_run(folder).summary["inner"] == {"mimo-gfm": "cascaded"}


def test_none_takes_the_stage_of_a_law_away(tmp_path):
    law = file(tmp_path, f'inner = "virtual-stator"\n{VSG_2}', "law.toml")
    assert load_scenario(JUMP, law=law).signal_set
    assert not load_scenario(JUMP, law=law, inner="none").signal_set
    assert load_scenario(JUMP, law=law, inner="cascaded").signal_set


def test_the_laws_digest_is_that_of_the_content(tmp_path):
    """Two machines may keep the stage elsewhere, but it must be the same."""
    one = file(tmp_path, 'type = "cascaded"\n', "a.toml")
    same = file(tmp_path, 'type = "cascaded"\n', "b.toml")
    other = file(tmp_path, 'type = "cascaded"\nI_max = 1.1\n', "c.toml")
    digests = [load_scenario(JUMP, inner=path).laws_digest() for path in (one, same, other)]
    assert digests[0] == digests[1] != digests[2]
    through_law = []
    for path in (one, same, other):
        law = file(tmp_path, f'inner = "{path}"\n{VSG_2}', "law.toml")
        through_law.append(load_scenario(JUMP, law=law).laws_digest())
    assert through_law[0] == through_law[1] != through_law[2]


def test_a_law_object_with_a_stage_runs_and_is_saved(tmp_path):
    law = gfmhil.Law.load("vsg-2").with_inner(
        "virtual-stator", "limited", I_max=1.1, power={"P_max": 1.0, "P_min": -1.0}
    )
    run = gfmhil.run(JUMP, law)
    assert run.summary["inner"] == {"limited": "virtual-stator"}
    size = np.hypot(run.signals["i_ref_d"], run.signals["i_ref_q"])
    assert size.max() == pytest.approx(1.1, abs=1e-12)
    saved = law.save(tmp_path / "limited.toml")
    assert gfmhil.Law.load(saved).built().inner == law.built().inner
    assert np.array_equal(gfmhil.run(JUMP, saved).signals["p"], run.signals["p"])
    without = law.with_inner("none").built()
    assert without.inner is None and without.phi == gfmhil.Law.load("vsg-2").built().phi
    changed = law.with_gains("softer", D_p=0.02).built()
    assert changed.inner == law.built().inner


def test_python_takes_the_name_as_the_command_does():
    by_name = gfmhil.run(JUMP, inner="virtual-stator")
    by_law = gfmhil.run(JUMP, gfmhil.Law.load("vsg-2").with_inner("virtual-stator"))
    assert np.array_equal(by_name.signals["p"], by_law.signals["p"])
    assert (
        load_law("vsg-2", "virtual-stator").laws[0].inner
        == load_law("droop-1", "virtual-stator").laws[0].inner
    )


def test_a_number_may_be_an_expression_over_the_parameters_of_the_law(tmp_path):
    law = file(tmp_path, f'inner = {{type = "cascaded", I_max = "110 * D_p"}}\n{VSG_2}', "l.toml")
    assert load_law(law).laws[0].inner.I_max == 110 * law_file("vsg-2").parameters["D_p"].value


def test_what_a_law_has_is_shown(tmp_path, capsys):
    law = file(tmp_path, f'inner = {{type = "cascaded", I_max = 1.05}}\n{VSG_2}', "law.toml")
    assert main(["laws", "show", law]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "inner stage: cascaded (m = 1.30257" in out and "I_max = 1.05" in out
    assert "X_thr" not in out and "I_thr" not in out
    assert main(["laws", "show", law, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["inner"]
    assert (found["type"], found["I_max"]) == ("cascaded", 1.05)
    assert main(["laws", "show", "vsg-2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["inner"] is None


@pytest.mark.parametrize(
    ("inner", "said"),
    [
        ('"virtual-statr"',
         "inner stage virtual-statr: unknown; use a .toml file or one of ['none',"),
        ("3", "inner: must be a table, not 3"),
        ("{X_v = 1.0}", "inner.type: missing"),
        ('{type = "stator"}',
         "inner.type = 'stator': must be one of ['virtual-stator', 'cascaded',"),
        ('{type = "virtual-stator", X_v = 0.0}', "inner.X_v: must be > 0, not 0.0"),
        ('{type = "virtual-stator", I_thr = 1.0}', "inner.I_thr = 1.0: unknown key"),
        ('{type = "cascaded", priority = "e"}', "priority: must be 'circular', 'd', 'q' or"),
        ('{type = "cascaded", I_max = "x"}', "inner.I_max: unknown parameter 'x'; known: ['D_p',"),
        ('{type = "cascaded", power = {P_max = 0.1, P_min = 0.2}}',
         "inner.power: P_max = 0.1 must be above P_min = 0.2"),
    ],
)  # fmt: skip
def test_each_mistake_is_one_line_that_names_it(inner, said, tmp_path, refused):
    law = file(tmp_path, f"inner = {inner}\n{VSG_2}", "law.toml")
    line = refused("run", "pref_step", "--law", law, "--out", str(tmp_path / "run"))
    assert line.startswith(f"gfmhil: law file {law}: ") and said in line


def test_a_mistake_of_the_option_names_it(tmp_path, refused):
    run = ["run", "pref_step", "--link", "inproc", "--out", str(tmp_path / "run"), "--inner"]
    line = refused(*run, "cascade")
    assert line.startswith("gfmhil: inner stage cascade: unknown;")
    assert line.endswith("did you mean 'cascaded'?\n")
    stage = file(tmp_path, 'type = "cascaded"\nI_mx = 1.0\n')
    why = "I_mx = 1.0: unknown key; did you mean 'I_max'?"
    assert refused(*run, stage) == f"gfmhil: inner stage {stage}: {why}\n"
    stage = file(tmp_path, 'type = "virtual-stator"\nI_max = 0.3\n')
    assert "inner.I_max: 0.3 p.u.: this operating point needs 0.5" in refused(*run, stage)


def test_the_resolved_scenario_says_the_stage():
    assert 'inner = "cascaded"' in scenario_toml(load_scenario(JUMP, inner="cascaded"))


def test_a_current_loop_too_fast_for_T_s_is_told_with_the_range_of_k_c(tmp_path, capsys):
    """i[k+1] = i[k] - g i[k-1] is stable for g < 1: k_c < L_f / (omega_b T_s) = 0.0554 p.u."""
    scenario = tmp_path / "slow.toml"
    scenario.write_text(
        'title = "slow"\nduration = 0.5\nlaw = "vsg-2"\ninner = "virtual-stator"\nT_s = 1e-3\n'
        'link.type = "inproc"\nplant.delay.samples = 1\n'
        '[[events]]\nt = 0.1\ntype = "reference"\nP_ref = 0.8\n'
    )
    run = ["run", str(scenario), "--quiet", "--no-figures", "--out", str(tmp_path / "run")]
    assert main(run) == 3
    assert "needs k_c below 0.0554 p.u. (it is 0.15)" in capsys.readouterr().out


NETWORK = """\
title = "one follows"
duration = 0.01
link = { type = "inproc" }
[network]
grid = "g"
lines.feeder = { start = "g", end = "bus", L = 0.2, R = 0.02 }
converters.A = { node = "bus", law = "vsg-2" }
converters.B = { node = "bus", law = "grid-following" }
"""


@pytest.mark.parametrize("network", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_grid_following_law_says_that_it_keeps_its_stage(network, tmp_path, capsys):
    given = (
        [file(tmp_path, NETWORK, "net.toml")]
        if network
        else ["pref_step", "--law", "grid-following"]
    )
    options = ["--link", "inproc", "--no-figures", "--quiet", "--out", str(tmp_path / "run")]
    assert main(["run", *given, "--inner", "none", *options]) == 0
    said = "gfmhil: --inner none: grid-following needs its own stage, and keeps it\n"
    assert capsys.readouterr().err.count(said) == 1
