"""All is at rest at the end."""

from typing import ClassVar, Literal

from pydantic import Field

from gfm_hil.recording.columns import symbol_of
from gfm_hil.run.ripple import remaining_ripple
from gfm_hil.studies.conformity.criteria.base import Clause, Moment
from gfm_hil.studies.conformity.verdict import Verdict


class NoOscillation(Clause):
    """At the end of the run p, V, omega_u and the current are at rest."""

    kind: Literal["no_oscillation"] = Field(description="kind of criterion")
    ripple: float = Field(0.02, gt=0, description="p.u. peak to peak of the strongest sinusoid")

    whole_run: ClassVar[bool] = True

    def judge(self, m: Moment) -> Verdict:
        """The value is the largest ripple, p.u. peak to peak, to four decimals."""
        if m.recording:
            for name in ("p", "V", "omega_u", "i", "omega_g"):
                m.check(name, m.last - round(2.0 / m.T_s), m.last)
        scenario = m.run.scenario.model_copy(update={"expect_ripple": self.ripple})
        ripple = remaining_ripple(scenario, m.run.columns, m.run.events, m.run.ticks)
        if ripple is None:
            return m.cannot_judge("the run is at rest for less than 0.2 s at its end")
        name = ripple.oscillates or max(ripple.pu, key=lambda n: ripple.pu[n])
        size = round(ripple.pu[name], 4)
        moves = f"{size:.2g}" if size else "less than 0.0001"
        text = f"At the end {symbol_of(name)} moves by {moves} p.u. peak to peak at most."
        if ripple.oscillates:
            text = ripple.words()[0].upper() + ripple.words()[1:] + "."
        limit = f"at most {ripple.limit:g} p.u."
        return m.make_verdict(not ripple.oscillates, size, "p.u.", limit, text, name)


CRITERION = NoOscillation
