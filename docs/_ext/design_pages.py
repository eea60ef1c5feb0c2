"""The H-infinity problem as tables: its weights, and gamma of gains that are fixed."""

from __future__ import annotations

import numpy as np

from gfm_design.norms.performance import PAPER_WEIGHTS, WeightedChannel
from gfm_design.tuning.gains import FreeGain
from gfm_design.tuning.paper import PAPER_START, PaperProblem
from gfm_hil.core.terminal import markdown
from gfm_runtime import law_file
from gfm_runtime.lawfile import tied

#: column: law, gains that differ from its file
_COLUMNS = (
    ("VSG-2, printed", "vsg-2", {}),
    ("the initial K", "mimo-gfm", PAPER_START["mimo-gfm"]),
    ("MIMO-GFM, printed", "mimo-gfm", {}),
    ("the same, $k_{24}$ = −0.00005", "mimo-gfm", {"k_24": -5e-5}),
    ("`mimo-gfm-deployable`", "mimo-gfm-deployable", {}),
)


def _channels(law: str, given: dict[str, float]) -> tuple[WeightedChannel, ...]:
    file = law_file(law)
    values = tied(file, given) if given else {}
    gains = tuple(FreeGain(n, v, -np.inf, np.inf) for n, v in values.items())
    return PaperProblem(file, gains).channels(np.array([g.start for g in gains]))


def gammas() -> str:
    """||W_ij T_ij|| and the frequency [rad/s] of its peak, one column a set of gains."""
    columns = [_channels(law, given) for _, law, given in _COLUMNS]
    rows = []
    for row in zip(*columns, strict=True):
        cells = [f"{c.norm:.4f} ({_short(c.omega)})" for c in row]
        rows.append([f"$W_{{{row[0].i}{row[0].j}}} T_{{{row[0].i}{row[0].j}}}$", *cells])
    rows.append(["**γ**", *(f"**{max(c.norm for c in column):.4f}**" for column in columns)])
    return markdown(["", *(head for head, *_ in _COLUMNS)], rows)


def weights() -> str:
    """Gain at rest and at high frequency, zeros and poles of each weight."""
    rows = []
    for w in PAPER_WEIGHTS:
        zeros, poles = (_roots(c) for c in (w.num, w.den))
        rest, far = w.num[-1] / w.den[-1], w.num[0] / w.den[0]
        rows.append([f"$W_{{{w.i}{w.j}}}$", f"{rest:.4g}", zeros, poles, f"{far:.4g}"])
    return markdown(["", "at ω = 0", "zeros [rad/s]", "poles [rad/s]", "at ω → ∞"], rows)


def _short(omega: float) -> str:
    return f"{omega:.0f}" if omega >= 1e3 else f"{omega:.3g}"


def _roots(coefficients: tuple[float, ...]) -> str:
    sizes = sorted(abs(float(r.real)) for r in np.roots(coefficients))
    return ", ".join(f"{s:.4g}" for s in sizes)
