"""The state of a run at a tick: kept by both sides in the run folder, and where another run starts.

The plant's records, grid and instruments included, are kept once, in the folder of the first
converter; each controller's in that of its converter. With a controller that is not ours goes what
that gives: a real-code model the arrays of its state, an FMU its FMU state.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers import ControllerError
from gfm_hil.controllers.external import State, put_back
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import open_file, replacing
from gfm_hil.core.roles import Role
from gfm_hil.recording.run import read_scenario
from gfm_hil.scenario import Scenario
from gfm_plant.names import WAYS
from gfm_runtime.assembly import SPARE

if TYPE_CHECKING:
    from gfm_hil.engine.external_ticks import SteppedController
    from gfm_hil.engine.setup import Bench
    from gfm_plant.wiring import Wiring

_LARGEST = 1 << 30  # bytes of a file
_SAME = ("T_s", "inner", "counts", "seed", "references", "plant", "network")
_CHANGED = ("units", "branches", "opened", "closed", "blocked")  # of a wiring, by events
_OWN = ("ctl", "laws", "states", "est")  # records of a controller of ours


def keep_snapshot(bench: Bench, folder: Path, roles: Sequence[Role]) -> None:
    """Write down the state of one side, or of both in process, between two ticks.

    Raises:
        ValueError: a law has other gains than its file, or something in the network is under way,
            so that a run of this scenario could not begin here.
        gfm_hil.controllers.ControllerError: a controller that is not ours refuses.
        OSError: it cannot be written.
    """
    if "plant" in roles and bench.place == 0:
        plant, wired = bench.plant, bench.wired
        settled = replace(plant.wiring, fault=None, opening=())  # without what is over
        over = not any(phases for phases, _ in plant.conducting().values())
        changed = {name: getattr(wired, name) for name in _CHANGED}
        if not over or replace(settled, **changed) != wired:
            raise ValueError("a fault, a breaker that opens or a synchro-check goes on")
        if settled != plant.wiring:
            plant.rewire(settled)
        _write(_file(folder, "plant"), _memory(bench) | _connections(settled))
    if "controller" in roles:
        c = bench.controller
        if c.gains or int(c.ctl["active"][0]) >= len(c.laws) - SPARE:
            raise ValueError("a law has other gains than its file")
        found: State = {name: _bytes(getattr(c, name)) for name in _OWN} | {"told": bench.u}
        if bench.external is not None:
            found |= {f"external_{name}": x for name, x in bench.external.state().items()}
        _write(_file(folder, "controller"), found)


def start_from(scenario: Scenario, benches: Sequence[Bench]) -> None:
    """Put all benches of a scenario where its ``start_from`` kept its state. Raises UserError: it
    kept none, or was a run of another plant or of other laws."""
    folder = Path(scenario.start_from or "")
    _check_same(scenario, folder)
    where = f"start_from = {scenario.start_from!r}"
    for bench in benches:
        own = _folder(folder, bench)
        if bench.place == 0:
            kept = _read(_file(own, "plant"), where)
            plant = bench.plant
            if (wiring := _connected(plant.wiring, kept, where)) != plant.wiring:
                plant.rewire(wiring)
            own_net = plant.net.copy()
            for name, record in _memory(bench).items():
                put_back(where, kept, name, record)
            plant.keep_addresses([int(own_net[name][0]) for name in WAYS])
        kept, c = _read(_file(own, "controller"), where), bench.controller
        if (kept.get("laws", np.zeros(0)).tobytes()) != c.laws.tobytes():
            raise UserError(
                f"{where}: its laws are others than {', '.join(scenario.laws())}, or their files"
                " have changed; name the same laws, with ready_laws if need be"
            )
        for name in _OWN:
            put_back(where, kept, name, _bytes(getattr(c, name)))
        c.ctl["inner_tick"] = 0  # an address of the process that kept it
        put_back(where, kept, "told", bench.u)
        request = int(c.ctl["request"][0])
        c.asked = c.names[request if request >= 0 else int(c.ctl["active"][0])]
    for bench in benches:
        bench.before = int(bench.plant.st["tick"][0])


def restore_external(scenario: Scenario, bench: Bench, external: SteppedController) -> None:
    """Put a controller that is not ours where the snapshot has it. Raises UserError: it cannot be
    read, or is of another controller; the message names the file."""
    file = _file(_folder(Path(scenario.start_from or ""), bench), "controller")
    kept, begin = _read(file, f"start_from = {scenario.start_from!r}"), "external_"
    own = {name.removeprefix(begin): x for name, x in kept.items() if name.startswith(begin)}
    try:
        external.restore(own)
    except (UserError, ControllerError) as problem:
        raise UserError(f"start_from: {file}: {problem}") from None


def _folder(folder: Path, bench: Bench) -> Path:
    return folder / bench.scenario.converter if bench.scenario.converter else folder


def _file(folder: Path, role: Role) -> Path:
    return folder / f"snapshot_{role}.npz"


def _connections(wiring: Wiring) -> State:
    """What events change of a wiring and a snapshot keeps: ``_CHANGED``."""
    lines = [(unit.L_g, unit.R_g) for unit in wiring.units]
    return {
        "opened": np.array(sorted(wiring.opened), str),
        "closed": np.array([wiring.closed]),
        "blocked": np.array(sorted(wiring.blocked), int),
        "lines": np.array([*lines, *((one.L, one.R) for one in wiring.branches)]),
    }


def _connected(wiring: Wiring, kept: State, where: str) -> Wiring:
    """A wiring with what a snapshot kept. Raises UserError: it is of another network."""
    n = len(wiring.units)
    lines = np.zeros((n + len(wiring.branches), 2))
    put_back(where, kept, "lines", lines)
    return replace(
        wiring,
        units=tuple(
            replace(unit, L_g=L, R_g=R)
            for unit, (L, R) in zip(wiring.units, lines[:n].tolist(), strict=True)
        ),
        branches=tuple(
            replace(branch, L=L, R=R)
            for branch, (L, R) in zip(wiring.branches, lines[n:].tolist(), strict=True)
        ),
        closed=bool(kept["closed"][0]),
        opened=frozenset(kept["opened"].tolist()),
        blocked=frozenset(kept["blocked"].tolist()),
    )


def _memory(bench: Bench) -> State:
    """Views of all bytes of the plant's records."""
    return {f"record_{k}": _bytes(record) for k, record in enumerate(bench.plant.memory)}


def _bytes(record: NDArray[Any]) -> NDArray[np.uint8]:
    return record.view(np.uint8)


def _check_same(scenario: Scenario, folder: Path) -> None:
    """Raise UserError unless two runs have what the records of a snapshot depend on."""
    was = read_scenario(folder)
    if scenario.converter is not None and was.parts:
        was = was.each[scenario.converter]
    for key in _SAME:
        mine, theirs = (_plain(one, key) for one in (scenario, was))
        if mine != theirs:
            short = f" = {mine!r}, there {theirs!r}" if len(f"{mine}{theirs}") < 100 else ""
            raise UserError(f"start_from = {str(folder)!r}: {key}{short}: must be as in that run")


def _plain(scenario: Scenario, key: str) -> Any:
    value = getattr(scenario, key)
    found = value.model_dump(mode="json") if hasattr(value, "model_dump") else value
    for member in found["converters"].values() if key == "network" and found else ():
        for free in ("link", "late_policy", "expect"):
            member.pop(free)
    return found


def _write(path: Path, found: State) -> None:
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **found)  # type: ignore[arg-type]


def _read(path: Path, where: str) -> State:
    try:
        with open_file(path, _LARGEST) as file, np.load(file, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except FileNotFoundError:
        raise UserError(f"{where}: {path} is not there: it took no snapshot") from None
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile) as problem:
        raise UserError(f"{where}: {path} cannot be read: {problem}") from None
