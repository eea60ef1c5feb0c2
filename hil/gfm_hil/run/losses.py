"""Losses of a switched bridge from the values of its devices' data sheet.

The devices of the plant switch in no time. What real ones lose follows from the currents and
voltages between the ticks: while a device conducts, V_0 |i| + r_on i^2; where the current of a leg
goes from one device to another, the energy of the data sheet in proportion to current and to the
step of the leg's voltage. A step up with a current out of the leg, or down with one into it, turns
a switch on against a diode, which recovers: E_on + E_rr. The others turn a switch off: E_off.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from gfm_hil.core.schema import read_model
from gfm_hil.run.between import WAYS, BetweenTicks
from gfm_plant.parameters import NonNegative, Options, Positive

_STEP = 0.1  # p.u. of v_dc; a smaller one of a leg is no commutation


class DataSheet(Options):
    """Devices of a bridge, in V, A, ohm and J; all switches are alike, and all diodes."""

    source: str = Field(description="where the numbers come from")
    V_switch: NonNegative = Field(description="threshold of a switch that conducts, V")
    r_switch: NonNegative = Field(description="its on-state resistance, ohm")
    V_diode: NonNegative = Field(description="threshold of a diode, V")
    r_diode: NonNegative = Field(description="its on-state resistance, ohm")
    E_on: NonNegative = Field(description="energy of turning a switch on, J")
    E_off: NonNegative = Field(description="energy of turning a switch off, J")
    E_rr: NonNegative = Field(0.0, description="energy of a diode's recovery, J")
    V_ref: Positive = Field(description="voltage at which the energies hold, V")
    I_ref: Positive = Field(description="current at which they hold, A")


@dataclass(frozen=True)
class Losses:
    """Mean losses of a window, W.

    Attributes:
        conduction: by device, ``switch`` and ``diode``.
        switching: by what, ``on``, ``off`` and ``recovery``.
    """

    conduction: dict[str, float]
    switching: dict[str, float]

    @property
    def total(self) -> float:
        """All of them, W."""
        return sum(self.conduction.values()) + sum(self.switching.values())


def losses(between: BetweenTicks, sheet: DataSheet | str | Path) -> Losses:
    """What devices with these values would have lost in a window. Raises UserError: one line a
    mistake of the file.

    Args:
        between: the window; its drops, if the plant has any, are not counted again.
        sheet: of the devices, or the TOML file of it.
    """
    if not isinstance(sheet, DataSheet):
        sheet = read_model(sheet, DataSheet)
    b = between.bases
    currents = b.I_peak * np.column_stack([between.columns[f"i_{phase}"] for phase in "abc"])
    h, lasts = np.diff(between.t)[:, None], float(between.t[-1] - between.t[0])
    i_0, i_1 = currents[:-1], currents[1:]
    size, square = np.abs(i_0 + i_1) / 2 * h, (i_0**2 + i_0 * i_1 + i_1**2) / 3 * h
    found = {}
    for device, V, r in (
        ("switch", sheet.V_switch, sheet.r_switch), ("diode", sheet.V_diode, sheet.r_diode)
    ):  # fmt: skip
        has = np.array([way.endswith((device, "both")) for way in WAYS])[between.ways]
        found[device] = float(np.sum(has * (V * size + r * square)) / lasts)
    step, i = np.diff(between.legs, axis=0) * b.V_dcref, i_0[1:]
    energy = np.abs(step * i) / (sheet.V_ref * sheet.I_ref)
    turns = np.abs(step) > _STEP * b.V_dcref
    on, off = (float(np.sum(energy[turns & (step * i * way > 0)])) for way in (1, -1))
    switching = {
        "on": on * sheet.E_on / lasts,
        "off": off * sheet.E_off / lasts,
        "recovery": on * sheet.E_rr / lasts,
    }
    return Losses(found, switching)
