"""Per-unit conversions against values computed by hand."""

import math

import pytest

from gfm_plant import Bases


@pytest.mark.parametrize(
    ("quantity", "si", "pu"),
    [
        # Z_b = 380^2/4000 = 36.1 ohm, Z_dc = 700^2/4000 = 122.5 ohm, omega_b = 314.159 rad/s
        ("R", 36.1, 1.0),
        ("L", 2e-3, 0.017404945),  # 314.159 * 2e-3 / 36.1
        ("C", 20e-6, 0.2268230),  # 314.159 * 20e-6 * 36.1
        ("C_dc", 500e-6, 19.242255),  # 314.159 * 500e-6 * 122.5
        ("P", 2000.0, 0.5),
        ("Q", -4000.0, -1.0),
        ("V", 190.0, 0.5),
        ("I", 6.0773714, 1.0),  # 4000 / (sqrt(3) * 380)
        ("v_dc", 735.0, 1.05),
        ("i_dc", 5.7142857, 1.0),  # 4000 / 700
        ("omega", 100 * math.pi, 1.0),
        ("f", 49.9, 0.998),
    ],
)
def test_values_worked_by_hand(quantity, si, pu):
    bases = Bases()
    assert bases.to_pu(si, quantity) == pytest.approx(pu, rel=1e-6)
    assert bases.to_si(pu, quantity) == pytest.approx(si, rel=1e-6)


def test_peaks_of_a_phase():
    bases = Bases()
    assert bases.V_peak == pytest.approx(310.26870, rel=1e-6)  # sqrt(2/3) * 380
    assert bases.I_peak == pytest.approx(8.5947010, rel=1e-6)  # sqrt(2) * 6.0773714


@pytest.mark.parametrize("value", [0.0, -380.0, math.nan, math.inf])
def test_a_base_must_be_positive(value):
    with pytest.raises(ValueError, match=r"V_n = .*must be finite and > 0"):
        Bases(V_n=value)


def test_unknown_quantity_lists_the_known():
    with pytest.raises(ValueError, match=r"quantity = 'G': must be one of P, Q, V, .*, f"):
        Bases().to_pu(1.0, "G")
