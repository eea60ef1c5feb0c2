"""gfmhil design sweep and map: where a loop is stable, and what is refused."""

import csv
import json

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli.main import main
from gfmhil import plot
from gfmhil.design import loop_margins, stability_map, sweep


def test_the_edge_of_a_whole_row_is_its_gain_margin():
    """k_34 and k_35, which is tied to it, are all of VSG-2's row of E_u."""
    law = gfmhil.Law.load("vsg-2")
    found = sweep(law, "k_34", points=15)
    (edge,) = found.edges
    assert found.stable() == [(found.values[0], edge)]
    loop = law.closed_loop("pref_step")
    (E_u,) = (c for c in loop_margins(loop).u if c.name == "E_u")
    assert edge / found.own == pytest.approx(E_u.gain_phase.gain_high, rel=1e-4)
    assert found.own == law.file.parameters["k_34"].value
    for value, stable in ((edge * 0.999, True), (edge * 1.001, False)):
        one = law.with_gains(k_34=value).closed_loop("pref_step")
        assert (one.sigma() < 0.0) == stable


@pytest.mark.full
def test_a_map_has_a_sweep_in_each_row():
    found = stability_map("mimo-gfm", "k_34", 1.0, 50.0, scr=(2.0, 8.0), points=4)
    on = gfmhil.load_scenario("pref_step", plant__grid={"scr": 8.0, "x_over_r": 10.0})
    row = sweep("mimo-gfm", "k_34", 1.0, 50.0, points=4, on=on)
    again = stability_map("mimo-gfm", "k_34", 1.0, 50.0, scr=(2.0, 8.0), points=4, on=on)
    np.testing.assert_allclose(again.sigma[-1], row.sigma, rtol=1e-9)
    assert found.scr == pytest.approx([2.0, 2.0 * 4 ** (1 / 3), 2.0 * 4 ** (2 / 3), 8.0])
    assert (found.sigma[:, 0] < 0.0).all()
    assert (found.sigma[:, -1] > 0.0).all()


def test_a_figure_s_csv_has_what_its_colours_show(tmp_path):
    found = stability_map("mimo-gfm", "k_34", 1.0, 50.0, scr=(2.0, 8.0), points=4)
    locus = sweep("mimo-gfm", "k_34", 1.0, 50.0, points=4)
    poles = [
        [s.real, s.imag / (2 * np.pi), value]
        for value, some in zip(locus.values, locus.poles, strict=True)
        for s in some
    ]
    x, y = np.meshgrid(found.values, found.scr)
    cells = np.transpose([x.ravel(), y.ravel(), found.sigma.ravel()])
    for figure, points in (
        (plot.stability_map(found), cells), (plot.root_locus(locus, style="paper"), poles)
    ):  # fmt: skip
        (file,) = plot.save(figure, tmp_path / "figure.csv")
        with file.open(encoding="utf-8", newline="") as text:
            rows = [row for row in csv.DictReader(text) if row["value"]]
        told = [[float(row[name]) for name in ("x", "y", "value")] for row in rows]
        np.testing.assert_allclose(told, points, rtol=1e-8, atol=1e-12)


@pytest.mark.full
def test_both_commands_print_and_draw(capsys, tmp_path):
    where = ["k_34", "--law", "mimo-gfm", "--range", "1:20", "--points", "5"]
    assert main(["design", "sweep", *where, "-o", str(tmp_path / "sweep.svg")]) == 0
    told = capsys.readouterr().out
    assert "stable for k_34 of 1 to 7.3" in told
    assert "from 0.5 to 1 p.u. · P_ref 0.5 p.u., SCR 57.2, X/R 10.5\n" in told
    assert main(["design", "map", *where, "--json", "-o", str(tmp_path / "map.svg")]) == 0
    content = json.loads(capsys.readouterr().out)
    assert np.shape(content["sigma"]) == (5, 5)
    assert all((tmp_path / f"{name}.svg").stat().st_size > 10_000 for name in ("sweep", "map"))


def test_a_map_says_of_which_grids_it_is(capsys):
    strong = ["--set", "plant.grid={scr=3.0, x_over_r=5.0}"]
    where = ["k_34", "--range", "1:20", "--scr", "1:2", "--points", "2", *strong]
    assert main(["design", "map", *where]) == 0
    heading, heads, *_, last = capsys.readouterr().out.splitlines()
    assert "· P_ref 0.5 p.u., SCR 3, X/R 5 · --set plant.grid=" in heading
    assert "lowest stable k_34 tried  highest" in heads
    assert last == "all have X/R 5; SCR 1 to 2 does not contain the scenario's 3"


def test_no_pole_lies_at_the_edge_of_the_figure():
    axes = plot.pole_map(gfmhil.Law.load("mimo-gfm").closed_loop("pref_step"))
    poles = axes.lines[0].get_xydata()
    shown = axes.transAxes.inverted().transform(axes.transData.transform(poles))
    assert (shown > 0.02).all() and (shown < 0.98).all()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("sweep nope --law vsg-2", "nope: vsg-2 has the parameters ["),
        ("sweep k_34 --law vsg-2 --range 5:1", "k_34: range 5 to 1 must be finite and ascending"),
        ("sweep k_34 --law vsg-2 --points 1", "points = 1: must be 2 to 10000"),
        ("map k_34 --law vsg-2 --scr 0:3", "scr: 0 to 3 must be above 0, finite and ascending"),
        ("map k_34 --scenario three_share_a_load", "--converter: must name one of ['A', 'B', 'C']"),
        ("map k_34 --scenario three_share_a_load --converter A", "the scenario has a network"),
    ],
)
def test_what_is_refused(line, words, capsys):
    assert main(["design", *line.split()]) == 2
    assert words in capsys.readouterr().err
