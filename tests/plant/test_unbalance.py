"""Unbalanced voltages of the grid: their sequences, and what the network makes of them."""

import cmath
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_plant import grid_unbalance, phase_jump
from gfm_plant.records import V

WEAK = {"scr": 3.0, "x_over_r": 6.0}
OFF = {
    name: {"enabled": False}
    for name in (
        "over_current", "over_voltage", "under_voltage", "dc_over_voltage", "dc_under_voltage",
    )
}  # fmt: skip
W = 100 * math.pi
TURN = cmath.exp(1j * math.pi / 3)


@pytest.mark.parametrize(
    ("phases", "positive", "negative"),
    [
        ((1, 0.5, 0.5), 2 / 3, 1 / 6),  # two phases to ground: (1 + 2 d) / 3 and (1 - d) / 3
        ((0.0, 1.0, 1.0), 2 / 3, 1 / 3),
        ((TURN, 1, 1), abs(2 + TURN) / 3, 1 / 3),
        ((0.5, 0.5, 0.5), 0.5, 0.0),
    ],
)
def test_sequences(rest, phases, positive, negative):
    plant = rest()
    grid_unbalance(plant.plant, phases)
    found = [abs(complex(v)) for v in plant.now["sequence"][0]]
    assert found == pytest.approx([positive, negative], abs=1e-12)


def test_each_sequence_meets_its_own_impedances(rest):
    """After the transients, by phasors: the bridge is a short circuit to the negative sequence."""
    plant = rest(grid=WEAK, protection=OFF, dc_source={"mode": "regulated"})
    plant.advance(7)
    grid_unbalance(plant.plant, (1.0, 0.5, 0.5))
    plant.advance(30_000)
    v = np.empty(200, complex)  # of one cycle, in the frame that turns at nominal frequency
    for k in range(200):
        v[k] = complex(plant.now["w"][0, V])
        plant.advance()
    r = plant.par[0]
    Z_f, Z_g = complex(r["R_f"], -r["L_f"]), complex(r["R_g"], -r["L_g"])
    Z = 1 / (1 / Z_f - 1j * r["C_f"])
    t = (30_007 + np.arange(200)) * 1e-4
    assert np.mean(v * np.exp(2j * W * t)) == pytest.approx(Z / (Z + Z_g) / 6, abs=1e-6)
    Z_f, Z_g = Z_f.conjugate(), Z_g.conjugate()
    E, Y = plant.u[2] * np.exp(1j * plant.x[6]), 1 / Z_f + 1 / Z_g + 1j * r["C_f"]
    assert np.mean(v) == pytest.approx((E / Z_f + 2 / 3 / Z_g) / Y, abs=1e-6)


def test_transient_and_clearing_against_the_equations(rest):
    """One phase lost for 10 ms; the grid's angle jumps by 20 degrees meanwhile."""
    plant = rest(grid=WEAK, protection=OFF, dc_source={"mode": "regulated"})
    r, E, x = plant.par[0], plant.u[2], plant.x
    turned = math.radians(20)

    def slope(t: float, w: Any) -> Any:
        i_f, v, i_o = w
        jump = turned if t >= 0.005 else 0.0
        v_g = cmath.exp(1j * jump)
        if t < 0.01:  # a = 0: v+ = 2/3, v- = -1/3
            v_g = v_g * 2 / 3 - cmath.exp(-1j * (2 * W * t + jump)) / 3
        v_g *= cmath.exp(-1j * x[6])
        rates = [
            (E - v - r["R_f"] * i_f) / r["L_f"],
            (i_f - i_o) / r["C_f"],
            (v - v_g - r["R_g"] * i_o) / r["L_g"],
        ]
        return r["omega_b"] * (np.array(rates) - 1j * w)

    grid_unbalance(plant.plant, (0.0, 1.0, 1.0), duration=0.01)
    plant.advance(50)
    phase_jump(plant.plant, 20.0)
    plant.advance(150)
    w = x[0:6:2] + 1j * x[1:6:2]
    for begin, end in ((0.0, 0.005), (0.005, 0.01), (0.01, 0.02)):
        span = (begin, end - 1e-12)
        w = solve_ivp(slope, span, w, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    found = plant.st["x"][0, 0:6:2] + 1j * plant.st["x"][0, 1:6:2]
    np.testing.assert_allclose(found, w, atol=1e-8)
    assert plant.now["unbalance_left"][0] == 0.0


def test_the_dc_link_ripples_at_twice_the_frequency(rest):
    plant = rest(grid=WEAK, protection=OFF, dc_source={"mode": "regulated"})
    grid_unbalance(plant.plant, (1.0, 0.7, 1.0))
    plant.advance(20_000)
    v_dc = []
    for _ in range(2000):
        v_dc.append(plant.truth()["v_dc"])
        plant.advance()
    size = np.abs(np.fft.rfft(np.array(v_dc) - np.mean(v_dc)))
    assert np.argmax(size) == 20  # 100 Hz in 0.2 s


def test_impossible_factors_change_nothing(rest):
    plant = rest()
    before = [r.tobytes() for r in plant.plant.memory]
    with pytest.raises(ValueError, match=r"duration = 0.0: must be > 0"):
        grid_unbalance(plant.plant, (1.0, 0.5, 1.0), duration=0.0)
    with pytest.raises(ValueError, match="phases = nan: must be finite"):
        grid_unbalance(plant.plant, (1.0, math.nan, 1.0))
    assert [r.tobytes() for r in plant.plant.memory] == before
