"""Runs with a switched bridge: every law beside the averaged bridge, and dead time at the
switchover."""

import numpy as np
import pytest

import gfmhil

NOMINAL = {"R_f": 1.0, "R_g": 1.0}
LOOP = {
    "plant__dc_source": {"mode": "regulated"}, "plant__sensors": {"bandwidth_hz": 300.0},
    "plant__delay": {"samples": 1},
}  # fmt: skip
UNSTABLE = {"dvoc", "droop-1", "psc-1", "psc-dc"}  # in this loop, with either bridge


@pytest.mark.full
def test_every_law_sees_what_it_sees_of_an_averaged_bridge():
    """Without dead time a tick samples where the ripple of the current passes zero. The ripple of
    the capacitor's voltage does not: it is what differs at rest, 1e-3 p.u. of V."""
    for law in (getattr(one, "name", one) for one in gfmhil.laws()):
        average, switched = (
            gfmhil.run("pref_step", law, duration=1.6, plant__bridge={"kind": kind}, **LOOP)
            for kind in ("average", "two-level")
        )
        assert (average.status == "tripped") == (law in UNSTABLE)
        assert switched.status == average.status
        if law not in UNSTABLE:
            for name in ("p", "q", "V"):
                apart = np.subtract(average.signals[name], switched.signals[name])
                assert np.abs(apart).max() <= 2e-2, (law, name)


@pytest.mark.parametrize(
    ("scenario", "dead_time", "trips"),
    [("switchover", 0.0, False), ("switchover", 2e-6, True), ("rig_pref_step", 2e-6, False)],
)
def test_dead_time_loses_vsg_2_on_a_rig_of_nominal_resistances(scenario, dead_time, trips):
    """The switchover leads to VSG-2; the step of P_ref stays with MIMO-GFM."""
    bridge = {"kind": "two-level", "dead_time_s": dead_time}
    run = gfmhil.run(scenario, plant__bridge=bridge, plant__factors=NOMINAL, mode="lockstep")
    assert (run.status == "tripped") == trips
