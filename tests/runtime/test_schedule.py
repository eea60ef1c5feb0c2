"""Gain scheduling: stages over the estimated reactance or the voltage, hysteresis, dwell."""

from dataclasses import replace

import numpy as np
import pytest

from gfm_runtime import LawError, LawSet, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.controller import MAX_STAGES
from gfm_runtime.lawfile import parse_law

from ..support.laws import REF

T_S = 1e-4


def run(c: Controller, ticks: int) -> None:
    for _ in range(ticks):
        c.step(REF, np.zeros(3))


def scheduled(dwell_s: float = 0.0, hysteresis: float = 0.1) -> Controller:
    """Three stages up to 0.1, up to 0.3 and beyond; starts in the first."""
    s = load_law("mimo-gfm-scheduled")
    assert s.schedule is not None
    stage = s.schedule.stages[0]
    schedule = s.schedule.model_copy(
        update={
            "stages": [stage.model_copy(update={"X": X}) for X in (0.1, 0.3, 1.0)],
            "hysteresis": hysteresis,
            "dwell_s": dwell_s,
            "X_0": 0.05,
        }
    )
    first, second = s.laws[:2]
    stages = LawSet("three", (first, second, replace(second, name="third")), schedule)
    c = Controller([stages, load_law("vsg-2")], T_S, list(REF))
    c.start(np.zeros(3), np.array([0.0, 1.0, 1.0]))
    return c


def at(c: Controller, X: float, ticks: int = 2) -> str:
    """Label of the stage with the estimate X, which stays constant without swings."""
    c.est["X"] = X
    run(c, ticks)
    return c.active


def test_the_estimate_counts_in_the_converters_frequency():
    omega_b = 120 * np.pi
    c = Controller([load_law("mimo-gfm-scheduled")], T_S, list(REF), omega_b=omega_b)
    assert c.est["omega_b"][0] == omega_b


def test_stages_follow_the_estimate_with_hysteresis():
    c = scheduled()
    walk = [
        (0.05, 0), (0.105, 0), (0.109, 0), (0.111, 1), (0.1, 1), (0.091, 1), (0.089, 0),
        (0.5, 2), (0.28, 2), (0.26, 1), (0.01, 0), (50.0, 2), (0.2, 1),
    ]  # fmt: skip
    for X, stage in walk:
        assert at(c, X) == f"three[{stage}]", X
        assert c.ctl["bump"][0] <= 1e-12


def test_a_stage_stays_for_its_dwell():
    c, u = scheduled(dwell_s=20 * T_S), np.zeros(3)
    c.est["X"] = 0.5
    stages = []
    for k in range(100):
        if k == 30:
            c.est["X"] = 0.05
        c.step(REF, u)
        stages.append(c.active)
    assert stages[:20] == ["three[0]"] * 20
    first = stages.index("three[2]")
    assert first == 20
    assert stages[first : first + 21] == ["three[2]"] * 21
    assert stages[41:] == ["three[0]"] * 59


def test_the_first_stage_is_that_of_x_0():
    s = load_law("mimo-gfm-scheduled")
    assert s.schedule is not None
    for X_0, stage in ((s.schedule.stages[0].X, 0), (s.schedule.stages[0].X * 1.01, 1)):
        schedule = s.schedule.model_copy(update={"X_0": X_0})
        c = Controller([LawSet(s.name, s.laws, schedule)], T_S, list(REF))
        assert c.active == f"{s.name}[{stage}]"
        assert c.est["X"][0] == X_0


def test_leaving_a_scheduled_law_ends_its_schedule():
    c = scheduled()
    c.select("vsg-2")
    assert at(c, 0.5, 10) == "vsg-2"
    c.select("three")
    run(c, 2)
    assert c.active == "three[0]" and c.est["X"][0] == 0.05, "the estimate starts again"


def test_the_estimator_is_restarted_in_place():
    """A compiled loop may hold the record."""
    c = scheduled()
    held = c.est
    c.select("three")
    assert c.est is held


def test_a_voltage_that_falls_changes_the_stage_at_once_and_its_return_after_the_dwell():
    c = Controller([load_law("mimo-gfm-ride-through")], T_S, list(REF))
    c.start(np.zeros(c.active_law.order), np.array([0.0, 1.0, 1.0]))
    dip, usual = (f"mimo-gfm-ride-through[{k}]" for k in range(2))
    dwell, stages, u = int(c.ctl["dwell"][0]), [c.active], np.zeros(3)
    low = {*range(100, 200), *range(200 + dwell, 300 + dwell), *range(302 + dwell, 400 + dwell)}
    second = 403 + 2 * dwell  # soon after the way back
    for k in range(second + 10):
        y = REF.copy()
        y[4] = 0.98 if k in low or k == second else 0.992 if k < 100 else 1.0
        c.step(y, u)
        if c.active != stages[-1]:
            stages += [k, c.active]
        assert c.ctl["bump"][0] <= 1e-12
    assert stages == [usual, 100, dip, 400 + 2 * dwell, usual, second, dip]


@pytest.mark.parametrize(
    ("schedule", "why"),
    [
        ('X_0 = 0.1\n[[schedule.stages]]\nX = 0.1\n[[schedule.stages]]\nV = 0.9\n',
         "stages: each needs X, or each needs V"),
        ('[[schedule.stages]]\nV = 0.9\n[[schedule.stages]]\nparameters = {}\n',
         "stages: each needs X, or each needs V"),
        ('[[schedule.stages]]\nX = 0.1\n[[schedule.stages]]\nX = 0.9\n',
         "X_0: goes with stages of X, which need it"),
        ('X_0 = 1.0\n[[schedule.stages]]\nV = 0.1\n[[schedule.stages]]\nV = 0.9\n',
         "X_0: goes with stages of X, which need it"),
    ],
)  # fmt: skip
def test_stages_of_one_quantity(schedule, why):
    text = f'base = "mimo-gfm"\nname = "own"\ntitle = ""\nsource = ""\n[schedule]\n{schedule}'
    with pytest.raises(LawError, match=why):
        parse_law(text)


def test_too_many_stages():
    s = load_law("mimo-gfm-scheduled")
    with pytest.raises(LawError, match=f"9 stages; the controller holds {MAX_STAGES}"):
        Controller([LawSet("many", (s.laws[0],) * 9, s.schedule)], T_S, list(REF))
