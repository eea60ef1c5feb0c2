"""Equilibria: the plant stays in the equilibrium that it computes."""

import math

import numpy as np
import pytest

from gfm_plant import NoEquilibrium, Plant, make_plant, plant_advance, plant_equilibrium
from gfm_plant.model import f, g


@pytest.mark.parametrize("P", [-1.0, 0.0, 0.5, 1.0])
@pytest.mark.parametrize(("V", "V_g", "omega_g"), [(1.0, 1.0, 1.0), (1.05, 0.95, 0.98)])
def test_it_rests(P, V, V_g, omega_g):
    par = make_plant(Plant(), 1e-4).par
    x, u = plant_equilibrium(par, P, V, V_g, omega_g)
    assert np.abs(f(x, u, np.array([omega_g, V_g]), par)).max() < 1e-8
    y = g(x, u)
    assert y[[0, 1, 2, 4]] == pytest.approx([1.0, P, omega_g, V], abs=1e-12)


def test_emulator_stays_there():
    plant = make_plant(Plant(), 1e-4)
    x, u = plant_equilibrium(plant.par, 0.5, 1.0)
    plant.start(x, u)
    for _ in range(1000):
        plant_advance(plant.records, u)
    assert plant.st["x"][0] == pytest.approx(x, abs=1e-12)


def test_against_phasors():
    """The bridge voltage behind the filter, by circuit theory."""
    par = make_plant(Plant(), 1e-4).par
    r = par[0]
    x, u = plant_equilibrium(par, 0.8, 1.02)
    v, i_o = complex(x[2], x[3]), complex(x[4], x[5])
    i = i_o + 1j * r["C_f"] * v
    assert v + complex(r["R_f"], r["L_f"]) * i == pytest.approx(u[2], abs=1e-12)
    assert v - complex(r["R_g"], r["L_g"]) * i_o == pytest.approx(np.exp(-1j * x[6]), abs=1e-12)
    assert u[0] == pytest.approx(u[2] * x[0], abs=1e-12)  # DC power = power into the bridge


@pytest.mark.parametrize("factor", [1.0, 10.0, 50.0])
def test_up_to_the_limit_of_the_line(factor):
    par = make_plant(Plant(factors={"L_g": factor, "R_g": factor}), 1e-4).par
    R, X = par[0]["R_g"], par[0]["L_g"]
    Z = math.hypot(R, X)
    most = R / Z**2 + 1 / Z
    x, _ = plant_equilibrium(par, 0.99 * most, 1.0)
    angle = x[6] + math.atan2(x[3], x[2])
    assert angle < math.pi / 2 + math.atan2(R, X)  # the stable side
    with pytest.raises(NoEquilibrium, match=rf"P = .* carries -.* to {most:.4g} p.u."):
        plant_equilibrium(par, 1.01 * most, 1.0)


def test_no_voltage():
    par = make_plant(Plant(), 1e-4).par
    with pytest.raises(NoEquilibrium, match="all must be > 0"):
        plant_equilibrium(par, 0.5, 1.0, V_g=0.0)
