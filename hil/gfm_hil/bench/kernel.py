"""Time of one kernel step, compared with the C code of ``gfmhil firmware export``.

Both run a closed chain of steps: the previous u slightly changes each tick's measurements, so that
no step can be computed ahead or skipped. Before the timing, both process inputs that drive every
output into its limits, and their outputs and states are compared bit by bit.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_hil.bench.c_code import FLAGS, T_S, Drive, NoCompiler, Twin, compile_twin
from gfm_hil.bench.rounds import Spread, quickest, ratio, seconds, take_turns
from gfm_runtime import discretise, get_law
from gfm_runtime.compiled import compiled
from gfm_runtime.kernel import pack_law, state_dtype, step
from gfm_runtime.signals import NU, NY, group

ROWS = 256  # different measurements, used in turn
FEEDBACK = 1e-6  # p.u. of y per p.u. of u
REALS = ("float64", "float32")


def io_dtype(real: DTypeLike) -> np.dtype[Any]:
    """Record of a step's inputs and outputs."""
    f = np.dtype(real)
    return np.dtype([("ref", f, (NY,)), ("y", f, (NY,)), ("u", f, (NU,))], align=True)


@compiled
def drive(law, state, io, inputs, outputs, steps, feedback):
    """``steps`` steps on the rows of ``inputs`` in turn; the last u of each row in ``outputs``.

    ``law``, ``state`` and ``io`` are one-element arrays; inputs (rows, 5), outputs (rows, 3) and
    feedback have the law's real type. The fields of a record need no reference count: as plain
    arrays, ref, y and u would cost more time in atomic operations than some laws take.
    """
    law0, state0, now = law[0], state[0], io[0]
    m = 0
    for _ in range(steps):
        for j in range(NY):
            now.y[j] = inputs[m, j] + feedback * now.u[j % NU]
        step(law0, state0, now.ref, now.y, now.u)
        for i in range(NU):
            outputs[m, i] = now.u[i]
        m = 0 if m + 1 == len(inputs) else m + 1


@dataclass
class Chain:
    """One law at its reference, with measurements that scatter around it, and its outputs.

    ``how`` is numba's or C's ``drive``, and ``state`` is the kernel's record or C's.
    """

    how: Drive
    law: NDArray[Any]
    state: NDArray[Any]
    io: NDArray[Any]
    inputs: NDArray[Any]
    outputs: NDArray[Any]

    @staticmethod
    def make(name: str, real: DTypeLike, scatter: float, twin: Twin | None = None) -> Chain:
        """A new chain in numba, or in C with a twin.

        ``scatter`` is the standard deviation of the measurements, p.u.
        """
        ref = np.array([s.default for s in group("ref")])
        y = ref + scatter * np.random.default_rng(1).standard_normal((ROWS, NY))
        law = pack_law(discretise(get_law(name), T_S), real)
        state = twin.instance() if twin else np.zeros(1, state_dtype(real))
        how = twin.drive(name) if twin else drive
        io = np.zeros(1, io_dtype(real))
        io["ref"], io["u"] = ref, 1.0
        return Chain(how, law, state, io, y.astype(real), np.zeros((ROWS, NU), real))

    def run(self, steps: int) -> None:
        """Advance by ``steps`` steps."""
        feedback = self.inputs.dtype.type(FEEDBACK)
        self.how(self.law, self.state, self.io, self.inputs, self.outputs, steps, feedback)

    def limited(self) -> NDArray[np.bool_]:
        """Which of the outputs (rows, 3) are at a limit."""
        law = self.law[0]
        at: NDArray[np.bool_] = (self.outputs <= law["low"]) | (self.outputs >= law["high"])
        return at


def ulps(a: NDArray[Any], b: NDArray[Any]) -> int:
    """Largest distance of two arrays in units of the last place; 0: equal bit by bit."""
    whole = np.dtype(f"i{a.dtype.itemsize}")

    def ordered(x: NDArray[Any]) -> NDArray[Any]:
        bits = np.ascontiguousarray(x).view(whole)
        return np.where(bits < 0, np.iinfo(whole).min - bits, bits)

    return int(np.max(np.abs(ordered(a) - ordered(b)), initial=0))


@dataclass(frozen=True)
class Agreement:
    """Distance of two chains, and how often the outputs i_u, omega_u, E_u were limited."""

    ulps: int
    limited: tuple[int, ...]


def compare(name: str, real: DTypeLike, twin: Twin, rounds: int) -> Agreement:
    """Run numba and C on the same extreme inputs; ``rounds`` times all rows."""
    ours, theirs = (Chain.make(name, real, 0.5, of) for of in (None, twin))
    n = int(ours.law["n"][0])
    worst, limited = 0, np.zeros(NU, int)
    for _ in range(rounds):
        ours.run(ROWS)
        theirs.run(ROWS)
        worst = max(worst, ulps(ours.outputs, theirs.outputs))
        worst = max(worst, ulps(ours.state["x"][:, :n], theirs.state["x"][:, :n]))
        for field in ("offset", "u", "trend"):
            worst = max(worst, ulps(ours.state[field], theirs.state[field]))
        limited += ours.limited().sum(axis=0)
    return Agreement(worst, tuple(int(n) for n in limited))


def time_laws(
    names: Sequence[str], real: DTypeLike, twin: Twin | None, steps: int, turns: int
) -> dict[str, dict[str, Any]]:
    """ns per step of every law by numba and by C, and their ratio; None without a twin."""

    def job(name: str, of: Twin | None) -> float:
        chain = Chain.make(name, real, 1e-3, of)
        chain.run(ROWS)  # warm up
        return quickest(lambda: seconds(lambda: chain.run(steps))) / steps * 1e9

    ways: dict[str, Twin | None] = {"numba": None} | ({"c": twin} if twin else {})
    jobs = {
        f"{n} {way}": (lambda n=n, of=of: job(n, of)) for n in names for way, of in ways.items()
    }
    found = take_turns(jobs, turns)
    return {
        n: {
            "numba_ns": Spread.of(found[f"{n} numba"]).plain(),
            "c_ns": Spread.of(found[f"{n} c"]).plain() if twin else None,
            "ratio": ratio(found[f"{n} numba"], found[f"{n} c"]).plain() if twin else None,
        }
        for n in names
    }


def measure(
    names: Sequence[str],
    steps: int,
    turns: int,
    tell: Callable[[str, float], None],
    flags: str = FLAGS,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Measure laws; returns (rows, remarks), one row per law and real type.

    Args:
        names: of laws.
        steps: in one of the ``RUNS`` short runs of a turn.
        turns: of each.
        tell: called with the present work and the share done.
        flags: for the C compiler.
    """
    rows: list[dict[str, Any]] = []
    remarks: list[str] = []
    for k, real in enumerate(REALS):
        tell(f"kernel, {real}", k / len(REALS))
        with tempfile.TemporaryDirectory() as place:
            twin: Twin | None = None
            try:
                twin = compile_twin(Path(place), names, real, flags)
            except NoCompiler as problem:
                remarks.append(f"kernel, {real}: {problem}; nothing to compare with")
            agreements = {n: compare(n, real, twin, rounds=40) for n in names} if twin else {}
            times = time_laws(names, real, twin, steps, turns)
        for n in names:
            same = agreements.get(n)
            rows.append(
                {
                    "law": n,
                    "real": real,
                    "states": int(Chain.make(n, real, 0.0).law["n"][0]),
                    **times[n],
                    "ulps": same.ulps if same else None,
                    "limited": list(same.limited) if same else None,
                }
            )
    return rows, remarks
