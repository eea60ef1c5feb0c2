"""The benchmarks, run with minimal work; the tests judge no figure."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.processes

ROOT = Path(__file__).resolve().parents[1]


def rows_of(name: str, *words: str) -> Any:
    """The output of a benchmark with --json."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *words, "--json"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_versus_motulator():
    pytest.importorskip("motulator", reason="needs the extra 'bench'")
    found = rows_of("versus_motulator", "--quick")
    assert found["gfmhil"]["median"] > found["motulator"]["median"] > 0


@pytest.mark.alone
@pytest.mark.full
def test_observers():
    words = ["--clients", "3", "--rounds", "1", "--seconds", "0.3"]
    bare, none, many = rows_of("observers", *words)["rows"]
    assert [row["what"] for row in (bare, none, many)] == ["bare pacing", "no client", "clients"]
    assert min(row["ticks"] for row in (bare, none, many)) > 1000
    assert none["answers_per_s"] == 0 < many["answers_per_s"]


@pytest.mark.alone
@pytest.mark.full
def test_prevent_idle():
    rows = rows_of("prevent_idle", "--links", "shm", "--rounds", "1", "--seconds", "0.3")
    assert [(row["prevent_idle"], row["ticks"]) for row in rows] == [
        ("never", 3000),
        ("always", 3000),
    ]


def test_network_runs_the_same_ticks_with_and_without_all_currents():
    words = ["--sizes", "2,30", "--rounds", "2", "--record"]
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.network", *words],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ratios = [line.split(":")[0] for line in done.stdout.splitlines() if "of a tick" in line]
    assert ratios == ["2 converters", "30 converters"]
