"""The pages' examples work, and their hand-written lists match the code."""

import inspect
import re
import sys
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest

import gfmhil
import gfmhil.design
import gfmhil.envelopes
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.norms.performance import PAPER_WEIGHTS, read_weights
from gfm_hil.run.runner import Run, run_scenario
from gfm_hil.scenario import load_scenario
from gfm_plant import Plant
from gfm_runtime import get_law, load_law

DOCS = Path(__file__).resolve().parents[2] / "docs"
EXAMPLES = DOCS / "examples"
CELL = re.compile(r"^```\{code-cell\} python\n(.*?)^```$", re.M | re.S)
REF = np.array([1.0, 0.5, 1.0, 0.0, 1.0])
RIG = {"delay": {"samples": 1}, "sensors": {"bandwidth_hz": 300.0}}


@pytest.mark.parametrize("name", ["my-law", "my-schedule", "droop-5-integral"])
@pytest.mark.parametrize("plant", [{}, RIG])
def test_example_law_is_stable(name, plant):
    for stage in load_law(str(EXAMPLES / f"{name}.toml")).laws:
        assert ClosedLoop.of(stage, Plant.model_validate(plant)).modes()[0].sigma < -0.5


def test_droop_5_with_row_3_of_vsg_2_is_vsg_2_from_the_measurements():
    droop, vsg = get_law(str(EXAMPLES / "droop-5-integral.toml")), get_law("vsg-2")
    for s in (0.1j, 10j, 1e3j):
        for i in range(3):
            for j in range(5):
                feedback = droop.element("phi", (i, j))(s) + droop.element("psi", (i, j))(s)
                assert feedback == pytest.approx(vsg.element("phi", (i, j))(s), rel=1e-12)


@pytest.fixture(scope="module")
def example_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    scenario = load_scenario(str(EXAMPLES / "my-scenario.toml"), link__type="inproc")
    return run_scenario(scenario, tmp_path_factory.mktemp("docs") / "run")


def test_example_scenario_completes(example_run):
    assert example_run.summary["status"] == "completed"


def programs(page: str) -> list[str]:
    """The blocks of Python on a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text("utf-8"), re.S)


@pytest.mark.full
def test_a_law_of_python_control_goes_to_c_in_ten_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, ten, matrix = programs("laws.md")
    names = {"gfmhil": gfmhil}
    exec(ten, names)
    assert names["run"].status == "completed"
    assert max(names["poles"].real) < 0
    assert names["tuned"].gains != names["law"].gains
    assert names["verdicts"].passed and len(names["verdicts"].matrix) == 4
    assert "gfm_tuned_step" in (tmp_path / "firmware" / "gfm_tuned.c").read_text()
    exec(matrix, names)


def test_modes_of_the_example_law_are_looked_at_as_the_page_says(capsys, monkeypatch):
    program = programs("laws.md")[0]
    monkeypatch.chdir(DOCS.parent)
    exec(program, {})
    rates = [float(line.split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert len(rates) == 4
    assert max(rates) < 0


def test_no_property_of_the_api_begins_with_a_colon_sentence():
    """Sphinx reads what stands before a colon of a property's first line as its type."""
    rooms = (gfmhil, gfmhil.design, gfmhil.envelopes)
    names = {getattr(room, name) for room in rooms for name in room.__all__ if name != "design"}
    classes = {x for x in names if isinstance(x, type)}
    said = {
        f"{cls.__name__}.{name}": inspect.getdoc(member) or ""
        for cls in classes
        for name, member in inspect.getmembers(cls)
        if isinstance(member, (property, cached_property)) and not name.startswith("_")
    }
    assert len(said) > 20
    first = {name: re.sub(r"`.*?`", "", doc.partition("\n")[0]) for name, doc in said.items()}
    assert [name for name, line in first.items() if ":" in line] == []


def test_files_that_cells_name_are_there():
    """Cells run in the folder of the pages."""
    cells = [c for page in DOCS.glob("*.md") for c in CELL.findall(page.read_text("utf-8"))]
    names = [name for cell in cells for name in re.findall(r'"([^"\s]+/[^"\s]+\.toml)"', cell)]
    assert len(names) >= 2
    assert [name for name in names if not (DOCS / name).is_file()] == []


def test_readme_names_pages_that_there_are():
    text = (DOCS.parent / "README.md").read_text("utf-8")
    named = re.findall(r"\]\(([^)#:]+)", text)
    assert len(named) > 10
    assert [name for name in named if not (DOCS.parent / name).is_file()] == []


def documented(head: str) -> list[set[str]]:
    """The names in the first columns of the tables below a heading."""
    text = (DOCS / "scenarios.md").read_text(encoding="utf-8").split(f"## {head}\n", 1)[1]
    tables = re.findall(r"(?:^\|.*\n)+", text.split("\n## ", 1)[0], flags=re.MULTILINE)
    return [
        {name for line in t.splitlines()[2:] for name in re.findall(r"`(.+?)`", line.split("|")[1])}
        for t in tables
    ]


def test_summary_keys_are_documented(example_run):
    whole, event = documented("summary.json")
    # of a processor in the loop, of a run that did not last, and of one in real time
    assert whole == {*example_run.summary, "instructions", "unstable_mode", "latency"}
    there = {key for e in example_run.summary["events"] for key in e}
    assert event == there | {"cut_short"}  # which only a run that trips has


def test_run_folder_is_documented(example_run):
    (files,) = documented("The run folder")[:1]
    assert {path.name for path in example_run.folder.iterdir()} <= {f for f in files if "." in f}


def numbers(row: str) -> list[float]:
    return [float(n) for n in re.findall(r"-?\d+(?:\.\d+)?", row.replace("−", "-"))]


def test_committed_eigenvalues_are_current(monkeypatch):
    # the tables with runs of the bench take a minute: `python docs/make_figures.py`
    monkeypatch.setattr(sys, "path", [str(DOCS), *sys.path])
    from _figures import eigenvalues

    written: dict[str, list[str]] = {}

    def keep(name: str, head: list[str], rows: list[list[str]]) -> None:
        written[name] = [f"| {' | '.join(row)} |" for row in rows]

    monkeypatch.setattr(eigenvalues, "write_table", keep)
    eigenvalues.ideal_table()
    eigenvalues.bandwidth_table()
    eigenvalues.q_droop_table()
    eigenvalues.couplings_table()
    for name, rows in written.items():
        committed = (DOCS / "tables" / f"{name}.md").read_text(encoding="utf-8").splitlines()[2:]
        assert len(committed) == len(rows)
        for old, new in zip(committed, rows, strict=True):  # the last digit may differ
            np.testing.assert_allclose(numbers(old), numbers(new), rtol=1e-3, atol=0.02)


def test_committed_modes_over_the_delay_are_current(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(DOCS), *sys.path])
    from _figures import delay_loci

    written: list[list[str]] = []
    monkeypatch.setattr(delay_loci, "write_table", lambda name, head, rows: written.extend(rows))
    delay_loci.table()
    committed = (DOCS / "tables" / "delay_loci.md").read_text(encoding="utf-8").splitlines()[2:]
    for old, new in zip(committed, written, strict=True):
        np.testing.assert_allclose(numbers(old), numbers(" ".join(new)), rtol=1e-3, atol=2.5)


@pytest.mark.full
@pytest.mark.timeout(600)
def test_worked_example_of_a_tuning_says_what_the_page_shows(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(DOCS), *sys.path])
    from _figures import tuning

    said = tuning.run_example(tmp_path)
    for name, what in (
        ("tune_tune", r"γ = ([\d.]+)"),
        ("tune_file", r"gamma = ([\d.]+)"),
        ("tune_run", r"p final \[p\.u\.\] +([\d.]+)"),
        ("tune_margins", r"delay margin on top of 0 µs: ([\d.]+)"),
    ):
        committed = (DOCS / "tables" / f"{name}.md").read_text(encoding="utf-8")
        assert "[exit code" not in said[name]
        # gamma's minimum is flat: with other rounding the gains differ in the third digit
        shown = [float(n) for n in re.findall(what, committed)]
        assert shown
        assert [float(n) for n in re.findall(what, said[name])] == pytest.approx(shown, rel=0.02)


def test_weights_to_begin_with_are_the_papers():
    found = {(w.i, w.j): w for w in read_weights(EXAMPLES / "my-weights.toml")}
    s = 1j * np.logspace(-4, 6, 50)
    for weight in PAPER_WEIGHTS:
        np.testing.assert_allclose(found.pop((weight.i, weight.j))(s), weight(s), rtol=1e-9)
    assert not found
