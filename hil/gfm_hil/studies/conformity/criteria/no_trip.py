"""Nothing trips."""

from typing import ClassVar, Literal

from pydantic import Field

from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.conformity.criteria.base import Clause, Moment
from gfm_hil.studies.conformity.verdict import FAIL, PASS, Outcome, Verdict

_LASTED = ("completed", "oscillating")


class NoTrip(Clause):
    """The run lasts to its end: no protection trips, and the controller does not go to SAFE."""

    kind: Literal["no_trip"] = Field(description="kind of criterion")

    whole_run: ClassVar[bool] = True
    judges_early_end: ClassVar[bool] = True
    explains: ClassVar[int] = 0
    coarse: ClassVar[tuple[Outcome, ...]] = (PASS, FAIL)

    def judge(self, m: Moment) -> Verdict:
        """The value is how long the run lasted, s; no other converter of a network may trip."""
        run = m.run
        if m.recording and run.status == "completed":
            if not m.recording["trips_seen"]:
                return m.cannot_judge(
                    "without current before the event a recording needs channel trip"
                )
            if run.ticks < run.scenario.ticks:
                return m.cannot_judge(
                    f"the recording ends at {run.ticks * m.T_s:.4g} s of the test"
                )
        end, whole = run.ticks * m.T_s, run.scenario.ticks * m.T_s
        lost = {n: r for n, r in m.others.items() if r.status not in _LASTED}
        ok = run.status in _LASTED and run.ticks >= run.scenario.ticks and not lost
        if ok:
            text = f"Nothing trips in the {whole:g} s of the run."
        elif lost:
            name, other = next(iter(lost.items()))
            what = reason_name(other.summary["reason"])
            text = f"{name} ended at {other.ticks * m.T_s:.4g} s: {other.status}: {what}."
        else:
            text = f"The run should last {whole:g} s, but {m.end()}."
        return m.make_verdict(ok, end, "s", f"at least {whole:g} s", text)


CRITERION = NoTrip
