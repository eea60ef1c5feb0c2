"""The three phases of a recorded run: v_abc of the filter capacitor, i_abc of bridge and line.

The plant records the space vectors of the capacitor's voltage and of the bridge's current in a
frame that turns at omega_n, and p and q at the capacitor. With that frame's angle
theta = omega_n t, a vector x has the phases

    x_a = Re(x e^(j theta)), x_b = Re(x e^(j (theta - 2 pi/3))), x_c = Re(x e^(j (theta + 2 pi/3)))

which is the inverse of Clarke's amplitude-invariant transform. There is no zero sequence: the
converter has three wires. The line's current follows from p + j q = v conj(i_o).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import PHASES, WAVES, ColumnLike, Columns, wave
from gfm_plant import Bases

NEEDS = ("t", "true_v_re", "true_v_im", "true_i_re", "true_i_im", "true_p", "true_q")
BEFORE, AFTER = 3, 7  # cycles of the usual window, before and after the first event
_LAG = dict(zip(PHASES, (0.0, 2 * math.pi / 3, -2 * math.pi / 3), strict=True))  # rad


@dataclass(frozen=True)
class Phase:
    """A phase of a space vector as a column, of which only the rows asked for are computed."""

    columns: Columns  # with those of ``NEEDS``
    # name, phase: of ``WAVES`` and ``PHASES``
    name: str
    phase: str
    f_n: float  # nominal frequency, Hz
    factor: float = 1.0  # from p.u. to what is wanted
    dtype = np.dtype(float)

    def __len__(self) -> int:
        return len(self.columns["t"])

    def __getitem__(self, rows: slice) -> NDArray[np.float64]:
        def read(name: str) -> NDArray[np.float64]:
            return np.asarray(self.columns[name][rows])

        angle = 2 * math.pi * (self.f_n * read("t") % 1.0) - _LAG[self.phase]
        letter = "i" if self.name == "i" else "v"
        x = read(f"true_{letter}_re") + 1j * read(f"true_{letter}_im")
        if self.name == "i_o":
            with np.errstate(invalid="ignore", divide="ignore"):  # NaN where v is exactly 0
                x = (read("true_p") - 1j * read("true_q")) / x.conj()
        return self.factor * (x.real * np.cos(angle) - x.imag * np.sin(angle))


def three_phase(columns: Columns, bases: Bases, si: bool = False) -> dict[str, ColumnLike]:
    """The phases of v, i and i_o as columns, shape (ticks,) each, by the names of ``DERIVED``.
    Raises UserError: the recording lacks what this needs.

    Args:
        columns: of signals.npz.
        bases: of the converter.
        si: in V and A, names such as v_a_V, instead of in p.u. of the nominal peak value of a
            phase, sqrt(2/3) V_n and sqrt(2/3) S_n/V_n, so that p = 2/3 (v_a i_oa + ...).
    """
    if missing := [name for name in NEEDS if name not in columns]:
        raise UserError(
            f"the three phases need {', '.join(missing)}, which the recording lacks: it has no "
            "plant, or an older version made it"
        )
    scale = {"V": bases.V_peak, "A": bases.I_peak}
    f_n = bases.omega_b / (2 * math.pi)
    return {
        wave(name, phase, si): Phase(columns, name, phase, f_n, scale[unit] if si else 1.0)
        for name, unit in WAVES.items()
        for phase in PHASES
    }


def usual_window(summary: Mapping[str, Any], f_n: float) -> tuple[float, float]:
    """The window of the figure, s: around the first event, or the first cycles without one."""
    events = summary["events"]
    first = events[0]["t"] if events else BEFORE / f_n
    return max(0.0, first - BEFORE / f_n), first + AFTER / f_n
