"""A campaign's draws: within bounds, with the set distribution, a function of seed and run."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from gfm_hil.studies.campaign.spec import Choice, LogUniform, Normal, Uniform, draw

numbers = st.floats(-1e12, 1e12)
shares = st.floats(0, 1, exclude_max=True)


def bounded(low: float, high: float) -> tuple[float, float]:
    return (low, high) if low < high else (high, low)


@pytest.mark.parametrize(("kind", "least"), [(Uniform, -1e12), (LogUniform, 1e-12)])
@given(data=st.data(), u=shares)
def test_a_value_stays_within_its_bounds(kind, least, data, u):
    low, high = bounded(*(data.draw(st.floats(least, 1e12)) for _ in range(2)))
    if low < high:
        named = kind.model_fields["type"].annotation.__args__[0]
        assert low <= kind(type=named, path="x", low=low, high=high).quantile(u) <= high


@given(numbers, st.floats(1e-6, 1e6), st.floats(-6, 6), st.floats(-6, 6), shares)
def test_normal_stays_within_its_bounds(mean, sigma, a, b, u):
    low, high = (mean + sigma * limit for limit in bounded(a, b))
    try:
        normal = Normal(type="normal", path="x", mean=mean, sigma=sigma, low=low, high=high)
    except ValidationError:
        return  # no number between the bounds: an error
    assert low <= normal.quantile(u) <= high


@given(st.lists(st.integers() | st.text(), min_size=1), shares)
def test_choice_is_one_of_its_values(values, u):
    assert Choice(type="choice", path="x", values=values).quantile(u) in values


@given(shares, shares)
def test_quantiles_rise(u, v):
    """But for the last digit, to which `NormalDist.inv_cdf` is right."""
    low, high = bounded(u, v)
    normal = Normal(type="normal", path="x", mean=1.0, sigma=0.1, low=0.7, high=1.2)
    assert normal.quantile(low) <= normal.quantile(high) * (1 + 1e-15)


def test_draws_have_the_distribution():
    kinds = [
        Uniform(type="uniform", path="a", low=2.0, high=4.0),
        LogUniform(type="loguniform", path="b", low=0.1, high=10.0),
        Normal(type="normal", path="c", mean=1.0, sigma=0.1, low=0.0, high=2.0),
        Choice(type="choice", path="d", values=[1, 2]),
    ]
    drawn = np.array([draw(5, run, kinds)[1] for run in range(4000)])
    assert np.mean(drawn[:, 0]) == pytest.approx(3.0, abs=0.05)
    assert np.mean(np.log(drawn[:, 1])) == pytest.approx(0.0, abs=0.1)
    assert np.std(drawn[:, 2]) == pytest.approx(0.1, rel=0.05)
    assert np.mean(drawn[:, 3]) == pytest.approx(1.5, abs=0.05)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(4)).max() < 0.06


def test_a_run_depends_on_seed_and_number_only():
    kinds = [Uniform(type="uniform", path="a", low=0.0, high=1.0)]
    children = np.random.SeedSequence(9).spawn(4)
    for run in (3, 0):
        raw = np.random.Philox(children[run]).random_raw(2)
        seed, (value,) = draw(9, run, kinds)
        assert seed == int(raw[0]) >> 1
        assert math.isclose(value, int(raw[1]) / 2**64, abs_tol=1e-15)
