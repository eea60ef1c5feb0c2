"""The mode that stands in a law's way on the paper's converter, and the states that make it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.tolerance import mode_of
from gfm_design.model.case import Case
from gfm_design.model.linear import Mode
from gfm_design.tuning.paper_problem import PaperProblem
from gfm_runtime.lawfile import build_law
from gfm_runtime.realisation import realise
from gfm_runtime.signals import NU, U_NAMES

Matrix = NDArray[np.float64]

PLANT_STATES = ("i_d", "i_q", "v_d", "v_q", "i_od", "i_oq", "delta", "v_dc")  # gfm_plant.model
_SHOWN = 4


@dataclass(frozen=True)
class Culprit:
    """A mode of a loop, and its largest participation factors by state.

    The factor of state k is |l_k r_k| of the mode's left and right eigenvectors, as a share of
    their sum (Pérez-Arriaga, Verghese and Schweppe, 1982).
    """

    mode: Mode
    states: tuple[tuple[str, float], ...]

    def words(self) -> str:
        """In one line."""
        f = self.mode.frequency_hz
        where = f"at {f:.4g} Hz" if f else "(real)"
        who = ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.states)
        return f"mode {where} grows by {self.mode.sigma:.3g} 1/s: {who}"


def culprit(problem: PaperProblem, values: NDArray[np.float64]) -> Culprit:
    """The mode furthest right of the continuous loop at these gains."""
    law = build_law(problem.file, problem.law.named(values))
    names = (*PLANT_STATES, *_law_states(realise(law).rows))
    s, shares = _outermost(problem.loop(values)[0], lambda s: s.real)
    return Culprit(Mode(s.real, abs(s.imag) / (2 * np.pi)), _largest(names, shares))


def late_culprit(case: Case) -> Culprit:
    """The mode furthest out of a case's sampled loop."""
    loop = case.loop()
    ages = [f"{U_NAMES[j]} on its way" for j in range(NU) if loop.plant.B[:, j].any()]
    names = (*PLANT_STATES, *ages, *_law_states(case.law.rows))
    z, shares = _outermost(loop.closed(), np.abs)
    return Culprit(mode_of(z, case.law.T_s), _largest(names, shares))


def _law_states(rows: Sequence[int]) -> list[str]:
    return [f"law's state of {U_NAMES[row]}" for row in rows]


def _outermost(A: Matrix, how_far: Callable[[Any], Any]) -> tuple[complex, Matrix]:
    """The eigenvalue that is furthest, and the participation of each state in it."""
    s, right = np.linalg.eig(A)
    k = int(np.argmax(how_far(s)))
    shares = np.abs(np.linalg.inv(right)[k] * right[:, k])
    return complex(s[k]), shares / shares.sum()


def _largest(names: Sequence[str], shares: Matrix) -> tuple[tuple[str, float], ...]:
    assert len(names) == len(shares)
    return tuple((names[n], float(shares[n])) for n in np.argsort(-shares)[:_SHOWN])
