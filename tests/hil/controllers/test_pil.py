"""The laws of a run on another processor: the bits of the kernel, and how it fails."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.controllers import BenchContext, PortMap, open_controller, pil
from gfm_hil.controllers.external import ControllerError, ExternalController
from gfm_hil.core.errors import UserError
from gfm_hil.engine import setup
from gfm_hil.recording.run import Run
from gfm_hil.run import runner
from gfm_hil.scenario import find_scenario, load_scenario
from gfm_runtime import load_law
from gfm_runtime.firmware import TARGETS, make_modules
from gfm_runtime.firmware.check import HARNESS
from gfm_runtime.kernel import N_MAX
from gfm_runtime.signals import FULL_SCALES, NU

from ...support.firmware import STRICT
from ...support.processes import write


def qemu(test: Any) -> Any:
    return pytest.mark.compilers(pytest.mark.timeout(900)(test))


SHM, PAUSE_S = {"type": "shm"}, 2.0
STEP = {"tick": 100, "type": "reference", "P_ref": 0.8, "ramp_s": 0.01}
GAINS = {"tick": 150, "type": "gains", "values": {"D_p": 0.02}}
CHANGE = {"tick": 300, "type": "law", "law": "mimo-gfm"}
LATER = {**CHANGE, "tick": 400}
BACK = {"tick": 400, "type": "law", "law": "vsg-2"}
COUNTS = {
    "counts": "rig-dead-time",
    "plant": {
        "bridge": {"kind": "two-level", "dead_time_s": 2e-6},
        "delay": {"samples": 1},
        "dc_source": {"mode": "regulated"},
    },
}
CORTEX_M = Path(__file__).parents[3] / "examples" / "firmware_cortex_m"
STATES = Path(__file__).parents[2] / "support" / "firmware_c" / "states.c"
LOST = {"counts": "rig", "plant": {"phases": {"gain": {"v_b": 0.0}}, "delay": {"samples": 1}}}
DIP = [{"tick": 100, "type": "grid-voltage", "V_g": 0.0}, {"tick": 300, "type": "reset"}]


def run(tmp_path: Path, target: str, **content: Any) -> Run:
    """A run on a target, by the command."""
    file = write(tmp_path, **{"law": "vsg-2", "link": SHM, "duration": 0.06, **content})
    folder = tmp_path / "run"
    command = ["run", file, "--controller", f"pil:{target}", "--out", str(folder), "--quiet"]
    code = main([*command, "--no-figures"])
    found = Run.load(folder)
    assert (code == 0) == (found.summary["status"] == "completed")
    return found


def in_process(found: Run, real: str, monkeypatch: pytest.MonkeyPatch) -> Run:
    """The same scenario with the kernel of a precision in this process."""
    monkeypatch.setattr(runner, "make_benches", partial(setup.make_benches, real=real))
    assert found.folder is not None
    return runner.run_in_memory(
        load_scenario(str(found.folder / "scenario.toml"), link__type="inproc")
    )


def assert_same(found: Run, near: Run) -> None:
    """Every recorded column, byte by byte, and what happened to the laws."""
    assert found.summary["status"] == near.summary["status"]
    assert found.summary["laws"] == near.summary["laws"]
    assert found.summary["bump_pu"] == near.summary["bump_pu"]
    for name, column in near.columns.items():
        assert found.columns[name][:].tobytes() == column[:].tobytes(), name


@qemu
@pytest.mark.parametrize(
    ("target", "content"),
    [
        ("m4f", {"events": [STEP, GAINS, CHANGE, BACK]}),
        ("m7", {"inner": "cascaded", "events": [*DIP, LATER], "after_trip": "wait"}),
        ("host", {"law": "mimo-gfm-scheduled", "events": [STEP]}),
        ("m4f", {**COUNTS, "events": [STEP, CHANGE, BACK]}),
        ("m7", {**COUNTS, "events": DIP, "after_trip": "wait"}),
        ("host", LOST),
    ],
)
def test_a_run_has_the_bits_of_the_kernel(target, content, tmp_path, monkeypatch):
    found = run(tmp_path, target, **content)
    assert found.summary["controller"] == f"gfmhil on {target}"
    near = in_process(found, TARGETS[target].real, monkeypatch)
    assert_same(found, near)
    changes = [e for e in content.get("events", ()) if e["type"] in ("law", "gains")]
    assert np.count_nonzero(np.diff(found.columns["law"][:])) == len(changes)
    assert np.ptp(near.columns["true_p"][:]) > 0.005
    counted = found.summary.get("instructions")
    if target == "host":
        assert counted is None and "controller_instructions" not in found.timing
    else:
        column = found.timing["controller_instructions"][:]
        column = column[column >= 0]
        assert len(column) > 300  # a tick that waits for a reset has none
        assert 100 < counted["least"] <= counted["p50"] <= counted["most"] < 1000
        assert (column.min(), column.max()) == (counted["least"], counted["most"])


@qemu
def test_the_shipped_switchover_has_the_bits_of_the_float32_kernel(tmp_path, monkeypatch):
    """The paper's experiment on the rig on a Cortex-M4F, with its event after 20 ms."""
    text = find_scenario("switchover").read_text(encoding="utf-8").split("\n")
    short = {"t": "t = 0.02", "duration": "duration = 0.06"}
    kept = [short.get(line.partition(" =")[0], line) for line in text]
    (tmp_path / "short.toml").write_text(
        "\n".join(line for line in kept if not line.startswith("expect")), encoding="utf-8"
    )
    folder = tmp_path / "run"
    command = ["run", str(tmp_path / "short.toml"), "--controller", "pil:m4f", "--quiet"]
    assert main([*command, "--out", str(folder), "--no-figures"]) == 0
    found = Run.load(folder)
    assert (found.scenario.mode, found.summary["ticks"]) == ("lockstep", 600)
    exact = runner.run_in_memory(found.scenario)  # the negative control
    assert found.columns["u_omega_u"][:].tobytes() != exact.columns["u_omega_u"][:].tobytes()
    assert_same(found, in_process(found, "float32", monkeypatch))


@qemu
@pytest.mark.parametrize("target", ["m4f", "host"])
def test_the_firmware_of_the_example_switches_laws_with_the_bits_of_the_kernel(
    target, tmp_path, monkeypatch
):
    """From the interrupt to the compare registers, until the plant trips."""
    copy_example(tmp_path, t="0.1", expect_after="0.1")
    monkeypatch.chdir(tmp_path)
    command = ["run", "scenario.toml", "--controller", f"pil:{target}:."]
    assert main([*command, "--out", "run", "--quiet", "--no-figures"]) == 0
    found = Run.load(tmp_path / "run")
    assert found.summary["laws"] == ["mimo-gfm", "vsg-2"]
    assert 1_000 < found.summary["ticks"] < 40_000
    assert_same(found, in_process(found, TARGETS[target].real, monkeypatch))


def copy_example(folder: Path, **values: str | None) -> None:
    """The example with other values in lines of its scenario, or without them."""
    for part in CORTEX_M.iterdir():
        (folder / part.name).write_bytes(part.read_bytes())
    text = (folder / "scenario.toml").read_text(encoding="utf-8")
    for name, value in values.items():
        line = "" if value is None else f"{name} = {value}"
        text = re.sub(rf"(?m)^{name} = .*$", line, text)
    (folder / "scenario.toml").write_text(text, encoding="utf-8")


@pytest.mark.compilers
def test_the_firmware_of_the_example_enables_blocks_and_resets_as_it_should(tmp_path):
    """Through its registers: the trip input, a lost channel, a reset that must not come first."""
    laws = ["mimo-gfm", "vsg-2", "--counts", str(CORTEX_M / "board.toml")]
    assert main(["firmware", "export", *laws, "-o", str(tmp_path)]) == 0
    ones = {
        name: 2**12 / (FULL_SCALES[of][1] - FULL_SCALES[of][0])
        for name, of in {"V_1": "v", "V_DC_1": "v_dc"}.items()
    }
    sources = [*CORTEX_M.glob("[fi]*.c"), STATES, *tmp_path.glob("*.c")]
    command = ["gcc", *STRICT, "-ffp-contract=off", "-DGOLDEN_NO_MAIN", "-o", tmp_path / "states"]
    command += [f"-D{name}={value}" for name, value in ones.items()]
    command += [f"-I{folder}" for folder in (CORTEX_M, HARNESS, tmp_path)]
    subprocess.run([*command, *sources, "-lm"], check=True)
    said = subprocess.run([tmp_path / "states"], capture_output=True, text=True, check=True).stdout
    assert said.splitlines() == [
        "power: START 0 0",
        "no v_dc: START 0 0",
        "charged: START 0 0",
        "calibrated: READY 0 0",
        "20 20",
        "enabled: RUN 1 0",
        "runs: RUN 1 0",
        "20",
        "1",
        "disabled: READY 0 0",
        "trip: SAFE 0 100",
        "reset while enabled: SAFE 0 100",
        "reset: READY 0 0",
        "again: RUN 1 0",
        "lost v_a: SAFE 0 7",
        "v_a is back: SAFE 0 7",
    ]


@qemu
@pytest.mark.parametrize(
    ("content", "where", "said"),
    [
        ({"counts": "rig"}, "none", r"controller pil:host:.*none: is no folder with C sources"),
        ({}, "", r"controller pil: counts: missing; the interrupt of .* begins with them"),
    ],
)
def test_a_firmware_that_cannot_run_is_refused(content, where, said, tmp_path, capsys):
    file = write(tmp_path, **{"law": "vsg-2", "link": SHM, "plant": LOST["plant"], **content})
    command = ["run", file, "--controller", f"pil:host:{CORTEX_M / where}", "--quiet"]
    assert main([*command, "--out", str(tmp_path / "run"), "--no-figures"]) == 2
    assert re.search(said, capsys.readouterr().err)


@qemu
@pytest.mark.parametrize(("gain", "ends"), [(1.9048, 0), (1.9049, 2)])
def test_a_firmware_that_brings_the_code_of_another_law_is_refused(
    gain, ends, tmp_path, monkeypatch, capsys
):
    """Its own copy of the laws' C has to be of the laws of the run."""
    monkeypatch.chdir(tmp_path)
    trip: dict[str, None] = dict.fromkeys(("expect", "expect_reason", "expect_after"))
    copy_example(tmp_path, duration="0.02", t="0.01", **trip)
    law = tmp_path / "vsg-2.toml"
    law.write_text(f"base = 'vsg-2'\nname = 'vsg-2'\nparameters.k_34 = {gain}\n")
    export = ["firmware", "export", "vsg-2.toml", "--counts", "board.toml", "--real", "float64"]
    assert main([*export, "-o", "own"]) == 0
    for end in "ch":
        name = f"gfm_vsg_2.{end}"
        (tmp_path / name).write_bytes((tmp_path / "own" / name).read_bytes())
    command = ["run", "scenario.toml", "--controller", "pil:host:.", "--quiet", "--no-figures"]
    assert main([*command, "--out", "run"]) == ends
    said = capsys.readouterr().err.strip()
    assert Path("run", "signals.npz").exists() == (not ends)
    if ends:
        assert re.fullmatch(
            r"gfmhil: controller pil: gfmhil on host: its code is of another law: "
            r"'gfmhil [\d.]+; vsg-2; [0-9a-f]{32}; float64; T_s = 0.0001 s; f_n = 50 Hz', "
            r"the run has 'gfmhil .*'",
            said,
        )


@qemu
@pytest.mark.parametrize(
    ("number", "link", "reason"),
    [
        (signal.SIGKILL, SHM, "gfmhil on m4f: qemu-system-arm has ended by SIGKILL"),
        (signal.SIGSTOP, SHM | {"peer_timeout_s": 4.0}, "gfmhil on m4f: has not answered for 2 s"),
    ],
)
def test_a_machine_that_dies_or_hangs_is_named_and_the_run_is_kept(
    number, link, reason, tmp_path, monkeypatch
):
    scratch = Path(tempfile.mkdtemp(prefix="pil-"))  # short: a socket is to be made there
    monkeypatch.setenv("TMPDIR", str(scratch))
    machines: list[int] = []
    thread = threading.Thread(target=hit, args=(tmp_path, scratch, machines, number))
    thread.start()
    found = run(tmp_path, "m4f", duration=60.0, link=link)
    thread.join()
    assert (found.summary["status"], found.summary["reason"]) == ("safe", reason)
    assert found.summary["ticks"] > 100
    assert np.isfinite(found.columns["u_omega_u"][:100]).all()
    assert machines and not any(Path(f"/proc/{process}").exists() for process in machines)
    scratch.rmdir()  # nothing is left there


@qemu
def test_a_machine_that_answers_after_seconds_completes_the_run(tmp_path, monkeypatch):
    scratch = Path(tempfile.mkdtemp(prefix="pil-"))
    monkeypatch.setenv("TMPDIR", str(scratch))
    machines: list[int] = []
    stops = (signal.SIGSTOP, signal.SIGCONT)
    thread = threading.Thread(target=hit, args=(tmp_path, scratch, machines, *stops))
    thread.start()
    found = run(tmp_path, "m4f", duration=2.0, link=SHM)
    thread.join()
    assert (found.summary["status"], found.summary["ticks"]) == ("completed", 20_000)
    assert found.summary["wall_s"] > PAUSE_S
    assert machines and not any(Path(f"/proc/{process}").exists() for process in machines)
    scratch.rmdir()


def hit(tmp_path: Path, scratch: Path, machines: list[int], *numbers: signal.Signals) -> None:
    """Send the machine and its guard, which work below ``scratch``, signals in mid run."""
    parts, ticks = tmp_path / "run" / "parts" / "plant_progress.npy", 0
    while ticks <= 100:
        time.sleep(0.01)
        with contextlib.suppress(OSError, ValueError, EOFError):  # not there, or not whole, yet
            ticks = np.load(parts)[0]
    machines.extend(processes_in(scratch))
    for number in numbers:
        for process in machines:
            with contextlib.suppress(ProcessLookupError):  # it has ended with its guard
                os.kill(process, number)
        time.sleep(PAUSE_S if number == signal.SIGSTOP else 0.0)


def processes_in(folder: Path) -> list[int]:
    """The processes that work in a folder below this one."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if folder in (place / "cwd").readlink().parents:
                found.append(int(place.name))
        except OSError:
            pass  # it has ended, or is another user's
    return found


IMPOSTOR = """\
#!{python}
import os, struct
os.write(from_ := os.open("from", os.O_WRONLY), bytes({size}))
to = os.open("to", os.O_RDONLY)
print("the machine is on fire", flush=True)
while request := os.read(to, {asks}):
    if (what := request[0]) == 0:
        {does}
    elif what == 5:
        os.write(from_, bytes({size}) + {identification!r})
    elif what == 3:
        os.read(to, 4096)  # a golden row of which no word differs
        os.write(from_, bytes({size}))
    else:
        os.read(to, {state})
"""


@qemu
@pytest.mark.parametrize(
    ("does", "reason"),
    [
        ("os._exit(3)", "qemu-system-arm has ended with code 3: the machine is on fire"),
        ("os.write(from_, struct.pack('<ii', 77, 0) + bytes({size} - 8))",
         "answers 77 for signal 0, which no law does: the machine is on fire"),
        ("os.write(from_, struct.pack('<ii', 1, 3) + bytes({size} - 8))",
         "refuses: a measurement is not finite or out of range: q"),
    ],
)  # fmt: skip
def test_a_wrong_answer_is_named(does, reason, tmp_path, monkeypatch):
    """Another program in the machine's place."""
    machine = tmp_path / "qemu-system-arm"
    asks, size, state = 4 * (3 + 5 + 5), 4 * (4 + 3 + 3 + 1 + 2), 4 * (N_MAX + 3 * 3)
    does = does.replace("{size}", str(size))
    (module,) = make_modules({"0 vsg-2": load_law("vsg-2").laws[0]}, 1e-4, np.float32)
    text = module.identification(1e-4).encode() + b"\0"
    machine.write_text(IMPOSTOR.format(
        python=sys.executable, asks=asks, size=size, state=state, does=does, identification=text
    ))  # fmt: skip
    machine.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with closing(open_controller("pil:m4f", PortMap(), BenchContext())) as model:
        begin(model)
        u = np.zeros(NU)
        model.start(u)
        with pytest.raises(ControllerError, match=re.escape(f"gfmhil on m4f: {reason}")):
            model.tick(np.ones(5), np.ones(5), u)
    assert not processes_in(tmp_path)


@qemu
def test_what_it_cannot_do_is_refused(tmp_path, capsys):
    file = write(tmp_path, law="vsg-2", link={"type": "shm"})
    command = ["controller", file, "--endpoint", "shm://none", "--out", str(tmp_path / "run")]
    assert main([*command, "--model", "pil:m4f", "--mode", "realtime"]) == 2
    said = capsys.readouterr().err
    assert "mode = 'realtime': gfmhil on m4f keeps no time; choose --mode lockstep" in said


@qemu
@pytest.mark.parametrize("inner", ["none", "cascaded"])
def test_a_program_with_other_bits_is_refused(inner, tmp_path, monkeypatch):
    """A compiler that fuses multiply-add, which the processor can do."""
    instead(tmp_path, "arm-none-eabi-gcc", 'exec {real} "$@" -ffp-contract=fast', monkeypatch)
    with pytest.raises(UserError) as refused:
        begin(open_controller("pil:m4f", PortMap(), BenchContext()), inner=inner)
    assert re.sub(r"[1-9][\d,]*", "N", str(refused.value)) == (
        "controller pil: gfmhil on mNf: its program does not compute the kernel's bits: "
        "N words differ in N golden rows, the first in law vsg-N; a compiler that fuses "
        "multiply-add (-ffp-contract=fast, -ffast-math) does this"
    )


@qemu
@pytest.mark.parametrize(
    ("does", "reason"),
    [
        (
            'exec {real} "${{@/mps2-an386/mps3}}"',
            "qemu-system-arm has ended with code 1: qemu-system-arm: unsupported machine type",
        ),
        (  # a Cortex-M3, which has no floating-point unit
            'exec {real} "${{@/mps2-an386/mps2-an385}}"',
            "qemu-system-arm has ended by SIGABRT: qemu: fatal: Lockup: can't escalate 3 to Hard",
        ),
        ("echo no machine; echo for you; exec sleep 60", "for 0.5 s: no machine; for you"),
        ("yes > from", r"its code is of another law: 'y\ny\n"),
    ],
)
def test_what_is_no_such_machine_is_refused_with_what_it_says(does, reason, tmp_path, monkeypatch):
    instead(tmp_path, "qemu-system-arm", does, monkeypatch)
    monkeypatch.setattr(pil, "_START_S", 0.5 if "sleep" in does else 30.0)
    model = open_controller("pil:m4f", PortMap(), BenchContext())
    with pytest.raises(UserError, match=re.escape(reason)):
        begin(model)
    assert not processes_in(tmp_path)


def begin(model: ExternalController, **content: Any) -> None:
    """Begin with the laws of a run."""
    scenario = load_scenario("pref_step", in_process=True, law="vsg-2", **content)
    model.begin(setup.make_bench(scenario, "float32").controller)


def instead(folder: Path, name: str, does: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a shell script in a program's place, whose path is ``real`` in it."""
    script = folder / name
    script.write_text("#!/bin/bash\n" + does.format(real=shutil.which(name)) + "\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


# --- without a compiler ---


def test_a_missing_tool_and_a_wrong_target_are_named(tmp_path, monkeypatch):
    with pytest.raises(
        UserError, match=r"pil:m0: must be pil: and one of host, clang, m4f, m7, m3, rv"
    ):
        open_controller("pil:m0", PortMap(), BenchContext())
    with pytest.raises(UserError, match=r"pil:s390x: has the other order of bytes"):
        open_controller("pil:s390x", PortMap(), BenchContext())
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        UserError, match=r"m4f: arm-none-eabi-gcc is not there; apt-get install gcc"
    ):
        open_controller("pil:m4f", PortMap(), BenchContext())
    with pytest.raises(UserError, match=r"pil:m4f: has our signals, and takes no map"):
        open_controller("pil:m4f", PortMap(fixed={"i_u": 0.5}), BenchContext())
