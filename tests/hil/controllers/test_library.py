"""Controllers in shared libraries that measure and command phase voltages and currents."""

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfm_hil.controllers
from gfm_hil.cli import main
from gfm_hil.controllers import BenchContext, PortMap, library, open_controller
from gfm_hil.controllers.external import ControllerError
from gfm_hil.core.errors import UserError
from gfm_hil.realtime.priority import processors
from gfm_hil.recording.run import Run
from gfm_plant import Bases
from gfm_runtime.signals import COUNTS, carried

from ...support.files import text_of
from ...support.firmware import STRICT, cc
from ...support.processes import write

HEADERS = Path(gfm_hil.controllers.__file__).parent
EXAMPLE = Path(__file__).parents[3] / "examples" / "foreign_controller"
FAILS = Path(__file__).parents[2] / "support" / "foreign_library.c"
FLAGS = [*STRICT, "-O2"]
SHARED = ["-shared", "-fPIC", f"-I{HEADERS}"]


class Fake:
    """A library in Python: keeps what it measures, and gives phase voltages by a function of t."""

    def __init__(self, e: Any) -> None:
        self.e, self.setup, self.seen, self.started = e, None, [], []

    def gfmhil_name(self) -> bytes:
        return b"fake"

    def gfmhil_new(self, setup: Any) -> int:
        self.setup = setup._obj
        return 1

    def gfmhil_start(self, _: Any, given: Any, now: Any) -> int:
        self.started.append(list(now._obj.e))
        return 0

    def gfmhil_step(self, _: Any, given: Any, out: Any) -> int:
        self.seen.append((given._obj.t, *map(list, (given._obj.v, given._obj.i))))
        out._obj.e[:] = self.e(given._obj.t)
        out._obj.i_dc = 4.0
        return 0


@pytest.fixture
def failing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Makes the library that fails in a way."""

    def make(what: str) -> Path:
        done = cc(tmp_path, *FLAGS, *SHARED, str(FAILS), "-o", "fails.so", "-lm")
        assert (done.returncode, done.stderr) == (0, "")
        monkeypatch.setenv("FOREIGN_WHAT", what)
        return tmp_path / "fails.so"

    return make


def phases(amplitude: float, angle: float) -> list[float]:
    return [amplitude * math.cos(angle - 2 * math.pi * k / 3) for k in range(3)]


@pytest.mark.parametrize(("step_ticks", "delay"), [(1, 0.0), (1, 1.3), (4, 0.5)])
def test_phases_are_those_of_the_turning_frame(step_ticks, delay, tmp_path, monkeypatch):
    """A controller that gives a voltage of constant amplitude and speed, and makes up for the delay
    that it is told, is in the frame a constant but for the steps in which it is held."""
    rig, speed = BenchContext(1e-4, True, Bases(), delay), 1.01
    w = speed * rig.bases.omega_b
    V, A = 380.0 * math.sqrt(2 / 3), 4000.0 / (1.5 * 380.0 * math.sqrt(2 / 3))
    fake = Fake(lambda t: phases(0.9 * V, w * (t + fake.setup.delay) + 0.3))
    monkeypatch.setattr(library, "_load", lambda path: fake)
    ports = PortMap(step_s=step_ticks * rig.T_s)
    model = library.LibraryController(tmp_path / "x.so", ports, rig)
    assert fake.setup.delay == pytest.approx((delay + step_ticks / 2) * rig.T_s)
    places = {name: k for k, name in enumerate(carried("y", True))}
    y, u, ref = np.zeros(11), np.array([0.5, speed, 0.8, 0.1]), np.ones(5)
    y[[places["v_d"], places["v_q"]]] = 0.8, -0.2
    y[[places["i_d"], places["i_q"]]] = 0.5, 0.1
    model.start(u)
    turned = []
    for _ in range(100 * step_ticks):
        model.tick(ref, y, u)
        assert u[:2].tolist() == [4.0 / (4000.0 / 700.0), speed]
        turned.append(complex(u[2], u[3]))
    for t, v, i in fake.seen:
        assert v == pytest.approx(phases(V * abs(0.8 - 0.2j), w * t + math.atan2(-0.2, 0.8)))
        assert i == pytest.approx(phases(A * abs(0.5 + 0.1j), w * t + math.atan2(0.1, 0.5)))
    assert [t for t, *_ in fake.seen] == pytest.approx(np.arange(100) * step_ticks * rig.T_s)
    # it stands still in space while the frame turns on: around the wanted angle, by these steps
    wanted = 0.9 * np.exp(1j * 0.3)
    back = np.exp(-1j * w * rig.T_s * (np.arange(step_ticks) - (step_ticks - 1) / 2))
    np.testing.assert_allclose(turned, np.tile(wanted * back, 100))
    begun = phases(V * abs(0.8 + 0.1j), w * fake.setup.delay + math.atan2(0.1, 0.8))
    assert fake.started == [pytest.approx(begun)]


@pytest.mark.parametrize(
    ("rig", "ports", "message"),
    [
        (BenchContext(signal_set=False), PortMap(), "choose --inner virtual-stator"),
        (
            BenchContext(signal_set=COUNTS),
            PortMap(),
            "no function gfmhil_isr, and the scenario's laws",
        ),
        (BenchContext(signal_set=True), PortMap(blocks="x"), "of a map it takes step_s only"),
        (
            BenchContext(signal_set=True),
            PortMap(step_s=1.5e-4),
            "must be a multiple of the run's T_s",
        ),
    ],
)
def test_what_does_not_fit_is_refused(rig, ports, message, tmp_path, monkeypatch):
    monkeypatch.setattr(library, "_load", lambda path: Fake(None))
    with pytest.raises(UserError, match=message):
        library.LibraryController(tmp_path / "x.so", ports, rig)


def test_the_headers_folder_is_told(capsys):
    assert main(["firmware", "include"]) == 0
    assert (Path(capsys.readouterr().out.strip()) / "gfmhil_controller.h").is_file()


# --- with a compiler ---


def run(tmp_path: Path, model: Path, scenario: str, *options: str) -> Run:
    folder = tmp_path / "run"
    command = ["run", scenario, "--link", "shm", "--out", str(folder)]
    command += ["--controller", f"c:{model}", "--inner", "cascaded", "--quiet", "--no-figures"]
    code = main([*command, *options])
    found = Run.load(folder)
    assert (code == 0) == (found.summary["status"] == "completed"), found.summary["reason"]
    return found


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example's library, by its own Makefile."""
    folder = tmp_path_factory.mktemp("example")
    for name in ("controller.c", "Makefile"):
        shutil.copy(EXAMPLE / name, folder)
    command = ["make", f"CFLAGS={' '.join(FLAGS)}", f"GFMHIL_INCLUDE={HEADERS}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "controller.so"


@pytest.mark.apt
@pytest.mark.parametrize(
    ("scenario", "p_end"),
    [("rig_pref_step", 1.0), ("ride_through_fault", 0.5), ("phase_jump_within_rating", 0.5)],
)
def test_the_example_holds_the_plant(example, scenario, p_end, tmp_path):
    found = run(tmp_path, example, scenario, "--mode", "lockstep", "--duration", "2.5")
    p, i = found.columns["true_p"][:], found.columns["true_i"][:]
    first = found.scenario.sorted_events()[0].at(found.scenario.T_s)
    assert found.summary["status"] == "completed"
    assert found.summary["controller"] == "c droop of another house"
    assert np.abs(p[: first - 1] - 0.5).max() < 0.02  # it begins where the plant rests
    assert p[-2000:].mean() == pytest.approx(p_end, abs=0.01)
    width = round(0.02 / found.scenario.T_s)
    assert np.convolve(i, np.ones(width) / width, "valid").max() < 1.3  # its limit is 1.2
    assert found.summary["events"][0]["f_nadir_hz"] is None  # the frame's speed is no frequency


@pytest.mark.apt
@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("fault", "c a library that fails: blocks the bridge: fault 7, the cooling has stopped"),
        ("start", "c a library that fails: blocks the bridge: fault 3, it does not say what it is"),
        ("nan", "c a library that fails: out->e[1] = nan at t = 0.01 s"),
        ("hang", "c a library that fails: has not answered for 2 s"),
        ("crash", "the controller was ended by SIGSEGV"),
    ],
)
def test_a_library_that_fails_is_named_and_the_run_is_kept(what, reason, failing, tmp_path):
    timeout_s = {"hang": 4.0, "crash": 2.0}.get(what, 20.0)
    link = {"type": "shm", "peer_timeout_s": timeout_s}
    found = run(tmp_path, failing(what), write(tmp_path, law="vsg-2", link=link))
    assert (found.summary["status"], found.summary["reason"]) == ("safe", reason)
    if what != "start":
        assert found.summary["ticks"] >= 100
        assert np.ptp(found.columns["true_p"][:100]) < 0.05  # a voltage that turns: at rest


@pytest.mark.apt
def test_in_lockstep_a_library_may_take_seconds(failing, tmp_path):
    found = run(tmp_path, failing("pause"), write(tmp_path, law="vsg-2"))
    assert (found.summary["status"], found.summary["ticks"]) == ("completed", 1000)
    assert found.summary["wall_s"] > 2.0


@pytest.mark.apt
@pytest.mark.skipif(processors() < 2, reason="every process has one processor")
def test_in_lockstep_a_library_and_its_threads_share_a_processor(failing, tmp_path):
    """A processor that sleeps takes long to wake: no thread waits for another processor."""
    found = run(tmp_path, failing("where"), write(tmp_path, law="vsg-2"))
    assert found.summary["reason"].endswith("fault 8, 1 for its thread, 1 for its step, 1 for both")


@pytest.mark.apt
def test_in_real_time_a_library_that_takes_too_long_ends_the_run(failing, tmp_path):
    late = {"mode": "realtime", "T_s": 1e-3, "late_policy": {"hold": 50}, "duration": 5.0}
    link = {"type": "shm", "peer_timeout_s": 20.0}
    found = run(tmp_path, failing("slow"), write(tmp_path, law="vsg-2", link=link, **late))
    reason = "no fresh u for longer than late_policy.hold allows"
    assert (found.summary["status"], found.summary["reason"]) == ("safe", reason)
    assert found.summary["misses"] >= 50


@pytest.mark.apt
def test_what_is_no_such_library_is_refused(tmp_path, monkeypatch):
    rig = BenchContext(signal_set=True)
    (tmp_path / "text.so").write_text("no library")
    (tmp_path / "other.c").write_text("int other(void) { return 0; }\n")
    assert cc(tmp_path, *SHARED, "other.c", "-o", "other.so").returncode == 0
    for name, *more in (("old.so", "-DSAYS=0"), ("fails.so",)):
        assert cc(tmp_path, *SHARED, *more, str(FAILS), "-o", name, "-lm").returncode == 0
    monkeypatch.setenv("FOREIGN_WHAT", "refuse")
    for name, message in (
        ("text.so", "cannot be loaded"),
        ("other.so", "has no function gfmhil_version"),
        ("old.so", "was compiled for version 0 of gfmhil_controller.h"),
        ("fails.so", "refuses this bench"),
    ):
        with pytest.raises(UserError, match=message):
            open_controller(f"c:{tmp_path / name}", PortMap(), rig)


# --- the adapter of a firmware whose tasks a timer calls ---

TASKS = Path(__file__).parents[3] / "examples" / "task_firmware"
#: keeps what each call gets; its bridge gives the voltage that it measures
RECORDER = text_of("recorder.c")
MEGAWATT = Bases(S_n=1e6, V_n=480.0, V_dcref=900.0, omega_n=2 * math.pi * 60)


def adapted(folder: Path, firmware: str) -> Path:
    """The adapter with a firmware, by its own Makefile."""
    shutil.copytree(TASKS, folder, ignore=shutil.ignore_patterns("*.so"))
    (folder / "other.c").write_text(RECORDER)
    command = ["make", f"CFLAGS={' '.join(FLAGS)}", f"GFMHIL_INCLUDE={HEADERS}"]
    done = subprocess.run(
        [*command, f"FIRMWARE={firmware}"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return folder / "controller.so"


@pytest.mark.apt
def test_a_firmware_sees_the_start_as_if_it_had_been_there_before(tmp_path):
    path = adapted(tmp_path / "tasks", "other.c")
    rig, ports = BenchContext(1e-4, True, MEGAWATT), PortMap(step_s=2e-4)
    model = library.LibraryController(path, ports, rig)
    with pytest.raises(UserError, match="refuses this bench"):  # its variables are static
        library.LibraryController(path, ports, rig)
    places = {name: k for k, name in enumerate(carried("y", True))}
    y, u = np.zeros(11), np.array([0.5, 1.0, 0.9, 0.1])
    y[[places["v_d"], places["v_q"], places["i_d"], places["i_q"]]] = 0.9, 0.1, 0.5, -0.1
    y[places["v_dc"]] = 1.0
    ref = np.array([1.0, 0.5, 1.0, 0.1, 1.0])
    model.start(u)
    model.tick(ref, y, u)
    of = ctypes.CDLL(str(path))
    calls = ctypes.c_int.in_dll(of, "calls").value
    seen = np.ctypeslib.as_array((ctypes.c_double * (80000 * 11)).in_dll(of, "seen"))
    seen = np.array(seen).reshape(-1, 11)[:calls]
    assert calls == 20000 + 40000 + 1
    at = 2 * math.pi * 60 * 2e-4 * (np.arange(calls) - (calls - 1))  # rad, 0 at the start
    V, A = 480 * math.sqrt(2 / 3), 1e6 / (1.5 * 480 * math.sqrt(2 / 3))
    for column, base, vector in ((0, V, 0.9 + 0.1j), (3, A, 0.5 - 0.1j)):
        waves = [
            abs(vector) * base * np.cos(at + np.angle(vector) - 2 * math.pi * k / 3)
            for k in range(3)
        ]
        if column == 3:
            waves = [wave * (np.arange(calls) >= 20000) for wave in waves]
        np.testing.assert_allclose(seen[:, column : column + 3].T, waves, atol=1e-6 * base)
    assert (seen[:, 9] == (np.arange(calls) >= 20000)).all()
    assert set(map(tuple, seen[:, 6:9])) == {(900.0, 5e5, 1e5)} and seen[0, 10] == 2e6
    assert u[2] + 1j * u[3] == pytest.approx(0.9 + 0.1j, rel=0.05)  # turned by half a period
    ctypes.c_int.in_dll(of, "pwm_on").value = 0
    model.tick(ref, y, u)
    with pytest.raises(ControllerError, match="fault 1, the firmware does not enable its PWM"):
        model.tick(ref, y, u)
    model.close()


@pytest.mark.apt
def test_the_firmware_of_the_example_holds_the_plant(tmp_path):
    path = adapted(tmp_path / "tasks", "firmware.c")
    scenario = tmp_path / "tasks" / "short.toml"
    text = (path.parent / "events.toml").read_text()
    for was, now in (("8.0", "3.2"), ("t = 1.0", "t = 0.1"), ("t = 3.0", "t = 0.5"),
                     ("t = 6.0", "t = 2.5")):  # fmt: skip
        assert text.count(was) == 1
        text = text.replace(was, now)
    scenario.write_text(text)
    map_file = str(path.parent / "map.toml")
    found = run(tmp_path, path, str(scenario), "--map", map_file, "--inner", "virtual-stator")
    assert found.summary["status"] == "completed"
    assert found.summary["controller"] == "c firmware of 5 kHz tasks"
    p, i = found.columns["true_p"][:], found.columns["true_i"][:]
    assert np.abs(p[:1000] - 0.5).max() < 0.05  # it begins where the plant rests
    assert np.abs(p[5100:6900]).max() < 0.1 and i[5500:6900].max() < 1.7  # its limit is 1.6
    assert p[-500:].mean() == pytest.approx(0.8, abs=0.1)
