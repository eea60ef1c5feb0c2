"""Spectra of currents and voltages between ticks, grouped as IEC 61000-4-7 groups them.

IEC 61000-4-7:2002 with its amendment 1 of 2008: a rectangular window of 10 cycles at 50 Hz, or of
12 at 60 Hz, whose lines lie 5 Hz apart; harmonic groups and subgroups of them; and the distortions
THD, THDG and THDS. The window is synchronous to the nominal frequency: of a converter that turns at
another one the lines leak, which groups are there for.

The value between two instants is a straight line (a current) or a constant (the voltage of a leg).
Both are averaged exactly over equal cells; what the averaging takes from a line is known.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.run.between import BetweenTicks

_WINDOW = 0.2  # s, in whole cycles
MOST_ORDER = 50


@dataclass(frozen=True)
class Spectrum:
    """Lines of a window.

    Attributes:
        f: (m,), Hz, 1 / window apart.
        rms: RMS value of each line, (m,), in the unit of what they are of; f = 0: the mean.
        cycles: of the fundamental in the window, N.
    """

    f: NDArray[np.float64]
    rms: NDArray[np.float64]
    cycles: int

    def harmonic(self, order: int) -> float:
        """RMS of the line at a multiple of the fundamental."""
        return float(self.rms[order * self.cycles])

    def group(self, order: int) -> float:
        """RMS of a harmonic group: all lines up to half way to the next harmonics, those half way
        with half of their square."""
        half = self.cycles // 2
        lines = self.rms[order * self.cycles - half : order * self.cycles + half + 1] ** 2
        return float(np.sqrt(lines.sum() - (lines[0] + lines[-1]) / 2))

    def subgroup(self, order: int) -> float:
        """RMS of a harmonic subgroup: the line of the harmonic and those beside it."""
        at = order * self.cycles
        return float(np.sqrt(np.sum(self.rms[at - 1 : at + 2] ** 2)))

    def distortion(self, most: int = MOST_ORDER) -> dict[str, float]:
        """``THD`` of lines, ``THDG`` of groups and ``THDS`` of subgroups, each of the harmonics
        from 2 to ``most`` over that of the fundamental."""
        parts = {"THD": self.harmonic, "THDG": self.group, "THDS": self.subgroup}
        orders = range(2, most + 1)
        return {
            name: float(np.sqrt(sum(part(k) ** 2 for k in orders))) / part(1)
            for name, part in parts.items()
        }


def spectrum(between: BetweenTicks, name: str) -> Spectrum:
    """The spectrum of the first 10 cycles (at 60 Hz: 12) of a window. Raises UserError: the window
    is too short, or has no such column.

    Args:
        between: the window.
        name: of one of its columns, or ``u_a`` … of a leg's voltage.
    """
    f_n = between.bases.omega_b / (2 * np.pi)
    cycles = round(_WINDOW * f_n)
    lasts = cycles / f_n
    t = between.t - between.t[0]
    cells = round(lasts / (between.T_s / np.ceil(between.T_s / between.step - 1e-9)))
    if t[-1] < lasts * (1 - 1e-9):
        raise UserError(f"window of {t[-1]:g} s: IEC 61000-4-7 takes {cycles} cycles, {lasts:g} s")
    if name.startswith("u_") and name[2:] in "abc":
        steps = between.legs[:, "abc".index(name[2:])] * np.diff(t)
    elif name in between.columns:
        x = between.columns[name]
        steps = (x[1:] + x[:-1]) / 2 * np.diff(t)
    else:
        known = ", ".join([*between.columns, "u_a", "u_b", "u_c"])
        raise UserError(f"name = {name!r}: must be one of {known}")
    whole = np.interp(np.arange(cells + 1) * (lasts / cells), t, np.cumsum([0.0, *steps]))
    lines = np.fft.rfft(np.diff(whole) * (cells / lasts)) / cells
    order = np.arange(len(lines))
    rms = np.abs(lines) / np.sinc(order / cells) * np.where(order > 0, np.sqrt(2), 1.0)
    return Spectrum(order / lasts, rms, cycles)
