"""The kernel's step in C, compiled at run time and called on the records that numba uses."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_hil.benchmark.c_code import FLAGS, compile_c, load_c
from gfm_runtime.c_header import c_header

Drive = Callable[..., None]


def compile_twin(folder: Path, real: DTypeLike, flags: str = FLAGS) -> Drive:
    """Compile ``drive`` of kernel_step.c for float64 or float32 into ``folder``.

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
