"""Workers of a study: processes that die, and a Dask cluster."""

import json
import os
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

import gfmhil
from gfm_hil.cli.main import main
from gfm_hil.studies.workers import Pool, Watch, WorkerLost, processes, run_tasks

from ...support.files import text_of


def double(dies: dict[int, int], marks: Path, task: int) -> int:
    """Twice a task, whose worker dies the first so many times."""
    before = len(list(marks.glob(f"{task}-*")))
    if before < dies.get(task, 0):
        (marks / f"{task}-{before}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 2 * task


def work(pool: Pool, function: Callable[[int], int]) -> tuple[list[int], list[str]]:
    results, notices = list[int](), list[str]()
    try:
        run_tasks(function, range(8), pool, results.append, Watch(notice=notices.append))
    except WorkerLost as problem:
        notices.append(str(problem))
    return sorted(results), notices


@pytest.mark.full
def test_what_a_dead_worker_had_in_hand_is_worked_on_anew(tmp_path):
    with processes(2) as pool:
        results, notices = work(pool, partial(double, {3: 2, 4: 2, 6: 2}, tmp_path))
        assert results == [2 * task for task in range(8)]
        assert {*notices} == {"a worker process died (killed, or out of memory?); going on …"}
        results, notices = work(pool, partial(double, {5: 9}, tmp_path))
        assert {*results} >= {0, 2, 4, 6, 8} and 10 not in results  # none but the fifth is blamed
        assert notices[-1] == "3 worker processes died of the same work (out of memory?)"


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a cluster of one worker with two threads, in a working directory of its own."""
    distributed = pytest.importorskip("distributed")
    here = Path.cwd()
    os.chdir("/")
    try:
        local = distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, dashboard_address="127.0.0.1:0"
        )
    finally:
        os.chdir(here)
    with local:
        yield local.scheduler_address


@pytest.mark.full
def test_a_cluster_finds_what_this_process_does(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lab, mine = tmp_path / "lab", str(tmp_path / "mine.toml")
    lab.mkdir()
    (lab / "jump.toml").write_text(text_of("jump.toml"))
    gfmhil.Law.load("droop-3").with_gains("mine", D_p=0.02).save(mine)
    asked = "conform", "--law", mine, "--against", "lab", "-o", "out", "--dask", cluster
    assert main([*asked, "--quiet"]) == 2
    assert "'lab/jump.toml' (give paths in full" in capsys.readouterr().err
    found = []
    for option, where in (("--dask", cluster), ("--workers", "1")):
        out = Path(option.strip("-"))
        asked = "--law", mine, "vsg-2", "--against", str(lab), "-o", str(out), option, where
        assert main(["conform", *asked, "--quiet"]) == 0
        content = json.loads((out / "results.json").read_text("utf-8"))
        figures = [path.read_bytes() for path in sorted(out.rglob("figure.png"))]
        found.append((content["laws"], content["hashes"], figures))
    assert found[0] == found[1] and len(found[0][2]) == 2
    campaigns, maps = [], []
    for workers in (cluster, 1):
        content = tomllib.loads(text_of("campaign.toml"))
        campaign = gfmhil.campaign(content, runs=3, laws=[gfmhil.Law.load(mine)], workers=workers)
        campaigns.append(campaign.records)
        over = {"references.P_ref": (-1.9, 0.5)}
        maps.append(gfmhil.clearing_map(mine, over=over, longest=0.2, workers=workers).rows())
    assert campaigns[0] == campaigns[1] and len(campaigns[0]) == 3
    assert maps[0] == maps[1] and maps[0][0]["seconds"] == 0.0


@pytest.mark.full
def test_a_cluster_that_sees_other_files_runs_nothing(cluster, tmp_path, monkeypatch, refused):
    monkeypatch.setattr("gfm_hil.studies.cluster.version", lambda name: "0.0.1")
    said = refused("conform", "--law", "vsg-2", "--against", "miso", "--dask", cluster, "-o", "x")
    assert "has another gfmhil, or other files of what is to be run" in said
    assert not Path("x").exists()


def test_a_cluster_wants_its_package(tmp_path, monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for command in (["campaign", "rig_mimo_gfm"], ["conform", "--law", "vsg-2"]):
        said = refused(*command, "--dask", "tcp://127.0.0.1:9", "-o", str(tmp_path / "out"))
        assert "pip install 'gfmhil[dask]'" in said
    assert not (tmp_path / "out").exists()


def test_an_address_that_is_empty_is_no_word_for_this_machine(refused):
    said = refused("campaign", "rig_mimo_gfm", "--dask", "", "-o", "x")  # as of a variable not set
    assert "cluster '': no scheduler there" in said
