"""The laws for grid codes: a declared droop of 5 % and an inertia constant of 2 to 8 s."""

import pytest

from gfm_runtime import get_law, grid_names, law_file, law_names

_S = 1e-5  # 1/s, nearly at rest


def test_listed_apart():
    assert grid_names() and not set(grid_names()) & set(law_names())


@pytest.mark.parametrize("name", grid_names())
def test_droop_and_inertia_are_what_the_law_declares(name):
    """1 / G(s) = 1 / D_p + 2 H s + ... of the gain G from p to omega_u, of which the damping that
    fades takes a part."""
    law, file = get_law(name), law_file(name)
    assert file.name == name

    def opposes(s: float) -> float:
        return 1 / sum(law.element(m, (1, 1))(s).real for m in ("phi", "psi"))

    assert 1 / opposes(0.0) == pytest.approx(0.05, rel=1e-9)
    H = (opposes(_S) - opposes(0.0)) / (2 * _S)
    declared = file.parameters["H"].value
    assert 2.0 <= declared <= 8.0 and pytest.approx(declared, rel=0.2) == H


@pytest.mark.parametrize("name", grid_names())
def test_what_goes_from_the_voltage_to_the_speed_vanishes_at_rest(name):
    """It is proportional to e_q + e_V / D_q, which row 3 integrates to zero."""
    law = get_law(name)
    for row, s in ((1, 0.0), (2, 1.0)):
        on_q, on_V = (law.element("phi", (row, j))(s) for j in (3, 4))
        assert on_V == pytest.approx(on_q / 0.05, rel=1e-9)
    assert law.element("phi", (1, 3))(0.0).real < 0
    assert abs(law.element("phi", (2, 3))(_S)) > 1e3
