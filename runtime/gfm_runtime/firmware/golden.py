"""Golden vectors: what the compiled kernel does with inputs that reach all of a law's paths.

A row is one tick: what is done before the step, the references and measurements, and what the step
returns and leaves. All are the bits of numbers of the law's precision, or small integers, in words
of its size. The inputs are 30 ticks each of: noise about the operating point; ramps of the
references; the whole ranges of the signal table at random; the same extreme for long, so that u is
limited; powers that are subnormal or zeros of both signs; measurements that are not finite or out
of range, the safe state and its end; changes of law. They come from integers of PCG64, so they are
the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import compiled
from gfm_runtime.firmware.module import BAD_REF, Module
from gfm_runtime.kernel import N_MAX, state_dtype, step
from gfm_runtime.signals import NU, NY, group
from gfm_runtime.states import BAD_U, BAD_Y, OK
from gfm_runtime.switchover import change_law, settle_into

#: what a row does before its step: nothing, init, a bumpless change to the row's law, or reset and
#: settle at the last u
STEP, INIT, SWITCH, RESET = range(4)
SEGMENT = 30  # ticks of one kind
KINDS = 7
SHIPPED, CHECKED = KINDS * SEGMENT, 48 * KINDS * SEGMENT  # ticks a law: 210 and 10,080

Inputs = tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class Golden:
    """Golden rows of a set of laws.

    Attributes:
        words: shape (rows, columns), uint32 or uint64.
        columns: their names: op, law, result, ref_*, y_*, u_*, bump, x_*, offset_*, last_* (u of
            the last tick), trend_*.
    """

    words: NDArray[Any]
    columns: tuple[str, ...]

    def csv(self) -> str:
        """Lines of hexadecimal words under a line of names."""
        return (
            ",".join(self.columns)
            + "\n"
            + "".join(",".join(f"0x{w:x}" for w in row) + "\n" for row in self.words.tolist())
        )


def columns(states: int) -> tuple[str, ...]:
    """The columns of golden rows whose laws have up to ``states`` states."""
    y, u, ref = (tuple(s.name for s in group(name)) for name in ("y", "u", "ref"))
    return (
        "op", "law", "result",
        *(f"ref_{name}" for name in ref), *(f"y_{name}" for name in y),
        *(f"u_{name}" for name in u), "bump",
        *(f"x_{i}" for i in range(states)), *(f"offset_{name}" for name in u),
        *(f"last_{name}" for name in u), *(f"trend_{name}" for name in u),
    )  # fmt: skip


def golden(modules: Sequence[Module], ticks: int) -> Golden:
    """Golden rows of the laws one after the other, each with that many ticks.

    The first law starts by init, each of the others by a change from the law before it.
    """
    real = modules[0].real
    states = max([1, *(m.n for m in modules)])
    names = columns(states)
    word = np.dtype(f"u{real.itemsize}")
    laws = np.array([m.record for m in modules])
    instances = np.zeros((len(modules), 2), state_dtype(real))
    ends = [[getattr(s, e) for s in group(v)] for v in ("y", "ref") for e in ("low", "high")]
    ranges = np.array(ends, real)
    start = np.array([s.default for s in group("u")], real)
    now, bump = np.zeros(3, np.int64), np.zeros(1, real)
    u, new_u, zero = np.zeros(NU, real), np.zeros(NU, real), np.zeros(NU, real)
    parts = []
    for k in range(len(modules)):
        op, refs, ys = inputs(k, ticks, real)
        op[0] = INIT if k == 0 else SWITCH
        result, out = np.zeros(ticks, np.int64), np.zeros((ticks, len(names) - 3), real)
        _drive(
            laws, instances, ranges, start, op, k, refs, ys, now, u, new_u, zero, bump, result, out
        )
        integers = np.stack([op, np.full(ticks, k), result], axis=1).astype(word)
        parts.append(np.hstack([integers, out.view(word)]))
    return Golden(np.vstack(parts), names)


@compiled
def _drive(laws, instances, ranges, start, op, k, refs, ys, now, u, new_u, zero, bump, result, out):
    """The rows of law k, as the self-test has them: two instances of each law, one in use.

    ``now`` is the law and the instance in use and the result that is latched, ``u`` and ``bump``
    are the newest; they go on from call to call. ``result`` and ``out`` are what the rows say.
    """
    for i in range(len(op)):
        ref, y = refs[i], ys[i]
        if op[i] == INIT:
            now[0], now[1], now[2] = k, 0, OK
            state = instances[k, 0]
            for j in range(N_MAX):
                state.x[j] = 0
            for j in range(NU):
                state.offset[j] = state.trend[j] = 0
                state.u[j] = start[j]
        elif op[i] == SWITCH:
            old = now[0]
            old_state, new_state = instances[old, now[1]], instances[k, 1 - now[1]]
            bump[0] = change_law(laws[old], old_state, laws[k], new_state, ref, y, u)
            now[0], now[1] = k, 1 - now[1]
        elif op[i] == RESET:
            now[2] = OK
            for j in range(NU):
                u[j] = instances[now[0], now[1]].u[j]
            settle_into(laws[now[0]], instances[now[0], now[1]], ref, y, u, zero)
        law, state = laws[now[0]], instances[now[0], now[1]]
        if now[2] == OK:
            now[2] = _refusal(ranges, ref, y)
        if now[2] == OK:
            step(law, state, ref, y, new_u)
            for j in range(NU):
                if not math.isfinite(new_u[j]):
                    now[2] = BAD_U
        if now[2] == OK:
            for j in range(NU):
                u[j] = new_u[j]
        result[i] = now[2]
        _write(out[i], state, ref, y, u, bump[0])


@compiled
def _refusal(ranges, ref, y):
    """OK, or why a step refuses references and measurements (each (5,), p.u.)."""
    for j in range(NY):
        if not (ranges[0, j] <= y[j] <= ranges[1, j]):
            return BAD_Y
    for j in range(NY):
        if not (ranges[2, j] <= ref[j] <= ranges[3, j]):
            return BAD_REF
    return OK


@compiled
def _write(out, state, ref, y, u, bump):
    """The numbers of a row, in the order of the columns."""
    n = len(out) - 2 * NY - 4 * NU - 1
    for j in range(NY):
        out[j], out[NY + j] = ref[j], y[j]
    at = 2 * NY
    for j in range(NU):
        out[at + j] = u[j]
    out[at + NU] = bump
    at += NU + 1
    for j in range(n):
        out[at + j] = state.x[j]
    at += n
    for j in range(NU):
        out[at + j] = state.offset[j]
        out[at + NU + j] = state.u[j]
        out[at + 2 * NU + j] = state.trend[j]


def inputs(seed: int, ticks: int, real: np.dtype[Any]) -> Inputs:
    """What is done before each step, references and measurements (ticks, 5), p.u."""
    source = np.random.PCG64(seed)

    def uniform(*shape: int) -> NDArray[np.float64]:
        bits = source.random_raw(int(np.prod(shape)))  # integers: the same with every numpy
        return np.asarray((bits >> np.uint64(11)).reshape(shape) * 2.0**-53, np.float64)

    ref_group, y_group = group("ref"), group("y")
    rest = np.array([s.default for s in ref_group])
    ref_low, ref_high, y_low, y_high = (
        np.array([getattr(s, end) for s in signals])
        for signals in (ref_group, y_group)
        for end in ("low", "high")
    )
    inner = 1e-3  # stays off the ends of the ranges, which differ in float32
    op = np.zeros(ticks, np.int64)
    refs, ys = np.tile(rest, (ticks, 1)), np.tile(rest, (ticks, 1))
    for k, start in enumerate(range(0, ticks, SEGMENT)):
        at = slice(start, min(start + SEGMENT, ticks))
        n = at.stop - at.start
        kind = k % KINDS
        ys[at] += 0.02 * (uniform(n, NY) - 0.5)
        refs[at] += 0.02 * (uniform(NY) - 0.5)
        whole = y_low + (inner + (1 - 2 * inner) * uniform(n, NY)) * (y_high - y_low)
        if kind == 1:
            target = ref_low + (inner + (1 - 2 * inner) * uniform(NY)) * (ref_high - ref_low)
            along = (np.arange(1, n + 1) / SEGMENT)[:, None]
            refs[at] = rest + along * (target - rest)
        elif kind == 2:
            ys[at] = whole
        elif kind == 3:
            ys[at] = whole[0]
        elif kind == 4:
            tiny = float(np.finfo(real).tiny)
            for values in (refs, ys):
                values[at] = rest
                signs = np.resize([1.0, -1.0, 0.0, -0.0], n)  # zeros of both signs too
                values[at, 1], values[at, 3] = tiny * uniform(2, n) * [signs, np.roll(signs, 1)]
            op[start + n // 2] = SWITCH
        elif kind == 5 and n == SEGMENT:
            bad, where = (uniform(2) * [6, NY]).astype(int)
            wrong = (np.nan, np.inf, -np.inf, y_low[where] - 1, y_high[where] + 1, np.nan)
            ys[start + 5, where] = wrong[bad]
            if bad == 5:
                ys[start + 5], refs[start + 5, where] = rest, ref_high[where] + 1
            op[start + 10] = RESET
        elif kind == 6:
            op[start : at.stop : 10] = SWITCH
    return op, refs.astype(real), ys.astype(real)
