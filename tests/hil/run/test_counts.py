"""Runs of laws that read counts of an A/D and give compare counts."""

from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import gfm_hil.controllers
import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import load_scenario
from gfm_runtime.assembly import Controller
from gfm_runtime.counts import align, measure
from gfm_runtime.firmware.module import at_rest
from gfm_runtime.signals import NU, NY, names
from gfm_runtime.switchover import settle_into

from ...support.firmware import cc

HEADERS = Path(gfm_hil.controllers.__file__).parent
LIBRARY = Path(__file__).parents[2] / "support" / "counts_library.c"
COUNTS = "[measure]\nbits = 16\n"


def rig(law: str = "mimo-gfm", **by: Any) -> gfmhil.Run:
    """A step of P_ref on the rig with nominal resistances, or the 0.9 s before it."""
    kept = {"counts": "rig", "plant__bridge": {"kind": "two-level"}, "duration": 1.2, **by}
    return gfmhil.run(
        "rig_switched", law, **({"events": []} if kept["duration"] < 1 else {}), **kept
    )


@pytest.fixture
def sixteen(tmp_path) -> str:
    """Measurement with 16 bits and without a low-pass."""
    file = tmp_path / "sixteen.toml"
    file.write_text(COUNTS, encoding="utf-8")
    return str(file)


@pytest.mark.parametrize("law", ["mimo-gfm", "vsg-2"])
@pytest.mark.parametrize(("kind", "most"), [("average", 6e-3), ("two-level", 3e-2)])
def test_with_ideal_sensors_a_law_measures_what_it_is_given_without_them(tmp_path, law, kind, most):
    """The averaged bridge differs by the predicted angle, which the firmware turns at once and the
    plant after its delay; the switched one by the ripple of V besides, 2.5e-2 p.u. of q."""
    file = tmp_path / "counts.toml"
    file.write_text(COUNTS + "f_y = 300.0\n", encoding="utf-8")
    by = {"plant__phases": {"bits": 16}}
    plain = rig(law, counts="none", plant__bridge={"kind": "average"}, **by)
    own = rig(law, counts=str(file), plant__bridge={"kind": kind}, **by)
    assert {plain.status, own.status} <= {"completed", "oscillating"}
    for name in ("p", "q", "V"):
        apart = np.subtract(plain.signals[f"y_{name}"], own.signals[f"m_{name}"])
        assert np.abs(apart).max() <= most, name


@pytest.mark.parametrize(
    ("error", "gives"),
    [
        ({"offset": {"i_o_a": 0.02}}, {50: 2 / 3 * 0.02, 100: 0.0}),
        ({"gain": {"i_o_a": 1.04}}, {50: 0.0, 100: 0.04 / 3 * 0.5}),
    ],
)
def test_an_error_of_one_current_shows_in_p_as_on_hardware(sixteen, error, gives):
    """Clarke's transform makes of an offset a vector that stands still, 2/3 of it long: 50 Hz in
    the frame; and of a gain one of a third that turns backwards: 100 Hz."""
    run = rig(counts=sixteen, plant__phases={"bits": 16, **error}, plant__sensors={}, duration=0.9)
    wrong = np.subtract(run.signals["m_p"], run.signals["y_p"])[-6000:]
    k = np.arange(len(wrong))
    for hertz, amplitude in gives.items():
        found = 2 * abs(np.mean(wrong * np.exp(-2j * np.pi * hertz * 1e-4 * k)))
        assert found == pytest.approx(amplitude, abs=3e-4), hertz


@pytest.mark.parametrize(
    ("phases", "named"),
    [
        ({"gain": {"i_b": 0.0}}, "adc_i_b"), ({"offset": {"v_c": 3.0}}, "adc_v_c"),
        ({"offset": {"i_o_a": 0.3}}, "adc_i_o_a"),
    ],
)  # fmt: skip
def test_a_sensor_that_fails_leads_to_the_safe_state_with_its_name(phases, named):
    """Lost, at its end, and a sum that is not zero."""
    run = rig(plant__phases=phases, duration=0.1)
    assert run.status == "safe"
    assert f"a sensor is not plausible: {named}" in str(run.events)


def test_a_mean_of_n_conversions_has_less_noise(tmp_path):
    """By the root of n, of what is white."""
    noise, spread = dict.fromkeys(("i_o_a", "i_o_b", "i_o_c"), 0.02), []
    for n in (1, 4, 16):
        file = tmp_path / f"{n}.toml"
        file.write_text(f"[measure]\nsamples = {n}\n", encoding="utf-8")
        run = rig(
            counts=str(file), plant__phases={"samples": n, "noise_std": noise},
            plant__sensors={}, duration=0.6,
        )  # fmt: skip
        assert run.status == "completed"
        wrong = np.subtract(run.signals["m_p"], run.signals["y_p"])[-4000:]
        assert abs(wrong.mean()) < 1e-3
        spread.append(wrong.std())
    assert spread[0] / np.array(spread[1:]) == pytest.approx([2, 4], rel=0.05)
    # 16 conversions of 12 bits at their ends: the largest sum that 16 bits hold
    ends = {"samples": 16, "offset": {"i_o_a": 100.0, "i_o_b": -100.0}}
    run = rig(counts=str(file), plant__phases=ends, duration=0.01)
    assert set(run.signals["y_adc_i_o_a"]) == {16 * 4095} and 16 * 4095 < 2**16
    assert set(run.signals["y_adc_i_o_b"]) == {0}


def test_the_start_takes_the_offsets_of_the_currents(tmp_path):
    """What is left of 50 Hz in p is that of the mean of 1,000 counts with noise."""
    file = tmp_path / "calibrated.toml"
    file.write_text(COUNTS + "calibrate = 1000\n", encoding="utf-8")
    by = {"counts": str(file), "plant__sensors": {}}
    offset = {"i_o_a": 0.05, "i_b": -0.03}
    run = rig(plant__phases={"bits": 16, "offset": offset, "noise_std": {"i_o_a": 0.01}},
              duration=0.6, **by)  # fmt: skip
    wrong = np.subtract(run.signals["m_p"], run.signals["y_p"])[-4000:]
    assert 2 * abs(np.mean(wrong * np.exp(-2j * np.pi * 0.005 * np.arange(4000)))) < 1e-3
    run = rig(plant__phases={"bits": 16, "offset": {"i_o_c": -0.2}}, duration=0.1, **by)
    assert run.status == "safe"
    assert "a sensor is not plausible: adc_i_o_c" in str(run.events)


def test_predicted_compensation_keeps_vsg_2_where_dead_time_loses_it(tmp_path):
    """At 2 us; and it takes most of the fifth and the seventh harmonic of the line's current of
    MIMO-GFM away."""
    bridge, harmonics = {"kind": "two-level", "dead_time_s": 2e-6}, []
    for compensate in ("none", "predicted"):
        file = tmp_path / f"{compensate}.toml"
        text = f'f_y = 300.0\n[modulate]\ndead_time_s = 2e-6\ncompensate = "{compensate}"'
        file.write_text(f"{COUNTS}{text}\nband = 0.02\nL_f = 0.0188\n", encoding="utf-8")
        by = {"counts": str(file), "plant__bridge": bridge, "plant__phases": {"bits": 16}}
        run = rig("vsg-2", duration=2.0, events=[], **by)
        assert (run.status == "tripped") == (compensate == "none")
        run = rig(duration=2.0, events=[], **by)
        i_o = (np.asarray(run.signals["y_adc_i_o_a"])[-4000:] - 2**15) * 8 / 2**16
        turns = 1e-4 * np.outer((250.0, 350.0), np.arange(4000))
        harmonics.append(2 * np.abs((i_o * np.exp(-2j * np.pi * turns)).mean(axis=1)))
    assert np.ptp(np.asarray(run.signals["y_p"])[-4000:]) < 0.03
    assert np.all(harmonics[0] > 5 * harmonics[1])


def test_the_shipped_scenario_ends_as_it_expects():
    """The 22nd harmonic, 1050 Hz in p, which dead time leaves 25 Hz beside the resonance of the
    filter, is none of its oscillations."""
    run = gfmhil.run("rig_switched")
    assert run.status == "completed" and run.summary["unmet"] == []
    p = np.asarray(run.signals["true_p"])[-5000:]
    assert 2 * abs(np.mean(p * np.exp(-2j * np.pi * 1050e-4 * np.arange(5000)))) > 0.015


def test_the_shipped_scenario_runs_with_either_bridge():
    for bridge in ({"kind": "average"}, {"kind": "two-level", "dead_time_s": 2e-6}):
        run = rig(plant__bridge=bridge, counts="rig-dead-time" if len(bridge) > 1 else "rig")
        compare = np.column_stack([run.signals[f"u_cmp_{leg}"] for leg in "abc"])
        assert run.status in ("completed", "oscillating")
        assert 0 < compare.min() < 2500 and 7500 < compare.max() < 10_000
        assert np.all(compare == np.round(compare))


@pytest.mark.processes
@pytest.mark.parametrize("link", ["shm", "zmq"])
def test_a_link_carries_counts_with_the_same_bits(tmp_path, link):
    one = rig(duration=0.2)
    other = rig(duration=0.2, link__type=link, folder=tmp_path / "run")
    for name in ("y_adc_i_a", "u_cmp_b", "m_p", "true_v_re"):
        assert np.array_equal(one.signals[name], other.signals[name]), name


def controlled(folder: Path, controller: str) -> gfmhil.Run:
    """The first 1.2 s of rig_switched with a controller of another's."""
    command = ["run", "rig_switched", "--link", "shm", "--controller", controller, "--no-figures"]
    assert main([*command, "--duration", "1.2", "--out", str(folder), "--quiet"]) in (0, 3)
    return gfmhil.Run.load(folder)


@numba.njit
def begin(laws, states, ref, adc, u, trend):
    """As models begin: along the measured voltage, then at rest at u."""
    align(laws[0], states[0], adc, 0)
    states[1].angle[0], states[1].angle[1] = states[0].angle[0], states[0].angle[1]
    measure(laws[0], states[1], adc, 0)
    settle_into(laws[0], states[0], ref, states[1].sensed[:NY], u, trend)


def start_as_a_model(controller: Controller, adc: Any, u: Any) -> None:
    """Give a controller, which has started, the state in which a model begins with these counts."""
    k = int(controller.ctl["active"][0])
    states = np.zeros(2, controller.states.dtype)
    states["angle"], states["sensed"], states["speed"] = (1.0, 0.0), at_rest(), 1.0
    states["e"] = controller.states["e"][k]
    begin(controller.laws[k : k + 1], states, controller.ctl["ref"][0], adc, u, np.zeros(NU))
    controller.states[k] = states[0]


@pytest.mark.processes
@pytest.mark.compilers
def test_a_dll_and_a_library_from_counts_to_counts_are_controllers(tmp_path, monkeypatch):
    """They align their frame by what they measure: near the run with the law itself, not its bits,
    unless that begins so too. The library holds the same C, and has no frame in common with the
    plant: the same bits."""
    command = ["mimo-gfm", "--counts", "rig-dead-time", "--real", "float64", "-o", str(tmp_path)]
    assert main(["firmware", "dll", *command]) == 0 == main(["firmware", "export", *command])
    build = ["-O2", "-ffp-contract=off", "-shared", "-fPIC", f"-I{HEADERS}", f"-I{tmp_path}"]
    done = cc(tmp_path, *build, str(LIBRARY), "gfm_mimo_gfm.c", "-o", "own.so", "-lm")
    assert (done.returncode, done.stderr) == (0, "")
    found = controlled(tmp_path / "run", f"dll:{tmp_path / 'gfm_mimo_gfm.so'}")
    other = controlled(tmp_path / "other", f"c:{tmp_path / 'own.so'}")
    for name in ("y_p", "u_cmp_b", "true_v_re"):
        assert np.array_equal(found.signals[name], other.signals[name]), name
    own = gfmhil.run("rig_switched", duration=1.2)
    for name, most in (("y_p", 0.04), ("y_v_dc", 1e-3), ("y_V", 1e-3)):
        apart = np.subtract(found.signals[name], own.signals[name])[2000:].reshape(-1, 200)
        assert np.abs(apart.mean(axis=1)).max() < most, name  # of a period: the ripple differs
    adc = np.array([found.signals[f"y_{name}"][0] for name in names("adc")])
    of_the_plant = Controller.start

    def started(controller: Controller, x: Any, u: Any, *rest: Any) -> None:
        of_the_plant(controller, x, u, *rest)
        start_as_a_model(controller, adc, np.array(u))

    monkeypatch.setattr(Controller, "start", started)
    own = gfmhil.run("rig_switched", duration=1.2)
    for name in ("y_p", "u_cmp_b", "true_v_re"):
        assert np.array_equal(found.signals[name], own.signals[name]), name


@pytest.mark.parametrize(
    ("by", "says"),
    [
        ({"counts": "rigg"}, "unknown; use a .toml file or one of ['none', 'rig'"),
        ({"link__type": "can"}, "link.type = 'can': carries no counts"),
        ({"plant__bridge": {"timer_hz": 1e8}}, "plant.bridge has 5000: timer_hz and carriers"),
        ({"plant__phases": {"bits": 17}}, "plant.phases.bits: must be less than or equal to 16"),
        (
            {"plant__phases": {"samples": 32}},
            "plant.phases.samples = 32: their sum must fit 16 bits, so with bits = 12 at most 16",
        ),
        ({"plant__phases": {"v": [2.0, -2.0]}}, "range [2.0, -2.0]: must be [lo, hi] with lo < hi"),
        ({"plant__phases": {"skew_s": {"i_a": 2e-4}}}, "plant.phases.skew_s.i_a = 0.0002: must be"),
        ({"plant__bridge": {"kind": "two-level", "carrier_hz": 15e3}}, "must be 10000 or 20000"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(by, says):
    with pytest.raises(UserError) as told:
        load_scenario("rig_switched", **by)
    assert says in str(told.value) and "\n" not in str(told.value)
