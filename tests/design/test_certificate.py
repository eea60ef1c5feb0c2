"""Certificates against closed forms, and against the poles of whole networks."""

import math

import numpy as np
import pytest

from benchmarks.certificates import largest_sigma, random_network, widest
from gfm_design.margins.admittance import line_impedance
from gfm_design.margins.certificate import GridClass, certify
from gfm_hil.cli.main import main
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.certificate import strength_of

HZ = np.geomspace(0.01, 5000.0, 120)
OMEGA_B = 2 * math.pi * 50.0


def branch(R: float, L: float):
    """The admittance of R and L in series, and the same at other frequencies."""

    def at(hz):
        return [np.linalg.inv(line_impedance(hz, R, L, OMEGA_B))]

    return at


@pytest.mark.parametrize("loads", [False, True])
def test_passive_converters_are_certified_for_all_grids(loads) -> None:
    at = branch(0.02, 0.2)
    grids = GridClass(0.1, math.inf, (2.0, 20.0), loads)
    assert certify(grids, HZ, at(HZ), at).holds


@pytest.mark.parametrize("scr, holds", [(0.98, True), (1.02, False)])
def test_a_negative_resistance_is_certified_up_to_that_of_the_line(scr, holds) -> None:
    """L and -R_n behind a line of resistance r/SCR decays while SCR < r/R_n."""
    x_over_r, R_n = 10.0, 0.05
    r = 1.0 / math.hypot(1.0, x_over_r)
    at = branch(-R_n, 0.2)
    edge = scr * r / R_n
    grids = GridClass(0.3 * edge, edge, (x_over_r, x_over_r))
    found = certify(grids, HZ, at(HZ), at)
    assert found.holds is holds
    if not holds:  # its current does not decay, and turns at 50 Hz in the dq frame
        assert any(low <= 50.0 <= high for low, high in found.void)


def test_the_strength_of_two_converters_on_one_line() -> None:
    """S^-1 B of two ratings on a chain, by hand: X of 0.5 and 0.25 p.u., no resistance inside."""
    paper = {"L_g": 0.5 / 0.017404945449250933, "R_g": 0.05 / 0.0016620498614958448}
    far = {"L_g": 0.25 / 0.017404945449250933, "R_g": 0.025 / 0.0016620498614958448}
    network = {
        "grid": "bus",
        "converters": {
            "A": {"node": "bus", "plant": {"factors": paper}},
            "B": {"node": "bus", "plant": {"factors": far}},
        },
    }
    one = load_scenario({"title": "t", "duration": 1.0, "law": "vsg-2", "network": network})
    found, size = strength_of(one), math.hypot(1.0, 0.1)
    assert found.weakest == pytest.approx(1.0 / (0.5 * size))
    assert found.stiffest == pytest.approx(1.0 / (0.25 * size))
    assert found.x_over_r == pytest.approx((10.0, 10.0)) and not found.loads


@pytest.mark.full
@pytest.mark.parametrize("law", ["vsg-2", "mimo-gfm"])
def test_no_certified_network_is_unstable(law) -> None:
    """By the poles of random networks, of which some have a certificate."""
    inner, rng, certified = "virtual-stator", np.random.default_rng(7), 0
    certificate = widest(law, inner)
    assert certificate is not None
    for _ in range(20):
        scenario = random_network(rng, law, inner)
        if strength_of(scenario).within(certificate.grids):
            certified += 1
            assert largest_sigma(scenario) < 0.0
    assert certified > 5


def test_the_command_names_a_grid_that_makes_a_law_unstable(capsys) -> None:
    assert main(["certify", "vsg-2", "--scr", "40:80", "--power", "0", "-q"]) == 1
    out = capsys.readouterr().out
    assert "counter-example: vsg-2 at SCR 40, X/R 20, P_ref 0: 50" in out
    assert "ends as oscillating" in out


@pytest.mark.full
def test_the_command_certifies(capsys, tmp_path) -> None:
    given = ["certify", "vsg-2", "--inner", "virtual-stator", "--power", "0.5", "-q", "--loads"]
    assert main([*given, "--network", "line_fault", "--out", str(tmp_path / "c.svg")]) == 0
    out = capsys.readouterr().out
    assert "every network of this class is stable" in out and (tmp_path / "c.svg").exists()


@pytest.mark.parametrize("given, says", [
    (["--scr", "3:1"], "scr = 3:1: must be 0 < low <= high"),
    (["--x-over-r", "3:inf"], "x_over_r = 3:inf: must be 0 < low <= high, finite"),
    (["--network", "three_share_a_load"], "network: without a grid"),
    (["--scenario", "three_share_a_load"], "network: a certificate is that of a converter"),
])  # fmt: skip
def test_what_cannot_be_certified_is_one_line(given, says, capsys) -> None:
    assert main(["certify", "vsg-2", *given]) == 2
    err = capsys.readouterr().err
    assert says in err and err.count("\n") == 1
