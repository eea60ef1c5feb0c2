"""Converter files and factors."""

import pytest
from pydantic import ValidationError

from gfm_plant import load_converter


def test_the_papers_converter():
    paper = load_converter("paper")
    assert (paper.L_f, paper.R_f, paper.C_f, paper.C_dc) == (2e-3, 0.06, 20e-6, 500e-6)
    assert paper.bases.base_of("R") == pytest.approx(36.1)
    assert paper.pu() == pytest.approx(
        {
            "L_f": 0.0174048,
            "R_f": 0.00166205,
            "C_f": 0.2268230,
            "L_g": 0.0174048,
            "R_g": 0.00166205,
            "C_dc": 19.242255,
        },
        rel=1e-5,
    )


def test_factors_scale_the_element_and_leave_the_bases():
    paper = load_converter("paper")
    assert paper.pu({"L_g": 3.0})["L_g"] == pytest.approx(3 * paper.pu()["L_g"])
    assert paper.pu({"L_g": 3.0})["L_f"] == paper.pu()["L_f"]
    assert paper.pu({"R_f": 0.0})["R_f"] == 0.0


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ({"L_f": -1.0}, r"factors.L_f = -1.0: must be > 0"),
        ({"C_dc": 0.0}, r"factors.C_dc = 0.0: must be > 0"),
        ({"L_x": 1.0}, r"factors.L_x: must be one of L_f, R_f"),
    ],
)
def test_wrong_factors(factors, message):
    with pytest.raises(ValueError, match=message):
        load_converter("paper").pu(factors)  # type: ignore[arg-type]


def test_unknown_name_lists_what_is_shipped():
    with pytest.raises(ValueError, match=r"converter = 'papre': must be one of .*paper.*\.toml"):
        load_converter("papre")


def test_a_file_reports_every_mistake_at_once(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'source = "x"\nS_n = 4e3\nV_n = 380.0\nomega_n = 314.0\nV_dcref = 700.0\n'
        "L_f = -2e-3\nR_f = 0.06\nC_f = '20u'\nL_g = 2e-3\nR_g = 0.06\nC_dc = 5e-4\nL_h = 1.0\n"
    )
    with pytest.raises(ValidationError) as caught:
        load_converter(path)
    wrong = {error["loc"][0]: error for error in caught.value.errors()}
    assert set(wrong) == {"L_f", "C_f", "L_h"}
    assert wrong["L_f"]["input"] == -2e-3
    assert "greater than 0" in wrong["L_f"]["msg"]
