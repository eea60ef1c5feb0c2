"""Regions of attraction against the equilibria of the circuit, and over quantities."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

import gfmhil
from gfm_hil.cli.main import main
from gfm_hil.scenario import load_scenario
from gfm_hil.scenario.loading import plant_of
from gfm_hil.studies.attraction import ANOTHER_TURN

from .test_clearing import OFF


def first_order(P_ref: float, tmp_path) -> dict:
    """An angle that follows P_ref - p and has no inertia, behind 0.35 p.u. and a line."""
    law = tmp_path / "first.toml"
    law.write_text(
        """name = "first"\ntitle = "An angle without inertia, constant E"\nsource = "test"\n[phi]
        11 = { type = "PI", k = 90.0, k_i = 400.0 }
        22 = { type = "P", k = 0.01 }
        33 = { type = "P", k = 1e-9 }\n"""
    )
    return {
        "title": "no inertia",
        "duration": 1.0,
        "law": str(law),
        "references": {"P_ref": P_ref},
        "plant": {
            "grid": {"scr": 2.0, "x_over_r": 30.0},
            "factors": {"L_f": 20.0},
            "dc_source": {"mode": "regulated"},
            "protection": OFF,
        },
    }


@pytest.mark.parametrize("P_ref", [0.3, 0.8])
def test_without_inertia_its_ends_are_the_unstable_equilibria(P_ref, tmp_path):
    content = first_order(P_ref, tmp_path)
    par = plant_of(load_scenario(content, in_process=True)).par[0]
    R_f, L_f, C_f, R_g, L_g = (float(par[n]) for n in ("R_f", "L_f", "C_f", "R_g", "L_g"))
    z_f, z_g = R_f + 1j * L_f, R_g + 1j * L_g

    def lacks(delta: float) -> float:
        e = np.exp(1j * delta)
        v = (e / z_f + 1 / z_g) / (1 / z_f + 1 / z_g + 1j * C_f)
        return float((v * np.conj((v - 1) / z_g)).real) - P_ref

    rest, unstable = brentq(lacks, -0.5, 1.4), brentq(lacks, 1.6, math.pi)
    back, ahead = math.degrees(rest - unstable), math.degrees(rest - unstable) + 360.0
    made = gfmhil.attraction(None, content, after=6.0, within=0.5)
    assert made.low == pytest.approx(back, abs=2.0) and made.below == ANOTHER_TURN
    assert made.high == pytest.approx(min(ahead, 180.0), abs=2.0)
    assert made.above == (ANOTHER_TURN if ahead < 180.0 else "")


@pytest.mark.full
def test_a_map_has_the_regions_of_its_places():
    over = {"scr": (2.0, 6.0), "references.P_ref": (0.2, 0.8)}
    how = {"after": 2.0, "within": 4.0, "on": "deep_sag"}
    made = gfmhil.attraction_map("droop-5", over=over, **how)
    one = gfmhil.attraction("droop-5", references__P_ref=0.8, **how)
    assert made.values("low")[0, 1] == one.low and made.values("high")[0, 1] == one.high
    assert [*made.to_pandas().columns] == [*over, "low", "high", "below", "above", "runs"]
    # more power leaves less room behind the unstable equilibrium
    assert (np.diff(-made.values("low"), axis=1) < 0.0).all()


@pytest.mark.full
def test_the_protection_may_end_it_first(capsys, tmp_path):
    figure = tmp_path / "region.png"
    asked = ["--law", "vsg-2", "--after", "1", "--scr", "2,4", "--out", str(figure)]
    assert main(["design", "attraction", *asked]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[3:5] for row in rows if row[:1] in (["2"], ["4"])] == [["over-current"] * 2] * 2
    assert figure.stat().st_size > 5000


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--within", "0"], "within = 0 degrees: must lie in [0.01, 90]"),
        (["--after", "1e9"], "after = 1e+09 s: must lie in [0.1, 60]"),
        (["--scenario", "three_share_a_load"], "network: the region of attraction is that of one"),
        (["--over", "references.P_rf=0.1"], "references.P_rf"),
    ],
)
def test_what_has_no_region_is_refused_in_one_line(options, said, capsys):
    assert main(["design", "attraction", *options]) == 2
    assert said in capsys.readouterr().err
