"""The second inductor of a filter: between its capacitor and the point of connection."""

from collections.abc import Callable
from typing import Any

import pytest

from gfm_plant import fault, grid_impedance, phase_jump
from gfm_plant.grid import breaker

OFF = {name: {"enabled": False} for name in ("over_current", "under_voltage", "over_voltage")}
STIFF = {"mode": "regulated"}
SECOND = {"L": 0.08, "R": 0.013}
LOAD = {"load_R": 40.0, "load_L": 0.02}


def two(rest: Callable[..., Any], **grid: Any) -> tuple[Any, Any]:
    """A plant with a second inductor, and one whose line is as long as inductor and line."""
    with_lcl = rest(lcl=SECOND, grid=grid, protection=OFF, dc_source=STIFF)
    r = with_lcl.par[0]
    factors = {f"{x}_g": float(r[f"{x}_g"] / r[f"{x}_line_n"]) for x in "LR"}
    return with_lcl, rest(factors=factors, grid=grid, protection=OFF, dc_source=STIFF)


def test_it_adds_to_the_line(rest):
    lcl, line = two(rest, **LOAD)
    r = lcl.par[0]
    nominal = rest().par[0]
    assert r["L_g"] == pytest.approx(SECOND["L"] + nominal["L_g"], rel=1e-15)
    assert r["R_g"] == pytest.approx(SECOND["R"] + nominal["R_g"], rel=1e-15)
    assert lcl.x == pytest.approx(line.x, abs=1e-14)
    for one in (lcl, line):
        phase_jump(one.plant, 10.0)
        one.advance(200)
        breaker(one.plant, closed=False)
        one.advance(200)
        breaker(one.plant, closed=True)
        one.advance(100)
    assert lcl.st["x"][0] == pytest.approx(line.st["x"][0], abs=1e-10)


@pytest.mark.parametrize("kind", ["3ph", "LG"])
def test_a_fault_at_the_point_of_connection(rest, kind):
    """With R over L the same in both parts, the place on a line as long as both is known."""
    r = rest().par[0]
    ratio = 3.0
    lcl = rest(
        lcl={"L": float(ratio * r["L_g"]), "R": float(ratio * r["R_g"])},
        protection=OFF, dc_source=STIFF,
    )  # fmt: skip
    line = rest(factors={"L_g": 1 + ratio, "R_g": 1 + ratio}, protection=OFF, dc_source=STIFF)
    fault(lcl.plant, 0.0, 0.01, duration=0.02, kind=kind)
    fault(line.plant, ratio / (1 + ratio), 0.01, duration=0.02, kind=kind)
    for one in (lcl, line):
        one.advance(300)
    assert lcl.st["x"][0] == pytest.approx(line.st["x"][0], abs=1e-10)


def test_another_line_leaves_it_as_it_is(rest):
    changed, made = two(rest)
    grid_impedance(changed.plant, 5.0, 4.0)
    r, nominal = changed.par[0], rest().par[0]
    assert r["L_g"] == pytest.approx(SECOND["L"] + 5 * nominal["L_g"], rel=1e-14)
    grid_impedance(made.plant, *(float(r[f"{x}_g"] / r[f"{x}_line_n"]) for x in "LR"))
    for one in (changed, made):
        one.advance(300)
    assert changed.st["x"][0] == pytest.approx(made.st["x"][0], abs=1e-10)


def test_a_scr_is_that_at_the_point_of_connection(rest):
    plant = rest(lcl=SECOND, grid={"scr": 3.0, "x_over_r": 6.0})
    line = plant.plant.wiring.branches[0]
    assert abs(complex(line.R, line.L)) == pytest.approx(1 / 3)
    assert (line.start, line.end) == ("connection", "far")


@pytest.mark.parametrize("kind", ["LG", "LLG"])
def test_an_earthed_transformer_carries_the_zero_sequence(rest, kind):
    """Beside the line to the grid; alone in an island, where a fault otherwise has no way."""
    grid = {"scr": 3.0, "x_over_r": 6.0, **LOAD}
    own = rest(lcl={**SECOND, "earthed": True}, grid=grid, protection=OFF, dc_source=STIFF)
    told = rest(lcl=SECOND, grid=grid, protection=OFF, dc_source=STIFF)
    Z_t, r = complex(SECOND["R"], SECOND["L"]), own.par[0]
    Z_line = complex(r["R_g"], r["L_g"]) - Z_t
    at_once: Any = {"kind": kind, "duration": 0.01, "clearing": "instant"}
    fault(own.plant, 0.0, 0.01, **at_once)
    fault(told.plant, 0.0, 0.01, Z_0=Z_t * Z_line / (Z_t + Z_line), **at_once)
    for one in (own, told):
        one.advance(100)
    assert own.st["x"][0] == pytest.approx(told.st["x"][0], abs=1e-12)
    breaker(own.plant, closed=False, clearing="instant")
    breaker(told.plant, closed=False, clearing="instant")
    fault(own.plant, 0.0, 0.01, **at_once)
    fault(told.plant, 0.0, 0.01, Z_0=Z_t, **at_once)
    for one in (own, told):
        one.advance(100)
    assert own.st["x"][0] == pytest.approx(told.st["x"][0], abs=1e-12)
