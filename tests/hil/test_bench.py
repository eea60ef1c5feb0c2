"""``gfmhil bench``: what it leaves, what it refuses. No figure is judged."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.cli import main

KEYS = {
    "link", "peer", "code", "mode", "load", "policy", "payload", "n", "ratio_to_baseline_p50",
    "p50_us", "p90_us", "p99_us", "p99_9_us", "p99_99_us", "max_us",
}  # fmt: skip


def bench(tmp_path: Path, capsys: Any, *options: str) -> dict[str, Any]:
    """A benchmark with hardly any work; what it prints."""
    line = ["bench", *options, "--rounds", "2", "--out", str(tmp_path / "bench"), "--json"]
    assert main(line) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "bench" / "bench.json").read_text("utf-8"))
    return dict(printed)


@pytest.mark.apt
def test_latency_puts_every_link_beside_its_limit(tmp_path: Path, capsys: Any) -> None:
    found = bench(tmp_path, capsys, "latency", "--links", "shm,zmq", "--seconds", "0.02")
    rows = found["results"]
    assert {r["link"] for r in rows} == {"shm", "zmq"}
    assert {(r["mode"], r["load"]) for r in rows} == {
        (m, w) for m in ("lockstep", "realtime") for w in ("idle", "hogs")
    }
    for row in rows:
        assert row.keys() >= KEYS
        assert row["n"] > 0
        assert 0 < row["p50_us"] <= row["p90_us"] <= row["p99_us"] <= row["max_us"]
        assert row["ratio_to_baseline_p50"] > 0
        assert sum(n for _, n in row["histogram"]) == row["n"]
        if row["peer"] == "C":
            assert row["ratio_to_baseline_p50"] == 1
    assert found["seconds"] > 0
    assert found["environment"]["cpus"] == len(os.sched_getaffinity(0))


def test_without_a_compiler_the_links_are_measured_alone(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    found = bench(
        tmp_path, capsys, "latency", "--links", "shm", "--seconds", "0.02", "--load", "idle"
    )
    assert {r["peer"] for r in found["results"]} == {"ours"}
    assert all(r["ratio_to_baseline_p50"] is None and r["n"] for r in found["results"])
    assert any("no C compiler" in remark for remark in found["remarks"])


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["latency", "--links", "carrier-pigeon"], "carrier-pigeon"),
        (["latency", "--links", "shm,"], "--links"),
        (["latency", "--mode", "fast"], "--mode"),
        (["latency", "--load", "heavy"], "--load"),
        (["latency", "--payload", "0"], "--payload"),
        (["latency", "--seconds", "nan"], "--seconds"),
        (["latency", "--rounds", "0"], "--rounds"),
    ],
)
def test_wrong_input_starts_nothing(
    options: list[str], named: str, tmp_path: Path, capsys: Any
) -> None:
    assert main(["bench", *options, "--out", str(tmp_path / "bench")]) == 2
    said = capsys.readouterr()
    assert named in said.err
    assert len(said.err.splitlines()) == 1
    assert not said.out
    assert not (tmp_path / "bench").exists()
