"""Models that are not ours as the controller: real-code DLLs and FMUs, and how they fail."""

import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfm_hil.controllers
from gfm_hil.cli import main
from gfm_hil.controllers import BenchContext, open_controller, read_map
from gfm_hil.controllers.external import MappedController, ticks_a_step
from gfm_hil.controllers.phases import Frame
from gfm_hil.controllers.ports import PortMap, wire
from gfm_hil.core.errors import UserError
from gfm_hil.engine import setup
from gfm_hil.recording.run import Run
from gfm_hil.run import runner
from gfm_hil.scenario import load_scenario
from gfm_plant import Bases, plant_sample
from gfm_runtime.inner import settle
from gfm_runtime.signals import INNER, PLAIN, Y_I_D, Y_I_Q, Y_V_D, Y_V_DC, Y_V_Q
from gfm_runtime.states import RUNNING, SAFE
from gfm_runtime.switchover import settle_into

from ...support.firmware import cc
from ...support.processes import write

PHASES = Path(__file__).parents[2] / "support" / "phases_model.c"
EXAMPLE = Path(__file__).parents[3] / "examples" / "foreign_controller" / "controller.c"
CONTROLLERS = Path(gfm_hil.controllers.__file__).parent
MAP = """\
step_s = 2e-4
blocks = "block"
inputs.mode = 7
inputs."dispatch[0]" = { signal = "P_ref", scale = 4000.0 }
inputs."dispatch[1]" = { signal = "Q_ref", scale = 4000.0 }
inputs.p = { signal = "p", scale = 4000.0 }
inputs.q = { signal = "q", scale = 4000.0 }
outputs.f = { signal = "omega_u", scale = 50.0 }
outputs.amplitude = { signal = "E_u", scale = 400.0 }
fixed.i_u = 0.5
"""
STEP = {"t": 0.02, "type": "reference", "P_ref": 0.6, "ramp_s": 0.01}
RIG = {"dc_source": {"mode": "regulated"}}
FAILS_AT = 100  # step of the model


def compiles(test: Any) -> Any:
    return pytest.mark.apt(pytest.mark.timeout(900)(test))


def run(tmp_path: Path, model: str, *options: str, **content: Any) -> Run:
    """A run with a model as the controller, by the command."""
    link = {"type": "shm", "peer_timeout_s": 20.0}
    file = write(tmp_path, **{"law": "vsg-2", "link": link, **content})
    folder = tmp_path / "run"
    command = ["run", file, "--controller", model, "--out", str(folder), *options]
    code = main([*command, "--quiet", "--no-figures"])
    found = Run.load(folder)
    assert (code == 0) == (found.summary["status"] == "completed")
    return found


@compiles
@pytest.mark.parametrize(
    ("kind", "inner"), [("dll", "cascaded"), ("dll", "none"), ("fmu", "cascaded")]
)
def test_our_own_model_gives_the_run_of_the_law(exported, kind, inner, tmp_path, monkeypatch):
    """Bit for bit, with the law settled at the first measurement, as the model settles itself."""
    content = {"law": "vsg-2", "inner": inner, "events": [STEP]}
    found = run(tmp_path, exported(kind, "vsg-2", inner), **content)
    assert (found.summary["controller"], found.summary["laws"]) == (f"{kind} vsg-2", [])
    scenario = load_scenario(str(tmp_path / "scenario.toml"), link__type="inproc")
    near = runner.run_in_memory(scenario)

    def settled(scenario: Any) -> Any:
        (bench,) = setup.make_benches(scenario)
        c, y = bench.controller, bench.y.copy()
        plant_sample(bench.plant.copy().records, 0, y)
        own = bench.u[:3].copy()  # with a stage its E_u begins at e_d: no port says more
        settle_into(c.laws[0], c.states[0], c.ctl["ref"][0], y[:5], own, np.zeros(3))
        if bench.signal_set:
            settle(c.laws[:1], c.states[:1], own, y, *c.ctl["out"][0, 2:])
        return [bench]

    monkeypatch.setattr(runner, "make_benches", settled)
    equal = runner.run_in_memory(scenario)
    empty = {"law", "X_est", "E_law", "i_ref_d", "i_ref_q", "limited"}
    assert np.ptp(equal.columns["true_p"][:]) > 0.01
    for name, column in equal.columns.items():
        if name in empty:
            assert np.isnan(found.columns[name][:]).all(), name
        else:
            assert found.columns[name][:].tobytes() == column[:].tobytes(), name
            if inner == "none":  # else what is left of the start decays with T_off
                np.testing.assert_allclose(column[:], near.columns[name][:], rtol=0, atol=1e-9)


@compiles
@pytest.mark.parametrize("kind", ["dll", "fmu"])
def test_a_reset_starts_the_model_anew(exported, kind, tmp_path):
    """A dip to nothing trips; the run after the reset has the bits of the run from its start."""
    falls = [{"type": "grid-voltage", "tick": 200, "V_g": 0.0}, {"type": "reset", "tick": 500}]
    content = {"after_trip": "wait", "events": falls}
    found = run(tmp_path, exported(kind, "vsg-2", "none"), **content)
    state, p = found.columns["state"][:], found.columns["true_p"][:]
    assert set(state[300:500]) == {SAFE} and set(state[502:]) == {RUNNING}
    for name in ("true_p", "u_i_u", "u_omega_u", "u_E_u"):
        column = found.columns[name][:]
        np.testing.assert_array_equal(column[501:700], column[:199], err_msg=name)
    assert np.ptp(p) > 0.4


@compiles
def test_a_model_of_others_by_its_map(foreign, tmp_path):
    """Its arithmetic, done again here from what the run recorded, step by step."""
    (tmp_path / "map.toml").write_text(MAP + "parameters.droop = 2e-4\n")
    options = ["--map", str(tmp_path / "map.toml")]
    found = run(tmp_path, f"dll:{foreign}", *options, duration=0.5, plant=RIG, events=[STEP])
    assert (found.summary["status"], found.summary["controller"]) == (
        "completed",
        "dll droop of others",
    )
    p, q, ref = (found.columns[name][:] for name in ("y_p", "y_q", "ref_P_ref"))
    filtered, omega, E = np.nan, [], []
    for k in range(0, len(p), 2):  # a step is two ticks
        watts = p[k] * 4000.0
        filtered = watts if k == 0 else filtered + 0.01 * (watts - filtered)
        omega += 2 * [(50 + 2e-4 * (float(np.float32(ref[k] * 4000.0)) - filtered)) / 50]
        E += 2 * [float(np.float32(400 + 0.0005 * (0.0 - q[k] * 4000.0))) / 400]
    assert found.columns["u_omega_u"][:].tolist() == omega
    assert found.columns["u_E_u"][:].tolist() == E
    assert set(found.columns["u_i_u"][:]) == {0.5}
    assert p[-1] == pytest.approx(0.6, abs=0.02)


@compiles
def test_phases_of_a_library_written_for_windows(exported, tmp_path, capsys):
    """The same controller as a DLL by its map and as a library by our header: the same bits."""
    headers = Path(exported("dll", "vsg-2", "none").removeprefix("dll:")).parent
    flags = ["-std=c99", "-Wall", "-O2", "-shared", "-fPIC", f"-I{CONTROLLERS}", str(EXAMPLE)]
    done = cc(tmp_path, *flags, "-lm", "-o", "library.so")
    assert (done.returncode, done.stderr) == (0, "")
    sources = tmp_path / "sources"
    sources.mkdir()
    for file in (EXAMPLE, PHASES):
        shutil.copy(file, sources)
    (sources / "harness.c").write_text("int main(void) { return 1; }")
    out = ["-I", str(headers), "-I", str(CONTROLLERS), "-o", str(tmp_path / "dll.so")]
    capsys.readouterr()
    assert main(["firmware", "compile", str(sources), *out]) == 0
    told = capsys.readouterr().out
    assert "controller.c, phases_model.c\n" in told and "inputs.v " in told
    assert "parameters.period" in told
    ports = {"P": "P_ref W", "Q": "Q_ref var", "V": "V_ref V", "w": "omega_g rad/s",
             "V_dc": "V_dcref V", "v_dc": "v_dc V"}  # fmt: skip
    for name, unit in (("v", "V"), ("i", "A"), ("i_o", "A")):
        ports |= {f'"{name}[{k}]"': f"{name}_{phase} {unit}" for k, phase in enumerate("abc")}
    map_ = [
        f'inputs.{name} = {{ signal = "{signal}", unit = "{unit}" }}'
        for name, (signal, unit) in ((name, text.split()) for name, text in ports.items())
    ]
    map_ += [f'outputs."e[{k}]" = {{ signal = "e_{p}", unit = "V" }}' for k, p in enumerate("abc")]
    map_ += ['outputs.i_dc = { signal = "i_u", unit = "A" }']
    (tmp_path / "map.toml").write_text("\n".join(map_))
    content = {"inner": "virtual-stator", "duration": 0.1, "plant": RIG, "events": [STEP]}
    runs = {}
    for kind, out, options in (("c", "library.so", []), ("dll", "dll.so", ["--map"])):
        place = tmp_path / kind
        place.mkdir()
        options = [*options, str(tmp_path / "map.toml")] if options else []
        runs[kind] = run(place, f"{kind}:{tmp_path / out}", *options, **content)
    scenario, map_file = tmp_path / "dll" / "scenario.toml", str(tmp_path / "map.toml")
    scenario.write_text(f"snapshot = 0.05\n{scenario.read_text()}")
    model = ["--controller", f"dll:{tmp_path / 'dll.so'}", "--map", map_file]
    assert main(["run", str(scenario), *model, "--out", str(tmp_path / "cut")]) == 2
    assert "snapshot: dll phases gives no state, so it has no snapshot" in capsys.readouterr().err
    assert np.ptp(runs["c"].columns["true_p"][:]) > 0.05
    for name in ("true_p", "true_q", "u_E_u", "u_E_q", "u_i_u", "u_omega_u"):
        a, b = (one.columns[name][:] for one in runs.values())
        np.testing.assert_array_equal(a, b, err_msg=name)


@compiles
@pytest.mark.parametrize(
    ("what", "reason"),
    [
        (1, "dll droop of others: Model_Outputs failed: the sun is down"),
        (2, "an output is not finite: omega_u"),
        (3, "dll droop of others: blocks the bridge: block = 1"),
    ],
)
def test_a_model_that_fails_is_named_and_the_run_is_kept(foreign, tmp_path, what, reason):
    """What hangs or crashes is named as a library's in C is, by the process around both."""
    wrong = f"parameters.at = {FAILS_AT}\nparameters.what = {what}\n"
    (tmp_path / "map.toml").write_text(MAP + wrong)
    options = ["--map", str(tmp_path / "map.toml")]
    found = run(tmp_path, f"dll:{foreign}", *options, plant=RIG, link={"type": "shm"})
    assert (found.summary["status"], found.summary["reason"]) == ("safe", reason)
    assert found.summary["ticks"] >= 2 * FAILS_AT
    assert np.isfinite(found.columns["y_p"][: 2 * FAILS_AT]).all()
    assert np.isfinite(found.columns["u_omega_u"][: 2 * FAILS_AT]).all()


@compiles
@pytest.mark.parametrize(
    ("event", "map_", "message"),
    [
        (STEP, "", "input dispatch[0]: signal 'dispatch[0]' must be one of V_dcref, P_ref"),
        (STEP, MAP + "parameters.droop = -1.0", "Model_Initialize failed: the droop must be posit"),
        (STEP, MAP + "parameters.dropo = 1.0",
         "parameters.dropo in its map: it has droop, at, what"),
        (STEP, MAP.replace("2e-4", "1.5e-4"),
         "FixedStepBaseSampleTime = 0.0002 s; leave step_s out"),
        (STEP, MAP.replace("2e-4", "2e-4\nscale = 1"), "scale = 1: unknown key"),
        ({"t": 0.02, "type": "law", "law": "vsg-5"}, MAP, "droop of others has a law of its own"),
    ],
)  # fmt: skip
def test_what_a_run_with_a_model_refuses(
    foreign, tmp_path, event, map_, message,
    capsys
):  # fmt: skip
    (tmp_path / "map.toml").write_text(map_)
    file = write(tmp_path, law="vsg-2", link={"type": "shm"}, events=[event])
    command = ["controller", file, "--endpoint", "shm://none", "--model", f"dll:{foreign}"]
    command += ["--map", str(tmp_path / "map.toml"), "--out", str(tmp_path / "run")]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert message in said and "Traceback" not in said


# --- without a compiler ---


def test_ports_are_found_by_name_and_by_map():
    ref, y = np.arange(1.0, 6.0), np.arange(11.0, 16.0)
    ports = PortMap.model_validate(
        {
            "inputs": {"power": {"signal": "p", "scale": 4000.0}, "mode": 7},
            "outputs": {"w": "omega_u"},
            "fixed": {"E_u": 1.5},
        }
    )
    inputs, outputs = ["ref.P_ref", "power", "mode", "V"], ["i_u", "w", "spare", "reason"]
    wiring = wire("model", ports, inputs, outputs, False, Bases())
    assert wiring.inputs(np.concatenate((ref, y))).tolist() == [2.0, 12.0 * 4000.0, 7.0, 15.0]
    u = np.zeros(3)
    wiring.take(np.array([0.25, 1.0625, 9.0, 0.0]), u)
    assert u.tolist() == [0.25, 1.0625, 1.5]
    assert wiring.outputs(u, ref).tolist() == [0.25, 1.0625, 0.0, 0.0]
    assert wiring.blocks == 3


class Waves(MappedController):
    """A controller in Python that keeps what it measures, and gives phases by a function of t."""

    def __init__(self, ports: PortMap, rig: BenchContext, e: Any) -> None:
        self._names, self._e, self.seen, self._T_s = ["a", "b", "c"], e, [], rig.T_s
        self._every = ticks_a_step("waves", ports.step_s or rig.T_s, rig.T_s)
        inputs = [*"ABC", *"IJK", "P"]
        self._wiring = wire("waves", ports, inputs, self._names, rig.signal_set, rig.bases)
        self._frame = Frame(rig, self._every)

    def _step(self, inputs: Any) -> Any:
        self.seen.append([self._time, *inputs])
        return np.array(self._e(self._time))


def phases(peak: float, angle: float) -> Any:
    return peak * np.cos(angle - 2 * np.pi / 3 * np.arange(3))


@pytest.mark.parametrize(("step", "delay", "e_unit"), [(1, 0.0, "kV"), (4, 1.3, "v_dc/2")])
def test_phases_in_the_units_of_their_ports(step, delay, e_unit):
    """It sees the start rise before tick 0, its voltage's phase a at a maximum at its first step;
    what it commands with the delay made up is a constant in the plant's frame."""
    rig, speed, before = BenchContext(1e-4, True, Bases(), delay), 1.01, 40
    w, V = speed * 100 * np.pi, 380.0 * np.sqrt(2 / 3)
    A = 4000.0 / (1.5 * V)
    ports = PortMap.model_validate(
        {
            "step_s": step * 1e-4, "angle_deg": 0.0, "ramp_s": 0.002, "hold_s": 0.002,
            "inputs": {
                **{"ABC"[k]: {"signal": f"v_{x}", "unit": "kV"} for k, x in enumerate("abc")},
                **{"IJK"[k]: {"signal": f"i_{x}", "unit": "A"} for k, x in enumerate("abc")},
                "P": {"signal": "P_ref", "unit": "kW"},
            },
            "outputs": {x: {"signal": f"e_{x}", "unit": e_unit} for x in "abc"},
            "fixed": {"i_u": 0.5},
        }
    )  # fmt: skip
    unit, lead = 1000.0 if e_unit == "kV" else 700.0 * 1.1 / 2, (delay + step / 2) * 1e-4
    model = Waves(ports, rig, lambda t: phases(0.9 * V / unit, w * (t + lead) + 0.3))
    y, u, ref = np.zeros(11), np.array([0.5, speed, 0.8, 0.1]), np.full(5, 0.6)
    y[Y_V_DC], y[Y_V_D], y[Y_V_Q], y[Y_I_D], y[Y_I_Q] = 1.1, 0.8, -0.2, 0.5, 0.1
    model.start(u)
    e = []
    for _ in range(100):
        model.tick(ref, y, u)
        assert u[:2].tolist() == [0.5, speed]
        e.append(complex(u[2], u[3]))
    shift = np.angle(0.5 + 0.1j) - np.angle(0.8 - 0.2j)
    for k, (t, *given) in enumerate(model.seen):
        share = min(1.0, k * step / 20)
        assert t == pytest.approx(k * step * 1e-4)
        wanted = [
            *phases(V * abs(0.8 - 0.2j) / 1000, w * t),
            *phases(A * abs(0.5 + 0.1j), w * t + shift),
        ]
        assert given == pytest.approx([share * x for x in (*wanted, 0.6 * 4.0)])
    assert len(model.seen) == (before + 100) / step
    # its angle 0 is that of the voltage, and it stands still in space while the frame turns on
    turn = np.exp(1j * (0.3 + np.angle(0.8 - 0.2j)))
    back = np.exp(-1j * w * 1e-4 * (np.arange(step) - (step - 1) / 2))
    np.testing.assert_allclose(e, np.tile(0.9 * turn * back, 100 // step))


@pytest.mark.parametrize(
    ("ports", "message"),
    [
        ({"e_a": "V", "e_b": "V"}, "e_c comes from no output"),
        ({"e_a": "V", "e_b": "V", "e_c": "v_dc/2"}, "must all have the unit v_dc/2, or none"),
        ({"e_a": "A", "e_b": "V", "e_c": "V"},
         "unit = 'A' of e_a: must be one of p.u., V, kV, MV, v_dc/2, and no scale beside it"),
        ({"omega_u": "Hz", "E_d": "V", "E_q": "V"}, "measures phases, so its outputs must be e_a"),
        ({"e_a": "V", "e_b": "V", "e_c": "V", "omega_u": "Hz"}, "omega_u comes twice: e_a, e_b"),
    ],
)  # fmt: skip
def test_phases_that_do_not_fit_are_refused(ports, message):
    outputs = {name: {"signal": name, "unit": unit} for name, unit in ports.items()}
    given = PortMap.model_validate(
        {"inputs": {"v": "v_a"}, "outputs": outputs, "fixed": {"i_u": 0.0}}
    )
    with pytest.raises(UserError) as refused:
        wire("model", given, ["v"], list(outputs), INNER, Bases())
    assert message in str(refused.value)
    with pytest.raises(UserError, match="input v: only a run with an inner stage"):
        wire("model", given, ["v"], list(outputs), PLAIN, Bases())


@pytest.mark.parametrize(
    ("ports", "outputs", "message"),
    [
        ({}, ["i_u", "E_u"], "omega_u comes from no output; name its port in the map file"),
        ({"fixed": {"E_u": 1.0}}, ["i_u", "omega_u", "E_u"], "E_u comes twice"),
        ({"fixed": {"E_q": 1.0}}, ["i_u", "omega_u", "E_u"],
         "fixed: only a run with an inner stage"),
        ({"outputs": {"x": "E_u"}}, ["i_u", "omega_u"],
         "outputs.x in its map: it has i_u, omega_u"),
        ({"inputs": {"p": "P"}}, ["i_u", "omega_u", "E_u"], "input p: signal 'P' must be one of"),
        ({"inputs": {"p": {"signal": "p", "scale": 0.0}}}, ["i_u", "omega_u", "E_u"],
         "input p: scale = 0 must not be 0"),
        ({"blocks": "x"}, ["i_u", "omega_u", "E_u"],
         "blocks = 'x' in its map: must be one of i_u, omega_u"),
    ],
)  # fmt: skip
def test_ports_that_do_not_fit_are_refused(ports, outputs, message):
    with pytest.raises(UserError) as refused:
        wire("model", PortMap.model_validate(ports), ["p"], outputs, False, Bases())
    assert message in str(refused.value) and str(refused.value).startswith("model: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("inputs = 1", "inputs: "),
        ("fixed.i_u = nan", "fixed.i_u: "),
        ("=", "Invalid"),
        (None, "No such file"),
    ],
)
def test_a_map_that_is_wrong_is_refused(text, message, tmp_path):
    if text is not None:
        (tmp_path / "map.toml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_map(tmp_path / "map.toml")


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("exe:x", "must be dll:FILE, fmu:FILE, c:FILE or pil:TARGET"),
        ("dll:", "must be dll:FILE, fmu:FILE, c:FILE or pil:TARGET"),
        ("dll:none.so", "none.so: there is no such file"),
        ("c:mine.c", "is a source, not a library; compile it by cc -O2 -shared -fPIC"),
        ("dll:{text}", "cannot be loaded"),
        ("fmu:{text}", "is no FMU that FMPy reads"),
    ],
)
def test_a_file_that_is_no_model_is_refused(model, message, tmp_path):
    (tmp_path / "text").write_text("no model")
    with pytest.raises(UserError, match=message):
        open_controller(model.format(text=tmp_path / "text"), PortMap(), BenchContext())


@compiles
@pytest.mark.parametrize(
    ("source", "more", "message"),
    [
        ("none", [], "none: must be a C file, or a folder with C files without main"),
        ("x.c", ["-I", "nowhere"], "nowhere: is no folder of headers"),
        ("x.c", [], "x.c:1:10: fatal error: nothing.h: No such file"),
        ("y.c", [], "undefined reference to `missing'"),
        ("z.c", [], "has no function Model_GetInfo, so it is no real-code model"),
    ],
)
def test_sources_that_do_not_compile_are_refused(source, more, message, tmp_path, capsys):
    (tmp_path / "x.c").write_text('#include "nothing.h"\n')
    (tmp_path / "y.c").write_text("void missing(void); void Model_GetInfo(void) { missing(); }\n")
    (tmp_path / "z.c").write_text("int z;\n")
    out = str(tmp_path / "z.so")
    assert main(["firmware", "compile", str(tmp_path / source), *more, "-o", out]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.attack(
    "16.5", "an FMU of 3 GB when unpacked, or a pipe", "3 GB written; waits for ever"
)
@pytest.mark.parametrize("kind", ["bomb", "members", "description"])
def test_an_fmu_is_unpacked_within_limits(kind, tmp_path, monkeypatch, attack_now):
    file, scratch = tmp_path / "x.fmu", tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", bytes(40 << 20 if kind == "description" else 9))
        for k in range(10_001 if kind == "members" else 0):
            archive.writestr(f"resources/{k}", b"")
        for k in range(9 if kind == "bomb" else 0):
            archive.writestr(f"resources/{k}", bytes(64 << 20))
    said = {
        "bomb": "unpacked it has 603979785 bytes, more than 536870912",
        "members": "its directory has more than 10000 members",
        "description": "modelDescription.xml has 41943040 bytes, more than 33554432",
    }[kind]
    with pytest.raises(UserError, match=f"{file}: is no FMU that FMPy reads: {said}"):
        open_controller(f"fmu:{file}", PortMap(), BenchContext())
    assert not [path for path in scratch.rglob("*") if path.is_file()]
    attack_now("refused before it is unpacked")
