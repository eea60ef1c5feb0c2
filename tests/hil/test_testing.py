"""The pytest plugin: a project of somebody's own, made in a folder and tested by pytest itself."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.errors import UserError
from gfm_hil.testing import Experiment

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
CONTROLLER = EXAMPLES / "own_controller" / "controller.py"

Lab = Callable[..., Experiment]

pytest_plugins = ["pytester"]


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    """An experiment as the fixture makes it, begun with what is given."""
    count = iter(range(100))

    def make(scenario: str | None = None, **setting: object) -> Experiment:
        experiment = Experiment(tmp_path, lambda: tmp_path / f"run{next(count)}")
        experiment.start(scenario, **setting)
        return experiment

    return make


def test_steps_happen_at_their_ticks(lab: Lab) -> None:
    bench = lab()
    bench.run(0.02)
    bench.set(p_ref=0.6)
    bench.run(0.0301)
    bench.grid(f_hz=50.02)
    bench.run(0.01)
    s = bench.signals
    assert len(s["t"]) == 601
    assert np.flatnonzero(np.diff(s["ref_P_ref"])).tolist() == [199]  # 0.6 from tick 200 on
    assert np.flatnonzero(np.diff(s["omega_g"])).tolist() == [500]  # y[501] is sampled before it
    assert s["f_hz"] == pytest.approx(s["omega_u"] * 50)


def test_going_on_after_a_look_is_the_same_run(lab: Lab) -> None:
    bench = lab()
    bench.run(0.02)
    first = bench.signals["p"]
    bench.set(p_ref=0.6)
    bench.run(0.02)
    both = bench.signals["p"]
    assert len(both) == 2 * len(first)
    np.testing.assert_array_equal(both[: len(first)], first)


def test_failing_test_says_why_and_leaves_a_figure(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        def test_too_fast(bench):
            bench.run(0.02)
            bench.set(p_ref=1.0)
            bench.run(0.1)
            bench.assert_settles("p", to=1.0, within=0.05)
        """
    )
    result = pytester.runpytest("--gfmhil-out=out")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            '>*bench.assert_settles("p", to=1.0, within=0.05)',
            "E*p should settle at 1 p.u. ± 0.02 within 0.05 s, but it had not at the end of the*",
            "E*P_ref = 1 at 0.02 s",
            "*figures of the bench*",
            "*test_too_fast: *settles_p.png",
        ]
    )
    (figure,) = (pytester.path / "out").rglob("*.png")
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_passing_test_passes_and_is_marked_by_its_link(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        def test_here(bench):
            bench.run(0.02)
            bench.assert_no_trip()

        @pytest.mark.gfmhil(link="zmq")
        def test_there(bench):
            raise AssertionError("not selected")
        """
    )
    pytester.runpytest("--strict-markers", "-m", "gfmhil_inproc").assert_outcomes(
        passed=1, deselected=1
    )


def test_what_is_not_looked_at_is_run_all_the_same(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.gfmhil("rig_pref_step", law="mimo-gfm", events=[])
        def test_jump(bench):
            bench.phase_jump(60)
            bench.run(0.05)
        """
    )
    result = pytester.runpytest()
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["E*The run should last 0.05 s, but it ended at*over-current*"])


@pytest.mark.parametrize(
    ("steps", "says"),
    [
        ("bench.set(p_ref=7)", "P_ref = 7"),
        ("bench.set(p_rf=1)", "p_rf = 1"),
        ("bench.switch('vsg-99')", "vsg-99"),
        ("bench.breaker(closed=False)", "plant.grid.load_R"),
        ("bench.run(0)", "seconds = 0"),
        ("bench.signals", "call run"),
        ("bench.run(0.01); bench.signals['pp']", "signal = 'pp'"),
        ("bench.run(0.01); bench.assert_bump_below(1e-9)", "never changed"),
        ("bench.run(0.01); bench.assert_settles('p', 1, within=1)", "within = 1"),
        ("bench.start('nowhere')", "nowhere"),
        ("bench.start(link='tin-can')", "tin-can"),
    ],
)
def test_wrong_use_is_told_in_one_line(lab: Lab, steps: str, says: str) -> None:
    bench = lab()
    with pytest.raises(UserError) as told:
        exec(steps, {"bench": bench})
    assert says in str(told.value)
    assert "\n" not in str(told.value)


def test_unused_plugin_imports_nothing_heavy() -> None:
    code = "import gfm_pytest.plugin, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"numpy", "numba", "gfm_hil", "pydantic", "zmq", "matplotlib"}
    assert heavy & set(done.stdout.split()) == set()


def project(name: str, tmp_path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """What pytest alone says in a copy of an example project."""
    copy = tmp_path / name
    shutil.copytree(EXAMPLES / name, copy, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *options]
    return subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)


def test_example_law_passes_its_tests(tmp_path: Path) -> None:
    done = project("own_law", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "7 passed" in done.stdout


def test_wrong_law_fails_with_the_reason_and_figures(tmp_path: Path) -> None:
    done = project("own_law", tmp_path, "--law=too-stiff", "--gfmhil-out=figures", "-k", "not do")
    assert done.returncode == 1
    assert "4 failed, 1 passed" in done.stdout
    assert "p should settle at 0.7 p.u. ± 0.01 within 0.2 s, but it took 0.4" in done.stdout
    assert "strongest oscillation after the step, at 8.27 Hz, has 0.168" in done.stdout
    named = re.findall(r"^tests/.*: (.*\.png)$", done.stdout, re.MULTILINE)
    assert len(named) == 4
    assert all(Path(name).is_file() for name in named)


def test_example_controller_passes_its_tests(tmp_path: Path) -> None:
    done = project("own_controller", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


def test_example_controller_is_droop_5_but_for_its_integrator(lab: Lab, tmp_path: Path) -> None:
    """Euler there, Tustin here: a response of the same law, to a part in a hundred."""
    source = (EXAMPLES / "own_law" / "laws" / "my-droop.toml").read_text(encoding="utf-8")
    (tmp_path / "law.toml").write_text(source, encoding="utf-8")
    p = []
    for own in ((), (sys.executable, str(CONTROLLER), "{endpoint}", "{scenario}")):
        bench = lab(
            "pref_step",
            events=[],
            law="law.toml",
            controller_command=own,
            plant__dc_source={"mode": "regulated"},
            plant__factors={"L_g": 3.0},
        )
        bench.run(0.01)
        bench.set(P_ref=0.7)
        bench.run(0.09)
        p.append(bench.signals["p"])
    assert np.ptp(p[0]) > 0.2
    assert np.max(np.abs(p[1] - p[0])) < 0.01 * 0.2
