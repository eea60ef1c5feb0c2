"""Error maps: the errors on which Phi(s) acts, if not Y_ref - y.

Each map turns references r and measurements y (five each, p.u.) into mapped ones, in place, so
that the error is (mapped r) - (mapped y). Column 3, omega_u, is never mapped.

=============== ==================================================================================
name            what it does
=============== ==================================================================================
linear          nothing: e = Y_ref - y (the paper's natural choice)
dc-energy       column 1: e = (V_dcref^2 - v_dc^2)/2, [Zhang2010] in the paper
dvoc            column 2: e = P_ref/V_ref^2 - p/V^2; column 4: e = Q_ref/V_ref^2 - q/V^2,
                [Tayyebi2020] in the paper (dispatchable virtual oscillator control)
hybrid-angle    column 2: e = sin((delta_ref - delta)/2), [Tayyebi2020hybrid] in the paper; delta
                is the angle across the impedance R + jX between the capacitor and the grid,
                delta = arg(V - (R + jX) conj(p + jq)/V) sign reversed, and delta_ref is the
                same expression of (P_ref, Q_ref, V_ref)
=============== ==================================================================================
"""

from __future__ import annotations

import math

from gfm_runtime.compiled import inlined

LINEAR, DC_ENERGY, DVOC, HYBRID_ANGLE = 0, 1, 2, 3

ERROR_MAPS = {
    "linear": LINEAR,
    "dc-energy": DC_ENERGY,
    "dvoc": DVOC,
    "hybrid-angle": HYBRID_ANGLE,
}

V_MIN = 1e-3  # p.u.; a dead bus must not divide by zero


@inlined
def _angle_across(p, q, V, R, X):
    """Angle [rad] by which V leads the voltage behind R + jX when p + jq flows into it."""
    return math.atan2(X * p - R * q, V * V - (R * p + X * q))


@inlined
def map_errors(code, parameters, r, y):
    """Map r and y (shape (5,), p.u.) in place by the map of that code, in their own precision."""
    half = r.dtype.type(0.5)
    if code == DC_ENERGY:
        r[0] = half * r[0] * r[0]
        y[0] = half * y[0] * y[0]
    elif code == DVOC:
        v_ref = max(r[4], r.dtype.type(V_MIN))
        v = max(y[4], r.dtype.type(V_MIN))
        r[1] /= v_ref * v_ref
        r[3] /= v_ref * v_ref
        y[1] /= v * v
        y[3] /= v * v
    elif code == HYBRID_ANGLE:
        R, X = parameters[0], parameters[1]
        target = _angle_across(r[1], r[3], r[4], R, X)
        actual = _angle_across(y[1], y[3], y[4], R, X)
        r[1] = math.sin(half * (target - actual))
        y[1] = 0
