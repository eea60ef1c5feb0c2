"""examples/paper/law_comparison: rows, tables, law files, going on, what it refuses."""

import json
from pathlib import Path

import pytest

from gfm_hil.cli.main import main as gfmhil
from gfm_runtime import law_file
from law_comparison.__main__ import main
from law_comparison.experiments import AT, EXPERIMENTS, TRACE_EVERY, experiment
from law_comparison.row import as_shipped
from law_comparison.tables import markdown, number

pytestmark = pytest.mark.full

Capture = pytest.CaptureFixture[str]
SHORT = ("--evaluations", "320", "--starts", "1", "--quiet")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("comparison") / "out"
    assert main(["--laws", "droop-1,vsg-2", "--out", str(out), *SHORT]) == 0
    return out


def test_rows(folder):
    vsg, droop = json.loads((folder / "law_comparison.json").read_text())["laws"]
    assert (vsg["law"], droop["law"]) == ("vsg-2", "droop-1")  # by gamma, none last
    assert vsg["gamma"] == pytest.approx(15.973, rel=1e-3)
    assert {(c["i"], c["j"]) for c in vsg["channels"]} >= {(1, 1), (4, 1)}
    assert set(vsg["free"]) == {"k_22", "k_34"}
    assert vsg["bench"]["p_ref"]["status"] == "completed"
    assert vsg["bench"]["switchover"]["bump_pu"] < 1e-9
    assert droop["gamma"] is None
    assert "50.7" in droop["reason"]
    assert "bench" not in droop


def test_a_run_that_oscillates_has_no_figures_in_the_table():
    done = {
        "status": "completed",
        "reason": "",
        "overshoot_pct": 1.5,
        "settling_s": 0.25,
        "dp": 0.0,
    }
    still = {**done, "status": "oscillating", "reason": "still oscillating: p by 0.1 p.u."}
    bench = {kind: still if kind == "p_ref" else done for kind in EXPERIMENTS}
    row = {"law": "x", "gamma": 1.0, "bench": bench}
    cells = markdown("law_comparison_bench", [row]).splitlines()[-1].split(" | ")
    assert cells[1:4] == ["oscillates", "–", "1.50"]


def test_the_law_file_loads_and_has_the_gamma_it_names(folder, capsys):
    path = folder / "laws" / "vsg-2-tuned.toml"
    row = json.loads((folder / "law_comparison.json").read_text())["laws"][0]
    assert gfmhil(["design", "gamma", "--law", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["gamma"] == pytest.approx(row["gamma"], rel=1e-9)
    file = law_file(str(path))
    assert file.name == "vsg-2-tuned"
    assert {n: file.parameters[n].value for n in row["gains"]} == row["gains"]


def test_tables(folder):
    assert (
        "| vsg-2 | 3 | 2 | 15.97 | 15.97 | **15.97** |"
        in (folder / "law_comparison_gamma.md").read_text()
    )
    assert "droop-1" not in (folder / "law_comparison_gamma.md").read_text()
    assert "50.7" in (folder / "law_comparison_unstable.md").read_text()


def test_what_is_done_is_kept(folder, capsys):
    def written() -> dict[str, int]:
        return {p.name: p.stat().st_mtime_ns for p in (folder / "rows").iterdir()}

    before = written()
    again = ("--laws", "droop-1,vsg-2", "--out", str(folder))
    assert main([*again, *SHORT]) == 0
    assert written() == before
    assert main([*again, *SHORT, "--seed", "1"]) == 0
    assert all(written()[name] > before[name] for name in before)


def test_an_experiment_measures_the_bench():
    run = experiment("p_ref", "mimo-gfm")
    trace = run["trace"]
    at = round(AT / 1e-4) // TRACE_EVERY
    assert trace[at - 1] == pytest.approx(0.5, abs=1e-3)
    assert trace[-1] == pytest.approx(1.0, abs=1e-2)
    overshoot = 100 * (max(trace) - run["p_final"]) / (run["p_final"] - run["p_before"])
    assert run["overshoot_pct"] == pytest.approx(overshoot, abs=0.5)


def test_an_experiment_that_ends_early():
    run = experiment("late", "mimo-gfm")  # unstable with one sample of delay
    assert run["status"] == "tripped"
    assert 0.0 < run["end_s"] < 4.5
    assert "overshoot_pct" not in run


def test_mimo_gfm_with_other_gains_is_not_searched():
    assert as_shipped("mimo-gfm-deployable")
    assert not as_shipped("mimo-gfm")
    assert not as_shipped("vsg-2")


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (1.42879, "1.43"), (-0.00132, "−0.00132"), (987.98, "988")],
)
def test_numbers(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--laws", "no-such-law"], "not in the catalogue"),
        (["--laws", "vsg-2,,mimo-gfm"], "none empty"),
        (["--laws", "mimo-gfm-scheduled"], "first stage"),
        (["--jobs", "0"], "at least 1"),
        (["--seed", "-1"], "at least 0"),
        (["--evaluations", "0"], "at least 1"),
    ],
)
def test_refuses_in_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
