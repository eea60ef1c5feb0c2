"""The files that recordings come in: each format's channels by name, as numbers."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError, need

Vector = NDArray[np.float64]
TIME = "t"  #: the channel of time, s, of formats that have one of their own


def read_channels(file: Path) -> dict[str, Vector]:
    """Every channel of a file by its name, shape (samples,). Raises UserError: it is not there, of
    no format that is known, damaged, or the package that reads it is not installed."""
    kind = file.suffix.lower().removeprefix(".")
    if kind not in FILES:
        known = ", ".join(f".{name}" for name in FILES)
        raise UserError(f"{file}: the format is told by the ending, which must be one of {known}")
    if not file.is_file():
        raise UserError(f"{file}: no such file")
    try:
        return FILES[kind](file)
    except UserError:
        raise
    except Exception as problem:  # of a library, each in its own way
        words = str(problem).splitlines() or [type(problem).__name__]
        raise UserError(f"{file}: is no {kind.upper()} file that can be read: {words[0]}") from None


def _csv(file: Path) -> dict[str, Vector]:
    with file.open(encoding="utf-8-sig") as lines, warnings.catch_warnings(action="ignore"):
        head = [name.strip().strip('"') for name in lines.readline().split(",")]
        rows = np.loadtxt(lines, delimiter=",", ndmin=2)
    if not rows.size:
        raise ValueError("there is nothing below its first line")
    if rows.shape[1] != len(head):
        raise ValueError(
            f"its first line names {len(head)} columns, its second has {rows.shape[1]}"
        )
    return dict(zip(head, np.ascontiguousarray(rows.T), strict=True))


def _mat(file: Path) -> dict[str, Vector]:
    from scipy.io import loadmat

    return _numbers({n: x for n, x in loadmat(file).items() if not n.startswith("__")})


def _parquet(file: Path) -> dict[str, Vector]:
    need("pyarrow", "pyarrow", f"{file}", "export")
    from pyarrow import parquet

    table = parquet.read_table(file)
    return _numbers({name: table[name].to_numpy() for name in table.column_names})


def _mf4(file: Path) -> dict[str, Vector]:
    need("asammdf", "asammdf", f"{file}", "export")
    from asammdf import MDF

    with MDF(file) as opened:
        signals = [*opened.iter_channels(skip_master=True)]
    return _numbers({TIME: signals[0].timestamps} | {s.name: s.samples for s in signals})


def _numbers(columns: dict[str, Any]) -> dict[str, Vector]:
    """The columns that are numbers."""
    found = {name: np.asarray(x).squeeze() for name, x in columns.items()}
    return {
        n: x.astype(np.float64) for n, x in found.items() if x.ndim == 1 and x.dtype.kind in "biuf"
    }


def _comtrade(file: Path) -> dict[str, Vector]:
    need("comtrade", "comtrade", f"{file}", "export")
    import comtrade

    opened = comtrade.Comtrade(ignore_warnings=True, use_numpy_arrays=True)
    opened.load(str(file))
    rates, t = opened.cfg.sample_rates, np.asarray(opened.time, np.float64)
    if len(t) > 1 and t[-1] <= t[0]:  # what the package has not read stays 0
        raise ValueError(f"its data end after {np.argmax(t) + 1} of {len(t)} samples")
    if len(rates) == 1 and rates[0][0] > 0:  # the package has 32-bit floats
        t = np.arange(len(t)) / rates[0][0]
    found = {TIME: t}
    for about, x in zip(opened.cfg.analog_channels, opened.analog, strict=True):
        # what is recorded on the secondary side of a transformer is told on the primary one
        ratio = about.primary / about.secondary if about.pors.upper() == "S" else 1.0
        found[about.name] = ratio * np.asarray(x, np.float64)
    for name, x in zip(opened.status_channel_ids, opened.status, strict=True):
        found[name] = np.asarray(x, np.float64)
    return found


FILES: dict[str, Callable[[Path], dict[str, Vector]]] = {
    "csv": _csv, "cfg": _comtrade, "cff": _comtrade, "mat": _mat, "parquet": _parquet, "mf4": _mf4,
}  # fmt: skip
"""What reads each format, by the ending of its files."""
