"""The benchmarks, tried out with hardly any work, as a reader runs them; no figure is judged."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from gfm_runtime import law_names

ROOT = Path(__file__).resolve().parents[1]


def benchmark(name: str, *options: str) -> dict[str, Any]:
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--json", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.apt
def test_kernel_is_its_twin_in_c_bit_for_bit() -> None:
    """All laws, float64 and float32, on inputs that drive each output into its limits."""
    laws = benchmark("kernel")["laws"]
    assert set(laws) == set(law_names())
    for real in ("float64", "float32"):
        assert {name: law[real]["ulps"] for name, law in laws.items()} == dict.fromkeys(laws, 0)
        assert all(law[real]["numba"]["median"] > 0 for law in laws.values())
        limited = [law[real]["limited"] for law in laws.values()]
        assert all(any(row) for row in zip(*limited, strict=True))


def test_loop_allocates_nothing_in_a_tick() -> None:
    loops = benchmark("loop", "--laws", "mimo-gfm,mimo-gfm-scheduled")["loops"]
    assert set(loops) == {"mimo-gfm", "mimo-gfm-scheduled", "mimo-gfm, rig"}
    for loop in loops.values():
        assert loop["substeps"] == 10
        assert loop["allocations_per_tick"] == 0
        assert loop["times_real_time"]["median"] > 0


def test_loop_that_trips_is_not_timed() -> None:
    command = [sys.executable, "-m", "benchmarks.loop", "--laws", "dvoc", "--turns", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("dvoc: tripped or safe at tick ")


def test_versus_motulator() -> None:
    pytest.importorskip("motulator", reason="needs the extra 'bench'")
    found = benchmark("versus_motulator")
    assert found["gfmhil"]["median"] > found["motulator"]["median"] > 0
