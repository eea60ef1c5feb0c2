"""The histogram of times against NumPy's own quantiles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gfm_hil.bench.histogram import (
    BUCKETS,
    RESOLUTION,
    dense,
    histogram,
    lower_ends,
    quantiles,
    sparse,
)

SHARES = [0.0, 0.1, 0.5, 0.9, 0.99, 0.999, 1.0]
TIMES = arrays(np.int64, st.integers(1, 300), elements=st.integers(0, 2**42))


@given(TIMES)
def test_quantiles_are_numpys_to_the_width_of_a_bucket(times):
    found = quantiles(histogram(times), SHARES)
    exact = np.quantile(times, SHARES, method="inverted_cdf")
    np.testing.assert_allclose(found, exact, rtol=RESOLUTION)


@given(arrays(np.int64, st.integers(1, 50), elements=st.integers(0, 127)))
def test_small_times_are_exact(times):
    found = quantiles(histogram(times), SHARES)
    np.testing.assert_array_equal(found, np.quantile(times, SHARES, method="inverted_cdf"))


@given(TIMES, TIMES)
def test_histograms_add(a, b):
    both = histogram(np.concatenate([a, b]))
    np.testing.assert_array_equal(histogram(a) + histogram(b), both)
    np.testing.assert_array_equal(dense(sparse(both)), both)


def test_buckets_leave_no_gap():
    """A bucket's smallest value falls into it, the next smaller value into the bucket before."""
    ends = lower_ends()[:-1].astype(np.int64)
    for shift in (0, 1):
        counts = histogram(np.maximum(ends - shift, 0))
        at = np.flatnonzero(counts)
        expected = np.maximum(np.arange(BUCKETS) - shift, 0)
        np.testing.assert_array_equal(at, np.unique(expected))


def test_negative_and_endless_times_are_kept_at_the_ends():
    counts = histogram(np.array([-5, np.iinfo(np.int64).max]))
    assert counts[0] == counts[-1] == 1
