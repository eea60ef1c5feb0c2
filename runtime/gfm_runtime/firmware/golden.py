"""Golden vectors: what the compiled kernel does with inputs that reach all of a law's paths.

A row is one tick: what is done before the step, the references and measurements, and what the step
returns and leaves. All are the bits of numbers of the law's precision, or small integers, in words
of its size. The inputs are 30 ticks each of: noise about the operating point; ramps of the
references; the whole ranges of the signal table at random; the same extreme for long, so that u is
limited; subnormal powers; measurements that are not finite or out of range, the safe state and its
end; changes of law. They come from integers of PCG64, so they are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.firmware.module import BAD_REF, Module
from gfm_runtime.kernel import state_dtype, step
from gfm_runtime.signals import NU, NY, Signal, group
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
    out = np.zeros((len(modules) * ticks, len(names)), word)
    records = np.array([m.record for m in modules])
    bench = _Bench(records, real)
    row = 0
    for k in range(len(modules)):
        op, refs, ys = inputs(k, ticks, real)
        op[0] = INIT if k == 0 else SWITCH
        for i in range(ticks):
            reals = bench.tick(int(op[i]), k, refs[i], ys[i])
            out[row, :3] = op[i], k, bench.result
            values = np.concatenate([refs[i], ys[i], *reals(states)])
            out[row, 3:] = values.view(word)
            row += 1
    return Golden(out, names)


class _Bench:
    """Two instances of each law, as the self-test has them, in the compiled kernel."""

    def __init__(self, records: NDArray[Any], real: np.dtype[Any]) -> None:
        self.laws, self.states = records, np.zeros((len(records), 2), state_dtype(real))
        self.u, self.bump = np.zeros(NU, real), real.type(0)
        self.law, self.instance, self.result = 0, 0, OK
        self._y, self._ref, self._u = (group(name) for name in ("y", "ref", "u"))
        self._zero = np.zeros(NU, real)

    def tick(self, op: int, law: int, ref: NDArray[Any], y: NDArray[Any]) -> Any:
        """One row; returns a function that gives its outputs and state for so many states."""
        u = self.u
        if op == INIT:
            self.law, self.instance, self.result = law, 0, OK
            self.states[law, 0] = np.zeros((), self.states.dtype)
            self.states[law, 0]["u"] = [s.default for s in self._u]
        elif op == SWITCH:
            old, old_state = self.laws[self.law], self.states[self.law, self.instance]
            self.law, self.instance = law, 1 - self.instance
            new, new_state = self.laws[law], self.states[law, self.instance]
            self.bump = u.dtype.type(change_law(old, old_state, new, new_state, ref, y, u))
        elif op == RESET:
            self.result = OK
            state = self.states[self.law, self.instance]
            u[:] = state["u"]
            settle_into(self.laws[self.law], state, ref, y, u, self._zero)
        state = self.states[self.law, self.instance]
        if self.result == OK:
            self.result = refusal(ref, y, self._ref, self._y)
        if self.result == OK:
            new_u = u.copy()
            step(self.laws[self.law], state, ref, y, new_u)
            if np.isfinite(new_u).all():
                u[:] = new_u
            else:
                self.result = BAD_U

        def reals(states: int) -> tuple[NDArray[Any], ...]:
            return (
                u,
                np.array([self.bump]),
                state["x"][:states],
                *(state[name] for name in ("offset", "u", "trend")),
            )

        return reals


def refusal(
    ref: NDArray[Any], y: NDArray[Any], refs: Sequence[Signal], ys: Sequence[Signal]
) -> int:
    """OK, or why a step refuses references and measurements (each (5,), p.u.)."""
    real = y.dtype.type
    for code, values, signals in ((BAD_Y, y, ys), (BAD_REF, ref, refs)):
        for value, s in zip(values, signals, strict=True):
            if not real(s.low) <= value <= real(s.high):
                return code
    return OK


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
                values[at, 1], values[at, 3] = tiny * uniform(2, n)
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
