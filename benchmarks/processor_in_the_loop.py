"""Ticks a second of a law on a processor in QEMU, and of the same program on this machine.

A tick is one request and one answer over the pipes, as ``gfmhil run --controller pil:TARGET`` has
them, without plant and link.
"""

from __future__ import annotations

import argparse
import shutil
import time

import numpy as np

from gfm_hil.controllers import PilController
from gfm_hil.engine.setup import make_bench
from gfm_hil.realtime.priority import one_processor
from gfm_hil.scenario import load_scenario
from gfm_runtime.firmware import TARGETS

TICKS, ROUNDS = 5_000, 8


class Bench:
    """A law on a target, with measurements at the operating point."""

    def __init__(self, law: str, target: str) -> None:
        self.model = PilController(target)
        bench = make_bench(load_scenario("pref_step", in_process=True, law=law), self.model.real)
        bench.controller.ctl["y"][0, :5] = bench.start.y
        self.model.begin(bench.controller)
        self.model.start(bench.u)
        self.ref, self.y, self.u = bench.controller.ctl["ref"][0], bench.y, bench.u.copy()

    def round(self) -> np.ndarray:
        """What each tick of a round takes, s."""
        at = np.empty(TICKS + 1)
        at[0] = time.perf_counter()
        for k in range(TICKS):
            self.model.tick(self.ref, self.y, self.u)
            at[k + 1] = time.perf_counter()
        return np.diff(at)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--law", default="vsg-2")
    law = parser.parse_args().law
    there = [name for name, t in TARGETS.items() if all(map(shutil.which, t.machine[:1]))]
    benches = {name: Bench(law, name) for name in there if shutil.which(_compiler(name))}
    spent = {name: [] for name in benches}
    for _ in range(ROUNDS):  # in turns, so that a busy machine is busy for all
        for name, bench in benches.items():
            spent[name].append(bench.round())
    host = np.median(spent["host"])
    print("| target | ticks/s | median [µs] | 99 % [µs] | times this machine | instructions |")
    print("|---" * 6 + "|")
    for name, bench in benches.items():
        tick = np.concatenate(spent[name])
        median, late = np.percentile(tick, [50, 99]) * 1e6
        best = max(TICKS / one.sum() for one in spent[name])
        count = bench.model.count if bench.model.count >= 0 else "–"
        cells = (name, f"{best:,.0f}", f"{median:.1f}", f"{late:.1f}",
                 f"{np.median(tick) / host:.2f}", count)  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |")
        bench.model.close()


def _compiler(name: str) -> str:
    return TARGETS[name].prefix + TARGETS[name].compiler


if __name__ == "__main__":
    with one_processor():  # as the controller's process in lockstep
        main()
