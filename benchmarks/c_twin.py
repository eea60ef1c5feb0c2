"""The kernel's step in C, compiled on the spot and called on the records that numba uses."""

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

SOURCE = Path(__file__).with_name("kernel_step.c")
FLAGS = "-O3"
# A fused multiply-add rounds once, the kernel twice. Compilers for x86-64 do not fuse at -O3
# alone; others do.
_ALWAYS = ("-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Werror")

Drive = Callable[..., None]


def compiler() -> str:
    """The C compiler: $CC or cc.

    Raises:
        SystemExit: there is none.
    """
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is None:
        raise SystemExit(f"{name}: no such C compiler; install one or set CC")
    return name


def compile_twin(folder: Path, real: DTypeLike, flags: str = FLAGS) -> Drive:
    """Compile ``drive`` of kernel_step.c for float64 or float32 into ``folder``.

    It takes what ``benchmarks.kernel.drive`` takes; the arrays are passed by address, uncopied.
    """
    dtype = np.dtype(real)
    (folder / "law.h").write_text(c_header(dtype), encoding="utf-8")
    library = folder / f"twin_{dtype}.so"
    command = [compiler(), *shlex.split(flags), *_ALWAYS, f"-I{folder}", str(SOURCE)]
    subprocess.run([*command, "-o", str(library), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).drive
    scalar = ctypes.c_double if dtype == np.float64 else ctypes.c_float
    function.argtypes = [ctypes.c_void_p] * 5 + [ctypes.c_int64] * 2 + [scalar]
    function.restype = None

    def drive(*arguments: Any) -> None:
        *arrays, steps, feedback = arguments
        inputs: NDArray[Any] = arrays[3]
        function(*(a.ctypes.data for a in arrays), len(inputs), steps, feedback)

    return drive


def version_line() -> str:
    """First line of what the compiler says about itself."""
    done = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0]
