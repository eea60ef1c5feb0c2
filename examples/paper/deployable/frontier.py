"""The frontier of docs/deployable.md: the least gamma found for boxes and demands of several sizes.

Usage, in examples/paper: python -m deployable.frontier    (about a quarter of an hour; writes
deployable/frontier.csv, and goes on where a stopped run was)
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from deployable.box import Box
from deployable.robust import Wanted
from deployable.search import deploy
from gfm_design.tuning.gains import free_gains
from gfm_runtime import law_file

TABLE = Path(__file__).resolve().parent / "frontier.csv"
COLUMNS = ("dc", "moved", "value", "gamma", "sigma", "overshoot", "slow", "beyond", "seconds")

_SEED, _ROUNDS, _EVALUATIONS = 0, 3, 1500
_RIG_R = 0.33  # least resistance for which the rig's law is tuned
_RIG_STRONG = 0.035  # overshoot that it is allowed, L_g to x 3
_RIG_GAINS = ("k_21", "k_22", "k_24", "k_31", "k_32", "k_34")  # rows 2 and 3


@dataclass(frozen=True)
class Case:
    """One synthesis: what is moved away from the box of a shipped law, and to where."""

    moved: str
    value: float
    box: Box
    wanted: Wanted

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells its line of the table."""
        return self.box.dc[0], self.moved, f"{self.value:g}"


def cases() -> Iterator[Case]:
    """Resistance and overshoot on the rig; largest delay with the source controlled."""
    easy = Wanted(gamma=np.inf)  # gamma is what is asked for, so it has no ceiling
    for least in (1.0, 0.5, _RIG_R, 0.25, 0.2, 0.1):
        yield rig("R", least, least, _RIG_STRONG)
    for strong in (0.015, 0.06, 0.1, 0.15):
        yield rig("overshoot", strong, _RIG_R, strong)
    for latest in (3.0, 5.0, 7.0, 9.0):
        delays = tuple(np.linspace(1.0, latest, 5))
        yield Case("delay", latest, Box(delay=delays, dc=("controlled",)), easy)


def rig(moved: str, value: float, least: float, strong: float) -> Case:
    """A law for the rig's source alone."""
    R = (least, 1.0, 3.0) if least < 1.0 else (1.0, 3.0)
    demands = Wanted(gamma=np.inf, strong=strong, weak=max(0.15, strong), rig_alpha=None)
    return Case(moved, value, Box(R_f=R, R_g=R, dc=("regulated",)), demands)


def synthesise(case: Case) -> dict[str, object]:
    """The case's line of the table."""
    if case.box.dc == ("controlled",):
        file = law_file("mimo-gfm-deployable")
        gains = free_gains(file)
    else:
        file = law_file("mimo-gfm-deployable-rig")
        gains = free_gains(file, only=_RIG_GAINS)
    found = deploy(file, gains, case.box, case.wanted, _SEED, _ROUNDS, _EVALUATIONS, starts=1)
    numbers = (found.gamma, found.sigma, found.overshoot, found.slow, found.beyond)
    texts = [f"{v:.4g}" for v in (*numbers, found.seconds)]
    return dict(zip(COLUMNS, [*case.key, *texts], strict=True))


def main() -> None:
    """Every case that the table does not have yet."""
    done = set()
    if TABLE.exists():
        with TABLE.open(encoding="utf-8", newline="") as lines:
            done = {(r["dc"], r["moved"], r["value"]) for r in csv.DictReader(lines)}
    else:
        TABLE.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    for case in cases():
        if case.key in done:
            continue
        line = synthesise(case)
        with TABLE.open("a", encoding="utf-8", newline="") as lines:
            csv.DictWriter(lines, COLUMNS, lineterminator="\n").writerow(line)
        print(line, flush=True)


if __name__ == "__main__":
    main()
