"""The controller's tick: states, checks, set-points, changes of law, scheduling."""

import numpy as np
import pytest

from gfm_runtime import LawError, LawSet, discretise, get_law, law_names, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.controller import make_controller, missed, set_reference
from gfm_runtime.signals import NU, NY, REF_NAMES, SIGNALS, Y_NAMES, group
from gfm_runtime.states import (
    BAD_U,
    BAD_Y,
    INIT,
    OK,
    READY,
    REASONS,
    RUNNING,
    SAFE,
    STALE,
    STATES,
    STOPPED,
)

from ..support.laws import LAWS, REF, Running, Vector

T_S = 1e-4


def ready(*names: str, hold: int = 0) -> Controller:
    return Controller([load_law(n) for n in names or ("vsg-2",)], T_S, list(REF), hold)


def started(*names: str, hold: int = 0) -> Controller:
    c = ready(*names, hold=hold)
    c.start(np.zeros(c.active_law.order), np.array([0.0, 1.0, 1.0]))
    return c


def state(c: Controller) -> tuple[int, int, int]:
    return int(c.ctl["state"][0]), int(c.ctl["reason"][0]), int(c.ctl["channel"][0])


# --- states ---


def test_names_of_states_and_reasons():
    assert [STATES[k] for k in (INIT, READY, RUNNING, SAFE, STOPPED)] == [
        "INIT", "READY", "RUNNING", "SAFE", "STOPPED",
    ]  # fmt: skip
    assert REASONS[OK] == "" and all(REASONS[1:]) and len(set(REASONS)) == len(REASONS)


def test_a_fresh_record_is_init_with_the_tables_ranges():
    ctl = make_controller(hold=3)[0]
    assert (ctl["state"], ctl["reason"], ctl["request"], ctl["hold"]) == (INIT, OK, -1, 3)
    np.testing.assert_array_equal(ctl["ref"], [s.default for s in group("ref")])
    measured = (*SIGNALS[:NY], *group("y_inner"))
    np.testing.assert_array_equal(ctl["y_low"], [s.low for s in measured])
    np.testing.assert_array_equal(ctl["y_high"], [s.high for s in measured])


def test_ready_does_nothing_until_started():
    c, u = ready(), np.array([7.0, 8.0, 9.0])
    assert state(c)[0] == READY
    c.step(REF, u)
    assert list(u) == [7.0, 8.0, 9.0]
    c.start(np.zeros(3), np.array([0.0, 1.0, 1.0]))
    c.step(REF, u)
    assert state(c) == (RUNNING, OK, 0)
    assert u == pytest.approx([0.0, 1.0, 1.0])


@pytest.mark.parametrize("now", [INIT, RUNNING, SAFE, STOPPED])
def test_only_ready_can_start(now):
    c = ready()
    c.ctl["state"] = now
    with pytest.raises(LawError, match=f"controller: is {STATES[now]}; only READY can start"):
        c.start(np.zeros(3), np.ones(3))


def test_start_is_at_rest():
    c = ready("vsg-2")
    c.states["offset"], c.states["trend"] = 0.3, 0.2
    c.start(np.array([0.1, 0.0, 0.2]), np.array([0.1, 1.0, 1.2]))
    u = np.zeros(3)
    c.step(REF, u)
    assert u == pytest.approx([0.1, 1.0, 1.2], abs=1e-12)
    assert np.abs(c.states["trend"][0]).max() < 1e-12


# --- checks of y and u ---


@pytest.mark.parametrize("channel", range(NY), ids=Y_NAMES)
@pytest.mark.parametrize("wrong", ["nan", "inf", "-inf", "above", "below"])
def test_bad_measurement_leads_to_safe(channel, wrong):
    c, u = started(), np.zeros(3)
    c.step(REF, u)
    held, x = u.copy(), c.states["x"].copy()
    y = REF.copy()
    row = SIGNALS[channel]
    y[channel] = {"above": row.high + 1e-6, "below": row.low - 1e-6}.get(wrong) or float(wrong)
    c.step(y, u)
    assert state(c) == (SAFE, BAD_Y, channel)
    np.testing.assert_array_equal(u, held)
    np.testing.assert_array_equal(c.states["x"], x)


def test_values_at_the_ends_of_the_range_are_good():
    c = started()
    for y in ([s.low for s in SIGNALS[:NY]], [s.high for s in SIGNALS[:NY]]):
        c.step(np.array(y), np.zeros(3))
    assert state(c)[0] == RUNNING


def test_safe_is_latched_until_reset():
    c, u = started(), np.zeros(3)
    c.step(REF, u)
    held = u.copy()
    c.step(REF * np.nan, u)
    for _ in range(5):
        c.step(REF + 0.01, u)
    assert state(c) == (SAFE, BAD_Y, 0)
    np.testing.assert_array_equal(u, held)
    missed(c.ctl)
    assert state(c) == (SAFE, BAD_Y, 0), "the first reason stays"
    c.reset()
    assert state(c) == (READY, OK, 0) and c.ctl["stale"][0] == 0
    c.start(np.zeros(3), held)
    c.step(REF, u)
    assert state(c)[0] == RUNNING


@pytest.mark.parametrize(("row", "field"), [(0, "i_u"), (1, "omega_u"), (2, "E_u")])
def test_bad_output_leads_to_safe(row, field):
    c, u = started("matching-2"), np.zeros(3)
    c.step(REF, u)
    held = u.copy()
    c.laws["u_0"][0, row] = np.nan
    c.step(REF, u)
    assert state(c) == (SAFE, BAD_U, row), field
    np.testing.assert_array_equal(u, held)


# --- stale measurements ---


@pytest.mark.parametrize("hold", [0, 1, 5])
def test_so_many_misses_are_held(hold):
    c = started(hold=hold)
    for k in range(hold):
        missed(c.ctl)
        assert (state(c)[0], int(c.ctl["stale"][0])) == (RUNNING, k + 1)
    missed(c.ctl)
    assert state(c) == (SAFE, STALE, -1)


def test_a_fresh_measurement_starts_the_count_again():
    c, u = started(hold=2), np.zeros(3)
    for _ in range(10):
        missed(c.ctl)
        missed(c.ctl)
        c.step(REF, u)
        assert state(c)[0] == RUNNING and c.ctl["stale"][0] == 0


# --- set-points ---


def test_set_point_step():
    c = started("droop-1")
    c.set("P_ref", 0.8)
    u = np.zeros(3)
    c.step(REF, u)
    assert u[1] == pytest.approx(1.0 + get_law("droop-1").parameters["D_p"].value * 0.3)
    np.testing.assert_array_equal(c.ctl["ref"][0], [1.0, 0.8, 1.0, 0.0, 1.0])


@pytest.mark.parametrize("name", REF_NAMES)
@pytest.mark.parametrize("away", [0.05, -0.05])
def test_set_point_ramp(name, away):
    """Equal steps; the ramp reaches the target exactly, without overshoot."""
    c, u, j = started(), np.zeros(3), REF_NAMES.index(name)
    c.set(name, REF[j] + away, ramp_s=10 * T_S)
    seen = []
    for _ in range(15):
        c.step(REF, u)
        seen.append(float(c.ctl["ref"][0, j]) - REF[j])
    np.testing.assert_allclose(seen[:10], away * np.arange(1, 11) / 10, atol=1e-12)
    assert seen[10:] == [seen[10]] * 5 and c.ctl["ref"][0, j] == REF[j] + away


def test_a_new_target_during_a_ramp():
    c, u = started(), np.zeros(3)
    c.set("P_ref", 1.0, ramp_s=10 * T_S)
    for _ in range(4):
        c.step(REF, u)
    assert c.ctl["ref"][0, 1] == pytest.approx(0.7)
    c.set("P_ref", 0.5, ramp_s=4 * T_S)
    c.step(REF, u)
    assert c.ctl["ref"][0, 1] == pytest.approx(0.65)
    c.set("P_ref", 0.2)
    c.step(REF, u)
    assert c.ctl["ref"][0, 1] == 0.2


def test_ramps_of_two_references_do_not_mix():
    ctl, c, u = make_controller(), started(), np.zeros(3)
    set_reference(ctl, 1, 0.6, -0.01)
    assert ctl["ref_rate"][0, 1] == 0.01, "a rate has no sign"
    c.set("P_ref", 0.6, ramp_s=10 * T_S)
    c.set("V_ref", 1.1)
    c.step(REF, u)
    assert c.ctl["ref"][0] == pytest.approx([1.0, 0.51, 1.0, 0.0, 1.1])


def test_unknown_reference():
    with pytest.raises(ValueError):
        ready().set("omega_x", 1.0)


def test_references_do_not_move_unless_running():
    c, u = ready(), np.zeros(3)
    c.set("P_ref", 1.0)
    c.step(REF, u)
    assert c.ctl["ref"][0, 1] == 0.5


# --- changes of law ---


def run(c: Controller, ticks: int, u: Vector, y: Vector = REF) -> Vector:
    out = np.empty((ticks, NU))
    for k in range(ticks):
        c.step(y, u)
        out[k] = u
    return out


def test_change_of_law_at_the_next_tick():
    c, u = started("mimo-gfm", "vsg-2"), np.zeros(3)
    y = REF + np.array([0.001, 0.01, 0.0, 0.01, 0.001])
    run(c, 200, u, y)
    c.select("vsg-2")
    assert (c.active, int(c.ctl["changes"][0])) == ("mimo-gfm", 0)
    before = u.copy()
    c.step(y, u)
    assert (c.active, int(c.ctl["changes"][0])) == ("vsg-2", 1)
    assert c.active_law.law == get_law("vsg-2")
    assert 0 <= c.ctl["bump"][0] <= 1e-12
    assert np.abs(u - before).max() < 0.02, "no more than MIMO-GFM's own slope"


def test_tour_of_all_laws():
    """All laws in one run, each for 20 ms: no bump anywhere."""
    names = law_names()
    c, u = started(*names), np.zeros(3)
    y = REF + np.array([0.0001, 0.001, 0.0, 0.001, 0.0001])
    for name in (*names[1:], names[0]):
        run(c, 200, u, y)
        c.select(name)
        c.step(y, u)
        assert c.active.split("[")[0] == name
        assert c.ctl["bump"][0] <= 1e-12
    assert state(c)[0] == RUNNING and c.ctl["changes"][0] == len(names)


def test_asking_for_the_active_law_changes_nothing():
    us = []
    for again in (True, False):
        c, u = started("vsg-12", "vsg-2"), np.zeros(3)
        y = REF + 0.001
        run(c, 50, u, y)
        if again:
            c.select("vsg-12")
        us.append(run(c, 50, u, y))
        assert c.ctl["changes"][0] == 0 and c.ctl["request"][0] == -1
    np.testing.assert_array_equal(us[0], us[1])


def test_a_law_left_and_taken_again_starts_afresh():
    c, u = started("vsg-2", "droop-1"), np.zeros(3)
    run(c, 100, u, REF + 0.002)
    for name in ("droop-1", "vsg-2"):
        c.select(name)
        run(c, 100, u, REF + 0.002)
        assert c.ctl["bump"][0] <= 1e-12
    assert c.active == "vsg-2" and c.ctl["changes"][0] == 2


def test_unknown_law():
    with pytest.raises(LawError, match=r"law 'vsg-3': not ready; ready are \['vsg-2'\]"):
        ready().select("vsg-3")


def test_a_law_that_does_not_discretise_is_refused_before_the_start():
    with pytest.raises(LawError, match="T_s"):
        Controller([load_law("vsg-2")], 0.0, list(REF))


@pytest.mark.parametrize("name", LAWS)
def test_a_tick_is_the_kernels_step(name):
    c = Controller([LawSet(name, (LAWS[name],))], T_S, list(REF))
    c.start(np.zeros(c.active_law.order), np.array([0.0, 1.0, 1.0]))
    bare, u = Running.of(discretise(LAWS[name], T_S)), np.zeros(3)
    y = REF + np.array([0.001, 0.01, 0.0, 0.01, 0.001])
    for _ in range(10):
        c.step(y, u)
        np.testing.assert_array_equal(u, bare.step(REF, y))
