"""IEEE 9's and 39's machines with their controls beside ANDES, whose points are stored."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"compare_{name}", EXAMPLES / name / "compare.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def compare() -> ModuleType:
    return load("ieee9")


@pytest.mark.full  # compiles the plant for several converters
@pytest.mark.parametrize(
    ("event", "in_all", "angles"),
    [("load", 2.5e-3, 0.035), ("machine", 5e-3, 0.08), ("fault", 8e-4, 0.025)],
)
def test_speeds_and_angles_are_those_of_andes(compare, event, in_all, angles):
    """In the first second; later the speeds are further apart, as ANDES's stator takes omega = 1,
    so that its torque is P where it is P / omega here. With that in ANDES the end is nearer."""
    t, theirs = compare.points(event)
    mine, kept = compare.run(event), [0, 1, 3] if event == "machine" else [*range(5)]
    apart, speeds = np.abs(mine - theirs)[:, kept], 2 if event == "machine" else 3
    soon, later = (t > 1.0) & (t <= 2.0), t > 1.0
    first = (5e-4, 0.025) if event == "fault" else (3e-4, 5e-3)
    assert apart[soon, :speeds].max() < first[0] and apart[soon, speeds:].max() < first[1]
    assert apart[later, :speeds].max() < in_all and apart[later, speeds:].max() < angles
    assert np.ptp(theirs[:, 1]) > 0.01 and np.ptp(theirs[:, 3]) > 0.2  # much happens
    if event == "load":
        _, with_torque = compare.points("load, T = P / omega")
        assert np.abs(mine - with_torque)[-1, :3].max() < 4e-4


@pytest.mark.full
@pytest.mark.parametrize(
    ("event", "soon", "in_all"),
    [("load", (1.5e-4, 0.015), (4e-4, 0.045)), ("machine", (1e-4, 8e-3), (4e-4, 0.018)),
     ("fault", (2e-4, 0.017), (2e-4, 0.017))],
)  # fmt: skip
def test_39_buses_are_those_of_andes(event, soon, in_all):
    one = load("ieee39")
    for until, (most_speed, most_angle) in ((2.0, soon), (one.END_S, in_all)):
        speed, angle = one.distances(event, until)
        assert speed < most_speed and angle < most_angle
    assert np.ptp(one.points(event)[1], axis=0).max() > 0.1  # much happens


@pytest.mark.parametrize(
    ("name", "script"), [("ieee9", "andes_points.py"), ("ieee39", "andes_reference.py")]
)
def test_the_points_say_where_they_come_from(name, script):
    first = (EXAMPLES / name / "points.csv").read_text().splitlines()[0]
    assert first == f"# ANDES 2.0.0, python examples/{name}/{script}"
