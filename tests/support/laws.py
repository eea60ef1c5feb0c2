"""Helpers of the runtime's tests: rows and blocks in the simplest form, plausible inputs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from numba import njit
from numpy.typing import NDArray
from scipy import signal

from gfm_runtime import (
    BuiltLaw,
    DiscreteLaw,
    get_law,
    law_names,
    load_law,
    pack_law,
    state_dtype,
    step,
)
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.inner import GridFollowingStage, InnerStage
from gfm_runtime.signals import NU, NY, REF_NAMES

from .files import text_of

repeatable = settings(derandomize=True)  # the same examples in every run

Vector = NDArray[np.float64]

REF = np.array([1.0, 0.5, 1.0, 0.0, 1.0])

#: all that a law file can say
EVERYTHING = text_of("everything.toml")

#: Every shipped law, each stage of a scheduled law separately.
LAWS = {
    law.name if len(s.laws) == 1 else f"{law.name}[{k}]": law
    for s in map(load_law, law_names())
    for k, law in enumerate(s.laws)
}


def behind(law: str, stage: InnerStage | None) -> BuiltLaw:
    """A law of the catalogue with a stage: the grid-following one where it takes no other."""
    follows = isinstance(stage, GridFollowingStage)
    return replace(get_law("grid-following" if follows else law), inner=stage)


def structure(name: str) -> tuple[object, ...]:
    """What makes two laws run the same code: error map, schedule, states of each row of Φ."""
    laws = load_law(name).laws
    orders = [sum(e.order for (i, _), e in laws[0].phi.items() if i == row) for row in range(NU)]
    return laws[0].error_map, len(laws) > 1, *(min(order, 3) for order in orders)


def every_law() -> list[Any]:
    """All laws as parameters of a test: one of each structure is fast, the others are ``full``."""
    first: dict[tuple[object, ...], str] = {}
    for name in law_names():
        first.setdefault(structure(name), name)
    return slow_but(first.values(), law_names())


def slow_but(fast: Iterable[Any], values: Iterable[Any]) -> list[Any]:
    """Values of a parameter of a test; all but the ``fast`` ones are ``full``."""
    few = [*fast]
    return [pytest.param(v, marks=() if v in few else pytest.mark.full) for v in values]


@dataclass(frozen=True)
class Blocks:
    """dx/dt = A x + B w, u = C x + D w with w = (r, y, u_0), element by element, loop closed.

    It does not use ``realisation``: each element is a separate block from SciPy, no state is
    shared, and the omega_u loop is closed in continuous time.
    """

    A: Vector
    B: Vector
    C: Vector
    D: Vector


def blocks(law: BuiltLaw) -> Blocks:
    """A law in its simplest form, with far more states than it needs."""
    parts = []
    for sign_r, cells in ((1.0, law.phi), (0.0, law.psi)):
        for (i, j), e in cells.items():
            den = np.array([1.0])
            for factor in e.den:
                den = np.convolve(den, factor)
            if e.is_zero:
                continue
            a, b, c, d = signal.tf2ss(e.num[::-1], den[::-1])
            parts.append((i, j, sign_r, a if e.order else np.zeros((0, 0)), b, c, d))
    n = sum(len(p[3]) for p in parts)
    A, B = np.zeros((n, n)), np.zeros((n, 2 * NY + NU))
    C, D = np.zeros((NU, n)), np.zeros((NU, 2 * NY + NU))
    at = 0
    for i, j, sign_r, a, b, c, d in parts:
        k = slice(at, at + len(a))
        at += len(a)
        if len(a):
            A[k, k], C[i, k] = a, c[0]
            B[k, j], B[k, NY + j] = sign_r * b[:, 0], -b[:, 0]
        D[i, j] += sign_r * d[0, 0]
        D[i, NY + j] -= d[0, 0]
    D[:, 2 * NY :] = np.eye(NU)
    gain = 1.0 / (1.0 - D[1, NY + 2])
    b3, d3 = B[:, [NY + 2]].copy(), D[:, [NY + 2]].copy()
    B[:, NY + 2], D[:, NY + 2] = 0.0, 0.0
    A, B = A + gain * b3 @ C[[1]], B + gain * b3 @ D[[1]]
    return Blocks(A, B, C + gain * d3 @ C[[1]], D + gain * d3 @ D[[1]])


def u_0(law: BuiltLaw, ref: Vector) -> Vector:
    """Set-points of u, those that follow a reference included."""
    return np.array([ref[REF_NAMES.index(v)] if isinstance(v, str) else v for v in law.u_0])


def mapped(law: BuiltLaw, ref: Vector, y: Vector) -> tuple[Vector, Vector]:
    """Mapped copies of references and measurements."""
    r, y = ref.copy(), y.copy()
    map_errors(ERROR_MAPS[law.error_map], np.array([*law.error_parameters, 0.0, 0.0])[:2], r, y)
    return r, y


@njit
def drive(law, state, ref, y, u, ticks):
    """Run ``ticks`` ticks with the same inputs; ``u`` is that of the last one."""
    for _ in range(ticks):
        step(law[0], state[0], ref, y, u)


@dataclass
class Running:
    """A law in the kernel."""

    law: NDArray[Any]
    state: NDArray[Any]

    @staticmethod
    def of(discrete: DiscreteLaw, real: type = np.float64) -> Running:
        return Running(pack_law(discrete, real), np.zeros(1, state_dtype(real)))

    def step(self, ref: Vector, y: Vector) -> Vector:
        u = np.zeros(NU)
        step(self.law[0], self.state[0], ref, y, u)
        return u

    def settle(self, ticks: int, ref: Vector = REF, y: Vector = REF) -> Vector:
        """u after ``ticks`` ticks with the same inputs."""
        u = np.zeros(NU)
        drive(self.law, self.state, ref, y, u, ticks)
        return u

    def run(self, refs: Vector, ys: Vector) -> Vector:
        """One row of u per row of references and measurements."""
        return np.array([self.step(r, y) for r, y in zip(refs, ys, strict=True)])

    def unlimited(self) -> Running:
        """The same law without limits."""
        self.law["low"], self.law["high"] = -np.inf, np.inf
        return self


def wander(ticks: int, seed: int = 1, size: float = 0.05) -> tuple[Vector, Vector]:
    """References and measurements (ticks, 5) that vary randomly about the operating point."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.normal(size=(2, ticks, NY)), axis=1) / np.sqrt(ticks)
    return REF + size * slow[0], REF + size * (slow[1] + 0.1 * rng.normal(size=(ticks, NY)))


def home_plant(law: str) -> dict[str, Any]:
    """``plant`` with the grid for which a law's defaults are tuned."""
    grid = get_law(law).home_grid
    return {"factors": {"L_g": grid.L_g, "R_g": grid.R_g}}
