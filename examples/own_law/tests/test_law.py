"""What our lab asks of a law before it may go near the converter."""

import numpy as np
import pytest


def test_follows_a_step_of_power(lab):
    lab.run(0.1)
    lab.set(P_ref=0.7)
    lab.run(0.5)
    lab.assert_settles("p", to=0.7, within=0.2, tolerance=0.01)
    lab.assert_overshoot_below("p", 50, to=0.7)
    lab.assert_within_envelope("p", csv="power_step.csv")


def test_stays_damped_when_the_grid_jumps(lab):
    lab.run(0.1)
    lab.phase_jump(-5)
    lab.run(0.5)
    lab.assert_damped(min_ratio=0.4, signal="f_hz")
    lab.assert_within_envelope("f_hz", low=49.5, high=50.5)
    lab.assert_settles("p", to=0.5, within=0.4)


def test_shares_a_drop_of_frequency_by_its_droop(lab):
    lab.run(0.1)
    lab.grid(f_hz=49.9)
    lab.run(0.5)
    lab.assert_settles("p", to=0.5 + (0.1 / 50) / 0.01, within=0.2, tolerance=0.01)
    lab.assert_settles("f_hz", to=49.9, within=0.2, tolerance=0.02)


def test_bears_a_weaker_line(lab):
    lab.run(0.1)
    lab.grid_impedance(L_g=6.0, R_g=3.0)
    lab.run(0.4)
    lab.assert_no_trip()
    lab.assert_settles("p", to=0.5, within=0.2)


def test_takes_over_from_mimo_gfm_without_a_bump(bench, law):
    bench.start("../lab.toml", law="mimo-gfm")
    bench.run(0.1)
    bench.switch(law)
    bench.run(0.4)
    bench.assert_bump_below(1e-9)
    bench.assert_within_envelope("p", low=0.4, high=0.6)


@pytest.mark.parametrize("link", ["shm", "zmq"])
def test_two_processes_do_what_one_does(bench, law, link):
    p = {}
    for chosen in ("inproc", link):
        bench.start("../lab.toml", law=law, link=chosen)
        bench.run(0.02)
        bench.set(P_ref=0.6)
        bench.run(0.05)
        p[chosen] = bench.signals["p"]
    np.testing.assert_array_equal(p[link], p["inproc"])
