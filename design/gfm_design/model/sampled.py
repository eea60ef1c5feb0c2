"""The sampled loop with any delay in any channel, whole samples or not, exact.

u_j[k] acts ``u_delay[j]`` seconds after its tick, through its own hold; y_i is read as it was
``y_delay[i]`` seconds before the tick, between samples too. Both are shifts of continuous
signals, so the answer is that of the plant itself and no approximation of e^(-s tau).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearLaw, LinearPlant, hold
from gfm_runtime.signals import NU, NY

Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

_WHOLE = 1e-9  # samples; a fraction below this is rounding


@dataclass(frozen=True)
class SampledPlant:
    """x[k+1] = A x + B u,  y = C x: states are the plant's, then its delay lines."""

    A: Matrix
    B: Matrix
    C: Matrix


@dataclass(frozen=True)
class SampledLoop:
    """A law on a linear plant, both around one operating point.

    Attributes:
        T_s: sampling time, s.
        delay: from the tick that samples y[k] to the moment when u[k] acts, s.
    """

    plant: LinearPlant
    law: LinearLaw
    T_s: float
    delay: float

    @property
    def commands(self) -> tuple[int, ...]:
        """Those of u that act: i_u does not where the DC source regulates itself."""
        acts = self.plant.B.any(axis=0) & (self.law.C.any(axis=1) | self.law.D.any(axis=1))
        return tuple(int(j) for j in np.flatnonzero(acts))

    @property
    def measurements(self) -> tuple[int, ...]:
        """Those of y that the law uses for a command that acts."""
        used = self.law.B.any(axis=0) | self.law.D[list(self.commands)].any(axis=0)
        return tuple(int(i) for i in np.flatnonzero(used & self.plant.C.any(axis=1)))

    def with_delay(
        self, u_extra: Matrix | float = 0.0, y_extra: Matrix | float = 0.0
    ) -> SampledPlant:
        """The plant with more delay in u (3,) and in y (5,), s; one number is for all channels."""
        u_delay = self.delay + np.broadcast_to(u_extra, NU)
        return sampled_plant(self.plant, self.T_s, u_delay, np.broadcast_to(y_extra, NY))

    def closed(self, plant: SampledPlant | None = None) -> Matrix:
        """The closed loop's matrix from tick to tick; state: plant, delay lines, law."""
        p, c = plant or self.with_delay(), self.law
        return np.block([[p.A + p.B @ c.D @ p.C, p.B @ c.C], [c.B @ p.C, c.A]])

    def factored(self, u: Response | float = 1.0, y: Response | float = 1.0) -> Response:
        """As ``closed`` with u (3,) and y (5,) multiplied on their way, by complex numbers too."""
        p, c = self.with_delay(), self.law
        B = p.B * np.broadcast_to(u, NU)
        C = p.C * np.broadcast_to(y, NY)[:, None]
        return np.block([[p.A + B @ c.D @ C, B @ c.C], [c.B @ C, c.A]])


def sampled_plant(plant: LinearPlant, T_s: float, u_delay: Matrix, y_delay: Matrix) -> SampledPlant:
    """The plant from tick to tick, u_delay (3,) and y_delay (5,) in s, all >= 0."""
    n = len(plant.A)
    # a command that does not act needs no delay line
    u_split = [_split(d, T_s) if plant.B[:, j].any() else (0, 0.0) for j, d in enumerate(u_delay)]
    y_split = [_split(d, T_s) for d in y_delay]
    u_lines = [whole + (part > 0.0) for whole, part in u_split]
    y_lines = [whole + (part > 0.0) for whole, part in y_split]
    u_at = n + np.concatenate([[0], np.cumsum(u_lines)]).astype(int)
    y_at = u_at[-1] + np.concatenate([[0], np.cumsum(y_lines)]).astype(int)
    size = int(y_at[-1])
    holds: dict[float, tuple[Matrix, Matrix]] = {}

    def over(t: float) -> tuple[Matrix, Matrix]:
        if t not in holds:
            holds[t] = hold(plant.A, plant.B, t)
        return holds[t]

    def command(j: int, age: int) -> int:
        """Where u_j[k - age] stands among (state, u[k])."""
        return size + j if age == 0 else u_at[j] + age - 1

    def after(t: float) -> Matrix:
        """The plant's state a time t <= T_s behind tick k, from (state, u[k])."""
        out = np.zeros((n, size + NU))
        out[:, :n] = over(t)[0]
        for j, (whole, part) in enumerate(u_split):
            old = min(t, part * T_s)
            through, by_new = over(t - old)
            out[:, command(j, whole)] += by_new[:, j]
            if old > 0.0:
                out[:, command(j, whole + 1)] += through @ over(old)[1][:, j]
        return out

    step = np.zeros((size, size + NU))
    C = np.zeros((NY, size))
    step[:n] = after(T_s)
    for j in range(NU):
        for age in range(u_lines[j]):
            step[u_at[j] + age, command(j, age)] = 1.0
    for i, (whole, part) in enumerate(y_split):
        if whole == 0 and part == 0.0:
            C[i, :n] = plant.C[i]
            continue
        # what enters the line at tick k is y_i at k + 1 - part, or at k
        now = after((1.0 - part) * T_s) if part > 0.0 else np.eye(n, size + NU)
        step[y_at[i]] = plant.C[i] @ now
        for age in range(1, y_lines[i]):
            step[y_at[i] + age, y_at[i] + age - 1] = 1.0
        C[i, y_at[i] + y_lines[i] - 1] = 1.0
    return SampledPlant(step[:, :size], step[:, size:], C)


def _split(delay: float, T_s: float) -> tuple[int, float]:
    """Whole samples and what is left of one."""
    samples = float(delay) / T_s
    whole = int(np.floor(samples + _WHOLE))
    part = samples - whole
    return whole, part if part > _WHOLE else 0.0


def outermost(A: Matrix | Response) -> complex:
    """The eigenvalue furthest from z = 0."""
    z = np.linalg.eigvals(A)
    return complex(z[np.argmax(np.abs(z))])
