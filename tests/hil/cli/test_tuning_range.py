"""``design tune`` over several short-circuit ratios of a scenario's grid."""

import pytest

import gfmhil
from gfm_hil.cli import main

CONTENT = {
    "title": "range", "law": "vsg-2", "duration": 1.0, "inner": "virtual-stator",
    "plant": {"grid": {"scr": 3.0, "x_over_r": 6.0}, "lcl": {"L": 0.15}, "delay": {"samples": 1}},
}  # fmt: skip


@pytest.mark.full
def test_gamma_is_the_largest_of_all_grids_and_none_of_them_is_left_out():
    on = gfmhil.load_scenario(CONTENT)
    found = gfmhil.design.tune(
        "vsg-2", on=on, scr=[20.0, 1.5], only=["k_34"], evaluations=20, starts=1
    )
    each = [
        gfmhil.design.gamma(found.law, on=gfmhil.load_scenario(CONTENT, plant__grid__scr=scr))
        for scr in (20.0, 1.5)
    ]
    for k, channel in enumerate(found.gamma.channels):
        assert channel.norm == pytest.approx(max(g.channels[k].norm for g in each), rel=1e-6)
    assert found.gamma.value == pytest.approx(max(g.value for g in each), rel=1e-6)
    assert each[0].value != pytest.approx(each[1].value, rel=1e-2)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--scr", "3"], "scr: are those of a scenario's grid"),
        (["--scr", "-3", "--scenario", "pref_step"], "scr"),
    ],
)
def test_a_wrong_range_is_told_in_a_line(capsys, options, says):
    assert main(["design", "tune", "--law", "vsg-2", "--quiet", *options]) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1


def test_ratios_that_are_no_numbers_are_told_in_a_line(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["design", "tune", "--law", "vsg-2", "--scr", "3,x"])
    err = capsys.readouterr().err
    assert "--scr: '3,x': must be numbers" in err and err.count("\n") == 1
