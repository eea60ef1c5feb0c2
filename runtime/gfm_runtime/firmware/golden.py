"""Golden vectors: what the compiled kernel does with inputs that reach all of a law's paths.

A row is one tick: what is done before the step, the references and measurements, and what the step
returns and leaves. All are the bits of numbers of the law's precision, or small integers, in words
of its size. The inputs are 30 ticks each of: noise about the operating point; ramps of the
references; the whole ranges of the signal table at random; the same extreme for long, so that u is
limited; powers that are subnormal or zeros of both signs; measurements that are not finite or out
of range, then a state that is NaN, with the safe state and its end after each; changes of law. They
come from integers of PCG64, so they are the same on every machine. With an inner stage the filter's
currents and voltages go with them.
"""

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import compiled
from gfm_runtime.counts import COUNTS_STATE, calibrate, go_on_with, measure, modulate
from gfm_runtime.firmware.fixed import REFS, YS, Instance, bump_of, refusal, to_integers
from gfm_runtime.firmware.module import BAD_REF, Module, at_rest
from gfm_runtime.inner import INNER_STATE, settle_inner, take_measurements
from gfm_runtime.kernel import advance, advance_with_inner, look, look_with_inner, state_dtype
from gfm_runtime.signals import (
    COUNTS,
    N_ADC,
    N_LEGS,
    NU,
    NU_COUNTS,
    NU_INNER,
    NY,
    NY_INNER,
    carried,
    carried_rows,
    command_rows,
    group,
    names,
)
from gfm_runtime.states import BAD_SENSOR, BAD_U, BAD_Y, OK
from gfm_runtime.switchover import change_law, settle_into, settle_with_inner

#: what a row does before its step: nothing, init, a bumpless change to the row's law, reset and
#: settle at the last u, or an error of memory: no number in the law's state, or in its stage's;
#: or one of the counts of its calibration; and from TUNE on the sets of gains of a law that can be
#: tuned
STEP, INIT, SWITCH, RESET, SPOIL, SPOIL_STAGE, CALIBRATE, TUNE = range(8)
SEGMENT = 30  # ticks of one kind
KINDS = 7
INSIDE = 1e-3  # of a range; stays off its ends, which differ in float32
SHIPPED, CHECKED = KINDS * SEGMENT, 48 * KINDS * SEGMENT  # ticks a law: 210 and 10,080

Inputs = tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]


@dataclass(frozen=True)
class Golden:
    """Golden rows of a set of laws."""

    words: NDArray[Any]  #: shape (rows, columns), uint32 or uint64
    #: their names: op, law, result, ref_*, y_*, u_*, bump, x_*, offset_*, last_* (the law's u of
    #: the last tick), trend_*; with an inner stage its variables, and limited; with counts
    #: adc_* and cmp_*, and their variables; in fixed point the rests, 31 lower bits and what is
    #: above
    columns: tuple[str, ...]

    def csv(self) -> str:
        """Lines of hexadecimal words under a line of names."""
        rows = [self.columns, *([f"0x{w:x}" for w in row] for row in self.words.tolist())]
        return "".join(",".join(row) + "\n" for row in rows)


def columns(
    states: int, stages: bool, fixed: bool = False, counts: bool = False
) -> tuple[str, ...]:
    """The columns of golden rows whose laws have up to ``states`` states, inner stages, counts."""
    y, u, ref = carried("y", stages), command_rows(stages), names("ref")
    if counts:
        y, u = names("adc"), (*u, *group("compare"))
    own = names("u")
    variables = [
        f"{name}{end}"
        for name, size, _ in INNER_STATE
        for end in (("_d", "_q") if size > 1 else ("",))
    ]
    kept = [f"{name}_{k}" for name, size, _ in COUNTS_STATE for k in range(size)]
    return (
        "op", "law", "result",
        *(f"ref_{name}" for name in ref), *(f"y_{name}" for name in y),
        *(f"u_{s.name}" for s in u), "bump",
        *(f"x_{i}" for i in range(states)), *(f"offset_{name}" for name in own),
        *(f"last_{name}" for name in own), *(f"trend_{name}" for name in own),
        *([*variables, "limited"] if stages else ()), *(kept if counts else ()),
        *(f"rest_{i}_{end}" for i in range(fixed * (2 * NU + states)) for end in ("low", "high")),
    )  # fmt: skip


def golden(modules: Sequence[Module], ticks: int) -> Golden:
    """Golden rows of the laws one after the other, each with that many ticks.

    The first law starts by init, each of the others by a change from the law before it, or by init
    where that one refuses its last row.
    """
    if modules[0].fixed:
        return _fixed_rows(modules, ticks)
    real, stages, counts = modules[0].real, modules[0].stages, modules[0].counts
    states = max([1, *(m.n for m in modules)])
    word = np.dtype(f"u{real.itemsize}")
    records = [m.record for m in modules]
    places = []  # of each law's records with other gains
    for m in modules:
        places.append(len(records))
        records += [m.tuning.record_of(gains) for gains in m.sets() if m.tuning]
    laws = np.array(records)
    instances = np.zeros((len(modules), 2), state_dtype(real))
    signals = (*carried_rows("y", stages), *group("ref"))
    ranges = np.array([[getattr(s, e) for s in signals] for e in ("low", "high")], real)
    fresh: NDArray[Any] = np.zeros(1, instances.dtype)  # an instance after its init
    fresh["u"] = _, omega, E = [s.default for s in group("u")]
    fresh["omega_pll"], fresh["pll"], fresh["e"] = omega, (1.0, 0.0), (E, 0.0)
    fresh["angle"], fresh["sensed"], fresh["speed"] = (1.0, 0.0), at_rest(), omega
    now, io = np.zeros(5, np.int64), np.zeros(1, _io_dtype(real))
    parts = []
    for k, module in enumerate(modules):
        seed = zlib.crc32(module.prefix.encode())
        op, refs, ys = inputs(seed, ticks, real, stages)
        if counts:
            op, ys = _adc(op, seed, module.record)
        op[0] = SWITCH if k and now[2] == OK else INIT
        sets = len(module.sets())
        for nth, at in enumerate(range(SEGMENT // 3, ticks, SEGMENT) if sets else ()):
            if op[at] == STEP:
                op[at] = TUNE + nth % sets
        n_u = len(carried("u", COUNTS if counts else stages))
        result, u = np.zeros(ticks, np.int64), np.zeros((ticks, n_u), real)
        bump = np.zeros(ticks, real)
        after: NDArray[Any] = np.zeros(ticks, instances.dtype)
        own = now, io, result, u, bump, after
        _drive(laws, instances, fresh, ranges, op, k, places[k] - TUNE, refs, ys, *own)
        integers = [op, np.full(ticks, k), result]
        numbers = [refs, ys, u, bump, after["x"][:, :states]]
        numbers += [after[name] for name in ("offset", "u", "trend")]
        if stages:
            numbers += [after[name] for name, *_ in INNER_STATE]
        columns_of = [np.column_stack(integers).astype(word), np.column_stack(numbers).view(word)]
        if stages:
            columns_of.append(after["limited"][:, None].astype(word))
        if counts:
            kept = [after[name] for name, *_ in COUNTS_STATE]
            columns_of.append(np.column_stack(kept).view(word))
        parts.append(np.hstack(columns_of))
    return Golden(np.vstack(parts), columns(states, stages, counts=counts))


def _fixed_rows(modules: Sequence[Module], ticks: int) -> Golden:
    """As ``_drive``, by the exact reference of the arithmetic in fixed point."""
    states = max([1, *(m.n for m in modules)])
    instances = [[Instance(m.fixed), Instance(m.fixed)] for m in modules if m.fixed]
    old, now, latched, held, bump = 0, 0, OK, [0] * NU, 0
    rows = []
    for k, module in enumerate(modules):
        op, refs, ys = inputs(zlib.crc32(module.prefix.encode()), ticks, np.dtype("f8"))
        op[0] = INIT if k == 0 else SWITCH
        ref_rows, y_rows = to_integers(refs, REFS).tolist(), to_integers(ys, YS).tolist()
        for what, ref, y in zip(op.tolist(), ref_rows, y_rows, strict=True):
            refused = refusal(ref, y, BAD_REF)
            if what == SWITCH:
                before, now = instances[old][now], 1 - now
                instances[k][now] = fresh = Instance(instances[k][now].law)
                if refused == OK and latched == OK:
                    u = before.look(ref, y)
                    bump = bump_of(u, fresh.settle(ref, y, u, before.trend))
            elif what == RESET:
                latched = OK
                one, u = instances[k][now], instances[k][now].u
                one.reset()
                if refused == OK:
                    one.settle(ref, y, u, [0] * NU)
            old = k
            one, latched = instances[k][now], latched or refused
            if latched == OK:
                held = one.step(ref, y)
            rest = [part for r in one.rest for part in (r & 0x7FFFFFFF, r >> 31)]
            pad = [0] * (states - len(one.x))
            rows.append(
                [what, k, latched, *ref, *y, *held, bump, *one.x, *pad, *one.offset, *one.u,
                 *one.trend, *rest, *pad, *pad]
            )  # fmt: skip
    words = np.array(rows, np.int64).astype(np.uint32)
    return Golden(words, columns(states, False, True))


def _io_dtype(real: np.dtype[Any]) -> np.dtype[Any]:
    """What goes into and out of a step, as ``gfm_runtime.controller`` has it; and the u in use."""
    return np.dtype(
        [
            ("ref", real, (NY,)), ("y", real, (NY_INNER,)), ("adc", real, (N_ADC,)),
            ("u", real, (NU,)), ("out", real, (NU_INNER,)), ("held", real, (NU_COUNTS,)),
            ("zero", real, (NU,)), ("bump", real),
        ],
        align=True,
    )  # fmt: skip


@compiled
def _drive(laws, instances, fresh, ranges, op, k, tuned, refs, ys, now, io, result, u, bump, after):
    """The rows of law k, as the self-test has them: two instances of each law, one in use.

    ``now`` is the law and the instance in use, the result that is latched, the record in use, and
    that of gains which wait for a tick, or -1; ``now`` and ``io`` go on from call to call. A row
    that tunes has its record at ``tuned`` and its op. ``result``, ``u``, ``bump`` and ``after`` are
    what the rows say.
    """
    c = io[0]
    n_y, n_u = min(ys.shape[1], NY_INNER), u.shape[1]
    inner, counts = n_y > NY, n_u > NU_INNER
    if counts:
        n_y, n_u = NY_INNER, NU_INNER
    for i in range(len(op)):
        for j in range(NY):
            c.ref[j] = refs[i, j]
        if counts:
            for j in range(N_ADC):
                c.adc[j] = ys[i, j]
            if op[i] == RESET:
                go_on_with(instances[now[0], now[1]], fresh[0])
            for j in range(NY_INNER):
                c.y[j] = instances[now[0], now[1]].sensed[j]
        else:
            for j in range(n_y):
                c.y[j] = ys[i, j]
        _carry_out(laws, instances, fresh, op[i], k, tuned, now, c, inner, counts)
        _tick(laws, instances[now[0], now[1]], ranges, now, c, n_y, n_u, inner, counts)
        result[i], bump[i] = now[2], c.bump
        for j in range(u.shape[1]):
            u[i, j] = c.held[j]
        after[i] = instances[now[0], now[1]]


@compiled
def _carry_out(laws, instances, fresh, op, k, tuned, now, c, inner, counts):
    """What a row asks for before its tick."""
    if op == INIT:
        now[0], now[1], now[2], now[3], now[4] = k, 0, OK, k, -1
        instances[k, 0] = fresh[0]
        c.bump = 0
        for j in range(NU_COUNTS):
            c.held[j] = 0
    elif op == SWITCH:
        old = now[0]
        old_state, new_state = instances[old, now[1]], instances[k, 1 - now[1]]
        c.bump = change_law(laws[now[3]], old_state, laws[k], new_state, c.ref, c.y, c.u)
        if inner:
            take_measurements(new_state, c.y)
            settle_inner(laws[k], new_state, old_state.e[0], old_state.e[1])
        if counts:
            go_on_with(new_state, old_state)
        now[0], now[1], now[3], now[4] = k, 1 - now[1], k, -1
    elif op == RESET:
        now[2] = OK
        if now[4] >= 0:
            now[3], now[4] = now[4], -1
        old_state = instances[now[0], now[1]]
        for j in range(NU):
            c.u[j] = old_state.u[j]
        if inner:
            e_d, e_q = old_state.e[0], old_state.e[1]
            settle_with_inner(laws[now[3]], old_state, c.ref, c.y, c.u, c.zero, e_d, e_q)
        else:
            settle_into(laws[now[3]], old_state, c.ref, c.y, c.u, c.zero)
    elif op == CALIBRATE:
        state = instances[now[0], now[1]]
        calibrate(laws[now[3]], state, c.adc, 0)
        if state.suspect >= 0:
            now[2] = BAD_SENSOR
    elif op == SPOIL:
        instances[now[0], now[1]].offset[0] = math.nan
    elif op == SPOIL_STAGE:
        instances[now[0], now[1]].away[0] = math.nan
    elif op >= TUNE:
        now[4] = tuned + op


@compiled
def _tick(laws, state, ranges, now, c, n_y, n_u, inner, counts):
    """A tick of the instance in use, which is refused once a result other than OK is latched."""
    law = laws[now[3]]
    if counts and now[2] == OK:
        measure(law, state, c.adc, 0)
        for j in range(NY_INNER):
            c.y[j] = state.sensed[j]
        if state.suspect >= 0:
            now[2] = BAD_SENSOR
    if now[2] == OK:
        now[2] = _refusal(ranges, c.ref, c.y, n_y)
    if now[2] == OK and now[4] >= 0:
        new = laws[now[4]]
        change_law(law, state, new, state, c.ref, c.y, c.u)
        if inner:
            take_measurements(state, c.y)
            settle_inner(new, state, state.e[0], state.e[1])
        law, now[3], now[4] = new, now[4], -1
    if now[2] == OK:
        if inner:
            look_with_inner(law, state, c.ref, c.y, c.out)
        else:
            look(law, state, c.ref, c.y, c.u)
            for j in range(NU):
                c.out[j] = c.u[j]
        for j in range(n_u):
            if not math.isfinite(c.out[j]):
                now[2] = BAD_U
    if now[2] == OK:
        if inner:
            advance_with_inner(law, state)
        else:
            advance(law, state)
        for j in range(n_u):
            c.held[j] = c.out[j]
        if counts:
            modulate(law, state)
            for x in range(N_LEGS):
                c.held[NU_INNER + x] = int(state.compare[x])


@compiled
def _refusal(ranges, ref, y, n_y):
    """OK, or why a step refuses references (5,) and the first n_y measurements, p.u."""
    for j in range(n_y):
        if not (ranges[0, j] <= y[j] <= ranges[1, j]):
            return BAD_Y
    for j in range(NY):
        if not (ranges[0, n_y + j] <= ref[j] <= ranges[1, n_y + j]):
            return BAD_REF
    return OK


def inputs(seed: int, ticks: int, real: np.dtype[Any], stages: bool = False) -> Inputs:
    """What is done before each step, references (ticks, 5) and measurements, p.u.

    The measurements are (ticks, 5), or (ticks, 11) with an inner stage.
    """
    uniform = _uniform(seed)
    ref_group, y_group = group("ref"), group("y")
    rest = np.array([s.default for s in ref_group])
    ref_low, ref_high = (np.array([getattr(s, end) for s in ref_group]) for end in ("low", "high"))
    y_low, y_high = (np.array([getattr(s, end) for s in y_group]) for end in ("low", "high"))
    op = np.zeros(ticks, np.int64)
    refs, ys = np.tile(rest, (ticks, 1)), np.tile(rest, (ticks, 1))
    for k, start in enumerate(range(0, ticks, SEGMENT)):
        at = slice(start, min(start + SEGMENT, ticks))
        n = at.stop - at.start
        kind = k % KINDS
        ys[at] += 0.02 * (uniform(n, NY) - 0.5)
        refs[at] += 0.02 * (uniform(NY) - 0.5)
        whole = y_low + (INSIDE + (1 - 2 * INSIDE) * uniform(n, NY)) * (y_high - y_low)
        if kind == 1:
            target = ref_low + (INSIDE + (1 - 2 * INSIDE) * uniform(NY)) * (ref_high - ref_low)
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
            op[start + 10] = op[start + 20] = RESET
            op[start + 15] = SPOIL
            if stages:
                op[start + 22], op[start + 26] = SPOIL_STAGE, RESET
        elif kind == 6:
            op[start : at.stop : 10] = SWITCH
    if stages:
        ys = np.hstack([ys, _filter_signals(ys, seed, float(np.finfo(real).tiny))])
    return op, refs.astype(real), ys.astype(real)


def _filter_signals(ys: NDArray[Any], seed: int, tiny: float) -> NDArray[np.float64]:
    """Currents and voltages of the filter (ticks, 6), p.u., for measurements (ticks, 5).

    They go with the kinds of inputs: noise; a dip to less than the PLL can follow, while p passes
    the power limiter's ends (p is changed in place); whole ranges, and their extremes for long;
    subnormal numbers and zeros of both signs; a voltage that turns, and a current that passes the
    threshold but not the limit.
    """
    uniform = _uniform(seed + 1)
    signals = group("y_inner")
    low, high = (np.array([getattr(s, end) for s in signals]) for end in ("low", "high"))
    out = np.tile([0.5, 0.0, 1.0, 0.0, 0.5, 0.0], (len(ys), 1))
    for k, start in enumerate(range(0, len(ys), SEGMENT)):
        at = slice(start, min(start + SEGMENT, len(ys)))
        n = at.stop - at.start
        along = np.arange(1, n + 1) / SEGMENT
        out[at] += 0.02 * (uniform(n, 6) - 0.5)
        whole = low + (INSIDE + (1 - 2 * INSIDE) * uniform(n, 6)) * (high - low)
        kind = k % KINDS
        if kind == 1:
            out[at] *= np.maximum(1.0 - 1.5 * along, 0.01)[:, None]
            ys[at, 1] += np.where(along < 0.5, 1.0, -2.0) * uniform(n)
        elif kind == 2:
            out[at] = whole
        elif kind == 3:
            out[at] = whole[0]
        elif kind == 4:
            signs = np.resize([1.0, -1.0, 0.0, -0.0], n)
            out[at] = tiny * uniform(n, 6) * np.stack([np.roll(signs, j) for j in range(6)], 1)
        elif kind == 5 and k // KINDS % 2:
            out[start + 4, k % 6] = (np.nan, np.inf, -np.inf, 7.0)[k // KINDS // 2 % 4]
        elif kind == 6:
            turned = out[at, 2] * np.exp(0.3j * along)
            out[at, 2], out[at, 3] = turned.real, turned.imag
            out[at, :2] *= 2.0 + uniform(1)
    return out


def _adc(op: NDArray[np.int64], seed: int, law: np.void) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """What is done before each step, and counts of the A/D (ticks, 10).

    Three-phase quantities with noise; ones that grow until the A/D is at its ends, while v_dc falls
    and the modulator has not enough; any counts; ones that stay; no current; a phase that stays;
    and ones that turn against the frame. What has led to the safe state is reset.
    """
    uniform, ticks, top = _uniform(seed + 2), len(op), float(law["adc_top"])
    half, out = 0.5 * (top + 1), np.zeros((len(op), N_ADC))
    op = np.where(op == RESET, STEP, op)
    for k, start in enumerate(range(0, ticks, SEGMENT)):
        at, kind = slice(start, min(start + SEGMENT, ticks)), k % KINDS
        n = at.stop - at.start
        along = np.arange(1, n + 1) / SEGMENT
        size = 1.0 + 5.0 * along * (kind == 1)
        turn = np.exp((-1j if kind == 6 else 1j) * 2 * np.pi * (0.6 * along + uniform(1)))
        for first, of in ((1, 0.13), (4, 0.5), (7, 0.13)):
            vector = of * size * turn * np.exp(0.2j * (first != 4)) * (kind != 4 or first == 4)
            for x in range(N_LEGS):
                out[at, first + x] = (vector * np.exp(-2j * np.pi * x / 3)).real
        out[at, 0] = 1.0 / size - 1.0
        out[at] = (1 + out[at]) * half + 4 * uniform(n, N_ADC)
        if kind == 2:
            out[at] = (top + 1) * uniform(n, N_ADC)
        elif kind == 3:
            out[at] = (top + 1) * uniform(N_ADC)
        elif kind == 5:
            out[at, 1 + k // KINDS % 9] = half
            out[at, 0] *= k // KINDS % 4 > 0
            op[start + 15 : at.stop : 8] = RESET
        op[start] = RESET
        if kind in (0, 4):  # with current, which is too much of an offset, and without
            op[start + 1 : start + 1 + int(law["calibrate"])] = CALIBRATE
    return op, np.clip(np.floor(out), 0.0, top).astype(law["u_0"].dtype)


def _uniform(seed: int) -> Callable[..., NDArray[np.float64]]:
    """Numbers from 0 to 1 in any shape, from integers: the same with every numpy."""
    source = np.random.PCG64(seed)

    def uniform(*shape: int) -> NDArray[np.float64]:
        bits = source.random_raw(int(np.prod(shape)))
        return np.asarray((bits >> np.uint64(11)).reshape(shape) * 2.0**-53, np.float64)

    return uniform
