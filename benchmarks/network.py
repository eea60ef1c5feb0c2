"""What a tick of several converters in one network costs, in process: ``python -m
benchmarks.network``.

Every converter runs VSG-2 behind its own feeder to one bus with a load, and all that a run in
process does is in the tick: the plant, the controllers, the recording. Rounds of all sizes take
turns, so that a busy machine is as busy for each of them.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from gfm_hil.engine.inproc import CHUNK, rows, run_ticks, stack
from gfm_hil.engine.setup import make_benches
from gfm_hil.scenario import load_scenario


class Case:
    """A network of n converters, ready to run the same ticks again and again."""

    def __init__(self, n: int) -> None:
        names = [f"c{k}" for k in range(n)]
        content: dict[str, Any] = {
            "title": f"{n} converters", "duration": 10.0, "law": "vsg-2",
            "link": {"type": "inproc"},
            "network": {
                "converters": {name: {"node": f"at_{name}"} for name in names},
                "lines": {f"to_{name}": {"start": f"at_{name}", "end": "bus", "L": 0.1, "R": 0.01}
                          for name in names},
                "loads": {"load": {"node": "bus", "P": 0.45 * n, "Q": 0.1 * n}},
            },
        }  # fmt: skip
        benches = make_benches(load_scenario(content))
        self.rows = rows(n, CHUNK, False)
        self.stack, self.plant = stack(benches), benches[0].plant
        self.kept = self.plant.copy()
        self.arrays = [*self.stack.controllers, self.stack.y, self.stack.u]
        self.start = [array.copy() for array in self.arrays]
        self.states = len(self.plant.wiring.order)
        self.ns: list[float] = []
        self.round()  # compiles
        self.ns.clear()

    def round(self) -> None:
        """Run ticks from the start, and keep what one took, in ns."""
        self.plant.restore(self.kept)
        for array, old in zip(self.arrays, self.start, strict=True):
            array[:] = old
        began = time.perf_counter()
        done = run_ticks(self.plant.records, self.stack, self.rows[0], self.rows[1], 0, CHUNK)
        self.ns.append((time.perf_counter() - began) / CHUNK * 1e9)
        if done != CHUNK:
            raise SystemExit(f"the run ended at tick {done}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=50)
    rounds = parser.parse_args().rounds
    cases = {n: Case(n) for n in (1, 2, 4, 10)}
    for _ in range(rounds):
        for case in cases.values():
            case.round()
    print("| converters | currents and voltages | ns a tick, least | median | times real time |")
    print("|--:|--:|--:|--:|--:|")
    for n, case in cases.items():
        least, middle = min(case.ns), float(np.median(case.ns))
        print(f"| {n} | {case.states} | {least:.0f} | {middle:.0f} | {1e5 / middle:.0f} |")


if __name__ == "__main__":
    main()
