"""Elements of a law file from the linear systems of python-control and SciPy.

A system is known by what it has (A, B, C, D; num and den; or zeros, poles and gain), so that
neither package is needed here.
"""

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_runtime.elements import Element, transfer
from gfm_runtime.errors import LawError
from gfm_runtime.signals import NU, NY

Factors = list[dict[str, Any]]  # a cell of a law file
FREE = 10.0  # by which factor a synthesis may move a gain


def cells_of(system: Any, shape: tuple[int, int] = (NU, NY)) -> list[list[Factors]]:
    """The cells of a continuous system, row by row; a cell that is 0 is empty.

    Raises:
        UserError: it is none, is sampled, or has another shape.
        LawError: a state space is unstable.
    """
    if (step := getattr(system, "dt", None)) not in (None, 0):
        raise UserError(f"system: is sampled (dt = {step}); Φ(s) is in continuous time")
    if not hasattr(system, "A") and hasattr(system, "gain"):  # SciPy's third form
        system = system.to_tf()
    if hasattr(system, "A"):
        A, B, C, D = (np.atleast_2d(np.asarray(getattr(system, n), float)) for n in "ABCD")
        try:
            cells = [[_factors(one) for one in row] for row in transfer(A, B, C, D)]
        except LawError:
            raise
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            raise UserError("system: its numbers are too far apart to compute with") from None
    elif hasattr(system, "num") and hasattr(system, "den"):
        num, den = (_grid(system, name) for name in ("num", "den"))
        cells = [
            [fraction(a, b) for a, b in zip(*rows, strict=True)]
            for rows in zip(num, den, strict=True)
        ]
    else:
        raise UserError(f"system: {type(system).__name__} is no transfer function or state space")
    got = (len(cells), len(cells[0]))
    if got != shape:
        raise UserError(f"system: is {got[0]} × {got[1]}; must be {shape[0]} × {shape[1]}")
    return cells


def _grid(system: Any, name: str) -> Any:
    """num or den row by row; SciPy has one cell and no rows."""
    grid = getattr(system, f"{name}_list", getattr(system, name))
    return [[grid]] if isinstance(grid[0], Real) else grid


def _factors(element: Element) -> Factors:
    dens = [list(factor[::-1]) for factor in element.den] or [[1.0]]
    above = [list(element.num[::-1]), *([1.0] for _ in dens[1:])]
    made: Factors = [{"type": "TF", "num": n, "den": d} for n, d in zip(above, dens, strict=True)]
    return [] if element.is_zero else made


def fraction(num: Sequence[float], den: Sequence[float]) -> Factors:
    """The cell num(s)/den(s), coefficients in descending powers of s.

    Raises:
        UserError: they are no numbers.
    """
    try:
        above, below = ([float(c) for c in np.atleast_1d(part)] for part in (num, den))
    except (TypeError, ValueError):
        raise UserError(f"({num!r}, {den!r}): must be two lists of numbers") from None
    while len(above) > 1 and above[0] == 0.0:
        del above[0]
    return [{"type": "TF", "num": above, "den": below}] if any(above) else []


def cell_of(value: Any) -> Factors:
    """One cell: a number, (num, den), or a system of one input and output.

    Raises:
        UserError: it is none of these.
        LawError: as ``cells_of``.
    """
    if value is None or isinstance(value, Real):
        return [{"type": "P", "k": float(value)}] if value else []
    if isinstance(value, tuple) and len(value) == 2:
        return fraction(*value)
    return cells_of(value, (1, 1))[0][0]


def read_matrix(cells: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """As ``content_of``, of cells that ``cell_of`` reads or that are as in a law file.

    Raises:
        UserError: other than 3 rows of 5, and as ``cell_of``.
        LawError: as ``cell_of``.
    """
    if len(cells) != NU or any(len(row) != NY for row in cells):
        raise UserError(f"cells: must be {NU} rows of {NY}")
    made = [[Factors()] * NY for _ in range(NU)]
    ready = dict[str, Any]()
    for i, row in enumerate(cells):
        for j, value in enumerate(row):
            where = f"{i + 1}{j + 1}"
            if isinstance(value, Mapping | list):
                ready[where] = value
                continue
            try:
                made[i][j] = cell_of(value)
            except UserError as problem:
                raise UserError(f"phi_{where}: {problem}") from None
            except LawError as problem:
                raise LawError(f"phi_{where}, {problem.where}", problem.why) from None
    content = content_of(made)
    return {**content, "phi": content["phi"] | ready}


def content_of(cells: Sequence[Sequence[Factors]]) -> dict[str, Any]:
    """The tables phi and parameters of a law file, with a gain for each cell, which a synthesis
    may move."""
    phi, parameters = dict[str, Any](), dict[str, Any]()
    for i, row in enumerate(cells, 1):
        for j, factors in enumerate(row, 1):
            if factors:
                gain, k = f"k_{i}{j}", factors[0].get("k", 1.0)
                phi[f"{i}{j}"] = [{**factors[0], "k": gain}, *factors[1:]]
                parameters[gain] = {
                    "value": k,
                    "source": f"gain of phi_{i}{j}",
                    "free": sorted((k / FREE, k * FREE)),
                }
    return {"phi": phi, "parameters": parameters}
