"""What was measured of latency: by a run in real time, or by the benchmark of the loop."""

from dataclasses import dataclass
from pathlib import Path

from gfm_design.misses.statistics import Misses
from gfm_hil.bench.result import read_result
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.studies.latency import misses_of


@dataclass(frozen=True)
class Measured:
    """What one loop in real time missed.

    Attributes:
        name: what measured it: a run folder, or link and load of a benchmark.
        T_s: s.
        misses: its ticks without a new u.
    """

    name: str
    T_s: float
    misses: Misses


def measured_misses(path: str | Path) -> list[Measured]:
    """What a run folder, or each loop in real time of a result of ``gfmhil bench loop``, missed.

    Raises:
        UserError: it is neither, or nothing in it ran in real time.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"{path}: no such run folder or result")
    if (path / "summary.json").exists():
        run = Run.load(path)
        return [Measured(path.name or str(path), run.scenario.T_s, misses_of(run))]
    rows = read_result(path).get("loop", {}).get("realtime", [])
    if not rows:
        raise UserError(f"{path}: has no loop in real time; gfmhil bench loop measures it")
    return [
        Measured(
            f"{row['link']}, {row['load']}",
            1e-6 * row["T_s_us"],
            Misses(int(row["ticks"]), tuple((int(n), int(many)) for n, many in row["bursts"])),
        )
        for row in rows
    ]
