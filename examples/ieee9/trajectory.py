"""What the machines of a network do by themselves, without the converter, after an event."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.setup import make_benches
from gfm_hil.scenario import load_scenario
from gfm_plant import Network, plant_command, plant_step
from gfm_plant.components import SynchronousMachine
from gfm_plant.grid import line_breaker


def start(file: Path, converter: str) -> Network:
    """The plant of a scenario at its operating point, the converter's breaker open."""
    bench = make_benches(load_scenario(file, in_process=True))[0]
    plant_command(bench.plant.records, 0, np.array([*bench.u[:3], 0.0]))
    line_breaker(bench.plant, converter, closed=False, clearing="instant")
    return bench.plant


def trajectory(
    plant: Network, event: Callable[[Network], None], event_s: float, point_s: float, end_s: float
) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Speeds, p.u., and the rotors' directions in the turning frame, every point_s, (K, machines).

    Args:
        plant: as ``start`` returns it.
        event: what happens to the plant at event_s.
        event_s, point_s, end_s: s.
    """
    T_s, machines = float(plant.net[0]["T_s"]), plant.of(SynchronousMachine)
    speeds, directions, each = [], [], round(point_s / T_s)
    for tick in range(1, round(end_s / T_s) + 1):
        if tick == round(event_s / T_s) + 1:
            event(plant)
        plant_step(plant.records)
        if tick % each == 0:
            speeds.append(machines["omega"].copy())
            directions.append(plant.now[0]["unit"][machines["source"]])
    return np.array(speeds), np.array(directions)
