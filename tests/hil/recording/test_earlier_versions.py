"""Files that earlier versions of gfmhil have written: they are opened, or one line says why not.

``tests/files/earlier`` holds them as the commits of November 2026 left them; that run folder is of
commit 99fa589a, whose recording lacked a column of today's. ``run-of-1.0.0`` is of that
version; its digest is the one it had then.
"""

import json
import shutil
from importlib.metadata import version
from pathlib import Path

import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.scenario.loading import load_scenario

EARLIER = Path(__file__).parents[2] / "files" / "earlier"
RUN = EARLIER / "run-of-21-november"


@pytest.mark.parametrize("name", ["mimo-gfm-scheduled", "psc-dc"])
def test_law_files_of_the_first_day_are_laws(name):
    assert gfmhil.Law.load(EARLIER / f"{name}.toml").name == name


def test_a_scenario_of_the_first_day_is_one():
    assert [event.type for event in load_scenario(EARLIER / "switchover.toml").events]


@pytest.mark.parametrize("then", [None, "0.0.9"])
def test_a_run_that_cannot_be_read_is_refused_with_both_versions(tmp_path, then):
    shutil.copytree(RUN, folder := tmp_path / "run")
    summary = json.loads((folder / "summary.json").read_text())
    if then is not None:
        summary["version"] = then
        (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(UserError) as refused:
        Run.load(folder)
    assert str(refused.value) == (
        f"{folder}: the recording has true_v_dc, but no true_i_dc;"
        f" gfmhil {then or '0.1'} has written it, and this is {version('gfmhil')}"
    )


def test_an_export_refuses_it_in_one_line(refused, tmp_path):
    out = str(tmp_path / "run.csv")
    assert "gfmhil 0.1 has written it" in refused("export", str(RUN), "--out", out)


def test_a_run_of_1_0_0_opens_and_is_exported(tmp_path):
    run = Run.load(EARLIER / "run-of-1.0.0")
    assert run.summary["version"] == "1.0.0" and len(run.columns["tick"]) == 500
    assert run.digest == "0328340864f8ad4cfcd1bcc24cd9f7da3c7f8c6e0083dadfbc0d6d0afb342202"
    out = tmp_path / "run.csv"
    assert main(["export", str(run.folder), "--out", str(out)]) == 0
    assert "p" in out.read_text().splitlines()[0]
