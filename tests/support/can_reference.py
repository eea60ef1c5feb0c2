"""Reference of a run over CAN: the same run in one process, with cantools instead of our codec."""

from pathlib import Path

import numpy as np

from gfm_hil.core.roles import ROLES
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links.can.dbc import read_dbc, write_dbc
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.recorder import record_command, record_sample
from gfm_hil.scenario import Scenario
from gfm_plant import plant_advance, plant_sample
from gfm_runtime.signals import VectorName, carried

DBC = read_dbc(write_dbc(True))


def through_cantools(name: VectorName, values: np.ndarray) -> None:
    """Quantise a vector, with the signals of an inner stage or without, as CAN FD does, with
    cantools alone."""
    inner = len(values) > len(carried(name, False))
    title = {"y": "Measurements", "u": "Commands"}[name] + "Inner" * inner
    message = DBC.get_message_by_name(title)
    physical = dict(zip(carried(name, inner), values.tolist(), strict=True))
    payload = message.encode({**physical, "Crc": 0, "Counter": 0}, strict=False)
    decoded = message.decode(payload, decode_choices=False)
    values[:] = [decoded[n] for n in carried(name, inner)]


def quantised_run(scenario: Scenario, folder: Path, every: int = 1) -> dict[str, np.ndarray]:
    """The same run in one process; y and u pass through cantools.

    With an exchange every n ticks, y is held, and so is u, which takes n ticks to arrive.
    """
    b = make_bench(scenario)
    timeline = Timeline(b, folder / "events.jsonl", ROLES)
    columns = ColumnSet(b.signal_set).signals("plant")
    rows = np.full((scenario.ticks, len(columns)), np.nan)
    command, sent, plant = b.u.copy(), [], b.plant.records
    for tick in range(scenario.ticks):
        timeline.carry_out(tick)
        plant_sample(plant, 0, b.y)
        if tick % every == 0:
            read = b.y.copy()
            through_cantools("y", read)
        b.controller.step(read, command)
        if tick % every == 0:
            sent.append(command.copy())
            through_cantools("u", sent[-1])
        applied = sent[max(0, tick // every - (every > 1))]
        record_sample(rows[tick], b.y, plant, 0)
        record_command(rows[tick], applied)
        plant_advance(plant, applied)
    timeline.close()
    return {name: rows[:, j] for j, name in enumerate(columns)}
