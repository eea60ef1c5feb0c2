"""The pytest plugin: a user's project, made in a folder and run by pytest itself."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.run.checks import (
    Violation,
    Window,
    damped,
    envelope,
    overshoot,
    read_envelope,
    settles,
)
from gfm_hil.run.modes import oscillations
from gfm_hil.testing import Experiment

pytestmark = pytest.mark.processes

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
CONTROLLER = EXAMPLES / "own_controller" / "controller.py"

Lab = Callable[..., Experiment]

pytest_plugins = ["pytester"]


#: of pytest's plugins the one whose thread keeps the sides of a run from beginning as its copies
ONE_THREAD = ("-p", "no:rerunfailures")


@pytest.fixture
def pytester(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """It runs in this process, where such a thread would stay."""
    monkeypatch.setenv("PYTEST_ADDOPTS", " ".join(ONE_THREAD))
    return pytester


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    """Makes an experiment like the fixture's, started with the given arguments."""
    count = iter(range(100))

    def make(scenario: str | None = None, **setting: object) -> Experiment:
        experiment = Experiment(tmp_path, lambda: tmp_path / f"run{next(count)}")
        experiment.start(scenario, **setting)
        return experiment

    return make


def test_steps_happen_at_their_ticks(lab):
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


def test_going_on_after_a_look_is_the_same_run(lab):
    bench = lab()
    bench.run(0.02)
    first = bench.signals["p"]
    bench.set(p_ref=0.6)
    bench.run(0.02)
    both = bench.signals["p"]
    assert len(both) == 2 * len(first)
    np.testing.assert_array_equal(both[: len(first)], first)


def test_failing_test_says_why_and_leaves_a_figure(pytester):
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


def test_wrong_input_of_a_test_is_told_at_its_line(pytester):
    pytester.makepyfile(
        """
        import pytest

        def test_unknown_key(bench):
            bench.start("pref_step", plant__factor={"L_g": 1})

        @pytest.mark.gfmhil("nowhere")
        def test_unknown_scenario(bench):
            bench.run(0.01)
        """
    )
    result = pytester.runpytest()
    result.assert_outcomes(failed=1, errors=1)
    result.stdout.fnmatch_lines(
        ["E*scenario nowhere: no such file*", "E*plant.factor = *did you mean 'factors'?"]
    )
    result.stdout.no_fnmatch_line("*loading.py*")


def test_passing_test_passes_and_is_marked_by_its_link(pytester):
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


def test_a_file_that_cannot_be_imported_is_told_by_pytest_alone(pytester):
    pytester.makepyfile("import nowhere_to_be_found")
    result = pytester.runpytest()
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*No module named 'nowhere_to_be_found'"])
    assert result.ret == pytest.ExitCode.INTERRUPTED


def test_what_is_not_looked_at_is_run_all_the_same(pytester):
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
        ("bench.start(link='inproc', controller_command=['c'])", "needs a link"),
        ("bench.start(controller_command=['c']); bench.switch('vsg-2')", "its own laws"),
        ("bench.grid()", "f_hz = None, V_g = None"),
    ],
)
def test_wrong_use_is_told_in_one_line(lab, steps, says):
    bench = lab()
    with pytest.raises(UserError) as told:
        exec(steps, {"bench": bench})
    assert says in str(told.value)
    assert "\n" not in str(told.value)


def test_unused_plugin_imports_nothing_heavy():
    code = "import gfm_pytest.plugin, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"numpy", "numba", "gfm_hil", "pydantic", "zmq", "matplotlib"}
    assert heavy & set(done.stdout.split()) == set()


def project(name: str, tmp_path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest in a copy of an example project."""
    copy = tmp_path / name
    shutil.copytree(EXAMPLES / name, copy, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *ONE_THREAD, *options]
    return subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)


def test_example_law_passes_its_tests(tmp_path):
    done = project("own_law", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


def test_wrong_law_fails_with_the_reason_and_figures(tmp_path):
    done = project("own_law", tmp_path, "--law=too-stiff", "--gfmhil-out=figures", "-k", "not do")
    assert done.returncode == 1
    assert "5 failed, 2 passed" in done.stdout
    assert "p should settle at 0.7 p.u. ± 0.01 within 0.2 s, but it took 0.4" in done.stdout
    assert re.search(
        r"strongest oscillation after the step, at 8\.2\d Hz, has 0\.16\d", done.stdout
    )
    assert "my-droop" not in done.stdout and "phase-jump: fail: p should be damped" in done.stdout
    named = re.findall(r"^tests/.*: (.*\.png)$", done.stdout, re.MULTILINE)
    assert len(named) == 4
    assert all(Path(name).is_file() for name in named)


def test_example_controller_passes_its_tests(tmp_path):
    done = project("own_controller", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "3 passed" in done.stdout


@pytest.mark.apt  # make, a C compiler, libzmq3-dev
@pytest.mark.timeout(600)
def test_example_controller_in_c_passes_its_tests(tmp_path):
    done = project("own_controller_c", tmp_path)
    assert done.returncode == 0, done.stdout
    assert "4 passed" in done.stdout


def test_example_controller_is_droop_5_but_for_its_integrator(lab, tmp_path):
    """Euler there, Tustin here: the responses of the same law agree within 1 %."""
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


T = np.linspace(0.0, 1.0, 1001)


def window(x: np.ndarray, before: float = 0.0) -> Window:
    return Window("p", 0.5 + T, x, before, 0.5)


def test_settles_counts_from_the_last_time_outside():
    w = window(np.where((T > 0.3) & (T < 0.6), 1.5, 1.0))
    assert settles(w, to=1.0, within=0.61, tolerance=0.02) is None
    found = settles(w, to=1.0, within=0.2, tolerance=0.02)
    assert found is not None
    assert "it took 0.6 s" in found.text
    assert 0.8 <= found.at <= 1.1
    assert np.isnan(found.low[T < 0.2 - 1e-6]).all()
    assert settles(window(np.full(1001, np.nan)), to=1.0, within=0.2, tolerance=9.0) is not None


@pytest.mark.parametrize("sign", [1, -1])
def test_overshoot_is_a_part_of_the_step(sign):
    w = window(2 + sign * np.where(T < 0.1, 1.25, 1.0), before=2.0)
    assert overshoot(w, percent=25.1, to=None) is None
    found = overshoot(w, percent=24.9, to=None)
    assert found is not None
    assert "25 %" in found.text
    with pytest.raises(UserError, match="did not step"):
        overshoot(w, percent=1.0, to=2.0)


def test_envelope_of_a_file_ends_with_its_lines(tmp_path):
    file = tmp_path / "limits.csv"
    file.write_text("t,low,high\n0.2,0,1\n0.4,,2\n")
    low, high = read_envelope(file, T)
    assert np.isnan(low[T < 0.199]).all()
    assert high[300] == pytest.approx(1.5)
    assert np.isnan(high[T > 0.401]).all()
    assert envelope(window(np.where(T < 0.19, 9.0, 0.5)), low, high) is None
    found = envelope(window(np.where(T < 0.3, 0.5, 1.8)), low, high)
    assert found is not None
    assert found.at == pytest.approx(0.8)
    assert "above the limit of 1.5" in found.text
    for text in (
        "",
        "t,low\n1,2\n",
        "t,low,high\n2,0,1\n1,0,1\n",
        "t,low,high\n,0,1\n",
        "t,low,high\n7,0,1\n",
    ):
        file.write_text(text)
        with pytest.raises(UserError, match=r"limits\.csv"):
            read_envelope(file, T)


def judged(x: np.ndarray, min_ratio: float) -> Violation | None:
    return damped(window(x), min_ratio, oscillations(x, 1e-3, 50.0))


def test_damped_reads_the_ratio():
    x = 1 + np.exp(-0.2 * 20 * T) * np.cos(20 * np.sqrt(1 - 0.2**2) * T)
    assert judged(x, 0.19) is None
    found = judged(x, 0.21)
    assert found is not None
    assert "has 0.2" in found.text
    assert judged(np.ones(1001), 0.9) is None
    offset = np.exp(-5 * T) * np.cos(100 * np.pi * T)
    assert judged(x + offset, 0.19) is None  # of the line, which decays
    grows = 0.01 * np.exp(2 * T) * np.cos(100 * np.pi * T)
    found = judged(x + grows, 0.19)
    assert found is not None and "at 50 Hz" in found.text and found.text.endswith("it grows.")


def test_a_run_that_still_oscillates_fails_unless_that_is_expected(lab):
    """Droop-5 on the rig, whose D/A keeps an oscillation going (docs/experiments.md)."""
    bench = lab("rig_pref_step", law="droop-5")
    bench.run()
    for check in (bench.assert_no_trip, lambda: bench.assert_settles("p", to=1.0, within=2.5)):
        with pytest.raises(AssertionError, match="should be at rest at its end, but it is still"):
            check()
    bench = lab("rig_pref_step", law="droop-5", expect="oscillating")
    bench.run()
    bench.assert_no_trip()


def test_change_of_law_and_its_bump(lab):
    bench = lab(plant__dc_source={"mode": "regulated"})
    bench.run(0.01)
    bench.switch("vsg-2")
    bench.run(0.01)
    bench.assert_bump_below(1e-9)
    with pytest.raises(AssertionError, match=r"law vsg-2 at t = 0\.01 s should move no input"):
        bench.assert_bump_below(-1.0)


def test_other_gains_and_a_way_back_from_a_trip(lab):
    bench = lab(law="droop-1", after_trip="wait")
    bench.run(0.1)
    bench.gains(D_p=0.002)
    bench.run(0.1)
    assert np.ptp(bench.signals["p"]) < 1e-6  # no bump, steady state
    bench.phase_jump(150)
    bench.run(0.05)
    with pytest.raises(AssertionError, match="tripped: over-current"):
        bench.assert_no_trip()
    bench.reset()
    bench.run(0.05)
    bench.assert_settles("p", to=0.5, within=0.001, tolerance=1e-3)
    assert bench.signals["trip"][[2010, -1]].tolist() == [1.0, 0.0]


def test_real_time_is_run_once_and_counts_its_misses(lab):
    patient = {"late_policy__hold": 10**6, "link__peer_timeout_s": 10.0}  # for a busy machine
    bench = lab("rig_pref_step", events=[], link="shm", mode="realtime", **patient)
    bench.run(0.05)
    bench.set(P_ref=0.6)
    bench.run(0.3)
    (event,) = bench.summary["events"]
    assert event["tick"] >= 500
    assert event["label"] == "P_ref = 0.6"
    bench.assert_no_miss(at_most=bench.summary["ticks"])
    with pytest.raises(AssertionError, match=r"At most -1 of 3500 ticks should go without"):
        bench.assert_no_miss(at_most=-1)
    assert (bench.folder / "miss_u.png").is_file()
    bench.run(0.05)
    with pytest.raises(UserError, match="in real time a run cannot be repeated"):
        _ = bench.summary


def test_link_of_the_command_line_replaces_or_skips(pytester):
    pytester.makepyfile(
        """
        import pytest

        def test_any(bench):
            bench.start(link="zmq", link__options={"portable": True})
            bench.run(0.01)
            assert bench.summary["link"] == "inproc"

        @pytest.mark.gfmhil(mode="realtime", link="shm")
        def test_clock(bench):
            raise AssertionError("skipped before it begins")

        @pytest.mark.gfmhil(controller_command=["controller"])
        def test_process(bench):
            raise AssertionError("skipped before it begins")
        """
    )
    result = pytester.runpytest("--gfmhil-link=inproc", "-rs")
    result.assert_outcomes(passed=1, skipped=2)
    result.stdout.fnmatch_lines(["*the controller of this test is a process that talks zmq*"])
    assert pytester.runpytest("--gfmhil-link=tin").ret == pytest.ExitCode.USAGE_ERROR


@pytest.mark.parametrize(
    ("command", "error", "says"),
    [
        (["no-such-program"], UserError, "no-such-program: cannot be started"),
        ([sys.executable, "-c", "raise SystemExit(3)"], AssertionError, "the controller failed"),
    ],
)
def test_controller_that_does_not_run_is_told(lab, command, error, says):
    bench = lab(controller_command=command)
    bench.run(0.01)
    with pytest.raises(error, match=says):
        bench.assert_no_trip()


def test_the_light_on_an_array_falls(lab):
    pv = {"V_oc": 1.25, "I_sc": 1.08, "V_mp": 1.0, "I_mp": 1.0}
    bench = lab(law="matching-2", plant__dc_source={"mode": "array", "pv": pv})
    bench.run(0.1)
    bench.irradiance(0.5, rate=5.0)
    bench.run(0.8)
    bench.assert_settles("v_dc", to=1.0, within=0.6, tolerance=1e-3)
    assert bench.signals["true_i_dc"][-1] == pytest.approx(1.0 - 0.5 * 1.08, abs=1e-3)
