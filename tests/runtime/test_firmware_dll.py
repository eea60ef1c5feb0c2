"""Laws as real-code models (IEEE/CIGRE, CIGRE TB 958): loaded as an EMT program does, bit by bit.

The layout below is the interface's (natural alignment), not read from our header.
"""

import ctypes as c
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import typeof

from gfm_hil.cli import main
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import load_scenario
from gfm_runtime import load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.controller import control
from gfm_runtime.signals import carried, command_rows, group, names
from gfm_runtime.states import BAD_SENSOR, BAD_Y, RUNNING
from gfm_runtime.switchover import settle_into

from ..support.firmware import STRICT, T_S, accepted, bench, cc, from_pin_to_pin, turning_counts

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]

SUPPORT = Path(__file__).parents[1] / "support"
REAL64, EMT = 9, 1
OK, MESSAGE = 0, 1
TICKS = 1000
DIP = {"type": "grid-voltage", "t": 0.5, "V_g": 0.97, "duration": 0.1}


class Signal(c.Structure):
    _fields_ = [("Name", c.c_char_p), ("Description", c.c_char_p), ("Unit", c.c_char_p),
                ("DataType", c.c_int), ("Width", c.c_int32)]  # fmt: skip


class ModelInfo(c.Structure):
    _fields_ = [
        ("DLLInterfaceVersion", c.c_uint8 * 4),
        *((name, c.c_char_p) for name in (
            "ModelName", "ModelVersion", "ModelDescription", "GeneralInformation", "ModelCreated",
            "ModelCreator", "ModelLastModifiedDate", "ModelLastModifiedBy", "ModelModifiedComment",
            "ModelModifiedHistory")),
        ("FixedStepBaseSampleTime", c.c_double), ("EMT_RMS_Mode", c.c_uint8),
        ("NumInputPorts", c.c_int32), ("InputPortsInfo", c.POINTER(Signal)),
        ("NumOutputPorts", c.c_int32), ("OutputPortsInfo", c.POINTER(Signal)),
        ("NumParameters", c.c_int32), ("ParametersInfo", c.c_void_p),
        ("NumIntStates", c.c_int32), ("NumFloatStates", c.c_int32), ("NumDoubleStates", c.c_int32),
    ]  # fmt: skip


class Instance(c.Structure):
    _fields_ = [
        ("ExternalInputs", c.c_void_p), ("ExternalOutputs", c.c_void_p), ("Parameters", c.c_void_p),
        ("Time", c.c_double), ("SimTool_EMT_RMS_Mode", c.c_uint8),
        ("LastErrorMessage", c.c_char_p), ("LastGeneralMessage", c.c_char_p),
        ("IntStates", c.c_void_p), ("FloatStates", c.c_void_p), ("DoubleStates", c.c_void_p),
    ]  # fmt: skip


class Model:
    """One instance in a program that hands out other memory at every call, as PSCAD does."""

    def __init__(self, path: Path) -> None:
        self._of = c.CDLL(str(path))
        self._of.Model_GetInfo.restype = c.POINTER(ModelInfo)
        self.info = self._of.Model_GetInfo().contents
        self.outputs = np.zeros(self.info.NumOutputPorts)
        self.inputs = np.zeros(self.info.NumInputPorts)
        self._states = [
            np.zeros(self.info.NumIntStates, np.int32),
            np.zeros(self.info.NumFloatStates, np.float32),
            np.zeros(self.info.NumDoubleStates),
        ]
        self.message = b""
        self.parameters: Any = None  # float64; none is given if not set

    def call(self, name: str) -> int:
        arrays = [self.inputs.copy(), self.outputs.copy(), *(s.copy() for s in self._states)]
        ins, outs, *states = (a.ctypes.data for a in arrays)
        gains = None if self.parameters is None else self.parameters.ctypes.data
        now = Instance(ins, outs, gains, 0.0, EMT, None, None, *states)
        result = int(getattr(self._of, name)(c.byref(now)))
        _, self.outputs, *self._states = arrays
        self.message = now.LastGeneralMessage or b""
        return result

    def start(self, u: Any) -> None:
        for name in ("Model_FirstCall", "Model_CheckParameters"):
            assert self.call(name) == OK
        self.outputs[: len(u)] = u
        assert self.call("Model_Initialize") == OK

    def tick(self, ref: Any, y: Any) -> int:
        self.inputs[:] = [*ref, *y]
        return self.call("Model_Outputs")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Any:
    found: dict[Any, Path] = {}

    def build(law: str, inner: str, real: str) -> Path:
        if (law, inner, real) not in found:
            folder = tmp_path_factory.mktemp("dll")
            command = ["firmware", "dll", law, "--inner", inner, "--real", real, "-o", str(folder)]
            assert main(command) == 0
            found[law, inner, real] = next(folder.glob("*.so"))
        return found[law, inner, real]

    return build


@pytest.mark.parametrize("real", ["float32", "float64"])
def test_a_model_from_counts_to_counts_has_the_kernels_bits(tmp_path, real):
    """Counts in, u and compare counts out; a phase that is lost ends in the safe state."""
    command = ["firmware", "dll", "vsg-2", "--counts", "rig-dead-time", "--real", real]
    assert main([*command, "-o", str(tmp_path)]) == 0
    model, u, ref = Model(next(tmp_path.glob("*.so"))), [0.5, 1.0, 1.0, 0.05], [1, 0.5, 1, 0, 1]
    names_of = [model.info.OutputPortsInfo[k].Name for k in range(model.info.NumOutputPorts)]
    assert names_of[4:] == [b"cmp_a", b"cmp_b", b"cmp_c", b"reason"]
    model.start(u)
    counts = turning_counts(TICKS)
    law = load_law("vsg-2", None, "rig-dead-time").laws[0]
    for row, expected in zip(counts, from_pin_to_pin(law, real, ref, counts, u), strict=True):
        assert model.tick(ref, row) == OK
        assert [*model.outputs] == [*expected, 0.0]
    lost = np.where(np.arange(10) == 5, 2048, counts[-1])
    assert any(model.tick(ref, lost) == MESSAGE for _ in range(400))
    assert model.outputs[-1] == BAD_SENSOR


@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize(
    ("law", "inner"),
    [("vsg-2", "none"), ("hybrid-angle", "none"), ("vsg-2", "cascaded"),
     ("mimo-gfm", "virtual-stator"), ("dvoc", "threshold-impedance")],
)  # fmt: skip
def test_the_model_has_the_kernels_bits(built, law, inner, real):
    """Two instances in turn over 1,000 ticks of golden inputs, limits included."""
    stages = inner != "none"
    u = np.array([0.5, 1.0, 1.0, 0.05][: 3 + stages], real).astype(float)
    twins = []
    for seed in (1, 2):
        refs, ys = accepted(seed, TICKS, real, stages)
        model = Model(built(law, inner, real))
        model.start(u)
        np.testing.assert_array_equal(model.outputs[:-1], u)
        twins.append((model, bench(law, inner, real, refs[0], ys[0], u), refs, ys))
    expected = u.copy()
    for k in range(TICKS):
        for model, kernel, refs, ys in twins:
            kernel.ctl["ref"] = kernel.ctl["ref_target"] = refs[k]
            kernel.step(ys[k], expected)
            assert kernel.ctl["state"][0] == RUNNING
            assert model.tick(refs[k], ys[k]) == OK
            assert model.outputs.tobytes() == np.append(expected, 0.0).tobytes(), k


@pytest.mark.skipif(
    not all(map(shutil.which, ("x86_64-w64-mingw32-gcc", "wine"))),
    reason="no mingw or wine; they take half a gigabyte, so CI goes without",
)
@pytest.mark.parametrize("real", ["float32", "float64"])
def test_the_model_has_the_same_bits_under_windows(built, real, tmp_path):
    folder, u = built("vsg-2", "cascaded", real).parent, [0.5, 1.0, 1.0, 0.05, 0.0]
    refs, ys = accepted(3, TICKS, real, True)
    ticks = np.hstack([refs, ys])
    (tmp_path / "ticks.bin").write_bytes(np.array(u).tobytes() + ticks.tobytes())
    cross = ["-std=c99", "-O2", "-ffp-contract=off", "-static-libgcc", f"-I{folder}"]
    sources = sorted(map(str, folder.glob("*.c")))
    for arguments in (
        [*cross, "-shared", *sources, "-o", "model.dll"],
        [*cross, str(SUPPORT / "load_model.c"), "-o", "load_model.exe"],
    ):
        done = cc(tmp_path, *arguments, compiler="x86_64-w64-mingw32-gcc")
        assert done.returncode == 0, done.stderr
    quiet = {
        "WINEPREFIX": str(tmp_path / "wine"),
        "WINEDEBUG": "-all",
        "WINEDLLOVERRIDES": "mscoree=",
    }
    subprocess.run(
        ["wine", "load_model.exe", "model.dll"], cwd=tmp_path, check=True, timeout=200,
        env=os.environ | quiet,
    )  # fmt: skip
    found = np.fromfile(tmp_path / "found.bin").reshape(TICKS, len(u))
    model = Model(built("vsg-2", "cascaded", real))
    model.start(u[:-1])
    for k in range(TICKS):
        assert model.tick(refs[k], ys[k]) == OK
        assert model.outputs.tobytes() == found[k].tobytes(), k


@pytest.mark.parametrize("inner", ["none", "cascaded"])
def test_the_model_says_what_it_is(built, inner):
    info = Model(built("vsg-2", inner, "float64")).info
    assert bytes(info.DLLInterfaceVersion) == bytes([1, 1, 0, 0])
    assert (info.ModelName, info.EMT_RMS_Mode, info.NumParameters) == (b"vsg-2", EMT, 6)
    assert info.FixedStepBaseSampleTime == T_S
    ports = [
        [port[k] for k in range(n)]
        for port, n in (
            (info.InputPortsInfo, info.NumInputPorts),
            (info.OutputPortsInfo, info.NumOutputPorts),
        )
    ]
    stages = inner != "none"
    wanted = [
        [*names("ref"), *carried("y", stages)],
        [*(s.name for s in command_rows(stages)), "reason"],
    ]
    assert [[p.Name.decode() for p in port] for port in ports] == wanted
    assert {(p.DataType, p.Width) for port in ports for p in port} == {(REAL64, 1)}
    assert info.NumFloatStates == info.NumDoubleStates == 0 < info.NumIntStates


def test_the_model_waits_for_measurements_and_stays_in_the_safe_state(built):
    model = Model(built("vsg-2", "cascaded", "float64"))
    ref = np.array([s.default for s in group("ref")])
    y = np.array([1.0, 0.5, 1.0, 0.0, 1.0, 0.5, 0.0, 1.0, 0.0, 0.5, 0.0])
    model.start([0.5, 0.0, 0.0, 0.0])  # a frequency of 0 is no output
    start = [0.0, 1.0, 1.0, 0.0]
    assert model.tick(ref, 0 * y) == OK
    assert model.outputs.tolist() == [*start, BAD_Y], "waits"
    assert model.tick(ref, y) == OK and model.outputs[-1] == 0
    held = model.outputs[:-1].copy()
    assert model.tick(ref, y * np.nan) == MESSAGE and b"safe state" in model.message
    assert model.tick(ref, y) == OK, "it says so once"
    np.testing.assert_array_equal(model.outputs, [*held, BAD_Y])
    for name in ("Model_Iterate", "Model_Terminate"):
        assert model.call(name) == OK
    model.start(held)
    assert model.tick(ref, y) == OK and model.outputs[-1] == 0


def test_only_the_interface_is_exported(built, tmp_path):
    library = built("vsg-2", "cascaded", "float64")
    said = cc(tmp_path, "-D", "--defined-only", str(library), compiler="nm").stdout
    calls = ("CheckParameters", "FirstCall", "GetInfo", "Initialize", "Iterate", "Outputs",
             "PrintInfo", "Terminate")  # fmt: skip
    assert sorted(line.split()[-1] for line in said.splitlines()) == [f"Model_{n}" for n in calls]
    for compiler in ("gcc", "clang"):
        done = cc(library.parent, *STRICT, "-fsyntax-only", "model.c", compiler=compiler)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize(
    ("law", "scenario", "changed", "stages"),
    [
        ("mimo-gfm-scheduled", "weakening_grid", {}, [0, 1]),
        ("mimo-gfm-ride-through", "pref_step", {"duration": 3.0, "events": [DIP]}, [1, 0, 1]),
    ],
)
def test_a_scheduled_law_changes_its_stage_as_the_kernel_does(
    built, real, law, scenario, changed, stages
):
    """What a run measured, tick by tick, with the changes of stage among them."""
    run = run_in_memory(load_scenario(scenario, law=law, link__type="inproc", **changed))
    refs = np.column_stack([run.columns[f"ref_{name}"][:] for name in names("ref")])
    ys = np.column_stack([run.columns[f"y_{name}"][:] for name in carried("y", False)])
    refs, ys = (np.ascontiguousarray(a.astype(real).astype(float)) for a in (refs, ys))
    u = np.array([0.5, 1.0, 1.0])
    model = Model(built(law, "none", real))
    assert model.info.NumDoubleStates == model.info.NumFloatStates == 0
    model.start(u)
    kernel = Controller([load_law(law)], T_S, refs[0], real=real)
    kernel.start(np.zeros(kernel.active_law.order), u)
    k = int(kernel.ctl["active"][0])
    settle_into(kernel.laws[k], kernel.states[k], refs[0], ys[0], u.copy(), np.zeros(3))
    records = kernel.ctl, kernel.laws, kernel.states, kernel.est, ys[0], u
    control_it = control.compile(tuple(map(typeof, records)))  # else it asks for types every tick
    expected, active = u.copy(), [k]
    for k in range(len(ys)):
        kernel.ctl["ref"] = kernel.ctl["ref_target"] = refs[k]
        control_it(*records[:4], ys[k], expected)
        if kernel.ctl["active"][0] != active[-1]:
            active.append(int(kernel.ctl["active"][0]))
        assert model.tick(refs[k], ys[k]) == OK
        assert model.outputs.tobytes() == np.append(expected, 0.0).tobytes(), k
    assert active == stages


@pytest.mark.parametrize("style", ["unrolled", "records"])
@pytest.mark.parametrize(
    ("law", "inner"),
    [
        ("mimo-gfm-scheduled", "none"),
        ("mimo-gfm-scheduled", "cascaded"),
        ("mimo-gfm-ride-through", "none"),
    ],
)
def test_a_scheduled_law_is_exported_whole(tmp_path, style, law, inner):
    command = ["firmware", "export", law, "--inner", inner, "--style", style]
    assert main([*command, "-o", str(tmp_path)]) == 0
    source = f"gfm_{law.replace('-', '_')}.c"
    for compiler in ("gcc", "clang"):
        done = cc(tmp_path, *STRICT, "-c", source, compiler=compiler)
        assert (done.returncode, done.stderr) == (0, "")
    done = cc(tmp_path, "-S", ".", "-B", "build", compiler="cmake")
    assert done.returncode == 0
    assert source in (tmp_path / "CMakeLists.txt").read_text(encoding="utf-8")


def test_without_a_compiler_the_command_names_it(tmp_path, refused, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    line = refused("firmware", "dll", "vsg-1", "-o", str(tmp_path))
    assert "apt-get install gcc libc6-dev" in line
