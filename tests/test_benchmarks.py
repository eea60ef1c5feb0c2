"""The benchmark beside a foreign package, tried out with hardly any work; no figure is judged."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_versus_motulator() -> None:
    pytest.importorskip("motulator", reason="needs the extra 'bench'")
    command = [sys.executable, "-m", "benchmarks.versus_motulator", "--quick", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["gfmhil"]["median"] > found["motulator"]["median"] > 0


@pytest.mark.slow
def test_observers() -> None:
    command = [sys.executable, "-m", "benchmarks.observers", "--clients", "3", "--turns", "1"]
    done = subprocess.run(
        [*command, "--seconds", "0.3", "--json"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    bare, none, many = json.loads(done.stdout)["rows"]
    assert [row["what"] for row in (bare, none, many)] == ["bare pacing", "no client", "clients"]
    assert min(row["ticks"] for row in (bare, none, many)) > 1000
    assert none["answers_per_s"] == 0 < many["answers_per_s"]


@pytest.mark.slow
def test_keep_awake() -> None:
    command = [sys.executable, "-m", "benchmarks.keep_awake", "--links", "shm", "--turns", "1"]
    done = subprocess.run(
        [*command, "--seconds", "0.3", "--json"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [(row["keep_awake"], row["ticks"]) for row in rows] == [
        ("never", 3000),
        ("always", 3000),
    ]
