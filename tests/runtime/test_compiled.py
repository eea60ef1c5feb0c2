"""The functions of a tick are compiled without numba's runtime."""

import subprocess
import sys

import numpy as np
import pytest
from numba.core.errors import TypingError

from gfm_runtime.compiled import _Index, compiled, inlined


@pytest.mark.parametrize("decorator", [compiled, inlined])
def test_what_allocates_does_not_compile(decorator):
    @decorator
    def tick(n):
        return np.zeros(n)[0]

    with pytest.raises(TypingError):
        tick(3)


@pytest.mark.parametrize("decorator", [compiled])
def test_arrays_come_in_and_views_of_them_are_had(decorator):
    @decorator
    def tick(x):
        total = 0.0
        for row in x:
            total += row[1:].sum()
        return total

    x = np.arange(6.0).reshape(2, 3)
    assert tick(x) == 1 + 2 + 4 + 5


def test_any_change_of_compiled_code_makes_numba_compile_again():
    """A compiled function contains its callees, so its cache is as old as the oldest of them."""
    from gfm_hil.engine.plant_ticks import plant_ticks
    from gfm_plant import plant_sample
    from gfm_runtime.compiled import _digest
    from gfm_runtime.kernel import step

    digest = _digest()
    stamps = [f._cache._cache_file._source_stamp for f in (plant_ticks, plant_sample, step)]
    assert [of_all for _, of_all in stamps] == [digest] * 3
    assert len({own for own, _ in stamps}) == 3


_THEIRS = """
import numba
from numba.core import caching, types
before = [vars(c).copy() for c in (caching._SourceFileBackedLocatorMixin,
          caching.IndexDataCacheFile, caching.FunctionCache, types.Record)]
import gfm_runtime.compiled, gfm_hil.engine.inproc
after = [vars(c).copy() for c in (caching._SourceFileBackedLocatorMixin,
         caching.IndexDataCacheFile, caching.FunctionCache, types.Record)]
assert [list(b.values()) for b in before] == [list(a.values()) for a in after]
assert type(numba.njit(cache=True)(lambda x: x)._cache) is caching.FunctionCache
"""


@pytest.mark.processes
def test_a_program_that_imports_us_keeps_numba_as_it_is(tmp_path):
    (tmp_path / "theirs.py").write_text(_THEIRS)
    done = subprocess.run([sys.executable, "theirs.py"], cwd=tmp_path, capture_output=True)
    assert done.returncode == 0, done.stderr


def test_a_cache_that_names_a_type_of_an_older_version_is_as_good_as_none(tmp_path):
    index = _Index(str(tmp_path), "tick", "stamp")
    kept = type("Gone", (), {"__module__": __name__})
    globals()["Gone"] = kept
    index._save_index({"signature": kept})
    assert index._load_index() == {"signature": kept}
    del globals()["Gone"]
    assert index._load_index() == {}


_TWO_RECORDS = """
import sys
import numpy as np
from gfm_runtime.compiled import compiled

@compiled
def length(r, k):  # too long to become part of its caller, so called by its name
    total = 0.0
    for i in range(len(r[0].a)):
        for j in range(k):
            total += np.sin(r[0].a[i] * j) + np.cos(total) * np.exp(-total) + np.log(1 + total**2)
            total += np.tan(total) + np.arctan2(total, 1.0 + j) + np.sinh(1e-3 * total)
    return len(r[0].a) + 0 * total

@compiled
def tick(r):
    return length(r, 3) + length(r, 4)

for n in map(int, sys.argv[1:]):
    print(tick(np.zeros(1, [("a", "f8", (n,))])))
"""


@pytest.mark.processes
def test_what_two_processes_compiled_for_two_records_does_not_mix_in_a_third(tmp_path):
    (tmp_path / "theirs.py").write_text(_TWO_RECORDS)
    found = [
        subprocess.run(
            [sys.executable, "theirs.py", *sizes], cwd=tmp_path, capture_output=True, text=True
        ).stdout.split()
        for sizes in (["2"], ["3"], ["2", "3"])
    ]
    assert found == [["4.0"], ["6.0"], ["4.0", "6.0"]]
