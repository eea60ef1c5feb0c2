"""The voltage of a recording as a course of the grid, which any law can be played against."""

import math
from pathlib import Path

import numpy as np

from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import write_text
from gfm_hil.core.schema import read_model
from gfm_hil.recording.foreign.channels import RecordingMap
from gfm_hil.recording.foreign.files import read_channels
from gfm_hil.recording.foreign.signals import sampled
from gfm_hil.scenario.events.grid_profile import MOST_LINES, RANGES

_LEAST_V = 0.1  # p.u.; the angle of a smaller voltage is not followed


def grid_profile(
    file: str | Path, map: str | Path, to: str | Path, f_n: float = 50.0, T_s: float = 1e-4
) -> Path:
    """Write the voltage of a recording as the file of an event ``grid-profile``; returns its path.

    It begins with the recording. V_g and omega_g are those of v, or of the channels V and f (or
    f_grid). Of phases the angle is followed too: at each line it jumps by what omega_g, a mean over
    a cycle, leaves of it. Raises UserError: a file cannot be read or written, a channel is missing,
    V or f is beyond what a grid may have, or there are more lines than an event takes.

    Args:
        file, map: a recording, and what its channels are, as for ``load_run``.
        to: CSV file.
        f_n: nominal frequency, Hz.
        T_s: least time between lines, s: the sampling time of the scenario.
    """
    for name, value in ("f_n", f_n), ("T_s", T_s):
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"{name} = {value}: must be > 0")
    try:
        s = sampled(read_channels(Path(file)), read_model(map, RecordingMap), f_n)
    except UserError as problem:
        words = str(problem)
        known = words.startswith((f"{file}:", f"{map}:"))
        raise UserError(words if known else f"{file}: {words}") from None
    f = s.of.get("f", s.of.get("f_grid"))
    if f is None:
        raise UserError(f"{map}: channels.f: missing; the grid needs it, or v and i")
    there = np.isfinite(f)
    if not there.any():
        raise UserError(f"{file}: V stays below {_LEAST_V} p.u.: it has no frequency")
    t = s.t - s.t[0]
    every = slice(None, None, max(1, round(T_s / s.dt)))
    columns = {"t": t, "omega_g": np.interp(t, t[there], f[there]), "V_g": s.of["V"]}
    columns = {name: x[every] for name, x in columns.items()}
    if (count := len(columns["t"])) > MOST_LINES:
        raise UserError(
            f"{file}: would make {count} lines: must be <= {MOST_LINES}; give a larger T_s"
        )
    low, high = RANGES["omega_g"]
    if s.vectors and low <= np.median(columns["omega_g"]) <= high:
        # what a jump makes of the frequency, the column degrees makes up for
        columns["omega_g"] = np.clip(columns["omega_g"], low, high)
    for name, said in ("omega_g", "f"), ("V_g", "V"):
        low, high = RANGES[name]
        x = columns[name]
        k = int(np.argmax(np.maximum(low - x, x - high)))
        if not low <= x[k] <= high:
            raise UserError(
                f"{file}: {said} = {x[k]:.4g} p.u. {columns['t'][k]:.4g} s after its begin: must "
                f"lie in [{low:g}, {high:g}]; units and bases are those of {map}"
            )
    if s.vectors:
        omega_n = 2 * math.pi * f_n
        ahead = s.vectors["v"] * np.exp(-1j * omega_n * t)
        seen = np.abs(ahead) >= _LEAST_V
        angle = np.interp(t, t[seen], np.unwrap(np.angle(ahead[seen])))[every]
        off = columns["omega_g"] - 1
        turned = omega_n * 0.5 * (off[1:] + off[:-1]) * np.diff(columns["t"])
        columns["degrees"] = np.concatenate([[0.0], np.degrees(np.diff(angle) - turned)])
    rows = (",".join(f"{x:.9g}" for x in row) for row in np.stack([*columns.values()], 1))
    with naming(to):
        write_text(Path(to), "\n".join([",".join(columns), *rows]) + "\n")
    return Path(to)
