"""Nine buses after the loss of a load, of a machine, and a fault: speeds and angles beside ANDES.

    python examples/ieee9/compare.py      # prints the largest distances

The reference points in points.csv come from ANDES (andes_points.py says how).
"""

import csv
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_plant import Network
from gfm_plant.grid import fault, line_breaker

HERE = Path(__file__).parent
sys.path.append(str(HERE))
from trajectory import start, trajectory  # noqa: E402

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


def happen(plant: Network, event: str) -> None:
    """What an event does to the plant."""
    if event == "fault":  # p.u. of the converter's 10 MVA
        fault(plant, None, FAULT_R / 10.0, FAULT_S, node=FAULT_BUS)
    else:
        line_breaker(plant, LOST[event], closed=False)


def run(event: str) -> NDArray[np.float64]:
    """``COLUMNS`` at the times of ``points``, (K, 5)."""
    plant = start(HERE / "network.toml", "probe")
    speeds, turns = trajectory(plant, lambda of: happen(of, event), EVENT_S, POINT_S, END_S)
    return np.hstack([speeds, np.angle(turns[:, 1:] / turns[:, :1])])


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
