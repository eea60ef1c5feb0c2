"""A law: the 3x5 grid of elements Phi(s), its error map, set-points and limits.

    u = u_0 + Phi(s) (Y_ref - y) - Psi(s) y                       (Fig. 6 of the paper)

``phi`` holds the elements of Table II; ``psi`` holds its ``{}`` terms, which act on the feedback
channel only. With a nonlinear error map the references and measurements are mapped first
(``gfm_runtime.error_maps``); column 3 feeds back the law's own omega_u.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from gfm_runtime.elements import INTEGRATOR, ZERO, Element
from gfm_runtime.errors import LawError, Mistakes, meant
from gfm_runtime.inner import Inner
from gfm_runtime.signals import NU, NY, REF_NAMES, U_NAMES

Cell = tuple[int, int]  # (i, j), zero-based row of u and column of y


def cell_name(matrix: str, cell: Cell) -> str:
    """The paper's name of a cell, e.g. ``phi_22``; the matrix is ``"phi"`` or ``"psi"``."""
    return f"{matrix}_{cell[0] + 1}{cell[1] + 1}"


@dataclass(frozen=True)
class Limits:
    """The clamps of u and the anti-windup.

    Attributes:
        low, high: shape (3,), p.u., for (i_u, omega_u, E_u).
        T_t: tracking time constant of the anti-windup, s: while a row is clamped its slowest
            state follows the clamped output with this time constant (back-calculation).
        T_off: time constant with which the offset left by a bumpless change decays, s.
    """

    low: tuple[float, float, float] = (-5.0, 0.9, 0.0)
    high: tuple[float, float, float] = (5.0, 1.1, 1.5)
    T_t: float = 0.02
    T_off: float = 0.2

    def __post_init__(self) -> None:
        mistakes = Mistakes()
        for name, low, high in zip(U_NAMES, self.low, self.high, strict=True):
            with mistakes.noting():
                if not low < high:
                    raise LawError(f"limits.{name}", f"[{low:g}, {high:g}] must be ascending")
        for name in ("T_t", "T_off"):
            with mistakes.noting():
                if not getattr(self, name) > 0.0:
                    raise LawError(f"limits.{name}", f"{getattr(self, name):g} s must be > 0")
        mistakes.check()


@dataclass(frozen=True)
class Parameter:
    """A named number of a law: value, unit and source."""

    value: float
    unit: str
    source: str


@dataclass(frozen=True)
class HomeGrid:
    """The grid a law's defaults are meant for, as factors on the converter's L_g and R_g."""

    L_g: float = 1.0
    R_g: float = 1.0
    note: str = "the paper's grid"


@dataclass(frozen=True)
class Law:
    """One grid-forming law as data.

    Attributes:
        name: e.g. ``"vsg-2"``.
        title, source: for tables and reports; the source names table, equation or paper.
        phi: elements on the errors, by zero-based (row, column); absent means 0.
        psi: the ``{}`` terms on the measurements alone; u_i is lowered by psi_ij(s) y_j.
        u_0: set-points of u; a number in p.u., or the name of the reference it follows.
        error_map: name in ``gfm_runtime.error_maps.ERROR_MAPS``.
        error_parameters: (R, X) in p.u. for maps that need an impedance, else ().
        limits: clamps and anti-windup.
        parameters: the named numbers the elements were computed from.
        home_grid: grid on which the defaults are stable.
        inner: the inner stage between the law and the bridge; None: the bridge produces E_u.
    """

    name: str
    title: str
    source: str
    phi: Mapping[Cell, Element]
    psi: Mapping[Cell, Element] = field(default_factory=dict)
    u_0: tuple[float | str, float | str, float | str] = (0.0, 1.0, 1.0)
    error_map: str = "linear"
    error_parameters: tuple[float, ...] = ()
    limits: Limits = Limits()
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    home_grid: HomeGrid = HomeGrid()
    inner: Inner | None = None

    def __post_init__(self) -> None:
        mistakes = Mistakes()
        for matrix, cells in (("phi", self.phi), ("psi", self.psi)):
            for cell, element in cells.items():
                with mistakes.noting():
                    if not (0 <= cell[0] < NU and 0 <= cell[1] < NY):
                        raise LawError(cell_name(matrix, cell), "row must be 1..3, column 1..5")
                    _check(cell_name(matrix, cell), element)
        for name, value in zip(U_NAMES, self.u_0, strict=True):
            with mistakes.noting():
                if value not in REF_NAMES if isinstance(value, str) else not math.isfinite(value):
                    raise LawError(
                        f"u_0.{name}",
                        f"{value!r} is neither a finite number nor one of {list(REF_NAMES)}"
                        + meant(value, REF_NAMES),
                    )
        mistakes.check()

    def element(self, matrix: str, cell: Cell) -> Element:
        """The element of ``"phi"`` or ``"psi"`` at a cell, ZERO where there is none."""
        cells = self.phi if matrix == "phi" else self.psi
        return cells.get(cell, ZERO)

    def dynamic(self, row: int | None = None) -> str:
        """The elements with states of one row, or of all, by the paper's names."""
        found = {
            cell_name(matrix, cell)
            for matrix, cells in (("phi", self.phi), ("psi", self.psi))
            for cell, element in cells.items()
            if element.den and row in (None, cell[0])
        }
        return ", ".join(sorted(found)) or self.name

    def __call__(self, s: complex) -> list[list[complex]]:
        """Phi(s) at the complex frequency s [rad/s], 3 rows of 5."""
        return [[self.element("phi", (i, j))(s) for j in range(NY)] for i in range(NU)]


def _check(where: str, element: Element) -> None:
    if not all(math.isfinite(c) for part in (element.num, *element.den) for c in part):
        raise LawError(where, "a coefficient is not finite")
    if not element.is_proper:
        raise LawError(
            where,
            f"improper: its numerator has degree {len(element.num) - 1}, its denominator "
            f"{element.order}; give a filter T_f to D or PD, or multiply by an IF",
        )
    for factor in element.den:
        # of degree one or two: stable when, and only when, all its coefficients are positive
        if factor != INTEGRATOR and not (len(factor) in (2, 3) and min(factor) > 0.0):
            raise LawError(where, f"unstable factor {factor} (ascending powers of s)")
    if element.den.count(INTEGRATOR) > 1:
        raise LawError(where, "unstable: a double integrator 1/s^2")
