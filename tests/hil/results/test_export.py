"""Runs exported to files of other tools, read back by those tools' libraries."""

import csv
import importlib.util
import json
import struct
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from asammdf import MDF
from pyarrow import parquet
from scipy.io import loadmat

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import (
    ACTS,
    CONTROLLER_COUNTS,
    CONTROLLER_INNER,
    INSTRUCTIONS,
    PLANT_COUNTS,
    PLANT_INNER,
    PLANT_OPTIONS,
    TABLE,
    describe,
)
from gfm_hil.recording.run import Run
from gfm_hil.results.export import FORMATS, export_run
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario
from gfm_plant.names import TRIP_REASONS
from gfm_runtime.states import STATES

EVENTS = [
    {"type": "reference", "t": 0.01, "P_ref": 0.8},
    {"type": "law", "tick": 333, "law": "vsg-2"},
]


@pytest.fixture(scope="module")
def table(tmp_path_factory) -> Run:
    """A run between two processes, so that there are times; its operator did something, too."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    content = {"title": "to be exported", "duration": 0.05, "link": {"type": "shm"}}
    run_scenario(check_scenario({**content, "events": EVENTS}, "test"), folder)
    log = folder / "events.jsonl"
    told = {"tick": 77, "t": 0.0077, "event": "grid-phase-jump", "label": "phase jump 1°"}
    first, *rest = log.read_text(encoding="utf-8").splitlines(keepends=True)
    line = json.dumps({**told, "by": "operator"}) + "\n"
    log.write_text("".join([first, line, *rest]), encoding="utf-8")
    run = Run.load(folder)
    signals, timing = ({name: x[:] for name, x in c.items()} for c in (run.columns, run.timing))
    return replace(run, columns=signals, timing=timing)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def test_the_table_has_every_column_of_the_recording(table):
    # of a stage, a transformer, phases in counts, and a processor
    counts = *PLANT_COUNTS, *CONTROLLER_COUNTS
    absent = {*PLANT_INNER, *PLANT_OPTIONS, *CONTROLLER_INNER, *counts, INSTRUCTIONS}
    assert list(table.recorded) == [name for name in TABLE if name not in absent]
    assert len({len(x) for x in table.recorded.values()}) == 1
    assert table.recorded["plant_received"].min() > 0


def test_every_column_is_described():
    for name in [*TABLE]:
        column = describe(name, ["a", "b"])
        assert column.comment
        assert bool(column.unit) != (bool(column.words) or name in ("tick", ACTS, INSTRUCTIONS))
    assert describe("y_p", []).unit == "p.u. (S_n)"
    assert describe("law", ["a", "b"]).words == ((0, "a"), (1, "b"))


def test_csv_is_read_again_as_it_was(table, tmp_path):
    export_run(table.folder, "csv", tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(newline="", encoding="utf-8") as file:
        names, *lines = list(csv.reader(file))
    assert names == list(table.recorded)
    for name, texts in zip(names, zip(*lines, strict=True), strict=True):
        x = table.recorded[name]
        number = float if x.dtype.kind == "f" else int
        assert same(np.array([number(text) for text in texts], x.dtype), x), name


def test_mat_is_read_again_as_it_was(table, tmp_path):
    export_run(table.folder, "mat", tmp_path / "run.mat")
    found = loadmat(tmp_path / "run.mat", simplify_cells=True)
    for column in table.described:
        assert same(found[column.name], table.recorded[column.name]), column
        unit = found["unit"][column.name]  # an empty text comes back as an empty array
        assert (unit if len(unit) else "") == column.unit
        assert found["comment"][column.name] == column.comment
    assert list(found["laws"]) == table.laws
    assert list(found["words"]["state"]["text"]) == list(STATES)
    assert [int(t) for t in found["events"]["tick"]] == [e["tick"] for e in table.events]
    assert "phase jump 1°" in list(found["events"]["text"])
    assert found["scenario"] == table.text("scenario.toml")


@pytest.mark.full
def test_parquet_holds_the_currents_of_a_network(tmp_path):
    """Those that ``network.record`` names, in the folder of the first converter."""
    network = {"network__record": ["feeder", "base"], "duration": 0.02, "events": []}
    run = gfmhil.run_network("three_share_a_load", tmp_path / "run", **network)
    names = [n for n in run.flows if n not in ("t", "tick")]
    export_run(tmp_path / "run" / "A", "parquet", tmp_path / "run.parquet")
    found = parquet.read_table(tmp_path / "run.parquet")
    assert {"feeder.P", "feeder.end.i_im", "base.Q"} <= {*names} <= {*found.column_names}
    for name in names:
        assert same(found[name].to_numpy(), np.asarray(run.flows[name][:])), name
    assert found.schema.field("feeder.P").metadata[b"unit"] == b"p.u. (S_n)"


def test_parquet_is_read_again_as_it_was(table, tmp_path):
    export_run(table.folder, "parquet", tmp_path / "run.parquet")
    found = parquet.read_table(tmp_path / "run.parquet")
    assert found.column_names == list(table.recorded)
    for column in table.described:
        assert same(found[column.name].to_numpy(), table.recorded[column.name]), column
        about = found.schema.field(column.name).metadata
        assert about[b"unit"].decode() == column.unit
        assert about[b"comment"].decode() == column.comment
    assert json.loads(found.schema.metadata[b"laws"]) == table.laws
    assert json.loads(found.schema.metadata[b"events"]) == table.events


@pytest.mark.parametrize("kind", ["cfg", "cff"])
def test_comtrade_is_read_by_its_package_with_scale_and_clock(table, tmp_path, kind):
    comtrade = pytest.importorskip("comtrade")
    export_run(table.folder, kind, tmp_path / f"run.{kind}", "si")
    found = comtrade.load(str(tmp_path / f"run.{kind}"), use_numpy_arrays=True)
    assert (found.rev_year, found.ft) == ("2013", "BINARY" if kind == "cfg" else "ASCII")
    assert found.total_samples == table.ticks and found.frequency == pytest.approx(50.0)
    assert np.allclose(found.time, table.columns["t"], atol=1e-9)
    assert found.trigger_time == pytest.approx(0.01, abs=1e-6)
    units = {c.name: (c.uu, c.ph) for c in found.cfg.analog_channels}
    assert units["v_b_V"] == ("V", "B") and units["i_oa_A"] == ("A", "A")
    assert units["true_p"] == ("p.u.", "")
    rows = dict(zip(found.analog_channel_ids, found.analog, strict=True))
    waves = table.three_phase(si=True)
    assert {*waves} - {"t"} < {*rows}
    for name, x in rows.items():
        want = waves[name] if name in waves else table.columns[name]
        step = np.ptp(want) / (131_000 if kind == "cfg" else 399_000)  # half of one
        near = step + 2e-7 * np.abs(want).max()  # and the package has 32-bit floats
        assert np.abs(x - want).max() <= near, name


def read_by_the_standard(file: Path) -> dict[str, np.ndarray]:
    """Channels of a .cfg and its binary .dat by the text of C37.111-2013 alone: records of two
    32-bit numbers and a 16-bit one for each channel, whose value is a x + b."""
    lines = file.read_text("utf-8").splitlines()
    count = int(lines[1].split(",")[1].removesuffix("A"))
    channels = [line.split(",") for line in lines[2 : 2 + count]]
    data = file.with_suffix(".dat").read_bytes()
    rows = [*struct.iter_unpack(f"<II{count}h", data)]
    assert [row[0] for row in rows] == [*range(1, len(rows) + 1)]
    found = {"t": np.array([row[1] for row in rows]) * 1e-6}
    for k, fields in enumerate(channels):
        a, b = float(fields[5]), float(fields[6])
        found[fields[1]] = np.array([a * row[2 + k] + b for row in rows])
    return found


def test_comtrade_is_read_by_the_formula_of_the_standard(table, tmp_path):
    """A second reader, which shares nothing with the package."""
    export_run(table.folder, "cfg", tmp_path / "run.cfg", "si")
    found = read_by_the_standard(tmp_path / "run.cfg")
    assert np.allclose(found["t"], table.columns["t"], atol=1e-9)
    waves = table.three_phase(si=True)
    assert {*waves} <= {*found}
    for name, x in found.items():
        want = waves[name] if name in waves else table.columns[name]
        assert np.abs(x - want).max() <= np.ptp(want) / 131_000 + 1e-9 * np.abs(want).max(), name


@pytest.fixture
def mdf(table, tmp_path):
    export_run(table.folder, "mf4", tmp_path / "run.mf4")
    with MDF(tmp_path / "run.mf4") as file:
        yield file


def test_mf4_is_read_again_as_it_was(table, mdf):
    for column in table.described:
        if column.name == "t":
            continue
        channel = mdf.get(column.name, raw=True)
        assert same(channel.samples, table.recorded[column.name]), column
        assert same(channel.timestamps, table.recorded["t"])
        assert (channel.unit, channel.comment) == (column.unit, column.comment)
    began = (table.folder / "scenario.toml").stat().st_mtime
    assert abs(mdf.start_time - datetime.fromtimestamp(began, UTC)).total_seconds() < 1e-3


def test_mf4_says_codes_in_words(table, mdf):
    laws = [table.laws[int(k)].encode() for k in table.recorded["law"]]
    assert mdf.get("law").samples.tolist() == laws
    assert {*laws} == {b"mimo-gfm", b"vsg-2"}
    assert {*mdf.get("state").samples.tolist()} == {b"RUNNING"}
    assert {*mdf.get("true_trip").samples.tolist()} == {TRIP_REASONS[0].encode()}


def test_mf4_has_the_events_at_their_ticks_and_what_they_came_from(table, mdf):
    found = [(e.sync_base, e.name) for e in mdf.events]
    assert found == [(e["tick"], e["event"]) for e in table.events]
    assert {e.sync_factor for e in mdf.events} == {table.summary["T_s"]}
    by_operator = [e.comment for e in mdf.events if e.cause == 4]  # user, of MDF 4.11
    assert by_operator == ["phase jump 1°"]
    for k, name in enumerate(["scenario.toml", "summary.json", "events.jsonl"]):
        data, path, _ = mdf._mdf._extract_attachment(index=k)
        assert (data.decode(), path.name) == (table.text(name), name)


def test_a_package_that_is_missing_is_named(table, tmp_path, monkeypatch):
    monkeypatch.setattr("gfm_hil.results.export.find_spec", lambda name: None)
    for name in sorted(name for name, form in FORMATS.items() if form.needs):
        with pytest.raises(UserError, match=rf"--format {name} needs .*gfmhil\[export\]"):
            export_run(table.folder, name, tmp_path / "file")
    export_run(table.folder, "csv", tmp_path / "file")
    assert importlib.util.find_spec("csv") is not None


def test_the_command(table, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["export", str(table.folder), "--format", "csv"]) == 0
    assert main(["export", str(table.folder), "-o", "other.mat"]) == 0
    assert capsys.readouterr().out.split() == ["run.csv", "other.mat"]
    assert sorted(p.name for p in Path().iterdir()) == ["other.mat", "run.csv"]


def test_a_run_that_is_not_over_is_to_be_streamed(tmp_path):
    (tmp_path / "scenario.toml").touch()
    with pytest.raises(UserError, match="the run is not over, see gfmhil stream"):
        Run.load(tmp_path)
