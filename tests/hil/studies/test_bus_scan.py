"""The impedance of a network at a bus, against that of its parts."""

import json

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.scenario import load_scenario
from gfm_plant import Plant, make_plant

HZ = np.array([1.3, 10.0, 45.0, 55.0, 80.0, 200.0, 700.0, 1500.0])
BY_S = 1j * np.abs(HZ / 50.0 - 1.0)[:, None, None]  # in the dq frame, over omega_b
TURN, ONE = np.array([[0.0, -1.0], [1.0, 0.0]]), np.eye(2)
LINES = {"bus": (0.08, 0.01), "mid": (0.12, 0.01)}  # L, R of the line that begins there


def network(**more):
    """One converter, and two lines to the grid behind each other."""
    ends = [*LINES, "far"]
    lines = {
        start: {"start": start, "end": end, "L": LINES[start][0], "R": LINES[start][1]}
        for start, end in zip(LINES, ends[1:], strict=True)
    }
    content = {"title": "one", "duration": 1.0, "law": "vsg-2", "link": {"type": "inproc"}}
    content |= {"references": {"P_ref": 0.5}}
    own = {"grid": "far", "converters": {"A": {"node": "bus"}}, "lines": lines}
    return load_scenario(content | {"network": own | more})


def inductor(L, R):
    """(K, 2, 2), p.u."""
    return (R + BY_S * L) * ONE + L * TURN


def converter():
    """Behind its own line, from its own loop at the same operating point."""
    par = make_plant(Plant(), 1e-4).par[0]
    own = {name: float(par[name]) for name in ("L_g", "R_g")}
    more = dict(zip(own, np.sum([*LINES.values()], axis=0), strict=True))
    factors = {name: float((own[name] + more[name]) / own[name]) for name in own}
    loop = gfmhil.Law.load("vsg-2").closed_loop("pref_step", plant__factors=factors)
    return loop.output_impedance(2 * np.pi * np.abs(HZ - 50.0)) + inductor(*own.values())


@pytest.mark.full
@pytest.mark.parametrize("bank", [0.0, 1e-4])
@pytest.mark.parametrize("bus", LINES)
def test_it_is_that_of_the_parts_beside_each_other(bus, bank):
    """As far as the frames agree: the trace, the determinant, and the difference across."""
    banks = {"capacitors": {"bank": {"node": bus, "Q": bank}}} if bank else {}
    scan = gfmhil.design.bus_scan(network(**banks), bus, HZ)
    sides = [converter(), inductor(*LINES["mid"])]
    sides[bus == "bus"] = sides[bus == "bus"] + inductor(*LINES["bus"])
    Z = np.linalg.inv(sum(map(np.linalg.inv, sides)) + bank * (BY_S * ONE + TURN))
    Z = np.where((HZ < 50.0)[:, None, None], Z.conj(), Z)
    for of in (np.linalg.det, lambda m: np.trace(m, axis1=1, axis2=2),
               lambda m: m[:, 1, 0] - m[:, 0, 1]):  # fmt: skip
        np.testing.assert_allclose(of(scan.Z_dq), of(Z), rtol=2e-4)
    own = 0.5 * (np.trace(Z, axis1=1, axis2=2) + 1j * (Z[:, 1, 0] - Z[:, 0, 1]))
    np.testing.assert_allclose(scan.Z, own, rtol=2e-4)


@pytest.mark.full
def test_the_command_prints_resonances_and_draws(capsys, tmp_path):
    file = str(tmp_path / "bus.svg")
    asked = ["design", "bus", "three_share_a_load", "far"]
    assert main([*asked, "--json", "-o", file]) == 0
    found = json.loads(capsys.readouterr().out)
    scan = gfmhil.design.bus_scan(load_scenario("three_share_a_load"), "far", found["hz"])
    for row, again in zip(found["resonances"], scan.resonances(), strict=True):
        assert row == pytest.approx(again) and len(scan.hz) > 400
    np.testing.assert_allclose([z[0] + 1j * z[1] for z in found["Z"]], scan.Z)
    size = np.abs(scan.Z)
    top = max((one for one in found["resonances"]), key=lambda one: one["size"])
    assert (top["kind"], top["size"]) == ("parallel", pytest.approx(size.max()))
    assert "bus far" in (tmp_path / "bus.svg").read_text("utf-8").replace("-->", "")
    assert main(asked) == 0 and "parallel" in capsys.readouterr().out


@pytest.mark.full
def test_a_resonance_is_where_it_is_and_not_at_the_nearest_frequency():
    """A bank of 0.1 p.u. at the end of a line from the grid; and none beside 50 Hz."""
    lines = {"spur": {"start": "far", "end": "tip", "L": 0.1, "R": 0.001}}
    lines |= {name: {"start": "bus", "end": "far", "L": 0.1, "R": 0.01} for name in ("a", "b")}
    corner = network(lines=lines, capacitors={"bank": {"node": "tip", "Q": 0.1}})
    scan = gfmhil.design.bus_scan(corner, "tip", np.geomspace(20.0, 2000.0, 40), refine=True)
    assert np.diff(scan.hz).min() > 1e-6
    (one,) = scan.resonances()
    hz = np.linspace(499.0, 501.0, 200_001)
    Z = np.abs(1.0 / (1.0 / (0.001 + 1j * hz / 50 * 0.1) + 1j * hz / 50 * 0.1))
    assert (one["kind"], one["hz"]) == ("parallel", pytest.approx(hz[Z.argmax()], rel=2e-4))
    assert one["size"] == pytest.approx(Z.max(), rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["pref_step", "bus"], "P_ref steps from 0.5 to 1 p.u.: has no network"),
        (["plant_of_two", "nowhere"], "bus = 'nowhere': must be one of ['bus']"),
        (["plant_of_two", "connection"], "must be one of ['bus'], not the grid's, which holds its"),
        (["plant_of_two", "bus", "--from", "49.9", "--to", "50.1"], "hz: all lie within 0.2 Hz"),
        (["plant_of_two", "bus", "--from", "0"], "--from, --to, --points: must be 0 < from < to"),
    ],
)
def test_what_cannot_be_asked(arguments, line, capsys):
    assert main(["design", "bus", *arguments]) == 2
    assert line in capsys.readouterr().err
