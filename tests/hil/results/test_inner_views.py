"""What people see of a run with an inner stage: figures, report, summary, scope, exports."""

import csv
import json
import re

import numpy as np
import pytest
from asammdf import MDF
from matplotlib.figure import Figure
from pyarrow import parquet
from scipy.io import loadmat

from gfm_hil.ports.scope.channels import make_channels
from gfm_hil.recording.columns import CONTROLLER_INNER, PLANT_INNER
from gfm_hil.recording.run import Run
from gfm_hil.results.export import export_run
from gfm_hil.results.figures import draw_signals
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario

COLUMNS = (*PLANT_INNER, *CONTROLLER_INNER)


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A jump that the virtual stator limits, with figures and a report."""
    content = {
        "title": "limited",
        "duration": 0.1,
        "law": "vsg-2",
        "inner": "virtual-stator",
        "link": {"type": "inproc"},
        "plant": {"grid": {"scr": 3.0, "x_over_r": 10.0}},
        "events": [
            {"t": 0.02, "type": "grid-phase-jump", "degrees": -25.0},
            {"t": 0.09, "type": "law", "law": "droop-1"},
        ],
    }
    folder = tmp_path_factory.mktemp("run") / "run"
    return run_scenario(check_scenario(content, "test"), folder, report=write_report)


def test_the_summary_names_the_stage_of_each_law(limited, run):
    stages = {"vsg-2": "virtual-stator", "droop-1": "virtual-stator"}
    assert limited.summary["inner"] == stages
    assert json.loads((limited.folder / "summary.json").read_text())["inner"] == stages
    assert "inner" not in run(duration=0.01).summary


def test_the_report_names_the_stage(limited):
    report = (limited.folder / "report.html").read_text(encoding="utf-8")
    assert re.search(r"<td[^>]*>inner stage</td>\s*<td[^>]*>virtual-stator</td>", report)


def test_the_figure_shows_the_reference_current_and_shades_its_limit(limited):
    axes = draw_signals(Figure(), limited)[-1]
    (curve,) = [line for line in axes.lines if line.get_label() == "|i*|"]
    assert max(curve.get_ydata()) == pytest.approx(1.2)
    (shade,) = [c for c in axes.collections if c.get_label() == "limited"]
    t, on = limited.signals["t"], limited.signals["limited"] == 1
    spans = [path.get_extents() for path in shade.get_paths()]
    inside = np.any([(s.x0 <= t) & (t < s.x1) for s in spans], axis=0)
    assert on.any() and not on.all() and np.array_equal(inside, on)


def test_the_scope_has_its_channels(limited, run):
    channels = {c.name: c for c in make_channels(1e-4, 50.0)}
    mine = [name for name, c in channels.items() if c.group == "inner"]
    assert mine == ["i_d", "i_q", "v_d", "v_q", "i_od", "i_oq", "u_E_q", *CONTROLLER_INNER, "i_ref"]
    found = {name: channels[name].read(limited.columns, 0, 1000) for name in mine}
    assert np.array_equal(found["E_law"], limited.signals["E_law"].astype(np.float32))
    size = np.hypot(limited.signals["i_ref_d"], limited.signals["i_ref_q"])
    assert np.array_equal(found["i_ref"], size.astype(np.float32))
    other = run(duration=0.01).columns
    assert all(np.isnan(channels[name].read(other, 0, 100)).all() for name in mine)


def test_every_export_has_its_columns(limited, tmp_path):
    files = {
        kind: export_run(limited.folder, kind, tmp_path / f"run.{kind}")[0]
        for kind in ("csv", "mat", "parquet", "mf4")
    }
    with files["csv"].open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    table = parquet.read_table(files["parquet"])
    variables = loadmat(files["mat"])
    with MDF(files["mf4"]) as measured:
        for name in COLUMNS:
            there = limited.signals[name].astype(float)
            assert np.array_equal([float(row[name]) for row in rows], there), name
            assert np.array_equal(variables[name].ravel(), there), name
            assert np.array_equal(table[name].to_numpy(), there), name
            assert np.array_equal(measured.get(name, raw=True).samples, there), name
