"""A law: the 3x5 grid of elements Phi(s), its error map, set-points and limits.

    u = u_0 + Phi(s) (Y_ref - y) - Psi(s) y                       (Fig. 6 of the paper)

``phi`` holds the elements of Table II; ``psi`` holds its ``{}`` terms, which act on the feedback
channel only. With a nonlinear error map the references and measurements are mapped first
(``gfm_runtime.error_maps``); column 3 feeds back the law's own omega_u.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from gfm_runtime.counts import Counts
from gfm_runtime.elements import INTEGRATOR, ZERO, Element, stable
from gfm_runtime.error_maps import MAPPED
from gfm_runtime.errors import LawError, Mistakes, meant
from gfm_runtime.inner import InnerStage
from gfm_runtime.signals import NU, NY, REF_NAMES, U_NAMES
from gfm_runtime.toml_file import TomlTable

Cell = tuple[int, int]  # (i, j), zero-based row of u and column of y


def cell_name(matrix: str, cell: Cell) -> str:
    """The paper's name of a cell, e.g. ``phi_22``; the matrix is ``"phi"`` or ``"psi"``."""
    return f"{matrix}_{cell[0] + 1}{cell[1] + 1}"


def _ascending(value: tuple[float, float]) -> tuple[float, float]:
    if not value[0] < value[1]:
        raise PydanticCustomError("ascending", "must be [low, high], ascending")
    return value


Range = Annotated[tuple[float, float], Field(strict=False)]  # [low, high]
Limit = Annotated[Range, AfterValidator(_ascending), Field(description="[low, high], p.u.")]


class Limits(TomlTable):
    """The clamps of u, p.u., and the anti-windup."""

    i_u: Limit = (-5.0, 5.0)
    omega_u: Limit = (0.9, 1.1)
    E_u: Limit = (0.0, 1.5)
    # while a row is clamped its slowest state follows the clamped output (back-calculation)
    T_t: float = Field(0.02, gt=0, description="tracking time constant of the anti-windup, s")
    T_off: float = Field(0.2, gt=0, description="decay of the offset left by a change of law, s")

    @property
    def low(self) -> tuple[float, float, float]:
        """Of (i_u, omega_u, E_u), p.u."""
        return self.i_u[0], self.omega_u[0], self.E_u[0]

    @property
    def high(self) -> tuple[float, float, float]:
        """Of (i_u, omega_u, E_u), p.u."""
        return self.i_u[1], self.omega_u[1], self.E_u[1]


class Parameter(TomlTable):
    """A named number; ``free`` bounds it for synthesis, ``tied`` makes it follow others there."""

    # of a file with a base, what the base says of the number may be missing here
    model_config = ConfigDict(json_schema_extra=lambda schema: schema.pop("required"))

    value: float = Field(allow_inf_nan=False, description="the number, in its unit")
    unit: str = Field("", description="e.g. p.u. or 1/s")
    source: str = Field("", description="where the number comes from")
    free: Range | None = Field(None, description="[low, high] within which a synthesis may move it")
    tied: str | None = Field(
        None, description="expression that it follows while a synthesis moves others"
    )


class HomeGrid(TomlTable):
    """The grid the defaults are meant for, as factors on the converter's L_g and R_g."""

    L_g: float = Field(1.0, gt=0, description="factor on the converter's line inductor")
    R_g: float = Field(1.0, ge=0, description="factor on the converter's line resistor")
    note: str = Field("the paper's grid", description="for people")


@dataclass(frozen=True)
class BuiltLaw:
    """One grid-forming law as data."""

    name: str  #: e.g. ``"vsg-2"``.
    #: title, source: for tables and reports; the source names table, equation or paper
    title: str
    source: str
    #: elements on the errors, by zero-based (row, column); absent means 0
    phi: Mapping[Cell, Element]
    #: the ``{}`` terms on the measurements alone; u_i is lowered by psi_ij(s) y_j
    psi: Mapping[Cell, Element] = field(default_factory=dict)
    #: set-points of u; a number in p.u., or the name of the reference it follows
    u_0: tuple[float | str, float | str, float | str] = (0.0, 1.0, 1.0)
    error_map: str = "linear"  #: name in ``gfm_runtime.error_maps.ERROR_MAPS``
    #: (R, X) in p.u. for maps that need an impedance, else ().
    error_parameters: tuple[float, ...] = ()
    limits: Limits = field(default_factory=Limits)  #: clamps and anti-windup
    #: the named numbers the elements were computed from
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    home_grid: HomeGrid = field(default_factory=HomeGrid)  #: grid on which the defaults are stable
    #: the inner stage between the law and the bridge; None: the bridge produces E_u
    inner: InnerStage | None = None
    #: how it measures and modulates; None: its y and u are in p.u.
    counts: Counts | None = None

    def __post_init__(self) -> None:
        mistakes = Mistakes()
        for matrix, cells in (("phi", self.phi), ("psi", self.psi)):
            for cell, element in cells.items():
                with mistakes.noting():
                    if not (0 <= cell[0] < NU and 0 <= cell[1] < NY):
                        raise LawError(cell_name(matrix, cell), "row must be 1..3, column 1..5")
                    _check(cell_name(matrix, cell), element)
        if self.inner is not None:
            idle = sorted(
                cell_name(matrix, cell)
                for matrix, filled in (("phi", self.phi), ("psi", self.psi))
                for cell in filled
                if cell[0] not in self.inner.rows
            )
            with mistakes.noting():
                if idle:
                    why = f"no effect in front of the inner stage {self.inner.kind}, which gives"
                    why += " omega_u and the current itself; a law for it has row 1 only"
                    raise LawError(", ".join(idle), why)
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

    def takes(self, reference: str) -> bool:
        """Whether a reference, by its name, moves its commands."""
        others = MAPPED.get(self.error_map, {}).get(reference, set())
        columns = {REF_NAMES.index(reference), *others}
        rows = (0, 1, 2) if self.inner is None else self.inner.rows
        return (
            reference in (self.u_0[row] for row in rows)
            or any(column in columns and not x.is_zero for (_, column), x in self.phi.items())
            or (self.inner is not None and reference in self.inner.references)
        )

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
            f"{element.order}; give it a pole (den of a TF, T_f of a D or PD, or an IF)",
        )
    for factor in element.den:
        if factor != INTEGRATOR and not stable(factor):
            word = "undamped" if len(factor) == 3 and factor[1] == 0.0 < factor[2] else "unstable"
            raise LawError(where, f"{word} factor {factor} (ascending powers of s)")
    if element.den.count(INTEGRATOR) > 1:
        raise LawError(where, "unstable: a double integrator 1/s^2")
