"""Tests of a controller that is a process of its own, against the emulated rig."""

import sys
from pathlib import Path

import pytest

CONTROLLER = Path(__file__).with_name("controller.py")

RIG = {"L_g": 3.0, "R_g": 1.5, "R_f": 0.5}

pytestmark = pytest.mark.gfmhil(
    "rig_pref_step",
    law="droop-5",  # at whose operating point the plant starts
    events=[],
    plant__factors=RIG,
    controller_command=[sys.executable, str(CONTROLLER), "{endpoint}", "{scenario}"],
)


def test_rests_where_it_starts(bench):
    bench.run(0.2)
    bench.assert_within_envelope("p", low=0.49, high=0.51)


def test_power_follows_its_reference(bench):
    bench.run(0.1)
    bench.set(P_ref=0.7)
    bench.run(0.5)
    bench.assert_settles("p", to=0.7, within=0.2)


def test_bears_a_sag(bench):
    bench.run(0.1)
    bench.grid(V_g=0.95, duration=0.05)
    bench.run(0.4)
    bench.assert_no_trip()
    bench.assert_settles("V", to=1.0, within=0.2)
