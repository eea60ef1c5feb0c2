"""gfmhil design box and deploy: their output, files and errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gfm_hil.cli.main import main
from gfm_runtime import law_file

Capture = pytest.CaptureFixture[str]
SMALL = ("--box", "R_f=1", "--box", "R_g=1", "--box", "L_g=1,3", "--box", "delay=1", "--box")


def test_box_beside_the_rigs_source(capsys: Capture) -> None:
    options = ("--random", "5", "--json", *SMALL, "dc=regulated", "--bench")
    assert main(["design", "box", "--law", "mimo-gfm-deployable-rig", *options]) == 0
    out = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    rows = {r["what"]: r for r in out["box"]}
    assert rows["sigma, corners [1/s]"]["points"] == 2 * 3  # L_g and P_ref
    assert rows["sigma, corners [1/s]"]["worst"] < -1.0
    assert 0.0 <= rows["sigma, corners [1/s]"]["mode_hz"] < 5000.0
    assert rows["delay margin [s]"]["worst"] is None  # none found
    assert rows["gamma with this source"]["worst"] == pytest.approx(3.58, abs=0.01)
    assert rows["bench overshoot, L_g x 3"]["worst"] < 0.05
    assert out["gamma"] != rows["gamma with this source"]["worst"]  # row 1 is the law's there


def test_box_as_a_table(capsys: Capture) -> None:
    arguments = ["--random", "5", *SMALL, "dc=controlled"]
    assert main(["design", "box", "--law", "mimo-gfm-deployable", *arguments]) == 0
    said = capsys.readouterr().out
    assert "γ = 1.4785" in said
    assert "regulated" not in said


def test_deploy_writes_what_it_was_asked(capsys: Capture, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    assert main([
        "design", "deploy", "--law", "mimo-gfm-deployable-rig", "--out", str(path),
        "--rounds", "1", "--evaluations", "64", "--only", "k_21,k_31",
        *SMALL, "dc=regulated", "--want", "alpha=0.5",
    ]) == 0  # fmt: skip
    text = path.read_text()
    assert "alpha 0.5" in text and "rig_alpha" not in text and "DC source regulated" in text
    tuned, was = law_file(str(path)), law_file("mimo-gfm-deployable-rig")
    moved = {n for n, p in tuned.parameters.items() if p.value != was.parameters[n].value}
    assert moved <= {"k_21", "k_31"}
