"""A finished run: what happened and every signal, read from its folder or kept in memory."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from gfm_hil.core.errors import UserError, lines, need
from gfm_hil.core.files import read_file
from gfm_hil.core.roles import OUR_CONTROLLER, target_of
from gfm_hil.recording.columns import (
    CONTROLLER_COLUMNS,
    CONTROLLER_INNER,
    HERTZ,
    PLANT_COLUMNS,
    PLANT_INNER,
    TIMES_OF,
    ColumnInfo,
    Columns,
    describe,
    pieces,
)
from gfm_hil.recording.log import most_bytes, read_events, read_summary, written_by
from gfm_hil.recording.npz import Column, open_npz
from gfm_hil.recording.waveforms import three_phase
from gfm_hil.scenario import Scenario, look_beside
from gfm_plant import CONNECTION, Bases, load_converter
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml

_NOT_METRICS = ("t", "tick", "type", "label")
_LAST = 253402300799.0  # s since 1970, of the year 9999
#: columns of which a recording has all or none
_TOGETHER = (
    *(
        [name for name in columns if name.startswith(kind)]
        for columns in (PLANT_COLUMNS, PLANT_INNER)
        for kind in ("y_", "u_", "true_")
    ),
    CONTROLLER_COLUMNS,
    CONTROLLER_INNER,
    tuple(f"true_{n}" for n in CONNECTION),
    *([f"{role}_{name}" for name in times] for role, times in TIMES_OF.items()),
)

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes


class Signals(Mapping[str, NDArray[Any]]):
    """The recorded signals by name, each of shape (ticks,), read when it is asked for.

    ``p``, ``q``, ``V``, ``v_dc``, ``omega_u``, ``i``, ``delta``, ``omega_g`` and ``V_g`` are the
    plant's own, without sensors, and ``p_c``, ``q_c``, ``V_c`` those at the connection point of a
    converter with a transformer; ``f_hz`` is omega_u in Hz; ``t`` is in s. All columns of the
    recording are there under their own names too: ``y_p`` as measured, ``u_E_u``, ``ref_P_ref``;
    iterating gives those.

    Args:
        columns: of signals.npz.
        f_n: nominal frequency, Hz.
    """

    def __init__(self, columns: Columns, f_n: float) -> None:
        self._columns, self._f_n = columns, f_n
        self._names = [name.removeprefix("true_") for name in columns if name.startswith("true_")]
        if "true_omega_u" in columns:
            self._names.append(HERTZ)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name == HERTZ and name in self._names:
            return np.asarray(self._columns["true_omega_u"][:] * self._f_n)
        for known in (name, f"true_{name}"):
            if known in self._columns:
                return np.asarray(self._columns[known][:])
        there = sorted([*self._columns, *self._names])
        raise UserError(f"signal = {name!r}: was not recorded; there are {there}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns or name in self._names


@dataclass(frozen=True, repr=False)
class Run:
    """A finished run.

    Attributes:
        scenario: what was run.
        summary: content of summary.json.
        columns: of signals.npz, each shape (ticks,): an array, or a column of the file, of which
            only slices are read.
        laws: labels of the laws, which the column ``law`` refers to.
        events: lines of events.jsonl.
        folder: where it is; None for a run in memory.
        timing: columns of timing.npz, likewise; empty for a run in one process.
        law_text: the law file of a run in memory whose law was an object, so that it has no file;
            empty otherwise.
    """

    scenario: Scenario
    summary: dict[str, Any]
    columns: Columns
    laws: list[str] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    folder: Path | None = None
    timing: Columns = field(default_factory=dict)
    law_text: str = ""

    if TYPE_CHECKING:  # functions of rooms further up, which ``gfm_hil.api.runs`` adds
        plot: ClassVar[Callable[..., list[Axes]]]
        plot_waveforms: ClassVar[Callable[..., list[Axes]]]
        between_ticks: ClassVar[Callable[..., Any]]
        save: ClassVar[Callable[..., Path]]
        _repr_html_: ClassVar[Callable[..., str]]

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """A run from its folder; no column is read yet.

        Raises:
            UserError: it is no run folder, the run is not over, or a file is damaged or of an
                earlier version that cannot be read any more.
        """
        folder = Path(folder)
        try:
            return cls._load(folder)
        except UserError as problem:
            raise UserError(f"{problem}{_written_by_another(folder)}") from None

    @classmethod
    def _load(cls, folder: Path) -> Self:
        try:
            columns, timing, laws = read_recording(folder)
            ticks = len(columns["tick"])
            summary = read_summary(folder, ticks)
        except FileNotFoundError as problem:
            going = (folder / "scenario.toml").is_file()
            if going and (names := converters_of(folder)):
                raise UserError(
                    f"{folder}: is the folder of a network; name that of a converter:"
                    f" {', '.join(str(folder / name) for name in names)}"
                ) from None
            what = "the run is not over, see gfmhil stream, or was cut off, see gfmhil recover"
            what = what if going else "is not a run folder"
            missing = Path(problem.filename).name
            raise UserError(f"{folder}: {what} ({missing} is missing)") from None
        if summary["ticks"] != ticks:
            said = summary["ticks"]
            raise UserError(f"{folder}: summary.json says {said} ticks, signals.npz has {ticks}")
        events = read_events(folder, ticks)
        return cls(read_scenario(folder), summary, columns, laws, events, folder, timing)

    def file(self, name: str) -> Path:
        """The path of a file of the run folder.

        Raises:
            UserError: the run is in memory only.
        """
        if self.folder is None:
            raise UserError(f"{name}: the run is in memory; save it first")
        return self.folder / name

    def text(self, name: str) -> str:
        """The content of a text file of the run folder.

        Raises:
            UserError: the run is in memory only, or the file is none of a run.
        """
        return read_file(self.file(name), most_bytes(self.ticks)).decode("utf-8", "replace")

    @property
    def began(self) -> float:
        """When the run of the folder began, s since 1970."""
        return began(self.file("."))

    @property
    def signals(self) -> Signals:
        """The signals by name, see ``Signals``; p.u. unless ``units`` says otherwise."""
        return Signals(self.columns, nominal_frequency(self.scenario))

    @cached_property
    def recorded(self) -> Columns:
        """All columns, ``columns`` and then ``timing``."""
        return {**self.columns, **self.timing}

    @property
    def described(self) -> list[ColumnInfo]:
        """What each column of ``recorded`` is, in its order.

        Raises:
            UserError: a column is unknown.
        """
        return [describe(name, self.laws) for name in self.recorded]

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column of ``columns``; empty for codes."""
        return {name: describe(name, self.laws).unit for name in self.columns}

    @property
    def ticks(self) -> int:
        """How many ticks were recorded."""
        return len(self.columns["tick"])

    @property
    def digest(self) -> str:
        """SHA-256 of all columns of signals.npz, each with its name, in hexadecimal digits. It is
        the same if a run in lockstep is repeated by the same version on the same kind of processor.
        """
        found = hashlib.sha256()
        for name, column in self.columns.items():
            found.update(name.encode())
            for piece in pieces(column, 0, len(column)):
                found.update(np.ascontiguousarray(piece).tobytes())
        return found.hexdigest()

    def blocks(self, ticks: int) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Rows in blocks of at most ``ticks``: the first tick, and all columns from there on."""
        recorded = self.recorded
        for first in range(0, self.ticks, ticks):
            yield first, {name: x[first : first + ticks] for name, x in recorded.items()}

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """What followed each event, by ``label @ t s`` (overshoot, settling, nadir and more, with
        the units of their names)."""
        return {
            f"{event['label']} @ {event['t']:g} s": {
                key: value for key, value in event.items() if key not in _NOT_METRICS
            }
            for event in self.summary["events"]
        }

    def three_phase(
        self, start: float = 0.0, stop: float = math.inf, si: bool = False
    ) -> dict[str, NDArray[Any]]:
        """v_abc of the filter capacitor and i_abc of the bridge and of the line, at every tick.

        Args:
            start, stop: from when to before when, s.
            si: in V and A instead of in p.u. of the nominal peak value of a phase.

        Returns:
            ``t`` in s, and v_a … v_c, i_a … i_c, i_oa … i_oc, in V and A under names such as v_a_V
            and i_oa_A; shape (ticks,) each.

        Raises:
            UserError: the recording lacks what this needs.
        """
        waves = three_phase(self.columns, bases(self.scenario), si)
        first, last = (
            round(min(max(0.0, t / self.scenario.T_s), self.ticks)) for t in (start, stop)
        )
        rows = {"t": self.columns["t"], **waves}
        return {name: np.asarray(column[first:last]) for name, column in rows.items()}

    @property
    def status(self) -> str:
        """``completed``, ``oscillating``, ``tripped``, ``safe`` or ``interrupted``."""
        return str(self.summary["status"])

    def to_pandas(self) -> pandas.DataFrame:
        """All signals as a DataFrame whose index is t in s.

        Raises:
            UserError: pandas is not installed.
        """
        need("pandas", "pandas", "to_pandas", "notebook")
        import pandas

        content = {name: column[:] for name, column in self.columns.items()}
        return pandas.DataFrame(content).set_index("t")

    def to_xarray(self) -> xarray.Dataset:
        """All signals as a Dataset over t, with units.

        Raises:
            UserError: xarray is not installed.
        """
        need("xarray", "xarray", "to_xarray", "notebook")
        import xarray

        units = self.units
        content = {
            name: ("t", column[:], {"units": units[name]})
            for name, column in self.columns.items()
            if name != "t"
        }
        about = {"title": self.scenario.title, "status": self.status}
        return xarray.Dataset(content, {"t": self.columns["t"][:]}, about)

    def __repr__(self) -> str:
        reason = f" ({self.summary['reason']})" if self.summary["reason"] else ""
        where = f", {self.folder}" if self.folder is not None else ""
        return (
            f"<Run {self.scenario.title!r}: {controlled_by(self.summary)}, {self.status}{reason}, "
            f"{self.summary['duration_s']:g} s in {self.summary['ticks']} ticks{where}>"
        )


def controlled_by(summary: Mapping[str, Any]) -> str:
    """The laws of a run, or what a controller that is not ours calls itself."""
    name = summary.get("controller", OUR_CONTROLLER)
    target = target_of(name)
    if target is not None:
        laws = " → ".join(summary["laws"])
        return laws + (f" on {target}" if target else "")
    return name or "a controller that gave no name"


def bases(scenario: Scenario) -> Bases:
    """The bases of the scenario's converter. Raises UserError: the converter's file cannot be
    read."""
    name = scenario.plant.converter
    try:
        return load_converter(name).bases
    except (OSError, ValueError) as problem:
        raise UserError(f"plant.converter = {name!r}: {problem}") from None


def nominal_frequency(scenario: Scenario) -> float:
    """Nominal frequency of the scenario's converter, Hz, which all of a network have; raises as
    ``bases``."""
    one = next(iter(scenario.each.values()), scenario)
    return bases(one).omega_b / (2 * math.pi)


def _written_by_another(folder: Path) -> str:
    """What a refusal adds if another version of gfmhil has written the folder."""
    try:
        one = next(iter(converters_of(folder)), "")  # of a network, whose own summary does not say
        then, now = printable(written_by(folder / one))[:40], version("gfmhil")
    except (OSError, UserError):
        return ""
    return "" if then == now else f"; gfmhil {then} has written it, and this is {now}"


def read_scenario(folder: Path) -> Scenario:
    """The scenario of a run as it was resolved; its law files may be gone. Raises UserError: there
    is none in the folder, or it is damaged."""
    try:
        content = read_toml(folder / "scenario.toml", links=False)
        look_beside(content, folder)
        return Scenario.model_validate(content)
    except ValidationError as problem:
        reason = "; ".join(lines(problem))
    except ValueError as problem:
        reason = str(problem)
    raise UserError(f"{folder}: not a run folder: scenario.toml: {reason}")


def converters_of(folder: Path) -> list[str]:
    """Names of the converters that have a run folder of their own in that of a network; none in any
    other folder."""
    try:
        return read_scenario(folder).parts
    except UserError:
        return []


def began(folder: Path) -> float:
    """When the run of a folder began, s since 1970: when its scenario was written."""
    return min(max(0.0, (folder / "scenario.toml").lstat().st_mtime), _LAST)


def read_recording(folder: Path) -> tuple[dict[str, Column], dict[str, Column], list[str]]:
    """The columns of signals.npz and of timing.npz, and the labels of the laws. Raises
    FileNotFoundError: a file is not there; UserError: a file is damaged."""
    files = folder / "signals.npz", folder / "timing.npz"
    signals, timing = map(open_npz, files)
    for name in ("tick", "t", "laws"):
        if name not in signals:
            raise UserError(f"{files[0]}: has no column {name}")
    labels = signals.pop("laws")
    if labels.dtype.kind != "U":
        raise UserError(f"{files[0]}: its column laws holds no texts")
    for file, columns, kind in (files[0], signals, float), (files[1], timing, np.int64):
        for name, column in columns.items():
            if column.dtype != (np.int64 if name == "tick" else kind):
                raise UserError(f"{file}: its column {name} holds {column.dtype}")
    for group in _TOGETHER:
        there = [name for name in group if name in signals or name in timing]
        if there and len(there) < len(group):
            lacks = next(name for name in group if name not in there)
            raise UserError(f"{folder}: the recording has {there[0]}, but no {lacks}")
    lengths = {name: len(column) for name, column in [*signals.items(), *timing.items()]}
    if len(set(lengths.values())) > 1:
        raise UserError(f"{folder}: the columns of the recording differ in length: {lengths}")
    return signals, timing, [str(label) for label in labels[:]]
