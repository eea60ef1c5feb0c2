"""A law file's state space for many sets of gains at once.

``gfm_runtime.realisation`` builds one law with all checks, in some milliseconds; a search asks for
thousands. Here the same elements have arrays as coefficients, one number for each of the laws. The
first law decides which factors are shared and which cancel, so its gains must not make two
different factors equal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.elements import ZERO, Element, P, make, usable
from gfm_runtime.lawfile import LawFile, element_numbers
from gfm_runtime.realisation import LawStateSpace, assemble, row_of
from gfm_runtime.signals import NU, NY, U_NAMES

Columns = Mapping[str, NDArray[np.float64]]  # parameters by name, shape (N,) each


@np.errstate(all="ignore")  # such a row is not usable
def realise_each(file: LawFile, numbers: Columns) -> LawStateSpace:
    """The law at N sets of parameters: as ``realise``, every matrix with a leading axis of N.

    Rows in which an element is out of its bounds are NaN. In row 0 different factors must have
    different values.
    """
    good = np.ones(max(len(c) for c in numbers.values()), dtype=bool)
    cells: dict[str, dict[str, Element]] = {"phi": {}, "psi": {}}
    for matrix, of in (("phi", file.phi), ("psi", file.psi)):
        for key, specs in of.items():
            product = P(1.0)
            for spec in specs:
                own = element_numbers(f"{matrix}_{key}", spec, numbers)
                good &= usable(own)
                product = product * make(f"{matrix}_{key}", spec.type, own)
            cells[matrix][key] = product
    rows = []
    for i in range(NU):
        phi, psi = ([of.get(f"{i + 1}{j + 1}", ZERO) for j in range(NY)] for of in cells.values())
        rows.append(row_of(phi, psi, smooth=True))
    out = assemble(rows, [getattr(file.u_0, name) for name in U_NAMES])
    A, D_y = (np.broadcast_to(m, (len(good), *m.shape[-2:])).copy() for m in (out.A, out.D_y))
    A[~good], D_y[~good] = np.nan, np.nan
    return replace(out, A=A, D_y=D_y)
