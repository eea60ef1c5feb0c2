"""The equations: Eq. (1)-(8) by hand, complex step, power balance."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from gfm_plant import Plant, make_plant
from gfm_plant.model import f, g

X = np.array([0.7, -0.2, 0.95, 0.15, 0.6, -0.1, 0.3, 1.05])
U = np.array([0.6, 1.01, 1.02])
D = np.array([0.998, 0.97])


@pytest.fixture
def par() -> NDArray[np.void]:
    return make_plant(Plant(), 1e-4).par


def test_as_printed_in_the_paper(par):
    r = par[0]
    i_d, i_q, v_d, v_q, i_od, i_oq, delta, v_dc = X
    i_u, omega_u, E_u = U
    omega_g, V_g = D
    w = 100 * math.pi
    L_f, R_f, C_f, L_g, R_g, C_dc = (
        r[name] for name in ("L_f", "R_f", "C_f", "L_g", "R_g", "C_dc")
    )
    expected = [
        w / L_f * E_u - w / L_f * v_d - w * R_f / L_f * i_d + w * omega_u * i_q,
        -w / L_f * v_q - w * R_f / L_f * i_q - w * omega_u * i_d,
        w / C_f * i_d - w / C_f * i_od + w * omega_u * v_q,
        w / C_f * i_q - w / C_f * i_oq - w * omega_u * v_d,
        w / L_g * (v_d - V_g * math.cos(delta)) - w * R_g / L_g * i_od + w * omega_u * i_oq,
        w / L_g * (v_q + V_g * math.sin(delta)) - w * R_g / L_g * i_oq - w * omega_u * i_od,
        w * omega_u - w * omega_g,
        w / C_dc * i_u - w * E_u * i_d / (C_dc * v_dc),
    ]
    assert f(X, U, D, par) == pytest.approx(expected, rel=1e-12)
    outputs = [
        v_dc,
        v_d * i_od + v_q * i_oq,
        omega_u,
        -v_d * i_oq + v_q * i_od,
        math.sqrt(v_d**2 + v_q**2),
    ]
    assert g(X, U) == pytest.approx(outputs, rel=1e-15)


def test_complex_step_agrees_with_central_differences(par):
    z = np.concatenate([X, U, D])

    def value(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        x, u, d = z[:8].copy(), z[8:11].copy(), z[11:].copy()
        return np.concatenate([f(x, u, d, par), g(x, u)])

    for j in range(z.size):
        nudge = np.zeros(z.size)
        nudge[j] = 1.0
        exact = value(z + 1e-30j * nudge).imag / 1e-30
        central = (value(z + 1e-6 * nudge) - value(z - 1e-6 * nudge)) / 2e-6
        np.testing.assert_allclose(exact, central.real, rtol=1e-7, atol=1e-5)


def test_power_balance_closes(par):
    """Change of stored energy = DC power in - losses in R_f, R_g - power into the grid."""
    r = par[0]
    rng = np.random.default_rng(1)
    for _ in range(20):
        x = X + 0.3 * rng.standard_normal(8)
        dx = f(x, U, D, par)
        stored = (
            r["L_f"] * (x[0] * dx[0] + x[1] * dx[1])
            + r["C_f"] * (x[2] * dx[2] + x[3] * dx[3])
            + r["L_g"] * (x[4] * dx[4] + x[5] * dx[5])
            + r["C_dc"] * x[7] * dx[7]
        ) / r["omega_b"]
        losses = r["R_f"] * (x[0] ** 2 + x[1] ** 2) + r["R_g"] * (x[4] ** 2 + x[5] ** 2)
        delivered = D[1] * (math.cos(x[6]) * x[4] - math.sin(x[6]) * x[5])
        assert stored == pytest.approx(U[0] * x[7] - losses - delivered, abs=1e-12)
