"""p, q, V, i and f of a recording, at its own samples: as channels, or from phases and phasors.

Of phases, p + jq = v conj(i) of the space vectors at every sample, and V and i are their
magnitudes; the zero sequence, which carries no power over three wires, is left out. The frequency
is what the angle of v turns in the cycle around a sample, over 2 pi times that cycle. Of phasors p,
q, V and i follow likewise, and the frequency is that and the nominal one, in whose frame they rest.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.foreign.channels import RecordingMap

Vector = NDArray[np.float64]
_LEAST_V = 0.1  # p.u.; the angle of a smaller voltage is not followed
_EVEN = 0.01  # of a sample: by how much two of them may be further apart than others


@dataclass(frozen=True)
class SampledRecording:
    """A recording at its own samples."""

    t: Vector  # s of its clock, shape (samples,)
    dt: float  # between two samples, s
    of: dict[str, Vector]  # by signal, p.u. or rad; f and f_grid in p.u. of f_n
    #: space vectors v and i of phases, p.u., complex; empty of others
    vectors: dict[str, NDArray[np.complex128]] = field(default_factory=dict)


def sampled(columns: dict[str, Vector], of: RecordingMap, f_n: float) -> SampledRecording:
    """The signals of a file's columns by their map. Raises UserError: a channel is not there, has
    gaps or no even clock."""
    for name in of.names():
        if name not in columns:
            hint = "; give rate_hz, or channels.t" if name == "t" else ""
            raise UserError(f"channel {name!r}: is not in it{hint}; there are {[*columns]}")
        if not np.isfinite(columns[name]).all():
            raise UserError(f"channel {name!r}: has gaps or values that are no numbers")
    count = len(columns[of.names()[-1]])
    if count < 8:
        raise UserError(f"it has {count} samples: must have 8 at least")
    t = np.arange(count) / of.rate_hz if of.rate_hz else of.scalar("t", columns)
    steps = np.diff(t)
    dt = float(t[-1] - t[0]) / (count - 1)
    if not (steps > 0).all() or np.max(np.abs(steps - dt)) > max(_EVEN * dt, 2e-6):
        k = int(np.argmax(np.abs(steps - dt)))
        raise UserError(
            f"the clock is not even: {steps[k]:.6g} s pass after sample {k}, else {dt:.6g} s"
        )
    found = {n: of.scalar(n, columns) for n in of.each() if n != "t"}
    for name in {"f", "f_grid"} & {*found}:
        found[name] = found[name] / f_n
    vectors = {n: of.vector(n, columns) for n in ("v", "i") if of.v is not None}
    if not vectors:
        if "i" not in found:
            with np.errstate(divide="ignore", invalid="ignore"):
                size = np.hypot(found["p"], found["q"]) / found["V"]
            found["i"] = np.where(found["V"] > _LEAST_V, size, np.nan)
        return SampledRecording(t, dt, found)
    v, i = vectors["v"], vectors["i"]
    s = v * np.conj(i)
    made: dict[str, Vector] = {"p": s.real, "q": s.imag, "V": np.abs(v), "i": np.abs(i)}
    turns = of.v is not None and of.v.phases is not None
    made["f"] = _frequency(t, v, 1 / f_n) / f_n + (0.0 if turns else 1.0)
    return SampledRecording(t, dt, {**made, **found}, vectors if turns else {})


def _frequency(t: Vector, v: NDArray[np.complex128], cycle: float) -> Vector:
    """What v turns in the cycle around each sample, or in two samples that are further apart, Hz;
    at the ends that of the nearest; nan where v is too small."""
    half = max(0.5 * cycle, t[1] - t[0])
    angle = np.unwrap(np.angle(v))
    inside = np.clip(t, t[0] + half, t[-1] - half)
    ends = [np.interp(inside + side, t, angle) for side in (-half, half)]
    f = (ends[1] - ends[0]) / (4 * math.pi * half)
    small = np.concatenate([[0], np.cumsum(np.abs(v) < _LEAST_V)])
    reach = np.searchsorted(t, np.stack([inside - half, inside + half]))
    f[small[np.minimum(reach[1] + 1, len(v))] > small[reach[0]]] = np.nan
    return np.asarray(f)


def sequences(t: Vector, x: NDArray[np.complex128], f_n: float) -> tuple[float, float]:
    """The magnitudes of the positive and the negative sequence of a space vector over the whole
    cycles at its end, at nominal frequency, p.u."""
    turn = np.exp(-2j * math.pi * f_n * t)
    count = round(int((t[-1] - t[0]) * f_n + 0.5) / f_n / (t[1] - t[0]))
    return tuple(float(np.abs(np.mean((x * y)[-count:]))) for y in (turn, turn.conj()))  # type: ignore[return-value]


def at_ticks(s: SampledRecording, x: NDArray[Any], t: Vector, T_s: float) -> NDArray[Any]:
    """A signal at other instants, nan outside the recording: straight lines between samples, of
    which as many as lie in a tick are averaged first."""
    inside = np.clip(t, s.t[0], s.t[-1])
    if s.dt > 0.75 * T_s:
        found = np.interp(inside, s.t, x)
    else:
        area = np.concatenate([[0], np.cumsum(0.5 * (x[1:] + x[:-1]) * np.diff(s.t))])
        ends = [np.clip(inside + side, s.t[0], s.t[-1]) for side in (-0.5 * T_s, 0.5 * T_s)]
        found = np.subtract(*(np.interp(e, s.t, area) for e in ends[::-1])) / (ends[1] - ends[0])
    found[(t < s.t[0] - 0.5 * T_s) | (t > s.t[-1] + 0.5 * T_s)] = np.nan
    return found
