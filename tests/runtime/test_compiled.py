"""The functions of a tick are compiled without numba's runtime."""

import subprocess
import sys

import numba
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


def test_another_number_is_no_other_type():
    @compiled
    def twice(k):
        return 2 * k

    @compiled
    def several(k):
        return twice(0) + twice(1) + twice(k)

    assert several(3) == 8
    assert len(twice.overloads) == 1


def test_any_change_of_compiled_code_makes_numba_compile_again():
    """A compiled function contains its callees, so its cache is as old as the oldest of them."""
    from gfm_hil.engine.plant_ticks import plant_ticks
    from gfm_plant import plant_sample
    from gfm_runtime.compiled import sources
    from gfm_runtime.kernel import step

    digest = sources()
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


_WRITER = """
import sys
from gfm_runtime.compiled import _Index
folder, me = sys.argv[1:]
for k in range(40):
    _Index(folder, "tick", "stamp").save((me, k), f"{me} {k}")
"""


@pytest.mark.processes
def test_processes_that_compile_at_once_keep_each_other_s_functions(tmp_path):
    (tmp_path / "writer.py").write_text(_WRITER)
    names = [*"abcd"]
    writers = [
        subprocess.Popen([sys.executable, "writer.py", str(tmp_path), name], cwd=tmp_path)
        for name in names
    ]
    assert [writer.wait(60) for writer in writers] == [0] * len(names)
    index = _Index(str(tmp_path), "tick", "stamp")
    keys = [(name, k) for name in names for k in range(40)]
    assert [index.load(key) for key in keys] == [f"{name} {k}" for name, k in keys]


_TWO_RECORDS = """
import sys
import numba
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


def test_a_function_that_only_compiled_ones_call_has_no_machine_code(monkeypatch, tmp_path):
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))  # where nothing is compiled

    @compiled
    def inner(x):
        return x + 1

    @compiled
    def outer(x):
        return 2 * inner(x)

    assert outer(1.0) == 4.0
    (entry,) = (cres.entry_point for cres in inner.overloads.values())
    assert entry.function is None
    assert inner(1.0) == 2.0
    assert entry.function is not None
    assert outer(2.0) == 6.0


def test_a_callee_that_the_first_of_two_callers_does_not_reach_is_linked_for_the_second():
    reached = False

    @compiled
    def far(x):
        return x**3 + x

    @compiled
    def first(x):
        return far(x) if reached else x

    @compiled
    def second(x):
        return far(x)

    @compiled
    def both(x):
        return first(x) + second(x)

    assert both(2.0) == 12.0


def test_numbas_own_functions_call_ours_and_so_does_python_afterwards():
    @compiled
    def ours(x):
        return x[0] - x[1]

    @numba.njit
    def theirs(x):
        return 3 * ours(x)

    x = np.array([5.0, 3.0])
    assert theirs(x) == 6.0
    assert ours(x) == 2.0


_COUNTED = """
import sys
from numba import njit
from numba.core import event
from gfm_runtime.compiled import compiled, inlined

@inlined
def inner(x):
    return x + 1

@compiled
def outer(x):
    return 2 * inner(x)

@njit
def theirs(x):
    return 3 * inner(x)

all_of_them = {"inner": inner, "outer": outer, "theirs": theirs}
with event.install_recorder("numba:compile") as recorder:
    print([all_of_them[name](1.0) for name in sys.argv[1:]])
print(len(recorder.buffer) // 2)
"""


@pytest.mark.processes
def test_each_function_is_compiled_once_a_machine(tmp_path):
    (tmp_path / "ours.py").write_text(_COUNTED)

    def run(*names: str) -> list[str]:
        command = [sys.executable, "ours.py", *names]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.splitlines()

    assert run("outer") == ["[4.0]", "2"]
    assert run("outer") == ["[4.0]", "0"]
    assert run("theirs") == ["[6.0]", "1"]  # numba's own calls what is kept without machine code
    assert run("inner", "outer") == ["[2.0, 4.0]", "0"]  # machine code of what is kept without
    assert run("inner") == ["[2.0]", "0"]
