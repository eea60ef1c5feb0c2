"""What we ask of the law; docs: Testing with pytest. Files are looked for from this folder."""

import pytest


@pytest.fixture
def lab(bench):
    """Our law at rest in our lab."""
    bench.start("../lab.toml", law="../laws/NAME.toml", link="inproc", events=[])
    return bench


def test_follows_a_step_of_power(lab):
    lab.run(0.1)
    lab.set(P_ref=0.7)
    lab.run(1.0)
    lab.assert_settles("p", to=0.7, within=0.5, tolerance=0.02)


def test_rides_through_a_sag(lab):
    lab.run(0.1)
    lab.grid(V_g=0.97)
    lab.run(0.5)
    lab.assert_no_trip()
