"""Run folders as files that other tools open: MF4, MAT, Parquet, CSV, COMTRADE, and CAN traffic as
BLF; what each format needs to be installed, and writing one whole or not at all."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import replacing
from gfm_hil.recording.run import Run, bases
from gfm_hil.recording.waveforms import three_phase


@dataclass(frozen=True)
class Format:
    """A format."""

    text: str  # what it is
    writer: str  # function that writes a run to a file, as module:name in this package
    needs: str = ""  # package that this takes
    # ending of a second file that the first goes with, and the function that writes it
    beside: tuple[str, str] | None = None
    columns: bool = True  # it holds the columns of the recording


FORMATS = {
    "mf4": Format("MDF 4.11, with events and attachments", "mf4:write_mf4", "asammdf"),
    "csv": Format("text, every number exactly", "writers:write_csv"),
    "mat": Format("MATLAB 5", "writers:write_mat"),
    "parquet": Format("Apache Parquet", "writers:write_parquet", "pyarrow"),
    "cfg": Format(
        "COMTRADE C37.111-2013, 16-bit numbers", "comtrade:write_cfg",
        beside=(".dat", "comtrade:write_dat"),
    ),
    "cff": Format("COMTRADE C37.111-2013, one file of ASCII", "comtrade:write_cff"),
    "blf": Format(
        "CAN frames and their DBC, for Vector's tools", "blf:write_blf",
        beside=(".dbc", "blf:write_dbc_file"), columns=False,
    ),
}  # fmt: skip


def check_format(name: str) -> None:
    """See that a format is there and can be written here. Raises UserError: it is none, or its
    package is not installed."""
    if name not in FORMATS:
        raise UserError(f"--format {name}: must be one of {', '.join(FORMATS)}")
    needs = FORMATS[name].needs
    if needs and find_spec(needs) is None:
        raise UserError(f"--format {name} needs {needs}: pip install 'gfmhil[export]'")


def export_run(
    folder: Path, name: str, file: Path, phases: Literal["pu", "si"] | None = None
) -> list[Path]:
    """Write a finished run to ``file`` in the format ``name``. Raises UserError: no run, no such
    format, the recording lacks what the three phases need, or the file cannot be written.

    Args:
        phases: with the three phases of voltages and currents as further columns, in p.u. or in V
            and A; see ``gfm_hil.recording.waveforms``.

    Returns:
        What was written: the file and, of CAN frames, their DBC, of a .cfg its .dat.
    """
    check_format(name)
    run, form = Run.load(folder), FORMATS[name]
    if phases is not None:
        if not form.columns:
            fitting = ", ".join(name for name, form in FORMATS.items() if form.columns)
            raise UserError(f"--three-phase {phases}: goes with {fitting}, not with {name}")
        waves = three_phase(run.columns, bases(run.scenario), si=phases == "si")
        run = replace(run, columns={**run.columns, **waves})
    written = [file]
    with naming(file), replacing(file) as part:
        part.touch()  # the packages say it each in its own way
        _function(form.writer)(run, part)
        if form.beside is not None:
            suffix, writer = form.beside
            written.append(file.with_suffix(suffix))
            with replacing(written[-1]) as second:
                _function(writer)(run, second)
    return written


def _function(where: str) -> Callable[..., Any]:
    module, _, name = where.partition(":")
    function: Callable[..., Any] = getattr(import_module(f"{__name__}.{module}"), name)
    return function
