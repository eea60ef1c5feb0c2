"""The folder of a run: whether it may be used, and how its files are made.

``summary.json`` is written last. While it is missing, the folder still holds all that the other
files are made of, and ``recover`` can make them again. ``merge_roles`` makes one folder from
the two of a controller and a plant that were started separately.
"""

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FiniteFloat

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import Unfinished, UserError, naming
from gfm_hil.core.files import check_empty, read_json, sync_folder, unfinished, write_text
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.setup import make_bench
from gfm_hil.recording.columns import PLAIN_COLUMNS, Columns, ColumnSet
from gfm_hil.recording.log import Outcome, read_events, read_log, worst
from gfm_hil.recording.merge import merge
from gfm_hil.recording.npz import ColumnGroup, write_npz
from gfm_hil.recording.parts import check_parts, place_of, remove_parts
from gfm_hil.recording.run import Run, began, converters_of, read_recording, read_scenario
from gfm_hil.run.summary import origin, stages, summarise
from gfm_hil.scenario import Scenario, load_scenario, write_scenario

#: draws the figures of a ``Run`` and writes its report into its folder, as ``results.report`` does;
#: is called with a ``NetworkRun`` too, for what its runs share
Report = Callable[[Any], object]

_LOCK = ".lock"  # removed when the folder is complete
_ENDED = "ended.json"  # how the run ended, while its folder is not complete


def check_free(
    folder: Path, ticks: int, columns: ColumnSet = PLAIN_COLUMNS, converters: int = 1
) -> None:
    """See that a run of some converters may be recorded in ``folder``, which need not exist.

    Raises UserError: it holds something, cannot be made or written, or the disk is too full; a
    memory-mapped file on a full disk would end the process without a word.
    """
    there = folder
    while not there.exists():
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise UserError(f"{folder}: {there} is not a folder that can be written to; choose --out")
    if there == folder and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty; choose another --out")
    # the parts stay until the run's files are there, which compression may not make smaller
    needed = 2 * ticks * (columns.bytes_per_tick(converters) + 16 * converters)  # with tick and t
    free = shutil.disk_usage(there).free
    if needed > free:
        raise UserError(
            f"{folder}: {ticks * converters} ticks need {needed / 1e9:.3g} GB, free are "
            f"{free / 1e9:.3g} GB; shorten duration or choose another --out"
        )


def finish(
    scenario: Scenario,
    folder: Path,
    laws: list[str],
    wall_s: float,
    report: Report | None = None,
    outside: Outcome | None = None,
) -> Run:
    """Turn the parts that the sides left in ``folder`` into the files of a run. Raises Unfinished:
    a file cannot be written; ``recover`` completes the folder. Raises KeyboardInterrupt: SIGINT,
    SIGTERM or SIGHUP came; the message says the same.

    Args:
        scenario, folder: of the run.
        laws: labels of the controller's laws, which the recording refers to by index.
        wall_s: how long it took.
        report: draws the figures and writes report.html; None for a folder without them.
        outside: how it ended as seen from outside the sides, which may not have lived to say.
    """
    ended = _EndRecord(wall_s=wall_s, figures=report is not None, outside=outside)
    with _kept(folder):
        write_text(folder / _ENDED, ended.model_dump_json())
        return _complete(scenario, folder, laws, wall_s, report, outside)


def recover(folder: Path, report: Report | None = None) -> Run:
    """Complete the folder of a run that was cut off; leave one that is complete as it is.

    ``report`` as for ``finish``; it is not called for a run that was to have none.

    What lies in the folder may be anything: no link in it is followed, and nothing is removed or
    written elsewhere than there and in the run's own folder in memory. Raises UserError: it is no
    run folder, the run is still going on, its recording is gone, or a file is none of a run. Raises
    Unfinished: a file cannot be written.
    """
    if not (folder / "scenario.toml").is_file():
        raise UserError(f"{folder}: is not a run folder (scenario.toml is missing)")
    with _alone(folder), _kept(folder):
        if os.path.lexists(folder / "summary.json"):
            run = Run.load(folder)
            _clear(folder)
            return run
        parts = folder / "parts"
        if place_of(folder) is None and not (folder / "signals.npz").is_file():
            lay = f" (it lay in {parts.readlink()})" if parts.is_symlink() else ""
            raise UserError(f"{folder}: nothing is left of what was recorded{lay}")
        read_scenario(folder)  # says what is wrong with it as a file
        scenario = load_scenario(str(folder / "scenario.toml"))
        laws = make_bench(scenario).controller.labels
        try:
            ended = _EndRecord(**read_json(folder / _ENDED, _EndRecord))
        except FileNotFoundError:  # it was cut off while it ran
            ended = _EndRecord(wall_s=_duration(folder))
        report = report if ended.figures else None
        return _complete(scenario, folder, laws, ended.wall_s, report, ended.outside)


class _EndRecord(BaseModel):
    """What ``ended.json`` says."""

    wall_s: FiniteFloat
    figures: bool = True
    outside: Outcome | None = None


class _LinkEnd(BaseModel):
    """What ``link_<role>.json`` says, see ``_link_ends``."""

    model_config = ConfigDict(strict=True)

    role: Role
    faults: dict[str, int]
    e2e: str
    injected: dict[str, int] = {}


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """While this process runs the run of ``folder``, ``recover`` refuses it. Raises UserError:
    another process is just recovering it."""
    with _locked(folder, fcntl.LOCK_SH, scratch.PATIENCE_S):
        yield


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep others from a folder, and from its parts where those lie elsewhere."""
    locked = _locked(folder, fcntl.LOCK_EX, 0.0, "the run is still going on")
    with locked, contextlib.ExitStack() as stack:
        place = place_of(folder)
        if place is not None and place.parent != folder:
            stack.callback(scratch.release, scratch.hold(place))
        yield


@contextlib.contextmanager
def _locked(folder: Path, operation: int, patience_s: float, why: str = "") -> Iterator[None]:
    """Lock a file of a run folder that only our user can open, so that no other user can keep it
    locked; ``why`` says what it means if another process has."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    with naming(folder / _LOCK):
        handle = os.open(folder / _LOCK, flags, 0o600)
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, handle)
        try:
            scratch.lock(handle, operation, patience_s)
        except TimeoutError as problem:
            raise UserError(f"{folder}: {why or problem}") from None
        yield


@contextlib.contextmanager
def cut_short(folder: Path) -> Iterator[None]:
    """Say in an interrupt what is left in a folder and how to complete it."""
    try:
        yield
    except KeyboardInterrupt:
        there = (folder / "parts").is_dir() or (folder / "signals.npz").is_file()
        left = f"all that was recorded is kept: gfmhil recover {folder} completes the folder"
        text = left if there or converters_of(folder) else "nothing was recorded"
        raise KeyboardInterrupt(f"{folder}: interrupted; {text}") from None


@contextlib.contextmanager
def _kept(folder: Path) -> Iterator[None]:
    """Say what to do where a file cannot be written, or a signal comes."""
    try:
        with cut_short(folder), Interrupt(at_once=True):
            yield
    except OSError as problem:
        raise Unfinished(
            f"{folder}: {problem.strerror or problem}; all that was recorded is kept: make room, "
            f"then gfmhil recover {folder}"
        ) from None


def _duration(folder: Path) -> float:
    """How long a run lasted whose end nobody saw: from its start to what was written last, s."""
    place = place_of(folder)
    files = [*folder.iterdir(), *(place.iterdir() if place is not None else ())]
    return max(0.0, max(path.lstat().st_mtime for path in files) - began(folder))


def _complete(
    scenario: Scenario,
    folder: Path,
    laws: list[str],
    wall_s: float,
    report: Report | None,
    outside: Outcome | None,
) -> Run:
    """Make the files of a run, then remove what they were made of; may be repeated at any point."""
    if place_of(folder) is not None or not (folder / "signals.npz").is_file():
        check_parts(folder, scenario.ticks)
        merge(folder, scenario.T_s, laws)  # of no parts where no side came so far
    signals, timing, labels = read_recording(folder)
    if len(signals["tick"]) > scenario.ticks:
        said = f"holds {len(signals['tick'])} ticks, but the run has {scenario.ticks}"
        raise UserError(f"{folder / 'signals.npz'}: {said}")
    log = read_events(folder, scenario.ticks)
    write_text(folder / "events.jsonl", "".join(json.dumps(e) + "\n" for e in log))
    links = _link_ends(folder)
    summary = summarise(scenario, signals, timing, log, worst(log, outside), links, wall_s)
    summary |= stages(scenario) | origin(scenario, began(folder))
    run = Run(scenario, summary, signals, labels, log, folder, timing)
    _conclude(run, report)
    return run


def _link_ends(folder: Path) -> dict[Role, dict[str, Any]]:
    """What each side wrote about its end of the link: the faults that it counted, the state of the
    end-to-end protection, and the faults injected on purpose."""
    ends = {}
    for role in ROLES:
        with contextlib.suppress(FileNotFoundError):
            ends[role] = read_json(folder / f"link_{role}.json", _LinkEnd)
    return ends


def save(run: Run, folder: str | Path, report: Report | None = None) -> Path:
    """Write the folder of a run in memory, or copy that of another; returns it.

    A law that was an object is there as ``law.toml``, which the scenario names. Raises UserError:
    the folder holds something already, or cannot be written.
    """
    folder = Path(folder)
    check_empty(folder)
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if run.folder is not None:
            shutil.copytree(run.folder, folder, dirs_exist_ok=True)
            return folder
        arrays = {name: np.asarray(column[:]) for name, column in run.columns.items()}
        scenario = run.scenario
        if run.law_text:
            law = folder.absolute() / "law.toml"
            write_text(law, run.law_text)
            scenario = scenario.model_copy(update={"law": str(law)})
        write_scenario(folder, scenario)
        laws = ColumnGroup.of(laws=np.array(run.laws))
        write_npz(folder / "signals.npz", [laws, ColumnGroup.of(**arrays)])
        write_npz(folder / "timing.npz", [])
        lines = "".join(json.dumps(event) + "\n" for event in run.events)
        write_text(folder / "events.jsonl", lines)
        if report is not None:
            report(replace(run, columns=arrays, folder=folder))
        write_text(folder / "summary.json", json.dumps(run.summary, indent=2) + "\n")
    return folder


def merge_roles(first: Path, second: Path, folder: Path, report: Report | None = None) -> Run:
    """Put what the two sides of a run left, each in a folder of its own, into one run folder.

    Rows end where the plant's recording does, as in a run whose sides were started together. Raises
    UserError: a folder is not that of one side, they are not of the same run or of the same
    converter, or ``folder`` is in use or cannot be written.

    Args:
        first, second: the finished folders of controller and plant, in any order; they stay.
        folder: new or empty.
        report: as for ``finish``.
    """
    roles: dict[Role, Run] = {}
    for run in (Run.load(first), Run.load(second)):
        recorded = [s for s, one in zip(ROLES, ("ref_P_ref", "true_p"), strict=True)
                    if one in run.columns]  # fmt: skip
        if len(recorded) != 1:
            said = " and ".join(recorded) or "neither side"
            raise UserError(f"{run.folder}: holds the recording of {said}, not of one side alone")
        if recorded[0] in roles:
            raise UserError(f"{first}, {second}: both are of the {recorded[0]}")
        roles[recorded[0]] = run
    plant, controller = roles["plant"], roles["controller"]
    ids = [run.summary.get("run") for run in (plant, controller)]
    if ids[0] is None or ids[0] != ids[1]:
        raise UserError(f"{first}, {second}: are not of the same run: run = {ids[0]!r}, {ids[1]!r}")
    names = [run.scenario.converter for run in (plant, controller)]
    if names[0] != names[1]:
        raise UserError(f"{first}, {second}: are of different converters: {names[0]}, {names[1]}")
    done = plant.summary["ticks"]
    check_free(folder, done, ColumnSet("inner" in plant.summary, plant.scenario.optional_signals))
    log = read_log(*(run.file("events.jsonl") for run in roles.values()))
    links = {
        role: _link_end(role, roles[role].summary)
        for role in ROLES
        if role in roles[role].summary["faults"]
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_scenario(folder, plant.scenario)
        write_text(folder / "events.jsonl", "".join(json.dumps(e) + "\n" for e in log))
        own = {k: v for k, v in controller.columns.items() if k not in ("tick", "t")}
        laws = ColumnGroup.of(laws=np.array(controller.laws))
        tables = [_pad(plant.columns, done, np.nan), _pad(own, done, np.nan), laws]
        write_npz(folder / "signals.npz", tables)
        times = [_pad(run.timing, done, -1) for run in (plant, controller)]
        write_npz(folder / "timing.npz", times)
        signals, timing, labels = read_recording(folder)
        wall_s = plant.summary["wall_s"]
        summary = summarise(plant.scenario, signals, timing, log, worst(log, None), links, wall_s)
        kept = ("inner", "date", "version")
        summary |= {key: plant.summary[key] for key in kept if key in plant.summary}
        summary["machines"] = controller.summary["machines"] | plant.summary["machines"]
        whole = Run(plant.scenario, summary, signals, labels, log, folder, timing)
        _conclude(whole, report)
    except OSError as problem:
        shutil.rmtree(folder, ignore_errors=True)
        raise UserError(f"{folder}: {problem.strerror or problem}") from None
    return whole


def _link_end(role: Role, summary: dict[str, Any]) -> dict[str, Any]:
    """What ``_link_ends`` gives of a side, from the summary of that side alone."""
    keys = ("faults", "e2e", "injected")
    return {key: summary[key][role] for key in keys if role in summary.get(key, {})}


def _pad(columns: Columns, rows: int, missing: float) -> ColumnGroup:
    """Columns of one side, cut or filled up with ``missing`` to ``rows``."""

    def read(first: int, last: int) -> Iterator[NDArray[Any]]:
        for column in columns.values():
            found = column[first : min(last, len(column))]
            rest = np.full(last - first - len(found), missing, found.dtype)
            yield np.concatenate([found, rest])

    return ColumnGroup({name: column.dtype for name, column in columns.items()}, rows, read)


def _conclude(run: Run, report: Report | None) -> None:
    """Have a run's report written, then write its summary, and remove what is left over."""
    assert run.folder is not None
    folder = run.folder
    if report is not None and run.ticks:
        report(run)
    sync_folder(folder)
    write_text(folder / "summary.json", json.dumps(run.summary, indent=2) + "\n")
    sync_folder(folder)
    _clear(folder)


def _clear(folder: Path) -> None:
    """Remove what the files of a complete run were made of, and what a killed process left."""
    remove_parts(folder)
    names = [_LOCK, _ENDED]
    for side in (*ROLES, "both"):
        names += [f"events_{side}.jsonl", f"events_{side}.room", f"link_{side}.json"]
        names += [f"commands_{side}.json", f"commands_{side}.new"]
    for path in [*(folder / name for name in names), *unfinished(folder)]:
        with contextlib.suppress(IsADirectoryError):  # it is none of ours
            path.unlink(missing_ok=True)
