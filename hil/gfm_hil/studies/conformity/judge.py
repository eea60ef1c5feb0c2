"""What a finished run says to the criteria of a test: nothing runs here, and nothing is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gfm_hil.recording.run import Run
from gfm_hil.studies.conformity.criteria.base import Clause, Moment
from gfm_hil.studies.conformity.under_test import UnderTest
from gfm_hil.studies.conformity.verdict import CANNOT, Verdict


def judge(
    run: Run, criteria: Sequence[Clause], under: UnderTest, others: Mapping[str, Run] | None = None
) -> list[Verdict]:
    """The verdicts of all criteria, each at each of its times.

    Args:
        run: of the converter under test; it may have ended early.
        criteria: of the test and of its part.
        under: what the owner of the converter declares.
        others: the runs of the other converters of a network, which must not trip either.
    """
    T_s, events = run.scenario.T_s, run.scenario.events
    first = min((e.at(T_s) * T_s for e in events), default=0.0)
    return [
        Moment(run, under, others or {}, criterion, at).verdict()
        for criterion in criteria
        for at in criterion.at or [first]
    ]


def cannot(criteria: Sequence[Clause], reason: str) -> list[Verdict]:
    """Verdicts on a run that did not take place, or none of a part without criteria."""
    return [
        Verdict(c.clause, c.kind, getattr(c, "signal", ""), at, at, CANNOT, None, "", "", reason)
        for c in criteria
        for at in c.at or [0.0]
    ]
