"""What a tick of many converters in one network costs, in process: ``python -m
benchmarks.network``.

Every converter runs VSG-2 behind its own feeder to one bus with a load, and all that a run in
process does is in the tick: the plant, the controllers, the recording. ``--case case39`` has a
published case instead, with converters at the buses of ``--converters``, and ``--bridges`` the
paper's rig with an averaged bridge, with switched ones, and from ADC counts to compare counts, and
four converters on feeders of which none, one or all are switched. ``--record`` has each number of
converters twice, the second time with all that ``network.record`` can name.
``--cores 1,2`` has two such buses instead, which a line of travelling waves connects: as one
circuit, and its parts on one processor core and on two, in time of the clock, with the ratios.
Rounds of all take turns. Times are those of the processor, so that a busy machine counts little.

With ``--modes`` the linear loop and its modes with their participations are timed instead.

With ``--dpsim``, and DPsim (``pip install dpsim==1.4.0``), a column says what one step of 100 us of
its EMT solver takes for the same feeders, in three phases, with a voltage source in place of each
bridge: no DC link, no sensor, no controller, no recording.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gfmhil
from gfm_hil.engine.inproc import CHUNK, run_inproc
from gfm_hil.engine.setup import make_benches
from gfm_hil.engine.timeline import TimelineInMemory
from gfm_hil.run.runner import make_room
from gfm_hil.scenario import Scenario, load_scenario

TICKS = 100_000  # of all converters of a case in a round


def star(
    n: int, switched: int = 0, bridge: dict[str, Any] | None = None, record: tuple[str, ...] = ()
) -> Scenario:
    """n converters on feeders, the first of which have a switched bridge."""
    own = [{"plant": {"bridge": bridge}} if k < switched else {} for k in range(n)]
    names = [f"c{k}" for k in range(n)]
    return load_scenario(
        {
            "title": f"{n} converters", "duration": 10.0, "law": "vsg-2",
            "link": {"type": "inproc"},
            "network": {
                "record": [*record],
                "converters": {
                    name: {"node": f"at_{name}", **more}
                    for name, more in zip(names, own, strict=True)
                },
                "lines": {f"to_{name}": {"start": f"at_{name}", "end": "bus", "L": 0.1, "R": 0.01}
                          for name in names},
                "loads": {"load": {"node": "bus", "P": 0.45 * n, "Q": 0.1 * n}},
            },
        }
    )  # fmt: skip


def halves(n: int, cores: int | None) -> Scenario:
    """n converters on the feeders of two buses, and a long line between these."""
    content = star(n).model_dump(mode="json", exclude_none=True)
    network = content["network"]
    for k in range(n // 2, n):
        network["lines"][f"to_c{k}"]["end"] = "other"
    load = network["loads"]["load"] | {"P": 0.225 * n, "Q": 0.05 * n}
    network["loads"] = {"load": load, "load2": load | {"node": "other"}}
    network["capacitors"] = {f"at_{bus}": {"node": bus, "Q": 0.02 * n} for bus in ("bus", "other")}
    size = 100 * np.pi * 1.3e-4  # 0.13 ms
    long = {"start": "bus", "end": "other", "L": 2 * size / n, "R": 0.02 / n, "B": size * n / 2}
    network["bergeron_lines"] = {"long": long}
    return load_scenario(content | {"cores": cores})


def rigs() -> dict[str, Scenario]:
    """The rig with MIMO-GFM, nominal resistances and several bridges, and four converters."""
    late = {"kind": "two-level", "dead_time_s": 2e-6}
    drops = {"V_switch": 1.5, "V_diode": 1.2, "R_switch": 0.03, "R_diode": 0.02}
    bridges = {
        "averaged": None,
        "two levels": {"kind": "two-level"},
        "two levels, 2 us": late,
        "two levels, 2 us, drops": late | drops,
        "three levels": {"kind": "t-type"},
        "three levels, 2 us": late | {"kind": "t-type"},
    }
    nominal = {"R_f": 1.0, "R_g": 1.0}
    made = {
        name: load_scenario(
            "rig_pref_step", in_process=True, plant__factors=nominal, plant__bridge=bridge
        )
        for name, bridge in bridges.items()
    }
    made["four averaged"] = star(4)
    made["four, one of two levels"] = star(4, 1, bridges["two levels"])
    made["four, one of two levels, 2 us"] = star(4, 1, late)
    made["four of two levels"] = star(4, 4, bridges["two levels"])
    made["two levels, from counts"] = load_scenario(
        "rig_switched", in_process=True, plant__bridge=bridges["two levels"], counts="rig"
    )
    made["two levels, 2 us, from counts"] = load_scenario("rig_switched", in_process=True)
    return made


def published(case: str, converters: str, share: float, folder: str) -> Scenario:
    """A power-flow case, with droop-3 at some of its buses; its files stay in a folder."""
    made = gfmhil.network_from(case, dict.fromkeys(converters.split(","), ("droop-3", share)))
    return load_scenario(made.save(Path(folder) / "net"), in_process=True)


class Case:
    """A network ready to run the same ticks again and again."""

    def __init__(
        self, name: str, scenario: Scenario, clock: Callable[[], float] = time.thread_time
    ) -> None:
        self.clock = clock
        self.name, n = name, max(1, len(scenario.converters))
        ticks = max(4000, min(CHUNK, TICKS // n))
        scenario = scenario.model_copy(update={"duration": ticks * scenario.T_s})
        began = time.process_time()
        self.benches = benches = make_benches(scenario)
        self.set_up = time.process_time() - began
        self.ticks, self.columns = ticks, len(benches[0].columns.flows)
        self.kept = [*zip(*make_room(benches), strict=True)]
        self.plants = [*{id(bench.plant): bench.plant for bench in benches}.values()]
        self.starts = [plant.copy() for plant in self.plants]
        self.old = [array.copy() for array in self.arrays()]
        each = [plant.wiring for plant in self.plants]
        fed = {name for wiring in each for name, _ in wiring.fed}
        lines = sum(len(wiring.branches) for wiring in each) + n
        self.sizes = n, len(fed), lines, sum(len(wiring.order) for wiring in each)
        net = self.plants[0].net[0]
        self.way = "series" if net["sparse"] or net["n_units"] else "modes"
        self.ns: list[float] = []
        self.ends: list[Any] = []
        self.round()  # compiles
        self.ns.clear()

    def arrays(self) -> list[Any]:
        """What a run changes of its controllers; a run puts it into memory of its own."""
        each = [(bench.controller, bench) for bench in self.benches]
        return [a for c, b in each for a in (c.ctl, c.laws, c.states, c.est, b.y, b.u)]

    def round(self) -> None:
        """Run from the start as ``gfmhil.run`` does in memory; keep what a tick took, in ns."""
        for plant, start in zip(self.plants, self.starts, strict=True):
            plant.restore(start)
        for array, old in zip(self.arrays(), self.old, strict=True):
            array[:] = old
        timelines = [TimelineInMemory(bench) for bench in self.benches]
        began = self.clock()
        done = run_inproc(self.benches, *self.kept, timelines, lambda ticks: True)
        self.ns.append((self.clock() - began) / self.ticks * 1e9)
        if done != self.ticks:
            raise SystemExit(f"{self.name}: the run ended at tick {done}")
        self.ends = [*self.ends[:1], [bench.u.tolist() for bench in self.benches]]
        if self.ends[0] != self.ends[-1]:
            raise SystemExit(f"{self.name}: a round was another run than the first one")
        for timeline in timelines:
            timeline.close()


def dpsim(n: int, steps: int) -> float:
    """What a step of DPsim takes for n sources on feeders, ns."""
    import dpsimpy  # type: ignore[import-not-found]

    emt, node, omega = dpsimpy.emt.ph3, dpsimpy.emt.SimNode, 2 * np.pi * 50
    unit = np.exp(2j / 3 * np.pi * np.array([[0], [-1], [1]]))
    bus = node("bus", dpsimpy.PhaseType.ABC)
    nodes, parts = [bus], list[Any]()

    def add(kind: Any, name: str, ends: list[Any], **values: Any) -> None:
        part = kind(name)
        part.set_parameters(**values)
        part.connect(ends)
        parts.append(part)

    def series(name: str, one: Any, other: Any, L: float, R: float) -> None:
        nodes.append(node(f"{name}.m", dpsimpy.PhaseType.ABC))
        add(emt.Resistor, f"{name}.R", [one, nodes[-1]], R=R * np.eye(3))
        add(emt.Inductor, f"{name}.L", [nodes[-1], other], L=L / omega * np.eye(3))

    for k in range(n):
        e, v, at = (node(f"{name}{k}", dpsimpy.PhaseType.ABC) for name in ("e", "v", "at"))
        nodes += [e, v, at]
        add(emt.VoltageSource, f"E{k}", [node.gnd, e], V_ref=unit, f_src=50.0)
        series(f"filter{k}", e, v, 0.1, 0.01)
        add(emt.Capacitor, f"C{k}", [v, node.gnd], C=0.05 / omega * np.eye(3))
        series(f"line{k}", v, at, 0.2, 0.01)
        series(f"feeder{k}", at, bus, 0.1, 0.01)
    add(emt.Resistor, "load", [bus, node.gnd], R=2.0 / n * np.eye(3))
    one = dpsimpy.Simulation(f"star{n}", dpsimpy.LogLevel.off)
    one.set_system(dpsimpy.SystemTopology(50.0, nodes, parts))
    one.set_domain(dpsimpy.Domain.EMT)
    one.set_time_step(1e-4)
    one.set_final_time(1e4)
    one.start()
    found = []
    for _ in range(10):
        began = time.thread_time()
        for _ in range(steps):
            one.next()
        found.append((time.thread_time() - began) / steps * 1e9)
    return min(found)


def modes(sizes: list[int]) -> None:
    """Print how long the linear loop of converters on feeders and its modes take."""
    print("| converters | states | loop, s | modes, s |\n|--:|--:|--:|--:|")
    for n in sizes:
        began = time.perf_counter()
        loop = gfmhil.design.network_loop(star(n))
        states, made = len(loop.A), time.perf_counter()
        loop.modes()
        print(f"| {n} | {states} | {made - began:.2g} | {time.perf_counter() - made:.2g} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--sizes", default="1,2,4,10,30,100,300", help="converters on feeders")
    parser.add_argument("--case", help="a published case instead, such as case39")
    parser.add_argument("--converters", default="30", help="its buses with converters")
    parser.add_argument("--share", type=float, default=1.0, help="of them, beside machines")
    parser.add_argument("--bridges", action="store_true", help="the rig with several bridges")
    parser.add_argument("--record", action="store_true", help="with and without network.record")
    parser.add_argument("--modes", action="store_true", help="the modes of the linear loop instead")
    parser.add_argument("--cores", help="1,2: two buses and a long line, on so many of them")
    parser.add_argument("--dpsim", action="store_true")
    asked = parser.parse_args()
    if asked.modes:
        return modes([int(n) for n in asked.sizes.split(",")])
    ways: dict[str, int | None] = {"one circuit": None}
    if asked.case:
        with tempfile.TemporaryDirectory() as folder:
            scenario = published(asked.case, asked.converters, asked.share, folder)
            cases = [Case(asked.case, scenario)]
    elif asked.bridges:
        cases = [Case(name, scenario) for name, scenario in rigs().items()]
    elif asked.cores:
        ways |= {f"cores: {c}": int(c) for c in asked.cores.split(",")}
        cases = [
            Case(name, halves(int(n), cores), time.perf_counter)
            for n in asked.sizes.split(",")
            if int(n) > 1  # one at each bus
            for name, cores in ways.items()
        ]
    elif asked.record:
        cases = [
            Case("all recorded" if record else "feeders", star(int(n), record=record))
            for n in asked.sizes.split(",")
            for record in ((), ("all",))
        ]
    else:
        cases = [Case("feeders", star(int(n))) for n in asked.sizes.split(",")]
    for _ in range(asked.rounds):
        for case in cases:
            case.round()
    print(
        "| network | converters | machines | branches | states | solved by | set-up, s"
        " | us a tick, least | median | times real time |" + " DPsim, us |" * asked.dpsim
    )
    print("|---|--:|--:|--:|--:|---|--:|--:|--:|--:|" + "--:|" * asked.dpsim)
    for case in cases:
        least, middle = min(case.ns) / 1e3, float(np.median(case.ns)) / 1e3
        sizes = " | ".join(map(str, case.sizes))
        theirs = ""
        if asked.dpsim and not (asked.case or asked.bridges):
            theirs = f" {dpsim(case.sizes[0], case.ticks // 10) / 1e3:.3g} |"
        print(
            f"| {case.name} | {sizes} | {case.way} | {case.set_up:.2g} | {least:.3g} |"
            f" {middle:.3g} | {100 / least:.3g} |{theirs}"
        )
    for k in range(0, len(cases) if asked.cores else 0, len(ways)):
        for a, b in itertools.combinations(cases[k : k + len(ways)], 2):
            least, middle = min(a.ns) / min(b.ns), np.median(np.divide(a.ns, b.ns))
            print(f"{a.sizes[0]} converters, {a.name} / {b.name}: {least:.3g}, median {middle:.3g}")
    if asked.record:
        for plain, case in zip(cases[::2], cases[1::2], strict=True):
            ratio = np.median(np.divide(case.ns, plain.ns))
            print(f"{case.sizes[0]} converters: {case.columns} columns, {ratio:.3f} of a tick")


if __name__ == "__main__":
    main()
