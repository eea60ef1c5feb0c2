"""examples/paper/deployable: what its commands print and write."""

import json

import pytest

from deployable.__main__ import main
from gfm_runtime import law_file

Capture = pytest.CaptureFixture[str]
SMALL = ("--box", "R_f=1", "--box", "R_g=1", "--box", "L_g=1,3", "--box", "delay=1", "--box")


def test_box_beside_the_rigs_source(capsys):
    options = ("--random", "5", "--json", *SMALL, "dc=regulated", "--bench")
    assert main(["check", "--law", "mimo-gfm-deployable-rig", *options]) == 0
    out = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    rows = {r["what"]: r for r in out["box"]}
    assert rows["sigma, corners [1/s]"]["points"] == 2 * 3  # L_g and P_ref
    assert rows["sigma, corners [1/s]"]["worst"] < -1.0
    assert 0.0 <= rows["sigma, corners [1/s]"]["mode_hz"] < 5000.0
    assert rows["delay margin [s]"]["worst"] is None  # none found
    assert rows["gamma with this source"]["worst"] == pytest.approx(3.58, abs=0.01)
    assert rows["bench overshoot, L_g x 3"]["worst"] < 0.05
    assert out["gamma"] != rows["gamma with this source"]["worst"]  # row 1 is the law's there


def test_box_as_a_table(capsys):
    arguments = ["--random", "5", *SMALL, "dc=controlled"]
    assert main(["check", "--law", "mimo-gfm-deployable", *arguments]) == 0
    said = capsys.readouterr().out
    assert "γ = 1.4785" in said
    assert "regulated" not in said


def test_deploy_writes_what_it_was_asked(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    assert main([
        "tune", "--law", "mimo-gfm-deployable-rig", "--out", str(path),
        "--rounds", "1", "--evaluations", "64", "--only", "k_21,k_31",
        *SMALL, "dc=regulated", "--want", "alpha=0.5",
    ]) == 0  # fmt: skip
    text = path.read_text()
    assert "alpha 0.5" in text and "rig_alpha" not in text and "DC source regulated" in text
    tuned, was = law_file(str(path)), law_file("mimo-gfm-deployable-rig")
    moved = {n for n, p in tuned.parameters.items() if p.value != was.parameters[n].value}
    assert moved <= {"k_21", "k_31"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        *(
            ([*command, "--law", "mimo-gfm", *(f"--box={entry}" for entry in entries)], words)
            for command in (["check"], ["tune", "--out", "never.toml"])
            for entries, words in (
                (["R_x=1"], "R_x"),
                (["R_f="], "NAME=v,v"),
                (["R_f=0.1,-1"], "from 0.001 to 100"),
                (["L_g=far"], "from 0.01 to 100"),
                (["delay=9"], "from 0 to 5.99"),
                (["dc=ideal"], "controlled"),
                (["dc=regulated", "dc=controlled"], "twice"),
            )
        ),
        *(
            (["tune", "--law", "mimo-gfm", "--out", "x.toml", *more], words)
            for more, words in (
                (["--want", "speed=1"], "speed"),
                (["--want", "alpha"], "--want"),
                (["--want", "alpha=-1"], "positive"),
                (["--want", "rig_alpha=1", "--box", "dc=regulated"], "both DC sources"),
                (["--only", "k_99"], "k_99"),
            )
        ),
    ],
)
def test_refuses_in_one_line(arguments, words, capsys):
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
