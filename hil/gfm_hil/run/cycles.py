"""Means over one cycle of the nominal frequency, which take a column piece by piece, and the window
and the length of a spectrum."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import ColumnLike

Vector = NDArray[np.float64]

PIECE = 10_000  # ticks of which means are made at a time, in the processor's cache


def cycle_ticks(T_s: float, f_n: float) -> float:
    """Ticks in a cycle, which need not be whole; at least 1."""
    return max(1.0, 1.0 / (f_n * T_s))


def whole_ticks(width: float) -> int:
    """Ticks that a mean over ``width`` ticks reads."""
    return int(np.ceil(width - 1e-6))


def detrend(x: NDArray[Any]) -> NDArray[Any]:
    """Rows of x, shape (..., ticks), without the straight line that fits each best.

    SciPy has it in ``scipy.signal``, whose import takes half a second in every run.
    """
    t = np.linspace(-1.0, 1.0, x.shape[-1])
    rest = x - x.mean(axis=-1, keepdims=True)
    return rest - (rest @ t / (t @ t))[..., None] * t


def fast_length(n: int) -> int:
    """The least length from n on that an FFT takes quickly, for it has no other factors than 2, 3
    and 5; SciPy has it in ``scipy.fft``, whose import takes a quarter of a second."""
    return next(k for k in count(n) if 30 ** k.bit_length() % k == 0)


@lru_cache(maxsize=8)
def hann(n: int) -> Vector:
    """Hann's window of n ticks; a campaign asks for the same ones in every run."""
    window = np.hanning(n)
    window.flags.writeable = False
    return window


def cycle_means(column: ColumnLike, first: int, last: int, width: float) -> Iterator[Vector]:
    """The mean of every window of ``width`` ticks that lies inside [first, last), in pieces.

    Value k belongs to the window that begins at tick ``first`` + k, so to the time (width − 1)/2
    ticks later, its middle. A fraction of a tick counts that part of the window's last tick.
    Sums never run beyond a window, so that they do not drift and do not depend on the pieces.

    Args:
        column: shape (ticks,); an array, or a column of a file, of which a piece is read at a time.
        first, last: ticks.
        width: ticks, at least 1.
    """
    taken = whole_ticks(width)
    n = int(width + 1e-6)
    stop = last - taken + 1
    step = max(PIECE, 4 * n)
    for begin in range(first, stop, step):
        have = min(step, stop - begin)
        x = np.asarray(column[begin : begin + have + taken - 1], np.float64)
        means = _sums(x, n)[:have]
        if taken > n:
            means += (width - n) * x[n:]
        means /= width
        yield means


def _sums(x: Vector, n: int) -> Vector:
    """The sum of every n values in a row, made of those of 1, 2, 4, ... values."""
    total, at, size = np.zeros(len(x) - n + 1), 0, 1
    while True:
        if n & size:
            total += x[at : at + len(total)]
            at += size
        if 2 * size > n:
            return total
        x = x[:-size] + x[size:]
        size *= 2
