"""Campaigns: determinism over workers, resuming, single runs, and wrong input."""

import json
import multiprocessing
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

import gfmhil
from gfm_hil.cli.main import main
from gfm_hil.core.errors import UserError
from gfm_hil.studies.campaign import worker
from gfm_hil.studies.campaign.execute import Store
from gfm_hil.studies.campaign.figure import fill_map
from gfm_hil.studies.campaign.loading import load_campaign
from gfm_hil.studies.campaign.result import find_axes, summary, verdict
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import run_chunk
from gfm_hil.studies.workers import WorkerLost

from ...support.files import text_of
from ...support.page import unpacked

TEXT = text_of("campaign.toml")


@pytest.fixture
def file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a campaign file: TEXT with some of its words replaced."""

    def write(**changed: str) -> Path:
        text = TEXT
        for old, new in changed.items():
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "small.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a complete campaign, run by two workers, with its file beside it."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "small.toml").write_text(TEXT, encoding="utf-8")
    arguments = ["campaign", str(folder / "small.toml"), "--out", str(folder / "two")]
    assert main([*arguments, "--workers", "2", "--quiet"]) == 0
    return folder


def stored(folder: Path) -> list[str]:
    """The store's lines by run number and law."""
    head, *lines = (folder / "runs.jsonl").read_text(encoding="utf-8").splitlines()
    return [head, *sorted(lines, key=lambda s: (json.loads(s)["run"], json.loads(s)["law"]))]


@pytest.mark.full
def test_one_worker_and_two_give_the_same_bits(whole):
    arguments = ["campaign", str(whole / "small.toml"), "--out", str(whole / "one")]
    assert main([*arguments, "--workers", "1", "--quiet"]) == 0
    lines = stored(whole / "two")
    assert len(lines) == 21
    assert stored(whole / "one") == lines


@pytest.mark.full
def test_a_resumed_campaign_equals_an_uninterrupted_one(whole, tmp_path):
    folder = tmp_path / "resumed"
    shutil.copytree(whole / "two", folder)
    lines = (folder / "runs.jsonl").read_text(encoding="utf-8").splitlines(keepends=True)
    kept = lines[:1] + lines[8:14] + [lines[15][:50]]  # like a power failure within a line
    (folder / "runs.jsonl").write_text("".join(kept), encoding="utf-8")
    arguments = ["campaign", str(whole / "small.toml"), "--out", str(folder)]
    assert main([*arguments, "--resume", "--workers", "1", "--quiet"]) == 0
    assert stored(folder) == stored(whole / "two")


def test_what_is_complete_is_not_run_again(whole):
    before = (whole / "two" / "runs.jsonl").stat()
    arguments = ["campaign", str(whole / "small.toml"), "--out", str(whole / "two")]
    assert main([*arguments, "--resume", "--quiet"]) == 0
    assert (whole / "two" / "runs.jsonl").stat().st_mtime_ns == before.st_mtime_ns


@pytest.mark.parametrize(
    "changed",
    [{"seed = 3": "seed = 4"}, {"high = 1.0": "high = 1.1"}, {"duration = 0.3": "duration = 0.4"}],
)
def test_a_changed_file_is_refused(file, whole, refused, changed):
    arguments = ["campaign", str(file(**changed)), "--out", str(whole / "two")]
    before = (whole / "two" / "runs.jsonl").read_bytes()
    assert "belongs to another campaign" in refused(*arguments, "--resume")
    assert "in use" in refused(*arguments)
    assert (whole / "two" / "runs.jsonl").read_bytes() == before


def test_more_runs_go_on_with_the_same_draws(file, whole):
    more = load_campaign(str(file(**{"runs = 10": "runs = 11"})))
    store = Store(whole / "two", more, resume=True)
    assert store.missing(more) == [(10, "mimo-gfm"), (10, "vsg-2")]


def test_from_python_it_has_the_same_records_in_memory_and_in_a_folder(whole, tmp_path):
    found = gfmhil.campaign(whole / "small.toml")
    assert [json.dumps(r) for r in found.records] == stored(whole / "two")[1:]
    table = found.to_pandas()
    assert list(table["verdict"]) == [verdict(r) for r in found.records]
    assert list(table["plant.factors.L_g"]) == [
        r["drawn"]["plant.factors.L_g"] for r in found.records
    ]
    peaks = [r["events"][0]["p_peak"] if r["events"] else None for r in found.records]
    assert (
        list(table["events.0.p_peak"].astype(object).where(table["events.0.p_peak"].notna(), None))
        == peaks
    )
    assert len(found.plot(y="plant.factors.R_f")) == 2
    assert "CampaignResult 'a small one', 20 runs" in repr(found)
    law = gfmhil.Law.load("vsg-2").with_gains("mine", D_p=0.02)
    content = tomllib.loads(TEXT)
    again = gfmhil.campaign(content, tmp_path / "out", laws=[law, "vsg-2"], runs=2)
    assert [(r["run"], r["law"]) for r in again.records] == [
        (run, name) for run in range(2) for name in ("mine", "vsg-2")
    ]
    assert again.records[1::2] == found.records[1:4:2]
    assert again.records[0] != again.records[1]
    kept = tomllib.loads((tmp_path / "out" / "campaign.toml").read_text(encoding="utf-8"))
    assert kept == content | {"laws": ["mine", "vsg-2"], "runs": 2}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "campaign.toml", "campaign.json", "runs.jsonl", "map.png", "report.html",
    }  # fmt: skip
    with pytest.raises(UserError, match="in use"):
        gfmhil.campaign(content, tmp_path / "out")
    with pytest.raises(UserError, match="workers = 0"):
        gfmhil.campaign(content, workers=0)


def test_folder_of_a_campaign(whole):
    names = {path.name for path in (whole / "two").iterdir()}
    assert names == {"campaign.toml", "campaign.json", "runs.jsonl", "map.png", "report.html"}
    plots = unpacked((whole / "two" / "report.html").read_text("utf-8"))
    assert len(plots) == 2 and all(plot["dots"] for plot in plots)
    assert sorted(plots[0]["curves"]["run"].round()) == [*range(10)]
    assert (whole / "two" / "campaign.toml").read_text(encoding="utf-8") == TEXT
    result = json.loads((whole / "two" / "campaign.json").read_text(encoding="utf-8"))
    assert result["done"] == 20
    assert result["missing"] == 0
    for found in result["laws"].values():
        assert sum(found["counts"].values()) == found["runs"] == 10
        assert len(found["worst"]) == 5


@pytest.mark.full
def test_a_run_alone_is_that_of_the_campaign(whole, tmp_path):
    arguments = ["campaign", str(whole / "small.toml"), "--only", "5"]
    assert main([*arguments, "--out", str(tmp_path / "alone")]) == 0
    records = [json.loads(line) for line in stored(whole / "two")[1:]]
    for law in ("mimo-gfm", "vsg-2"):
        folder = tmp_path / "alone" / law
        assert (folder / "report.html").is_file()
        record = json.loads((folder / "record.json").read_text(encoding="utf-8"))
        assert record in records
        result = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        assert result["status"] == record["status"]


def test_an_error_in_a_run_names_the_run(file, monkeypatch):
    def fail(*_: Any) -> None:
        raise ZeroDivisionError("as if there were a mistake")

    monkeypatch.setattr(worker, "simulate", fail)
    with pytest.raises(WorkerLost, match="run 0, mimo-gfm: ZeroDivisionError: as if") as lost:
        gfmhil.campaign(file())
    assert lost.value.result.summary["missing"] == 20


@pytest.mark.full
def test_ctrl_c_keeps_what_is_there(file, tmp_path):
    path, out = file(**{"runs = 10": "runs = 2000"}), tmp_path / "out"
    command = [sys.executable, "-m", "gfm_hil", "campaign", str(path), "--out", str(out)]
    with subprocess.Popen(
        [*command, "--workers", "1", "--quiet"], stderr=subprocess.PIPE, text=True
    ) as process:
        while not (out / "runs.jsonl").is_file() or len(stored(out)) < 2:
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "runs are missing; go on with: gfmhil campaign" in said
    done = len(stored(out)) - 1
    result = json.loads((out / "campaign.json").read_text(encoding="utf-8"))
    assert result["done"] == done
    assert result["missing"] == 4000 - done


def test_no_steady_state_is_a_result(file):
    # lines too long to transmit P_ref
    path = file(**{"low = 0.5\nhigh = 10.0": "low = 150.0\nhigh = 160.0"})
    campaign = load_campaign(str(path))
    records = run_chunk(campaign, [(0, "mimo-gfm")])
    assert records[0]["status"] == "no-steady-state"
    assert "the line of" in records[0]["reason"]
    result = summary(campaign, records)
    assert result["laws"]["mimo-gfm"]["counts"]["no-steady-state"] == 1
    figure = Figure()
    fill_map(figure, campaign, records, *find_axes(campaign, None, None))
    (said,) = {text.get_text() for text in figure.legends[0].get_texts()}
    assert said == "no steady state"


def test_shipped_campaign_is_valid():
    campaign = load_campaign("rig_mimo_gfm")
    assert campaign.file.laws == ["mimo-gfm", "vsg-2"]
    assert pickle_size(campaign) < 20_000  # it is sent with every task


def pickle_size(campaign: Campaign) -> int:
    return len(multiprocessing.reduction.ForkingPickler.dumps(campaign))


# --- wrong input -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"plant.factors.R_f": "plants.factors.R_f"}, "draw.1: path 'plants.factors.R_f': the"),
        ({"plant.factors.R_f": "plant.factors.R_x"}, "plant.factors.R_x"),
        ({"plant.factors.R_f": "plant.substep"}, "plant.substep = 0.0: unknown key"),
        ({"plant.factors.R_f": "events.1.P_ref"}, "'events' holds 1 entries, counted from 0"),
        ({"plant.factors.R_f": "plant.factors.L_g"}, "draw.1: 'plant.factors.L_g' is given twice"),
        ({"plant.factors.R_f": "seed"}, "'seed' is the campaign's own"),
        ({"plant.factors.R_f": "plant.delay.samples"}, "plant.delay.samples"),
        ({"low = 0.0\nhigh = 1.0": "low = 1.0\nhigh = 1.0"}, "low must be below high"),
        ({"low = 0.5": "low = 0.0"}, "must be > 0 for a logarithm"),
        ({"high = 1.0": "high = nan"}, "draw.1.high"),
        ({"low = 0.0\nhigh = 1.0": "low = -1.0\nhigh = 1.0"}, "draw.1, plant.factors.R_f = -1.0"),
        ({"sigma = 1e-3": "sigma = -1e-3"}, "sigma: must be greater than 0, not -0.001"),
        ({"mean = 1e-3": "mean = 1.0"}, "holds next to nothing of mean = 1"),
        ({"values = [1, 2]": "values = []"}, "draw.3.values"),
        ({"values = [1, 2]": "values = [1, 9999]"}, "draw.3, plant.delay.samples = 9999"),
        ({'type = "uniform"': 'type = "gamma"'}, "'gamma'"),
        ({"runs = 10": "runs = 0"}, "runs: must be greater than 0, not 0"),
        ({"runs = 10": 'runs = "10"'}, "runs: must be a valid integer, not '10'"),
        ({"runs = 10": "runs = 10\nworker = 3"}, "worker = 3: unknown key"),
        ({'title = "a small one"\n': ""}, "title: missing"),
        ({'"vsg-2"]': '"vsg-2000"]'}, "vsg-2000"),
        ({'"vsg-2"]': '"mimo-gfm"]'}, "each once"),
        ({'"rig_pref_step"': '"rig"'}, "scenario rig: no such file"),
        ({"duration = 0.3": "duration = 0.0"}, "duration"),
        ({'"events.0.t" = 0.1': '"events.0.t" = 0.9'}, "events.0: at 0.9 s"),
        ({"[set]": "[set"}, "small.toml: "),
    ],
)
def test_wrong_files(file, tmp_path, refused, changed, words):
    out = tmp_path / "out"
    assert words in refused("campaign", str(file(**changed)), "--out", str(out))
    assert not out.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], "workers = 0: must lie in"),
        (["--resume"], "goes with --out"),
        (["--only", "10", "--out", "x"], "--only 10: must lie in [0, 9]"),
        (["--x", "plant.factors.C_f"], "'plant.factors.C_f' is not drawn"),
        (["--x", "plant.factors.R_f", "--y", "plant.factors.R_f"], "both are"),
    ],
)
def test_wrong_options(file, refused, options, words):
    assert words in refused("campaign", str(file()), *options)


def test_unknown_campaign_names_those_that_ship():
    with pytest.raises(UserError, match=r"no such file; shipped are .*'rig_mimo_gfm'"):
        load_campaign("rig")


@pytest.mark.attack(
    "9.5", "a campaign whose checks take seconds", "not a word on the terminal until they end"
)
def test_checks_that_take_long_show_how_far_they_are(file, capsys, monkeypatch, attack_now):
    path, seen = str(file()), []
    load_campaign(path, tell=lambda done, of: seen.append((done, of)))
    assert seen == [(k, 18) for k in range(18)]  # 4 times 2 ends, 10 runs
    monkeypatch.setattr("gfm_hil.studies.campaign.execute._PATIENCE_S", 0.0)
    wrong = [path, "--only", "10"]
    main(["campaign", *wrong])
    assert capsys.readouterr().err.splitlines()[0] == "checking the runs: 0 of 18 done …"
    main(["campaign", *wrong, "--quiet"])
    assert "checking" not in capsys.readouterr().err
    attack_now(f"after a second a bar or a line says how many of the {len(seen)} checks are done")


@pytest.mark.full
def test_dead_time_and_drops_of_a_switched_bridge_are_drawn():
    """On nominal chokes VSG-2 bears no dead time from 2 us on, MIMO-GFM does."""
    draws = [
        {"path": "plant.bridge.dead_time_s", "type": "uniform", "low": 2e-6, "high": 3e-6},
        {"path": "plant.bridge.V_switch", "also": ["plant.bridge.V_diode"], "type": "uniform",
         "low": 0.5, "high": 1.5},
    ]  # fmt: skip
    content = {
        "title": "bridges", "scenario": "rig_switched", "laws": ["mimo-gfm", "vsg-2"], "runs": 2,
        "set": {"counts": "none"}, "draw": draws,
    }  # fmt: skip
    campaign = load_campaign(content)
    records = run_chunk(campaign, [(run, law) for law in campaign.laws for run in (0, 1)])
    assert [one["status"] == "tripped" for one in records] == [False, False, True, True]
    drops = [one["drawn"]["plant.bridge.V_switch"] for one in records]
    assert len(set(drops)) == 2 and 0.5 < min(drops) < max(drops) < 1.5
