"""The mode that stands in a law's way on the paper's converter, and the states that make it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.linear import Mode
from gfm_design.paper_problem import PaperProblem
from gfm_runtime.lawfile import build_law
from gfm_runtime.realise import realise
from gfm_runtime.signals import U_NAMES

PLANT_STATES = ("i_d", "i_q", "v_d", "v_q", "i_od", "i_oq", "delta", "v_dc")  # gfm_plant.model
_SHOWN = 4


@dataclass(frozen=True)
class Culprit:
    """A mode of the continuous loop, and its largest participation factors by state.

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
    """The mode furthest right at these gains."""
    A = problem.loop(values)[0]
    s, right = np.linalg.eig(A)
    k = int(np.argmax(s.real))
    left = np.linalg.inv(right)[k]
    shares = np.abs(left * right[:, k])
    shares /= shares.sum()
    rows = realise(build_law(problem.file, problem.law.named(values))).rows
    names = (*PLANT_STATES, *(f"law state of {U_NAMES[row]}" for row in rows))
    order = np.argsort(-shares)[:_SHOWN]
    mode = Mode(float(s[k].real), float(abs(s[k].imag)) / (2 * np.pi))
    return Culprit(mode, tuple((names[n], float(shares[n])) for n in order))
