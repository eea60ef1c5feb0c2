"""IEEE 9's machines with their controls beside ANDES, whose points are stored."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples/ieee9"


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare_ieee9", EXAMPLE / "compare.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(
    ("event", "in_all", "angles"), [("load", 2.5e-3, 0.035), ("machine", 5e-3, 0.08)]
)
def test_speeds_and_angles_are_those_of_andes(compare, event, in_all, angles):
    """In the first second; later the speeds are further apart, as ANDES's stator takes omega = 1,
    so that its torque is P where it is P / omega here. With that in ANDES the end is nearer."""
    t, theirs = compare.points(event)
    mine, kept = compare.run(event), [0, 1, 3] if event == "machine" else [*range(5)]
    apart, speeds = np.abs(mine - theirs)[:, kept], 2 if event == "machine" else 3
    soon, later = (t > 1.0) & (t <= 2.0), t > 1.0
    assert apart[soon, :speeds].max() < 3e-4 and apart[soon, speeds:].max() < 5e-3
    assert apart[later, :speeds].max() < in_all and apart[later, speeds:].max() < angles
    assert np.ptp(theirs[:, 0]) > 0.02 and np.ptp(theirs[:, 3]) > 0.2  # much happens
    if event == "load":
        _, with_torque = compare.points("load, T = P / omega")
        assert np.abs(mine - with_torque)[-1, :3].max() < 4e-4


def test_the_points_say_where_they_come_from():
    first = (EXAMPLE / "points.csv").read_text().splitlines()[0]
    assert first == "# ANDES 2.0.0, python examples/ieee9/andes_points.py"
