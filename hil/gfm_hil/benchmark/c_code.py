"""C sources of the benchmark, compiled at run time if there is a compiler."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_runtime.c_header import c_header

Drive = Callable[..., None]

SOURCES = Path(__file__).parent
FLAGS = "-O3"
# A fused multiply-add rounds once, the kernel twice. Compilers for x86-64 do not fuse with -O3
# alone; compilers for other processors do.
_ALWAYS = ("-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Werror")


class NoCompiler(Exception):
    """There is no C compiler, or it fails; the message is one line for the report."""


def compiler() -> str:
    """The C compiler: $CC or cc.

    Raises:
        NoCompiler: there is none.
    """
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is None:
        raise NoCompiler(f"no C compiler: {name} is not there; install one or set CC")
    return name


def compile_c(source: str, folder: Path, name: str, flags: str = FLAGS) -> Path:
    """Compile a source of this package into ``folder``/``name``.so; headers may be there too.

    Raises:
        NoCompiler: there is none, or it fails.
    """
    library = folder / f"{name}.so"
    command = [compiler(), *shlex.split(flags), *_ALWAYS, f"-I{folder}", str(SOURCES / source)]
    done = subprocess.run(
        [*command, "-o", str(library), "-lm"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        first = next(iter(done.stderr.splitlines()), "")
        raise NoCompiler(f"the C compiler refused {source}: {first}")
    return library


def load_c(library: Path) -> ctypes.CDLL:
    """The compiled functions; calls release the interpreter's lock."""
    return ctypes.CDLL(str(library))


def compile_twin(folder: Path, real: DTypeLike, flags: str = FLAGS) -> Drive:
    """Compile ``drive`` of kernel_step.c, the kernel's step in C, for float64 or float32.

    It has the arguments of ``gfm_hil.benchmark.kernel.drive``; arrays are passed by address,
    without a copy.

    Raises:
        NoCompiler: there is none, or it fails.
    """
    dtype = np.dtype(real)
    (folder / "law.h").write_text(c_header(dtype), encoding="utf-8")
    function = load_c(compile_c("kernel_step.c", folder, f"twin_{dtype}", flags)).drive
    scalar = ctypes.c_double if dtype == np.float64 else ctypes.c_float
    function.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_int64] * 2 + [scalar]
    function.restype = None

    def drive(*arguments: Any) -> None:
        *arrays, steps, feedback = arguments
        inputs: NDArray[Any] = arrays[3]
        function(*(a.ctypes.data for a in arrays), len(inputs), steps, feedback)

    return drive
