"""C sources of the benchmark, compiled at run time if there is a compiler, and their laws."""

import ctypes
import os
import shlex
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_runtime import get_law
from gfm_runtime.firmware import Module, make_modules, sources
from gfm_runtime.signals import NU

T_S = 1e-4  # s, of the laws
FLAGS = "-O3"
# A fused multiply-add rounds once, the kernel twice. Compilers for x86-64 do not fuse with -O3
# alone; compilers for other processors do.
_ALWAYS = ("-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Werror")


class NoCompiler(Exception):
    """There is no C compiler, or it fails; the message is one line for the report."""


def compile_c(
    source: Path, folder: Path, name: str, flags: str = FLAGS, more: Sequence[Path] = ()
) -> Path:
    """Compile sources into ``folder``/``name``.so by $CC or cc; headers may be there too. Raises
    NoCompiler: there is none, or it fails."""
    compiler, library = os.environ.get("CC", "cc"), folder / f"{name}.so"
    command = [compiler, *shlex.split(flags), *_ALWAYS, f"-I{folder}"]
    command += [str(source), *map(str, more), "-o", str(library), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        words = f"no C compiler: {compiler} is not there; install one or set CC"
        raise NoCompiler(words) from None
    if done.returncode:
        first = next(iter(done.stderr.splitlines()), "")
        raise NoCompiler(f"the C compiler refused {source.name}: {first}")
    return library


class Twin:
    """The generic step that ``gfmhil firmware export`` writes, compiled, with its laws."""

    def __init__(self, library: ctypes.CDLL, modules: Sequence[Module]) -> None:
        self._library, self._prefixes = library, {m.name: m.prefix for m in modules}
        real, states = modules[0].real, max(1, *(m.n for m in modules))
        self._scalar = ctypes.c_double if real == np.float64 else ctypes.c_float
        fields = [("x", real, (states,)), *((f, real, (NU,)) for f in ("offset", "u", "trend"))]
        self._instance = np.dtype([*fields, ("reason", "i4"), ("channel", "i4")], align=True)

    def instance(self) -> NDArray[Any]:
        """A ``gfm_t``, all 0, one element."""
        return np.zeros(1, self._instance)

    def drive(self, name: str) -> Callable[..., None]:
        """As ``gfm_hil.bench.kernel.drive`` for a law of the library; its state is an
        ``instance``. Arrays are passed by address, without a copy."""
        law = ctypes.addressof(ctypes.c_char.in_dll(self._library, f"{self._prefixes[name]}_law"))
        function = self._library.drive
        function.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_int64] * 2 + [self._scalar]
        function.restype = None

        def drive(*arguments: Any) -> None:
            _, *arrays, steps, feedback = arguments
            inputs: NDArray[Any] = arrays[2]
            function(law, *(a.ctypes.data for a in arrays), len(inputs), steps, feedback)

        return drive


def compile_twin(folder: Path, names: Sequence[str], real: DTypeLike, flags: str = FLAGS) -> Twin:
    """Export laws of the catalogue for float64 or float32, and compile them. Raises NoCompiler:
    there is none, or it fails."""
    modules = make_modules({name: get_law(name) for name in names}, T_S, real)
    files = sources(modules, T_S, "records")
    for file, text in files.items():
        (folder / file).write_text(text, encoding="utf-8")
    laws = [folder / file for file in files if file.endswith(".c") and file != "gfm.c"]
    drive = Path(__file__).with_name("kernel_drive.c")
    library = compile_c(drive, folder, f"twin_{np.dtype(real)}", flags, laws)
    return Twin(ctypes.CDLL(str(library)), modules)
