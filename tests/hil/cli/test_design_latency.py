"""gfmhil design latency: tables, JSON, and what cannot be."""

import json

import pytest

from gfm_hil.cli.main import main

ROW = {"link": "shm", "load": "idle", "T_s_us": 100.0, "ticks": 1000, "bursts": [[1, 3], [2, 1]]}


@pytest.fixture
def result(tmp_path):
    path = tmp_path / "bench.json"

    def write(**changes):
        loop = {"realtime": [{**ROW, **changes}]}
        path.write_text(json.dumps({"format": 1, "bench": "loop", "loop": loop}))
        return str(path)

    return write


@pytest.mark.full
def test_a_law_that_two_misses_in_a_row_make_unstable(result, capsys):
    """The bench missed 5 of 1000 ticks, two of them in a row."""
    asked = ["design", "latency", "--law", "mimo-gfm", "--from", result()]
    assert main([*asked, "--json"]) == 3
    out = json.loads(capsys.readouterr().out)
    of = out["laws"]["mimo-gfm"]
    assert of["delay_us"] == pytest.approx(51.82, rel=1e-3)  # as design margins
    assert (of["bears"], of["proved"], of["hold"]) == (1, 1, 200)
    for case in of["cases"].values():
        assert case["in_a_row"]["bounds"]["lower"] <= case["in_a_row"]["bounds"]["upper"] < 0.0
    (measured,) = out["measured"]
    assert (measured["ticks"], measured["misses"], measured["in_a_row"]) == (1000, 5, 2)
    used = measured["used"]["mimo-gfm"]
    assert used["verdict"] == "red" and used["in_a_row"] == 2.0 and used["in_a_window"] is None
    assert main(asked) == 3
    assert "shm, idle: 5 of 1000 ticks missed, 2 in a row at most" in capsys.readouterr().out


def test_refuses_what_measured_nothing(result, tmp_path, capsys):
    from_ = ["design", "latency", "--from"]
    for arguments, words in (
        ([str(tmp_path / "none")], "none: no such run folder or result"),
        ([result(T_s_us=200.0)], "T_s = 0.0002 s, and the scenario 0.0001 s"),
    ):
        assert main([*from_, *arguments]) == 2
        assert words in capsys.readouterr().err
    (tmp_path / "bench.json").write_text(json.dumps({"format": 1, "bench": "jitter"}))
    assert main([*from_, str(tmp_path)]) == 2
    assert "has no loop in real time" in capsys.readouterr().err
