"""The public API: what ten lines in a notebook do, in memory and silent."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib import pyplot

import gfmhil
from gfm_design.model.closed_loop import REFERENCES
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import load_scenario
from gfmhil import plot


def test_a_run_in_memory_has_the_bits_of_one_in_a_folder(tmp_path, capsys):
    run = gfmhil.run("pref_step", law="vsg-2", duration=2.5)
    out, err = capsys.readouterr()
    assert out == "" and all("compiling" in line for line in err.splitlines())
    scenario = load_scenario("pref_step", law="vsg-2", duration=2.5, link__type="inproc",
                             mode="lockstep")  # fmt: skip
    other = run_scenario(scenario, tmp_path / "run")
    assert run.status == "completed" and run.folder is None
    for name in ("p", "true_p", "y_v_dc", "u_E_u", "f_hz", "t", "law"):
        assert np.array_equal(run.signals[name], other.signals[name])
    assert run.metrics == other.metrics
    assert "vsg-2" in repr(run) and "completed" in repr(run)


def test_a_run_is_saved_and_loaded(tmp_path):
    softer = gfmhil.Law.load("vsg-2").with_gains("softer", D_p=0.02)
    run = gfmhil.run("pref_step", softer)
    assert run.laws == run.summary["laws"] == ["softer"] and "softer, completed" in repr(run)
    folder = run.save(tmp_path / "kept")
    repeated = gfmhil.run(folder / "scenario.toml")
    assert np.array_equal(repeated.signals["p"], run.signals["p"])
    again = gfmhil.load_run(folder)
    assert (folder / "report.html").stat().st_size > 10_000
    assert set(again.columns) == set(run.columns)
    for name in run.columns:
        assert np.array_equal(again.signals[name], run.signals[name])
    assert again.metrics == run.metrics and again.laws == run.laws
    law = {"law": str(folder / "law.toml")}  # it was an object, and has no other file
    assert again.scenario == run.scenario.model_copy(update=law)
    with pytest.raises(gfmhil.UserError, match=r"with duration 0.1, law softer: events.0"):
        gfmhil.run("pref_step", softer, duration=0.1)
    with pytest.raises(gfmhil.UserError, match="is not empty"):
        run.save(folder)
    copy = gfmhil.load_run(again.save(tmp_path / "copy"))
    assert copy.summary == run.summary


def test_a_law_is_changed_run_compared_and_saved(tmp_path):
    law = gfmhil.Law.load("vsg-2")
    name = next(iter(law.gains))
    softer = law.with_gains("softer", **{name: law.gains[name] * 0.9})
    assert softer.gains[name] == pytest.approx(0.9 * law.gains[name])
    assert law.gains[name] != softer.gains[name]
    both = gfmhil.compare("pref_step", ["vsg-2", softer], duration=2.5)
    assert list(both) == ["vsg-2", "softer"]
    assert not np.array_equal(both["vsg-2"].signals["p"], both["softer"].signals["p"])
    path = softer.save(tmp_path / "softer.toml")
    from_file = gfmhil.run("pref_step", law=path, duration=2.5)
    assert np.array_equal(from_file.signals["p"], both["softer"].signals["p"])
    assert "<table>" in law._repr_html_() and "\n  E_u      0     0   0        I  I\n" in repr(law)
    with pytest.raises(gfmhil.LawError, match="unknown to vsg-2; known"):
        law.with_gains(no_such=1.0)


@pytest.mark.parametrize("name", ["vsg-2", "mimo-gfm", "droop-5"])
def test_the_transfer_matrix_is_that_of_the_law(name):
    law = gfmhil.Law.load(name)
    matrix, built = law.to_control(), law.built()
    for omega in (0.3, 10.0, 2000.0):
        assert np.allclose(matrix(1j * omega), built(1j * omega), rtol=1e-9, atol=1e-12)


def test_a_package_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(gfmhil.UserError, match=r"needs python-control: pip install 'gfmhil\[desig"):
        gfmhil.Law.load("vsg-2").to_control()


def test_a_closed_loop_of_a_law_draws_what_it_says():
    law = gfmhil.Law.load("mimo-gfm")
    loop = law.closed_loop("rig_pref_step")
    rig = load_scenario("rig_pref_step")
    assert np.array_equal(loop.A, law.closed_loop(rig).A)
    assert np.array_equal(loop.A, law.closed_loop(rig.plant, references=REFERENCES).A)
    weak = {"scr": 3.0, "x_over_r": 6.0}
    changed = law.closed_loop(load_scenario("pref_step", plant__grid=weak))
    assert np.array_equal(law.closed_loop("pref_step", plant__grid=weak).A, changed.A)
    with pytest.raises(gfmhil.UserError, match="duration: no scenario that it could change"):
        law.closed_loop(duration=1.0)
    assert loop.T_s == 1e-4 and law.closed_loop(ideal=True).T_s is None
    for curve in plot.bode(loop, "E_u", "V")[0].lines[:2]:
        hz, gain = curve.get_data()
        expected = loop.loop_gain(curve.get_label(), 2 * np.pi * hz)
        assert np.allclose(gain, 20 * np.log10(np.abs(expected)))
    assert "unstable" not in plot.bode(loop, "E_u")[0].get_title(loc="left")
    grown = gfmhil.Law.load("vsg-2").with_gains(k_34=50.0).closed_loop("pref_step")
    gain, phase = plot.bode(grown, "E_u")
    assert gain.get_title(loc="left").endswith("the closed loop is unstable")
    assert len(phase.lines) == 2  # its curve and -180 degrees: no margin
    assert plot.bode(loop, "E_u", style="paper")[0].get_title(loc="left") == ""
    hz, phase = plot.bode(loop, "E_u")[1].lines[0].get_data()
    gain_margin, phase_margin = (axes.lines[1] for axes in plot.bode(loop, "E_u"))
    f, there = phase_margin.get_data()
    assert abs(loop.loop_gain("E_u", 2 * np.pi * f)) == pytest.approx(1.0, abs=0.02)
    assert phase_margin.get_label() == f"φ_m {there[0] + 180:.3g}° at {f[0]:.3g} Hz"
    f, there = gain_margin.get_data()
    (L,) = loop.loop_gain("E_u", 2 * np.pi * f)
    assert abs(L + 10 ** (there[0] / 20)) < 0.03 * abs(L)
    turned = phase / 360 - np.angle(loop.loop_gain("E_u", 2 * np.pi * hz)) / (2 * np.pi)
    assert np.allclose(turned, np.round(turned)) and np.abs(np.diff(phase)).max() < 180
    loci = plot.nyquist(loop).lines
    assert [line.get_label() for line in loci[:2]] == ["ω_u", "E_u"]  # its source ignores i_u
    for x, y in (line.get_data() for line in loci[:2]):  # the circles of resonances are round
        z = x + 1j * y
        assert np.abs(np.diff(z))[abs(z[1:]) < 1].max() < 0.25
    staged = gfmhil.Law.load("vsg-2").closed_loop("deep_sag")  # a stage commands both axes of E
    for figure in (plot.bode(staged)[0], plot.nyquist(staged)):
        labels = [line.get_label() for line in figure.lines]
        assert labels[1:3] == ["E_u", "E_q"]
    _, y = loop.step_response("grid.V_g", 0.1)
    for axes, column in zip(plot.step(loop, "grid.V_g", 0.1), y.T, strict=True):
        assert np.array_equal(axes.lines[0].get_ydata(), column)
    drawn = np.concatenate([line.get_xdata() for line in plot.pole_map(loop).lines[:2]])
    assert np.array_equal(np.sort(drawn), np.sort(loop.poles().real))
    hz, size = plot.impedance(loop)[0].lines[1].get_data()
    assert np.array_equal(size, np.abs(loop.output_impedance(2 * np.pi * hz)[:, 0, 1]))
    with pytest.raises(gfmhil.UserError, match="'i_u' is no channel of the loop"):
        plot.bode(loop, "i_u")
    with pytest.raises(gfmhil.UserError, match="'P' is no input of the loop"):
        plot.step(loop, "P")


def test_gamma_gains_and_margins_of_a_law():
    law = gfmhil.Law.load("vsg-2")
    gamma = gfmhil.design.gamma(law)
    assert gamma.value == pytest.approx(15.975, rel=5e-5)  # of the printed gains
    assert gamma.to_pandas()["norm"].max() == gamma.value
    softer = law.with_gains("softer", k_34=1.0)
    assert softer.gains["k_35"] == pytest.approx(20.0)  # tied: k_34 / D_q
    assert law.with_gains(k_34=1.0, k_35=3.0).gains["k_35"] == 3.0
    found = gfmhil.design.tune(softer, "mine", evaluations=24, starts=1, seed=4)
    assert found.law.name == "mine" and found.gains == {n: found.law.gains[n] for n in found.gains}
    assert found.gamma.value < gfmhil.design.gamma(softer).value
    assert gfmhil.design.gamma(found.law).value == pytest.approx(found.gamma.value, rel=1e-6)
    with pytest.raises(gfmhil.design.UnstableLoop, match="the mode at 49"):
        gfmhil.design.margins(law, "rig_pref_step")


def test_tables_of_other_libraries():
    run = gfmhil.run("pref_step", duration=2.5)
    frame = run.to_pandas()
    assert frame.index.name == "t" and np.array_equal(frame["true_p"], run.signals["p"])
    data = run.to_xarray()
    assert data["true_p"].attrs["units"] == "p.u. (S_n)"
    assert np.array_equal(data["true_p"], run.signals["p"])


def test_figures():
    run = gfmhil.run("pref_step", duration=2.5)
    assert len(run.plot()) == 6
    titles = [axes.get_title(loc="left") for axes in run.plot("p", "f_hz")]
    assert titles == ["$p$ [p.u.]", "$f$ [Hz]"]
    laws = gfmhil.compare("pref_step", ["mimo-gfm", "vsg-2"], duration=2.5)
    assert len(laws.plot()) == 4
    drawn = laws.plot("omega_u", "v_dc", "i", style="paper", xlim=(0.9, 1.4))
    assert [a.get_ylabel() for a in drawn] == [
        r"$\omega_u$ [p.u.]", "$v_{dc}$ [p.u.]", r"$| i_{dq} |$ [p.u.]"
    ]  # fmt: skip
    assert drawn[0].texts[0].get_text() == "$P_{ref}$ = 1"
    assert drawn[0].figure.get_figwidth() == 3.5 and drawn[-1].get_xlim() == (0.9, 1.4)
    line = drawn[1].lines[1]
    assert (line.get_ydata()[1:] == laws["vsg-2"].signals["v_dc"][9000:14001]).all()


def test_a_figure_follows_what_its_caller_has_set(tmp_path):
    run = gfmhil.run("pref_step", duration=1.2)
    with pyplot.style.context({"lines.linewidth": 3.0, "axes.prop_cycle": "cycler('color', 'rg')"}):
        figure, axes = pyplot.subplots(2)
        assert run.plot("p", "q", ax=axes) == [*axes] and figure.get_suptitle() == ""
    (line, *_) = axes[0].lines
    assert line.get_linewidth() == 3.0 and line.get_color() == "r"
    paths = plot.save(run.plot("p", style="paper", size=(3.0, 2.0)), tmp_path / "p")
    assert [path.name for path in paths] == ["p.pdf", "p.svg", "p.csv"]
    assert b"/MediaBox [ 0 0 216 144 ]" in paths[0].read_bytes()
    head, first, *_ = paths[2].read_text("utf-8").splitlines()
    assert head == "panel,curve,x,y" and first == f"$p$ [p.u.],p,0,{run.signals['p'][0]:.9g}"
    for wrong, said in (
        ({"style": "papr"}, r"style = 'papr': must be one of .*; did you mean 'paper'\?"),
        ({"xlim": (2, 1)}, r"xlim = \(2, 1\): must be two numbers, from < to"),
        ({"size": 3.5}, "size = 3.5: must be two numbers"),
        ({"ax": axes[0]}, "ax: the plot has 6 panels, and ax is 1"),
        ({"ax": 3}, "ax = 3: must be axes of matplotlib"),
        ({"signals": ["pp"]}, "signal = 'pp': was not recorded"),
    ):
        with pytest.raises(gfmhil.UserError, match=said):
            run.plot(**wrong)
    with pytest.raises(gfmhil.UserError, match="format 'doc': must be one of"):
        plot.save(axes, tmp_path / "p", "doc")


@pytest.mark.parametrize(
    ("arguments", "said"), [(("no-such",), "no such file"), (("pref_step", "no-such"), "unknown")]
)
def test_mistakes_are_said_in_words(arguments, said):
    with pytest.raises((gfmhil.UserError, gfmhil.LawError), match=said):
        gfmhil.run(*arguments)
    with pytest.raises(gfmhil.UserError, match="was not recorded"):
        gfmhil.run("pref_step", duration=1.5).signals["no-such"]


def test_importing_it_loads_nothing_heavy():
    program = "import sys, gfmhil; print(sorted({'numba', 'matplotlib', 'zmq'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stderr


def test_the_program_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    text = (Path(__file__).resolve().parents[3] / "README.md").read_text("utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.S)
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    assert "completed" in capsys.readouterr().out
    assert (tmp_path / "runs" / "mine" / "signals.npz").is_file()
