"""One-way delays and losses, from exchanges of two clocks whose truth is known."""

import numpy as np
import pytest

from gfm_hil.bench.histogram import quantiles
from gfm_hil.bench.one_way import STEPPED, delays, offset, ways

PPM = 1e-6


def exchanges(n=4000, ahead_ns=5e9, drift=40 * PPM, there=(1e6, 3e4), back=(2e5, 3e4), seed=1):
    """Exchanges every 100 µs: the answerer's clock is ahead and too quick; ways as the least, and
    the mean of what comes on top, ns."""
    rng = np.random.default_rng(seed)
    t1 = 1e14 + 1e5 * np.arange(n)
    t2 = t1 + there[0] + rng.exponential(there[1], n)
    t3 = t2 + 700
    t4 = t3 + back[0] + rng.exponential(back[1], n)

    def far(t):
        return t + ahead_ns + drift * (t - t1[0])

    return np.rint(np.stack([t1, t1, far(t2), far(t3), t4], axis=1)).astype(np.int64), t2 - t1


@pytest.mark.parametrize("drift", [0.0, 100 * PPM, -100 * PPM])
@pytest.mark.parametrize("there", [(1e6, 3e4), (3e5, 3e5), (5e4, 1e3)])
def test_the_way_there_is_known_to_half_of_the_quickest_round_trip(drift, there):
    stamps, truth = exchanges(drift=drift, there=there)
    found = offset(stamps, one_clock=False)
    assert found.clock == "quickest exchanges"
    assert found.within_ns < 0.6 * (there[0] + 2e5) + there[1]
    said = stamps[:, 2] - found.ns - stamps[:, 1]
    assert np.abs(said - truth).max() <= found.within_ns


def test_one_clock_needs_no_guess():
    stamps, truth = exchanges(ahead_ns=0.0, drift=0.0)
    found = delays(stamps, one_clock=True)
    assert (found["clock"], found["within_ns"]) == ("one clock", 0.0)
    for share in (0.5, 0.99):
        (median,) = quantiles(found["there"], [share])
        assert median == pytest.approx(np.quantile(truth, share, method="inverted_cdf"), rel=1 / 64)
    moved, _ = exchanges(ahead_ns=-5e9, drift=0.0)  # one machine, another time namespace
    assert delays(moved, one_clock=True)["clock"] == "quickest exchanges"


def test_clocks_that_follow_ptp_are_compared_as_they_say_and_contradicted():
    stamps, truth = exchanges(ahead_ns=800.0, drift=0.0)
    found = offset(stamps, one_clock=False, tai_ns=1e3)
    assert (found.clock, found.within_ns) == ("CLOCK_TAI", 1e3)
    assert np.abs(stamps[:, 2] - stamps[:, 1] - truth).max() <= 1e3
    wrong, _ = exchanges(ahead_ns=-2e6, drift=0.0)  # u would be there before y has left
    assert offset(wrong, one_clock=False, tai_ns=1e3).clock == STEPPED


@pytest.mark.parametrize("step_ns", [3e6, -3e6])
def test_a_clock_that_steps_is_told(step_ns):
    stamps, _ = exchanges()
    stamps[2000:, 2:4] += int(step_ns)
    found = delays(stamps, one_clock=False)
    assert found["clock"] == STEPPED and "there" not in found


def test_losses_have_their_interval():
    """Clopper and Pearson, 95 %, of 10 in 1,000: 0.48 to 1.83 % (tables of the binomial)."""
    stamps, _ = exchanges(1000)
    stamps[::100, 2:] = -1
    row = ways([delays(stamps[:500], False), delays(stamps[500:], False)])
    assert (row["sent"], row["lost"], row["lost_pct"]) == (1000, 10, 1.0)
    assert row["lost_pct_95"] == pytest.approx([0.4805, 1.8314], abs=1e-3)
    assert ways([delays(stamps[1:10], False)])["lost_pct_95"][0] == 0.0
    nothing = ways([delays(np.full((5, 5), -1), False)])
    assert nothing["lost_pct"] == 100.0 and nothing["there"]["p50_us"] is None
