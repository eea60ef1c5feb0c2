"""Time of one kernel step, compared with the C code of ``gfmhil firmware export``.

Both run a closed chain of steps: the previous u slightly changes each tick's measurements, so that
no step can be computed ahead or skipped. Before the timing, both process inputs that drive every
output into its limits, and their outputs and states are compared bit by bit.
"""

import ctypes
import tempfile
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_hil.bench.c_code import FLAGS, NoCompiler, compile_c
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.rounds import ShowProgress, quickest, ratios, seconds, spread, take_turns
from gfm_runtime import discretise, get_law, law_names
from gfm_runtime.compiled import compiled
from gfm_runtime.firmware import Module, make_modules, sources
from gfm_runtime.kernel import pack_law, state_dtype, step
from gfm_runtime.signals import NU, NY, group

T_S = 1e-4  # s, of the laws
ROWS = 256  # different measurements, used in turn
FEEDBACK = 1e-6  # p.u. of y per p.u. of u
REALS = ("float64", "float32")
_STEPS = 10_000  # in one of the short runs of a turn
_COMPARED = 40  # times all rows, before the timing


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


class Twin:
    """The generic step that ``gfmhil firmware export`` writes, compiled, with its laws; ``state``
    is the type of a ``gfm_t``."""

    def __init__(self, library: Path, modules: Sequence[Module]) -> None:
        self._library = ctypes.CDLL(str(library))
        self._prefixes = {m.name: m.prefix for m in modules}
        real, states = modules[0].real, max(1, *(m.n for m in modules))
        self._scalar = ctypes.c_double if real == np.float64 else ctypes.c_float
        fields = [("x", real, (states,)), *((f, real, (NU,)) for f in ("offset", "u", "trend"))]
        self.state = np.dtype([*fields, ("reason", "i4"), ("channel", "i4")], align=True)

    def drive(self, name: str) -> Callable[..., None]:
        """As ``drive`` for a law of the library. Arrays are passed by address, without a copy."""
        law = ctypes.addressof(ctypes.c_char.in_dll(self._library, f"{self._prefixes[name]}_law"))
        function = self._library.drive
        function.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_int64] * 2 + [self._scalar]
        function.restype = None

        def drive(*arguments: Any) -> None:
            _, *arrays, steps, feedback = arguments
            addresses = (array.ctypes.data for array in arrays)
            function(law, *addresses, len(arrays[2]), steps, feedback)

        return drive


def compile_twin(folder: Path, names: Sequence[str], real: DTypeLike, flags: str = FLAGS) -> Twin:
    """Export laws of the catalogue for float64 or float32, and compile them. Raises NoCompiler:
    there is none, or it fails."""
    modules = make_modules({name: get_law(name) for name in names}, T_S, real)
    files = sources(modules, T_S, "records")
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    laws = [folder / file for file in files if file.endswith(".c") and file != "gfm.c"]
    of_c = Path(__file__).with_name("kernel_drive.c")
    return Twin(compile_c(of_c, folder, f"twin_{np.dtype(real)}", flags, laws), modules)


class Chain:
    """One law at its reference, with measurements that scatter around it, and its outputs; in
    numba, or in C with a twin. ``scatter``: the standard deviation of the measurements, p.u."""

    def __init__(
        self, name: str, real: DTypeLike, scatter: float, twin: Twin | None = None
    ) -> None:
        ref = np.array([s.default for s in group("ref")])
        y = ref + scatter * np.random.default_rng(1).standard_normal((ROWS, NY))
        self.law = pack_law(discretise(get_law(name), T_S), real)
        self.state = np.zeros(1, twin.state if twin else state_dtype(real))
        fields = [("ref", real, (NY,)), ("y", real, (NY,)), ("u", real, (NU,))]
        io = np.zeros(1, np.dtype(fields, align=True))
        io["ref"], io["u"] = ref, 1.0
        self.outputs = np.zeros((ROWS, NU), real)
        self._drive: Callable[..., None] = twin.drive(name) if twin else drive
        self._arrays = self.law, self.state, io, y.astype(real), self.outputs
        self._feedback = self.outputs.dtype.type(FEEDBACK)

    def run(self, steps: int) -> None:
        """Advance by ``steps`` steps."""
        self._drive(*self._arrays, steps, self._feedback)

    def limited(self) -> NDArray[np.bool_]:
        """Which of the outputs (rows, 3) are at a limit."""
        low, high = self.law[0]["low"], self.law[0]["high"]
        return np.asarray((self.outputs <= low) | (self.outputs >= high))


def ulps(a: NDArray[Any], b: NDArray[Any]) -> int:
    """Largest distance of two arrays in units of the last place; 0: equal bit by bit."""
    return int(np.max(np.testing.assert_array_max_ulp(a, b, np.iinfo(np.int64).max), initial=0))


def compare(name: str, real: DTypeLike, twin: Twin, rounds: int) -> tuple[int, list[int]]:
    """Run numba and C on the same extreme inputs, ``rounds`` times all rows.

    Returns the largest distance of their outputs and states, ``ulps``, and how often the outputs
    i_u, omega_u, E_u were limited.
    """
    ours, theirs = (Chain(name, real, 0.5, of) for of in (None, twin))
    n = int(ours.law["n"][0])
    worst, limited = 0, np.zeros(NU, int)
    for _ in range(rounds):
        ours.run(ROWS)
        theirs.run(ROWS)
        pairs = [(ours.outputs, theirs.outputs)]
        pairs += [(ours.state["x"][:, :n], theirs.state["x"][:, :n])]
        pairs += [(ours.state[f], theirs.state[f]) for f in ("offset", "u", "trend")]
        worst = max(worst, *(ulps(a, b) for a, b in pairs))
        limited += ours.limited().sum(axis=0)
    return worst, limited.tolist()


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add a row per law and real type to ``kernel``."""
    names = options.laws or law_names()
    content["kernel"] = []
    for k, real in enumerate(REALS):
        show(f"kernel, {real}", k / len(REALS))
        with tempfile.TemporaryDirectory() as place:
            try:
                twin = compile_twin(Path(place), names, real, options.cflags)
            except NoCompiler as problem:
                twin = None
                content["remarks"].append(f"kernel, {real}: {problem}; nothing to compare with")
            content["kernel"] += _rows(names, real, twin, options.rounds)


def _rows(
    names: Sequence[str], real: str, twin: Twin | None, rounds: int
) -> Iterator[dict[str, Any]]:
    agreement = {n: compare(n, real, twin, _COMPARED) for n in names} if twin else {}

    def ns_per_step(name: str, of: Twin | None) -> float:
        chain = Chain(name, real, 1e-3, of)
        chain.run(ROWS)  # warm up
        return quickest(lambda: seconds(lambda: chain.run(_STEPS))) / _STEPS * 1e9

    ways: dict[str, Twin | None] = {"numba": None} | ({"C": twin} if twin else {})
    jobs = {f"{n} {way}": partial(ns_per_step, n, of) for n in names for way, of in ways.items()}
    times = take_turns(jobs, rounds)
    for n in names:
        numba, c = times[f"{n} numba"], times.get(f"{n} C")
        worst, limited = agreement.get(n, (None, None))
        yield {
            "law": n, "real": real, "states": int(Chain(n, real, 0.0).law["n"][0]),
            "numba_ns": spread(numba), "c_ns": spread(c) if c else None,
            "ratio": spread(ratios(numba, c)) if c else None, "ulps": worst, "limited": limited,
        }  # fmt: skip
