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

import math

from gfm_runtime.compiled import inlined

LINEAR, DC_ENERGY, DVOC, HYBRID_ANGLE = 0, 1, 2, 3

ERROR_MAPS = {"linear": LINEAR, "dc-energy": DC_ENERGY, "dvoc": DVOC, "hybrid-angle": HYBRID_ANGLE}
#: by map the references that move errors besides their own, and the columns of these, zero-based
MAPPED = {"dvoc": {"V_ref": {1, 3}}, "hybrid-angle": {"Q_ref": {1}, "V_ref": {1}}}
#: maps across a line, which need its R and X
WITH_IMPEDANCE = ("hybrid-angle",)

V_MIN = 1e-3  # p.u.; a dead bus must not divide by zero
R_MIN = 2.0**-60  # p.u.^4; shorter vectors have no direction; its square is normal in float32


@inlined
def _across(p, q, V, R, X):
    """The vector (x, y), p.u.^2, whose angle is that by which V leads the voltage behind R + jX."""
    return V * V - (R * p + X * q), X * p - R * q


@inlined
def _sine_of_half(x_a, y_a, x_b, y_b, half):
    """sin((a - b)/2) for the angles a and b, in (-pi, pi], of two vectors, without libm but sqrt.

    The dot and the cross product give cos and sin of a - b; cos(d/2) = sqrt((1 + cos d)/2) and
    sin d = 2 sin(d/2) cos(d/2) give the half, with sine and cosine exchanged where cos d < 0, so
    that no sum cancels. The error is below 1.5 eps. IEEE 754 rounds + - * / sqrt alike everywhere,
    so every compiler gives these bits; sin and atan2 differ between C libraries. ``half`` is 0.5
    in the law's precision. The result is 0 if a vector has no length.
    """
    dot, cross = x_a * x_b + y_a * y_b, y_a * x_b - x_a * y_b
    r = math.sqrt(dot * dot + cross * cross)
    if not r >= R_MIN:
        return half - half
    larger = math.sqrt(half + half * abs(dot / r))
    sine = half * abs(cross / r) / larger if dot >= 0 else larger
    a_below, b_below = y_a < 0, y_b < 0
    return -sine if (cross < 0 if a_below == b_below else a_below) else sine


@inlined
def _dc_energy(r, y):
    """Column 1: the error (V_dcref^2 - v_dc^2)/2."""
    half = r.dtype.type(0.5)
    r[0] = half * r[0] * r[0]
    y[0] = half * y[0] * y[0]


@inlined
def _dvoc(r, y):
    """Columns 2 and 4: the errors P_ref/V_ref^2 - p/V^2 and Q_ref/V_ref^2 - q/V^2."""
    v_ref = max(r[4], r.dtype.type(V_MIN))
    v = max(y[4], r.dtype.type(V_MIN))
    r[1] /= v_ref * v_ref
    r[3] /= v_ref * v_ref
    y[1] /= v * v
    y[3] /= v * v


@inlined
def _hybrid_angle(parameters, r, y):
    """Column 2: the error sin((delta_ref - delta)/2), delta across the impedance R + jX, p.u."""
    R, X = parameters[0], parameters[1]
    x_a, y_a = _across(r[1], r[3], r[4], R, X)
    x_b, y_b = _across(y[1], y[3], y[4], R, X)
    r[1] = _sine_of_half(x_a, y_a, x_b, y_b, r.dtype.type(0.5))
    y[1] = 0


@inlined
def map_errors(code, parameters, r, y):
    """The error map of that code, in place: what r and y are to the law.

    Args:
        code: a value of ``ERROR_MAPS``.
        parameters: shape (2,): R and X, p.u.
        r, y: shape (5,), p.u., in the law's own precision.
    """
    if code == DC_ENERGY:
        _dc_energy(r, y)
    elif code == DVOC:
        _dvoc(r, y)
    elif code == HYBRID_ANGLE:
        _hybrid_angle(parameters, r, y)
