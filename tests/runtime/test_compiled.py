"""The functions of a tick are compiled without numba's runtime."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile
from numba.core.errors import TypingError

from gfm_runtime.compiled import compiled, inlined


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


def test_any_change_of_compiled_code_makes_numba_compile_again() -> None:
    """A compiled function contains its callees, so its cache is as old as the oldest of them."""
    from gfm_hil.engine.plant_ticks import plant_ticks
    from gfm_plant import plant_sample
    from gfm_runtime.compiled import _sources
    from gfm_runtime.kernel import step

    _, digest = _sources()
    stamps = [f._cache._cache_file._source_stamp for f in (plant_ticks, plant_sample, step)]
    assert [of_all for _, of_all in stamps] == [digest] * 3
    assert len({own for own, _ in stamps}) == 3


def test_other_functions_keep_numbas_own_rule(tmp_path: Path) -> None:
    from gfm_runtime.compiled import _own_stamp, _stamp

    file = tmp_path / "theirs.py"
    file.write_text("x = 1\n")
    theirs = SimpleNamespace(_py_file=str(file))
    assert _stamp(theirs) == _own_stamp(theirs)


def test_a_cache_that_names_a_type_of_an_older_version_is_as_good_as_none(tmp_path: Path) -> None:
    index = IndexDataCacheFile(str(tmp_path), "tick", "stamp")
    kept = type("Gone", (), {"__module__": __name__})
    globals()["Gone"] = kept
    index._save_index({"signature": kept})
    assert index._load_index() == {"signature": kept}
    del globals()["Gone"]
    assert index._load_index() == {}


@pytest.mark.processes
def test_what_two_processes_compiled_for_two_records_does_not_mix_in_a_third(
    tmp_path: Path,
) -> None:
    (tmp_path / "theirs.py").write_text(
        "import sys\n"
        "import numpy as np\n"
        "from gfm_runtime.compiled import compiled\n"
        "@compiled\n"
        "def tick(r):\n"
        "    return r[0].a[len(r[0].a) - 1]\n"
        "for n in map(int, sys.argv[1:]):\n"
        "    r = np.zeros(1, [('a', 'f8', (n,))])\n"
        "    r['a'] = range(n)\n"
        "    print(tick(r))\n"
    )
    found = [
        subprocess.run(
            [sys.executable, "theirs.py", *sizes], cwd=tmp_path, capture_output=True, text=True
        ).stdout.split()
        for sizes in (["2"], ["3"], ["2", "3"])
    ]
    assert found == [["1.0"], ["2.0"], ["1.0", "2.0"]]
