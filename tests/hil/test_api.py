"""The public API: what ten lines in a notebook do, in memory and silent."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.results.runner import run_scenario
from gfm_hil.scenario.model import load_scenario


def test_a_run_in_memory_has_the_bits_of_one_in_a_folder(tmp_path, capsys):
    run = gfmhil.run("pref_step", law="vsg-2", duration=2.5)
    assert capsys.readouterr() == ("", "")
    scenario = load_scenario("pref_step", law="vsg-2", duration=2.5, link__type="inproc",
                             mode="lockstep")  # fmt: skip
    other = run_scenario(scenario, tmp_path / "run", figures=False)
    assert run.status == "completed" and run.folder is None
    for name in ("p", "true_p", "y_v_dc", "u_E_u", "f_hz", "t", "law"):
        assert np.array_equal(run.signals[name], other.signals[name])
    assert run.metrics == other.metrics
    assert "vsg-2" in repr(run) and "completed" in repr(run)


def test_a_run_is_saved_and_loaded(tmp_path):
    run = gfmhil.run("pref_step", duration=2.5)
    folder = run.save(tmp_path / "kept")
    again = gfmhil.load_run(folder)
    assert (folder / "report.html").stat().st_size > 10_000
    assert set(again.columns) == set(run.columns)
    for name in run.columns:
        assert np.array_equal(again.signals[name], run.signals[name])
    assert again.metrics == run.metrics and again.laws == run.laws
    assert again.scenario == run.scenario
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
    assert "<table>" in law._repr_html_() and "Law vsg-2" in repr(law)
    with pytest.raises(gfmhil.LawError, match="unknown to vsg-2; known"):
        law.with_gains(no_such=1.0)


@pytest.mark.parametrize("name", ["vsg-2", "mimo-gfm", "droop-5"])
def test_the_transfer_matrix_is_that_of_the_law(name):
    law = gfmhil.Law.load(name)
    matrix, built = law.to_control(), law.built()
    for omega in (0.3, 10.0, 2000.0):
        assert np.allclose(matrix(1j * omega), built(1j * omega), rtol=1e-9, atol=1e-12)


def test_a_closed_loop_of_a_law():
    loop = gfmhil.Law.load("vsg-2").closed_loop()
    assert max(mode.sigma for mode in loop.modes()) < 0


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
    assert [axes.get_title(loc="left") for axes in run.plot("p", "f_hz")] == ["p", "f_hz"]
    assert len(gfmhil.compare("pref_step", ["mimo-gfm", "vsg-2"], duration=2.5).plot()) == 4


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("no-such",), "no such file"),
        (("pref_step", "no-such"), "unknown"),
    ],
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
    text = (Path(__file__).resolve().parents[2] / "README.md").read_text("utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.S)
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    assert "completed" in capsys.readouterr().out
    assert (tmp_path / "runs" / "mine" / "signals.npz").is_file()
