"""The least stable mode of a law on the paper's converter, and the states that take part in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gfm_design.model.closed_loop import U_CARRIED, Y_CARRIED, ClosedLoop
from gfm_design.model.linear import Mode
from gfm_runtime.signals import U_NAMES, Y_NAMES

_PLANT = ("i_d", "i_q", "v_d", "v_q", "i_od", "i_oq", "delta", "v_dc")  # gfm_plant.model
_SENSORS = tuple(f"sensor of {name}" for name in Y_NAMES if name != "omega_u")
_SHOWN = 4


@dataclass(frozen=True)
class LeastStable:
    """A mode of a loop, and its largest participation factors by state.

    The factor of state k is |l_k r_k| of the mode's left and right eigenvectors, divided by the sum
    over all states (Pérez-Arriaga, Verghese and Schweppe, 1982).
    """

    mode: Mode
    states: tuple[tuple[str, float], ...]

    def words(self) -> str:
        """The mode and its states in one line."""
        who = ", ".join(f"{name} {100 * share:.0f} %" for name, share in self.states)
        return f"{self.mode.words()}: {who}"


def least_stable(loop: ClosedLoop) -> LeastStable:
    """The mode of a loop with the largest sigma, and the states that take part in it."""
    values, right = np.linalg.eig(loop.A)
    k = int(np.argmax(values.real if loop.T_s is None else np.abs(values)))
    shares = np.abs(np.linalg.inv(right)[k] * right[:, k])
    s = complex(values[k]) if loop.T_s is None else np.log(complex(values[k])) / loop.T_s
    names, shares = _states(loop), shares / shares.sum()
    assert len(names) == len(shares)
    largest = tuple((names[n], float(shares[n])) for n in np.argsort(-shares)[:_SHOWN])
    return LeastStable(Mode.of(s), largest)


def _states(loop: ClosedLoop) -> list[str]:
    """Names of the states of a single loop, in their order."""
    size, acts = len(loop.plant.A) - len(_PLANT), loop.plant.B.any(axis=0)
    names = [*_PLANT, *["integral of the DC source"] * (size % len(_SENSORS))]
    names += _SENSORS if size >= len(_SENSORS) else ()
    late = [*zip(U_CARRIED, loop.u_delay * acts, strict=False)]
    late += zip(Y_CARRIED, loop.y_delay, strict=False)
    for name, delay in late if loop.T_s else ():
        names += [f"{name} on its way"] * int(np.ceil(delay / loop.T_s - 1e-9))
    if loop.stage is not None and loop.stage.has_pll:
        names.append("omega_u that acts")
    names += [f"law's state of {U_NAMES[row]}" for row in loop.law.rows]
    return [*names, *(loop.stage.states if loop.stage else ())]
