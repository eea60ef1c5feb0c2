"""39 buses after the loss of a load, of a machine, and a fault: speeds and angles beside ANDES.

    python examples/ieee39/compare.py      # prints the largest distances

The reference points in points.csv come from ANDES (andes_reference.py says how).
"""

import csv
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_plant import Network
from gfm_plant.grid import fault, line_breaker

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "ieee9"))
from trajectory import start, trajectory  # noqa: E402

EVENT_S, FAULT_S, POINT_S, END_S = 1.0, 0.1, 0.1, 6.0
LOST = {"load": "load20", "machine": "G38"}
"""By event, the part whose breaker opens."""
FAULT_BUS, FAULT_R = "bus16", 0.02
"""Where the third event is, and its resistance, p.u. of 100 MVA."""
BASE = 11.0
"""MVA of the converter, in p.u. of which network.toml is."""
MACHINES = tuple(f"G{bus}" for bus in range(30, 40))
"""The angles are those against the last one."""


def points(event: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time, s, (K,), and after an event ANDES's speeds, p.u., and angles, rad, (K, 20)."""
    text = (HERE / "points.csv").read_text().splitlines()
    rows = [row[1:] for row in csv.reader(text[2:]) if row[0] == event]
    table = np.array(rows, float)
    return table[:, 0], table[:, 1:]


def happen(plant: Network, event: str) -> None:
    """What an event does to the plant."""
    if event == "fault":
        fault(plant, None, FAULT_R * BASE / 100.0, FAULT_S, node=FAULT_BUS)
    else:
        line_breaker(plant, LOST[event], closed=False)


def run(event: str) -> NDArray[np.float64]:
    """Speeds and angles at the times of ``points``, (K, 20)."""
    plant = start(HERE / "network.toml", "C39")
    speeds, turns = trajectory(plant, lambda of: happen(of, event), EVENT_S, POINT_S, END_S)
    return np.hstack([speeds, np.angle(turns / turns[:, -1:])])


def distances(event: str, until: float = END_S) -> tuple[float, float]:
    """The largest distance to ANDES of a speed, p.u., and of an angle, rad, of the machines that
    are not lost, from the event on."""
    t, theirs = points(event)
    kept = [k for k, name in enumerate(MACHINES) if LOST.get(event) != name]
    apart = np.abs(run(event) - theirs)[(t > EVENT_S) & (t <= until)]
    n = len(MACHINES)
    return float(apart[:, kept].max()), float(apart[:, [k + n for k in kept]].max())


if __name__ == "__main__":
    for case in ("load", "machine", "fault"):
        for until in (EVENT_S + 1.0, END_S):
            speed, angle = distances(case, until)
            print(f"{case}, until {until:g} s: speeds {speed:.2e} p.u., angles {angle:.2e} rad")
