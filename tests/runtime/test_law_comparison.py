"""The laws with tuned gains: not in the catalogue's list, but available by name."""

import pytest

from gfm_runtime import LawError, discretise, law_file, law_names, load_law, tuned_names


def test_listed_apart():
    assert tuned_names()
    assert not set(tuned_names()) & set(law_names())
    assert {name.removesuffix("-tuned") for name in tuned_names()} <= set(law_names())
    assert all(name.endswith("-tuned") for name in tuned_names())


@pytest.mark.parametrize("name", tuned_names())
def test_the_same_law_with_other_values_of_its_free_gains(name):
    tuned, own = law_file(name), law_file(name.removesuffix("-tuned"))
    assert tuned.name == name
    assert (tuned.phi, tuned.psi, tuned.u_0, tuned.error_map) == (
        own.phi, own.psi, own.u_0, own.error_map,
    )  # fmt: skip
    assert (
        discretise(load_law(name).laws[0], 1e-4).order
        == discretise(load_law(own.name).laws[0], 1e-4).order
    )
    for parameter, spec in tuned.parameters.items():
        was = own.parameters[parameter]
        if was.free is None and was.tied is None:
            assert spec.value == was.value
        if was.free is not None:
            assert was.free[0] <= spec.value <= was.free[1]


def test_an_unknown_one_says_where_the_tuned_are_listed():
    with pytest.raises(LawError, match=r"unknown; .*gfmhil laws --tuned"):
        load_law("droop-9-tuned")
