"""What others' programs print is read right: from a run, and from the manual."""

import shutil

import numpy as np
import pytest

from gfm_hil.bench import outside

#: form: rtla-timerlat-hist(1), numbers shortened
RTLA = """# RTLA timerlat histogram
# Time unit is nanoseconds (ns)
# Duration:   0 00:00:02
Index   Thr-000   Thr-001
3000          2         0
4200          1         3
over:         0         1
count:        3         4
min:       3100      4250
avg:       3400      9000
max:       4300   2100000
"""


def test_histogram_of_rtla():
    assert sorted(outside.read_rtla(RTLA)) == [3100, 3100, *[4300] * 4, 2_000_000]


def test_histogram_of_cyclictest():
    text = """{"thread": {"0": {"histogram": {"3633": 1, "4732": 2}, "cycles": 4, "max": 4116023},
                         "1": {"histogram": {"5119": 1}, "cycles": 1, "max": 5119}}}"""
    assert sorted(outside.read_cyclictest(text)) == [3633, 4732, 4732, 5119, 4116023]


@pytest.mark.apt
@pytest.mark.processes
def test_cyclictest_measures_here():
    if shutil.which("cyclictest") is None:
        pytest.skip("needs cyclictest (rt-tests)")
    late = outside.measure("cyclictest", [0], "other", 1_000_000, 0.2)
    assert len(late) > 150
    assert 0 < np.median(late) < 1e9
