"""Misses in real time without and with ``prevent_idle`` of the scenario, in interleaved rounds.

All are runs of the bench over a link, with two processes at 10 kHz.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path

from gfm_hil.bench.rounds import in_turn
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario

WAYS = ("never", "always")


def misses(link: str, way: str, seconds: float, folder: Path) -> int:
    """Ticks without a fresh u in one run."""
    content = {
        "title": f"{link}, prevent_idle = {way}",
        "duration": seconds,
        "mode": "realtime",
        "prevent_idle": way,
        "link": {"type": link, "peer_timeout_s": 5.0},
        "late_policy": {"hold": 10**9},
    }
    run = run_scenario(check_scenario(content, "benchmark"), folder)
    return int(run.summary["misses"])


def measure(links: list[str], seconds: float, rounds: int) -> list[dict[str, object]]:
    """A row for each link and way: misses of each round; every second round runs backwards."""
    jobs = [(link, way) for link in links for way in WAYS]
    found: dict[tuple[str, str], list[int]] = {job: [] for job in jobs}
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        for number, _, (link, way) in in_turn(jobs, rounds):
            print(f"round {number + 1} of {rounds}: {link}, {way}", file=sys.stderr)
            folder = Path(place) / f"{number}-{link}-{way}"
            found[link, way].append(misses(link, way, seconds, folder))
    ticks = round(seconds * 1e4)
    return [
        {
            "link": link,
            "prevent_idle": way,
            "ticks": ticks * rounds,
            "missed_pct": round(100 * sum(counts) / (ticks * rounds), 4),
            "median_of_a_run_pct": round(100 * statistics.median(counts) / ticks, 4),
            "missed": counts,
        }
        for (link, way), counts in found.items()
    ]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--links", default="shm,zmq", help="by commas")
    parser.add_argument("--seconds", type=float, default=5.0, help="of a run")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = measure(options.links.split(","), options.seconds, options.rounds)
    if options.json:
        print(json.dumps(rows, indent=2))
        return
    for row in rows:
        name = f"{row['link']}, {row['prevent_idle']}"
        print(
            f"{name:12} {row['missed_pct']:8} % of {row['ticks']:,} missed, "
            f"median of a run {row['median_of_a_run_pct']} %"
        )


if __name__ == "__main__":
    main()
