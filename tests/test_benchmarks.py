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
