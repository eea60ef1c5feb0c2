"""Stability of a network against the share of its converters that form the grid.

One converter after the other gets a law that follows the grid, at the power that it had, so that
only the dynamics change. The share is that of the forming ones in the rating of all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.network import NetworkMode
from gfm_design.model.operating_point import OperatingPoint
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario, plant_of
from gfm_hil.studies.linear_loop import initial_law, linearise, network_loop
from gfm_hil.studies.workers import SILENT, Watch
from gfm_plant import NoEquilibrium
from gfm_plant.model import V_DC
from gfm_runtime import BuiltLaw, load_law
from gfm_runtime.inner import GridFollowingStage
from gfm_runtime.signals import REF_NAMES, U_NAMES

BEST = "best"
FOLLOWING = "grid-following"
_P, _Q = REF_NAMES.index("P_ref"), REF_NAMES.index("Q_ref")
_OMEGA = U_NAMES.index("omega_u")


@dataclass(frozen=True)
class FormingShare:
    """A network in which some converters form the grid, and the others follow it."""

    share: float  #: of the forming ones in the rating of all converters
    follows: str  #: the last one that was made to follow; empty at first
    forming: tuple[str, ...]  #: those that form
    mode: NetworkMode | None  #: the one with the largest sigma; None: there is no linear loop
    reason: str  #: why there is none
    #: P_ref and Q_ref, p.u., of each that was made to follow, with which it keeps its current
    references: dict[str, dict[str, float]]

    @property
    def sigma(self) -> float:
        """That of the mode, 1/s; infinite without one."""
        return np.inf if self.mode is None else self.mode.sigma

    def plain(self) -> dict[str, Any]:
        """As plain data."""
        mode = None if self.mode is None else self.mode.plain()
        return {
            "share": self.share, "follows": self.follows, "forming": [*self.forming],
            "stable": self.sigma < 0.0, "mode": mode, "reason": self.reason,
            "references": self.references,
        }  # fmt: skip


def forming_shares(
    scenario: Scenario, law: str = FOLLOWING, order: str | Sequence[str] = (), watch: Watch = SILENT
) -> list[FormingShare]:
    """The stability of a network while one converter after the other follows the grid, from all
    that form it in the scenario to none.

    Args:
        scenario: with a network.
        law: of those that follow.
        order: in which they do: all names, or some that come first; then in the network's order.
            ``"best"`` takes each time the one that leaves the largest sigma least.
        watch: told the loops done.

    Raises:
        UserError: there is no network, no such converter, a law that does not follow the grid, or
            no steady state at the start.
    """
    if scenario.network is None:
        raise UserError(f"{scenario.title}: has no network")
    follows = load_law(law).first
    if not isinstance(follows.inner, GridFollowingStage):
        raise UserError(f"{law}: forms the grid; name a law that follows it, such as {FOLLOWING}")
    own = {name: initial_law(one)[0].law for name, one in scenario.each.items()}
    forming = [name for name, one in own.items() if not _follows(one)]
    if unknown := [name for name in order if order != BEST and name not in forming]:
        raise UserError(f"{unknown[0]!r}: must be one of those that form the grid, {forming}")
    if order != BEST:
        forming = list(dict.fromkeys([*order, *forming]))
    loop = network_loop(scenario)
    references = {m.name: _as_it_is(follows.inner, m.ref, m.op) for m in loop.members}
    ratings = dict(zip(loop.names, 1.0 / plant_of(scenario).par["current"], strict=True))
    total, whole, all_forming = sum(ratings.values()), len(forming), tuple(forming)
    loops, done = (whole * (whole + 1) // 2 if order == BEST else whole), 0

    def step(left: Sequence[str], name: str) -> FormingShare:
        """The network in which those ``left`` form, and ``name`` is the last one to follow."""
        changed = {one: references[one] for one in all_forming if one not in left}
        share = sum(ratings[one] for one in left) / total
        mode, reason = None, ""
        try:
            mode = linearise(scenario, dict.fromkeys(changed, follows), changed).modes()[0]
        except NoEquilibrium as problem:
            reason = str(problem)
        kept = {
            one: {"P_ref": float(ref[_P]), "Q_ref": float(ref[_Q])} for one, ref in changed.items()
        }
        return FormingShare(float(share), name, tuple(left), mode, reason, kept)

    steps = [step(forming, "")]
    while forming:
        each = list[FormingShare]()
        for name in forming if order == BEST else forming[:1]:
            if watch.stopped():
                raise KeyboardInterrupt
            each.append(step([one for one in forming if one != name], name))
            watch.progress(done := done + 1, loops, name)
        steps.append(min(each, key=lambda one: one.sigma))
        forming = [name for name in forming if name != steps[-1].follows]
    return steps


def _as_it_is(
    stage: GridFollowingStage, ref: NDArray[np.float64], op: OperatingPoint
) -> NDArray[np.float64]:
    """The references (5,), p.u., with which a stage holds the current that a converter has now."""
    i, v = (complex(*op.x[2 * k : 2 * k + 2]) for k in range(2))
    V = abs(v)
    missing = i * v.conjugate() / V - stage.wanted(ref, float(op.x[V_DC]), V, float(op.u[_OMEGA]))
    references = ref.copy()
    references[_P] += missing.real * max(V, stage.V_least)
    references[_Q] -= missing.imag * max(V, stage.V_least)
    return references


def _follows(law: BuiltLaw) -> bool:
    return isinstance(law.inner, GridFollowingStage)
