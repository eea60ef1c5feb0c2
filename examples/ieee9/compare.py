"""Nine buses after the loss of a load, of a machine, and a fault: speeds and angles beside ANDES.

    python examples/ieee9/compare.py      # prints the largest distances

The reference points in points.csv come from ANDES (andes_points.py says how).
"""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.setup import make_benches
from gfm_hil.scenario import load_scenario
from gfm_plant import Network, plant_command, plant_step
from gfm_plant.components import SynchronousMachine
from gfm_plant.grid import fault, line_breaker

HERE = Path(__file__).parent
EVENT_S, POINT_S, END_S = 1.0, 0.05, 6.0
LOST = {"load": "load6", "machine": "M3"}
"""By event, the part whose breaker opens."""
FAULT_BUS, FAULT_R, FAULT_S = "bus7", 0.1, 0.1
"""Where the third event is, its resistance, p.u. of 100 MVA, and how long it lasts."""
COLUMNS = ("omega_1", "omega_2", "omega_3", "delta_21", "delta_31")
"""Speeds, p.u., and angles of the rotors against the first, rad."""


def points(event: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time, s, (K,), and ANDES's ``COLUMNS`` after an event, (K, 5)."""
    text = (HERE / "points.csv").read_text().splitlines()
    rows = [row for row in csv.DictReader(text[1:]) if row["event"] == event]
    return (
        np.array([float(row["t_s"]) for row in rows]),
        np.array([[float(row[name]) for name in COLUMNS] for row in rows]),
    )


def start() -> Network:
    """The plant at its operating point, the converter's breaker open."""
    bench = make_benches(load_scenario(HERE / "network.toml", in_process=True))[0]
    plant_command(bench.plant.records, 0, np.array([*bench.u[:3], 0.0]))
    line_breaker(bench.plant, "probe", closed=False, clearing="instant")
    return bench.plant


def run(event: str) -> NDArray[np.float64]:
    """``COLUMNS`` at the times of ``points``, (K, 5)."""
    plant, rows = start(), []
    T_s, machines = float(plant.net[0]["T_s"]), plant.of(SynchronousMachine)
    each = round(POINT_S / T_s)
    for tick in range(1, round(END_S / T_s) + 1):
        if tick == round(EVENT_S / T_s) + 1:
            if event == "fault":  # p.u. of the converter's 10 MVA
                fault(plant, None, FAULT_R / 10.0, FAULT_S, node=FAULT_BUS)
            else:
                line_breaker(plant, LOST[event], closed=False)
        plant_step(plant.records)
        if tick % each == 0:
            turns = plant.now[0]["unit"][machines["source"]]
            angles = np.angle(turns[1:] / turns[0])
            rows.append([*machines["omega"], *angles])
    return np.array(rows)


def distances(event: str, theirs_of: str = "") -> dict[str, float]:
    """The largest distance to ANDES in each of ``COLUMNS`` but those of a lost machine, from the
    event on; ``theirs_of``: to ANDES's points of another name."""
    t, theirs = points(theirs_of or event)
    apart = np.abs(run(event) - theirs)[t > EVENT_S].max(axis=0)
    found = dict(zip(COLUMNS, map(float, apart), strict=True))
    return {name: far for name, far in found.items() if event != "machine" or "3" not in name}


if __name__ == "__main__":
    for case in ("machine", "load", "load, T = P / omega", "fault"):
        each = distances(case.partition(",")[0], case)
        print(f"{case}: {', '.join(f'{name} {far:.2e}' for name, far in each.items())}")
