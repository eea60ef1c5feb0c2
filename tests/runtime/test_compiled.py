"""The functions of a tick are compiled without numba's runtime."""

from __future__ import annotations

import numpy as np
import pytest
from numba.core.errors import TypingError

from gfm_plant import compiled as of_the_plant
from gfm_runtime.compiled import compiled, inlined


@pytest.mark.parametrize("decorator", [compiled, inlined, of_the_plant.compiled])
def test_what_allocates_does_not_compile(decorator):
    @decorator
    def tick(n):
        return np.zeros(n)[0]

    with pytest.raises(TypingError):
        tick(3)


@pytest.mark.parametrize("decorator", [compiled, of_the_plant.compiled])
def test_arrays_come_in_and_views_of_them_are_had(decorator):
    @decorator
    def tick(x):
        total = 0.0
        for row in x:
            total += row[1:].sum()
        return total

    x = np.arange(6.0).reshape(2, 3)
    assert tick(x) == 1 + 2 + 4 + 5
