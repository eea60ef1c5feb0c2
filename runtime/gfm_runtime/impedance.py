"""Estimate of the grid's reactance from the converter's own power swings, for gain scheduling.

Around an operating point p moves with the angle as dp = K d(delta), K = E V_g cos(delta)/X, and
d(delta)/dt = omega_b (omega_u - omega_g) (Eq. (7) of the paper). Both sides pass the same
low-pass, which removes the LC resonance, and the same washout, which removes the unknown omega_g
and the operating point; K is the ratio of two exponentially forgetting sums,
K = sum(p_w theta_w)/sum(theta_w^2). With p = E V_g sin(delta)/X the reactance follows without
knowing delta: X = E V_g / sqrt(K^2 + p^2), with V_g taken as 1 p.u., E as V, and p, like K, that of
the operating point. delta spans the converter's own filter too, whose X_f is known and taken off.
The estimate moves only while the sums hold enough excitation and p follows the angle (squared
correlation above COHERENT), and is held otherwise: in a transient that comes from the grid p moves
without the angle and would tell nothing.
"""

import math
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import compiled

COHERENT = 0.7
EXCITATION = 1e-7  # rad^2: least mean square of the washed-out angle that may move X
SMOOTH = 2 * math.pi * 20.0  # rad/s: corner of the low-pass on p and on omega_u
WASHOUT = 2 * math.pi * 0.5  # rad/s: corner of the washout on p and on the angle
MEMORY_S = 0.5  # time constant of the forgetting sums
X_MIN = 1e-3  # p.u.; no line is shorter
SETTLED = 5.0  # time constants of the washout; before, it still shows where it was started

impedance_dtype = np.dtype(
    [
        ("T_s", "f8"),
        ("omega_b", "f8"),
        ("X_f", "f8"),  # reactance of the converter's own filter, p.u.
        ("p_smooth", "f8"),
        ("omega_smooth", "f8"),
        ("forget", "f8"),  # per tick
        ("theta", "f8"),  # washed-out angle, rad
        ("p_slow", "f8"),  # slow part of p that the first washout takes away, p.u.
        ("p_slower", "f8"),  # and the second
        ("s_pt", "f8"),
        ("s_tt", "f8"),
        ("s_pp", "f8"),
        ("omega_slow", "f8"),
        ("age", "i8"),  # ticks since the start, until it has settled
        ("settled", "i8"),  # how many these are
        ("X", "f8"),  # the estimate, p.u.
    ],
    align=True,
)


def make_impedance(
    T_s: float, X_0: float, omega_b: float = 100 * math.pi, X_f: float = 0.0
) -> NDArray[Any]:
    """Estimator record, one element.

    Args:
        T_s: sampling time, s.
        X_0: estimate to start from, p.u.
        omega_b: base frequency, rad/s.
        X_f: reactance between the controlled voltage and the point where p is measured, p.u.

    Raises:
        ValueError: a value that is not positive.
    """
    for name, value in {"T_s": T_s, "X_0": X_0, "omega_b": omega_b}.items():
        if not value > 0.0:
            raise ValueError(f"{name} = {value} must be > 0")
    if not X_f >= 0.0:
        raise ValueError(f"X_f = {X_f} must be >= 0")
    out = np.zeros(1, impedance_dtype)
    out["T_s"], out["omega_b"], out["X"], out["X_f"] = T_s, omega_b, X_0, X_f
    out["forget"] = T_s / MEMORY_S
    out["settled"] = next(n for n in count(1) if n * (WASHOUT * T_s) > SETTLED)
    return out


@compiled
def estimate(est, p, omega_u, V):
    """One tick of the estimator from p, omega_u and V, p.u.; returns X, p.u."""
    if est.age == 0:
        est.p_slow, est.omega_slow = p, omega_u
        est.p_smooth, est.omega_smooth = p, omega_u
    if est.age < est.settled:
        est.age += 1
    b = SMOOTH * est.T_s
    est.p_smooth += b * (p - est.p_smooth)
    est.omega_smooth += b * (omega_u - est.omega_smooth)
    a = WASHOUT * est.T_s
    # twice through the washout, both of them: an angle under a constant omega_g is a ramp
    est.omega_slow += a * (est.omega_smooth - est.omega_slow)
    est.theta += est.T_s * est.omega_b * (est.omega_smooth - est.omega_slow) - a * est.theta
    est.p_slow += a * (est.p_smooth - est.p_slow)
    est.p_slower += a * (est.p_smooth - est.p_slow - est.p_slower)
    p_fast = est.p_smooth - est.p_slow - est.p_slower
    est.s_pt += est.forget * (p_fast * est.theta - est.s_pt)
    est.s_tt += est.forget * (est.theta * est.theta - est.s_tt)
    est.s_pp += est.forget * (p_fast * p_fast - est.s_pp)
    coherent = est.s_pt * est.s_pt > COHERENT * est.s_pp * est.s_tt
    if est.age >= est.settled and est.s_tt > EXCITATION and est.s_pt > 0 and coherent:
        K = est.s_pt / est.s_tt
        X = V / math.sqrt(K * K + est.p_slow * est.p_slow) - est.X_f
        est.X = max(X, X_MIN)
    return est.X
