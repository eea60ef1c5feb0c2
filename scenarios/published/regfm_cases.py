"""The published cases of REGFM_A1 and REGFM_B1, on the bench and beside the published points.

PNNL's seven disturbances of each model, computed by PSCAD and by PSS/E; ``regfm_points.csv`` has
points of all.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lsim

import gfmhil

HERE = Path(__file__).parent
T_EVENT = 0.5  # s
SIGNALS = ("P", "Q", "V", "f")
#: first-order lag of PSCAD's recorded P, Q and V, s. A1's P is its own P_f, as its f shows, so that
#: these are TPf, TQf and TVf; B1's is not published, and is fitted to the frequency cases.
METER = {"regfm_a1": 0.01, "regfm_b1": 0.007}
#: power and voltage of a model's p.u. of impedance
_OHM = {"regfm_a1": 480.0**2 / 1e5, "regfm_b1": 230e3**2 / 1e8}
_R = {"regfm_a1": 0.001, "regfm_b1": 0.1}  # of the faults, ohm
#: of the faults with a high impedance, ohm; that of A1 by P, Q and V of either program in its fault
_HIGH = {"regfm_a1": 0.032, "regfm_b1": 30.0}


def _fault(ohm: float, duration: float, model: str) -> dict[str, Any]:
    """A fault behind 0.4 % of the line, so that P and Q are those of the converter."""
    return {"type": "fault", "position": 0.004, "R": ohm / _OHM[model], "duration": duration}


CASES = {
    "voltage-down": lambda model: {"type": "grid-voltage", "V_g": 0.95},
    "voltage-up": lambda model: {"type": "grid-voltage", "V_g": 1.05},
    "frequency-down": lambda model: {"type": "grid-frequency", "f_hz": 60.0 * (1 - 1 / 300)},
    "frequency-up": lambda model: {"type": "grid-frequency", "f_hz": 60.0 * (1 + 1 / 300)},
    "fault-0.1s": lambda model: _fault(_R[model], 0.1, model),
    "fault-0.5s": lambda model: _fault(_R[model], 0.5, model),
    "high-impedance-fault": lambda model: _fault(_HIGH[model], 0.5, model),
}
MODELS = tuple(METER)
EVERY = [(model, case) for model in MODELS for case in CASES]


def points(model: str, case: str, program: str) -> NDArray[np.float64]:
    """Published rows (n, 5) of t after the event, s, then ``SIGNALS`` in p.u. and Hz."""
    lines = (HERE / "regfm_points.csv").read_text("utf-8").splitlines()
    rows = [line.split(",") for line in lines if not line.startswith("#")]
    found = [row[3:] for row in rows if row[:3] == [model, case, program]]
    return np.array(found, float).reshape(-1, 5)


def run(model: str, case: str, after: float = 0.8) -> gfmhil.Run:
    """The case on the bench, until ``after`` seconds after its event."""
    event = {"t": T_EVENT} | CASES[case](model)
    file = HERE.parent / f"{model}.toml"
    return gfmhil.run(file, duration=T_EVENT + after, events=[event])


def metered(x: NDArray[np.float64], T: float, T_s: float) -> NDArray[np.float64]:
    """What a meter with a lag of T shows."""
    out, keep = np.empty_like(x), np.exp(-T_s / T)
    last = x[0]
    for k, value in enumerate(x):
        last = out[k] = keep * last + (1.0 - keep) * value
    return out


def traces(model: str, case: str, run: gfmhil.Run) -> NDArray[np.float64]:
    """The bench's rows as ``points``, at every tick: P, Q and V as PSCAD's meter would show them.
    f of REGFM_B1 is that of its machine, as published: the bench records that of E, which the
    angle's window ties to the PLL in a fault."""
    s, T_s = run.signals, run.scenario.T_s
    columns = [metered(s[f"true_{name}"], METER[model], T_s) for name in ("p", "q", "V")]
    speed = s["true_omega_u"] if model == "regfm_a1" else machine_speed(s["true_p"], T_s)
    return np.stack([s["t"] - T_EVENT, *columns, 60.0 * speed], axis=1)


def machine_speed(p: NDArray[np.float64], T_s: float) -> NDArray[np.float64]:
    """The speed of REGFM_B1's machine, p.u., by its equation from P at every tick; at rest first.
    No case reaches its limits of 0.05 p.u."""
    k = gfmhil.Law.load("regfm-b1").gains
    moves = np.polymul([2 * k["H"], k["D1"] + 1 / k["mp"]], [1.0, k["omega_D"]])
    moves = np.polymul(np.polyadd(moves, [k["D2"], 0.0]), [k["TPf"], 1.0])
    _, w, _ = lsim(([1.0, k["omega_D"]], moves), p[0] - p, T_s * np.arange(len(p)))
    return np.asarray(1.0 + w)


def at(rows: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    """``SIGNALS`` of rows at other instants (n, 4), by the rows that have them; nan outside."""
    out = np.full((len(t), len(SIGNALS)), np.nan)
    for x, column in zip(rows.T[1:], out.T, strict=True):
        read = np.isfinite(x)
        if read.any():
            column[:] = np.interp(t, rows[read, 0], x[read], np.nan, np.nan)
    return out


def distances(
    own: NDArray[np.float64], pscad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest and RMS distance (4,) of rows from PSCAD's points, nan where there are no two."""
    away = np.ma.masked_invalid(at(own, pscad[:, 0]) - pscad[:, 1:])
    largest, rms = np.abs(away).max(axis=0), np.sqrt((away**2).mean(axis=0))
    return np.ma.filled(largest, np.nan), np.ma.filled(rms, np.nan)
