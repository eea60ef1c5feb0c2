"""The verdict on two results: the rank test against SciPy's, and synthetic results."""

import json
import shlex
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from gfm_hil.bench.compare import compare, holm, rank_test
from gfm_hil.bench.result import FORMAT
from gfm_hil.cli import main

VALUES = st.floats(0.1, 100.0)


@given(st.lists(VALUES, min_size=1, max_size=8), st.lists(VALUES, min_size=1, max_size=8))
def test_rank_test_is_scipys_exact_one_without_ties(a, b):
    assume(len({*a, *b}) == len(a) + len(b))
    expected = mannwhitneyu(a, b, method="exact").pvalue
    assert rank_test(a, b) == pytest.approx(expected, abs=1e-12)


def test_rank_test_of_few_with_ties_by_hand():
    """Ranks 1, 2.5 and 2.5, 4: 4 of 6 assignments are as far from the mean, 2 are not."""
    assert rank_test([1, 2], [2, 3]) == pytest.approx(4 / 6)


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]


def result(p50s: dict[str, Any], limit: float = 1.0) -> dict[str, Any]:
    rows = [
        {
            "name": name, "mode": "lockstep", "load": "idle", "policy": "fifo", "payload": 64,
            "peer": "ours", "rounds_p50_us": list(values),
            "rounds_ratio": [value / limit for value in values],
        }
        for name, values in p50s.items()
    ]  # fmt: skip
    return {"format": FORMAT, "results": rows}


def noisy(median: float, rounds: int, seed: int) -> np.ndarray:
    return median * np.random.default_rng(seed).lognormal(0.0, 0.03, rounds)


def test_real_change_is_told_from_noise():
    a = result({"same": noisy(40, 10, 1), "slower": noisy(40, 10, 2)})
    b = result({"same": noisy(40, 10, 3), "slower": noisy(50, 10, 4)})
    same, slower = compare(a, b, by_limit=False)
    assert same["verdict"] == "noise"
    assert slower["verdict"] == "real change"
    assert slower["p"] < 0.01 < same["p"]
    assert slower["ratio"] == pytest.approx(1.25, rel=0.05)


def test_machine_that_became_slower_is_no_change_of_ours():
    a = result({"shm": noisy(0.5, 10, 1)}, limit=0.4)
    b = result({"shm": noisy(2.0, 10, 2)}, limit=1.6)
    assert compare(a, b, by_limit=False)[0]["verdict"] == "real change"
    assert compare(a, b, by_limit=True)[0]["verdict"] == "noise"


def test_too_few_rounds_are_said_to_be_too_few():
    a, b = result({"shm": [1.0, 1.1, 1.2]}), result({"shm": [2.0, 2.1, 2.2]})
    assert compare(a, b, by_limit=False)[0]["verdict"] == "too few rounds to tell"


def test_noise_is_rarely_taken_for_a_change():
    """200 rows of pure noise: Holm's method keeps the risk of any false alarm below 5 %."""
    names = [f"row {k}" for k in range(200)]
    a = result({n: noisy(40, 20, k) for k, n in enumerate(names)})
    b = result({n: noisy(40, 20, 1000 + k) for k, n in enumerate(names)})
    assert {row["verdict"] for row in compare(a, b, by_limit=False)} == {"noise"}


def test_compare_command_reads_files_and_folders(tmp_path, capsys):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "bench.json").write_text(json.dumps(result({"shm": noisy(1, 8, 1)})))
    (tmp_path / "b.json").write_text(json.dumps(result({"shm": noisy(2, 8, 2)})))
    line = ["bench", "compare", str(tmp_path / "a"), str(tmp_path / "b.json"), "--json"]
    assert main(line) == 0
    (row,) = json.loads(capsys.readouterr().out)["results"]
    assert row["verdict"] == "real change"


@pytest.mark.parametrize(
    ("content", "named"),
    [(None, "cannot be read"), ("{", "cannot be read"), ("{}", "not a result"), ("[]", "not a")],
)
def test_what_is_no_result_is_refused(content, named, tmp_path, refused):
    path = tmp_path / "x.json"
    if content is not None:
        path.write_text(content)
    assert named in refused("bench", "compare", str(path), str(path))


def test_results_of_different_benchmarks_cannot_be_compared(tmp_path, refused):
    for name in "ab":
        (tmp_path / name).write_text(json.dumps(result({name: [1.0, 2.0]})))
    line = refused("bench", "compare", str(tmp_path / "a"), str(tmp_path / "b"))
    assert "no row in common" in line


FAKE = """
import json, pathlib, sys
count = pathlib.Path(sys.argv[1])
n = int(count.read_text() or 0) if count.exists() else 0
count.write_text(str(n + 1))
log = count.with_name("order")
log.write_text((log.read_text() if log.exists() else "") + sys.argv[2])
value = {"A": 1.0, "B": 3.0}[sys.argv[2]] + 0.01 * n
row = dict(name="x", mode="m", load="l", policy="p", payload=1, peer="ours",
           rounds_p50_us=[value], rounds_ratio=[])
print(json.dumps({"format": int(sys.argv[3]), "results": [row]}))
"""


def test_interleaved_installations_take_turns(tmp_path, capsys):
    fake = tmp_path / "fake.py"
    fake.write_text(FAKE)

    def command(name: str) -> str:
        return shlex.join([sys.executable, str(fake), str(tmp_path / name), name, str(FORMAT)])

    line = ["bench", "compare", command("A"), command("B"), "--interleave", "6"]
    out = tmp_path / "out"
    assert main([*line, "--json", "--quiet", "--out", str(out)]) == 0
    (row,) = json.loads(capsys.readouterr().out)["results"]
    assert row["verdict"] == "real change"
    assert row["rounds"] == [6, 6]
    assert (tmp_path / "order").read_text() == "ABBA" * 3
    kept = json.loads((out / "B.json").read_text())["results"][0]["rounds_p50_us"]
    assert kept == pytest.approx([3.0, 3.01, 3.02, 3.03, 3.04, 3.05])
