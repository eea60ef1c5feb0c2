"""p stays in the envelope of what a unit of such damping, inertia and reactance does."""

import math
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from gfm_hil.core.errors import UserError
from gfm_hil.run import checks
from gfm_hil.run.cycles import whole_ticks
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.grid_frequency import GridFrequency
from gfm_hil.scenario.events.grid_impedance import GridImpedance
from gfm_hil.scenario.events.phase_jump import PhaseJump
from gfm_hil.studies.conformity.criteria.base import Moment, UnderTest, Vector, Windowed
from gfm_hil.studies.conformity.verdict import CONSISTENT, Verdict
from gfm_hil.studies.envelopes import Envelope, Unit, phase_jump, rocof, scr_jump
from gfm_hil.studies.unit_fit import measure_unit

_CURVE = 600  # points of a limit in the figure


class InEnvelope(Windowed):
    """The means of p over the last cycle stay in the envelope that DyCoV draws around what a unit
    of the declared damping, inertia and reactance is expected to do. If none are declared they are
    measured, and p that stays inside is only ``consistent with itself``. The event at the time is a
    phase jump, a ramp of the grid's frequency or a jump of its short-circuit ratio."""

    alone: ClassVar[str] = "an envelope is that of a converter alone behind its line"

    kind: Literal["in_envelope"] = Field(description="kind of criterion")
    longest_s: float = Field(0.0, ge=0, description="s that p may be beyond, in one piece")

    def declare(self, under: UnderTest, scenario: Scenario) -> UnderTest:
        """With the unit that is measured by a small phase jump if none is declared."""
        if under.unit is not None:
            return under
        try:
            return under.with_measured(measure_unit(scenario))
        except UserError:
            return under

    def judge(self, m: Moment) -> Verdict:
        """The value is how far p goes beyond its envelope, p.u."""
        unit, P_0 = m.under.unit, m.before("p")
        if unit is None:
            return m.cannot_judge(
                "D, H and X_eff are not declared, and no swing equation fits the answer to a small "
                "phase jump"
            )
        after = m.T_s * np.arange(m.last - m.tick, dtype=np.float64)
        found = _expected(m, unit, after, P_0)
        if found is None:
            return m.cannot_judge("its time is not that of an event with an envelope")
        if not np.isfinite([found.lower, found.upper]).all():
            return m.cannot_judge(f"its envelope has no finite limits at {unit.inertia(2)}")
        if (droops := _by_droop(m, P_0)) > 0.5 * float(np.min(found.upper - found.lower)):
            return m.cannot_judge(
                "the envelope of a ramp knows no droop, and the declared one of "
                f"{100 * m.droop:g} % alone moves p by {droops:.3g} p.u."
            )
        # As DyCoV measures: the mean of the last cycle, and the limits are late by a cycle. In the
        # first one the mean is of before and after, and is not judged.
        cycle = whole_ticks(m.width)
        m.first = max(m.first, m.tick + cycle + 1)
        x = m.means("p", m.first - cycle, m.last)
        low, high = (y[m.first - m.tick :][: len(x)] for y in (found.lower, found.upper))
        t = m.T_s * (m.first + np.arange(len(low), dtype=np.float64))
        w = checks.Window("p", t, x[: len(low)], P_0, m.at)
        wrong = checks.envelope(w, low, high, self.longest_s)
        beyond = float(np.max(np.maximum(np.maximum(low - w.x, w.x - high), 0.0)))
        words = "measured " * m.under.measured
        words += f"D = {unit.D:.3g}, {unit.inertia()}, X_eff = {unit.X_eff:.3g}"
        if wrong is None:
            text = f"p stays in the envelope of {words}" + (
                f", but for {beyond:.2g} p.u. for a time." if beyond > 0 else "."
            )
        else:
            text = f"{wrong.text} The envelope is that of {words}."
        every = max(1, len(t) // _CURVE)
        made = m.make_verdict(
            wrong is None, beyond, "p.u.", "beyond the envelope: 0 p.u.", text, "p"
        )
        if m.under.measured and wrong is None:
            made = replace(made, verdict=CONSISTENT)
        return replace(made, curve=(t[::every], low[::every], high[::every]))


def _by_droop(m: Moment, P_0: float) -> float:
    """How far the declared droop moves p within the declared power, p.u.; 0 if the event is no
    ramp of the frequency."""
    ramps = [e for e in m.run.scenario.events if isinstance(e, GridFrequency) and e.rate]
    if not any(e.at(m.T_s) == m.tick for e in ramps):
        return 0.0
    omega_g, under = m.raw("omega_g"), m.under
    moved = (omega_g[m.tick - 1] - omega_g[m.last - 1]) / m.droop
    return float(abs(np.clip(P_0 + moved, under.P_min, under.P_max) - P_0))


def _expected(m: Moment, unit: Unit, t: Vector, P_0: float) -> Envelope | None:
    """The envelope of the event, or None if there is none; t: s after it."""
    scenario, scr = m.run.scenario, m.run.scenario.plant.grid.scr
    event = None
    for e in sorted(scenario.events, key=lambda e: e.at(m.T_s)):
        if e.at(m.T_s) == m.tick:
            event = e
        elif isinstance(e, GridImpedance) and e.at(m.T_s) < m.tick:
            scr = e.scr
    if scr is None:
        return None
    match event:
        case PhaseJump():
            return phase_jump(unit, t, math.radians(event.degrees), scr, P_0)
        case GridFrequency(rate=float(rate)):
            df = event.f_hz - m.f_n * float(m.raw("omega_g")[m.tick - 1])
            slope = math.copysign(rate / m.f_n, df)
            return rocof(unit, t, slope, scr, P_0, lasts=abs(df) / rate)
        case GridImpedance(scr=float(after)):
            return scr_jump(unit, t, scr, after, P_0)
    return None


CRITERION = InEnvelope
