"""Phases of voltages and currents for a controller that is not ours.

The plant works in a dq frame whose speed omega_u the controller commands. Such a controller
commands none, so the speed of the start stays for ever, the frame's angle is known, and what a
controller measures and commands is turned into that frame and out of it. The bridge's voltage
stays where it is in space until the next step, as that of a modulator does: each tick it is turned
back in the frame by what the frame turns.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.signals import Y_I_D, Y_I_OD, Y_V_D

if TYPE_CHECKING:
    from gfm_hil.controllers.external import BenchContext

_A = cmath.exp(2j * math.pi / 3)
#: phases a, b, c are the real parts of a space vector times these
TURNS = np.array([1.0, _A**2, _A])
#: what has phases, in the order of the rows of ``measured``, and where y has its d component
MEASURED = {"v": Y_V_D, "i": Y_I_D, "i_o": Y_I_OD}
_PLACES = np.array(list(MEASURED.values()))


class Frame:
    """The angle of the plant's frame, and phases in it.

    Args:
        context: what the controller is connected to.
        every: ticks between two of its steps.
    """

    def __init__(self, context: BenchContext, every: int) -> None:
        self._delay, self._radians = context.delay, context.bases.omega_b * context.T_s
        self.peak_V, self.peak_A = context.bases.V_peak, context.bases.I_peak
        # a voltage that is held for several ticks acts on average half of them later
        self.delay = context.delay + every / 2  # ticks from a sampling to the middle of its effect
        self.speed, self.origin = 1.0, 0.0

    def start(self, speed: float) -> None:
        """Turn at a speed, p.u., from angle 0 at tick 0."""
        self.speed, self.origin = speed, 0.0

    def angle(self, ticks: float) -> float:
        """Angle that many ticks after the start, rad."""
        cycles = self.speed * self._radians / (2 * math.pi) * ticks
        return 2 * math.pi * math.fmod(cycles, 1.0) + self.origin

    def measured(self, y: NDArray[np.float64], tick: int) -> NDArray[np.float64]:
        """Phases of v, i and i_o at a tick, p.u. of the peak value, (3, 3)."""
        space = (y[_PLACES] + 1j * y[_PLACES + 1]) * cmath.exp(1j * self.angle(tick))
        return (space[:, None] * TURNS).real

    def phases(self, e: complex) -> NDArray[np.float64]:
        """Phases (3,) of what acts on average on the bridge after the sampling of tick 0 for e to
        be its voltage, both p.u."""
        return ((e * cmath.exp(1j * self.angle(self.delay))) * TURNS).real

    def acting(self, phases: NDArray[np.float64], tick: int) -> complex:
        """What phases (3,), p.u. of the peak value, are in the frame in the middle of the time for
        which u of a tick acts."""
        space = complex(np.dot(phases, TURNS.conj())) * 2 / 3
        return space * cmath.exp(-1j * self.angle(tick + self._delay + 0.5))
