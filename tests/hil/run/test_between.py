"""What a switched bridge does between the ticks: by its circuit, closed forms and its recording."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.run.between import BetweenTicks
from gfm_hil.run.losses import DataSheet, losses
from gfm_hil.run.spectrum import Spectrum, spectrum
from gfm_plant import Bases, Plant, make_plant

W, T_S = 100 * math.pi, 1e-4
SHEET = Path(__file__).parents[3] / "docs/examples/data-sheet.toml"
QUIET = {"L_f": 10.0, "C_f": 0.2, "C_dc": 10.0}  # nearly sines, nearly a constant v_dc
RIG = {
    "plant__dc_source": {"mode": "regulated"}, "plant__sensors": {"bandwidth_hz": 300.0},
    "plant__delay": {"samples": 1},
}  # fmt: skip


def run(law="droop-3", bridge=None, duration=0.5, **more):
    return gfmhil.run(
        "pref_step", law, duration=duration, events=[], **RIG,
        plant__bridge={"kind": "two-level", **(bridge or {})}, **more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def quiet():
    """A bridge with small ripple on a stiff DC link, over 10 cycles."""
    return run(plant__factors=QUIET).between_ticks(0.3, 0.5)


def fundamental(t, x):
    """The complex peak value at 50 Hz of straight lines between instants, by trapezoids."""
    return 2 * np.trapezoid(x * np.exp(-1j * W * t), t) / (t[-1] - t[0])


def of_leg(between):
    """The same of leg a, which is constant in each piece."""
    turn = np.exp(-1j * W * between.t)
    return 2 * np.sum(between.legs[:, 0] * np.diff(turn) / (-1j * W)) / 0.2


@pytest.mark.parametrize(
    "bridge",
    [
        {"dead_time_s": 2e-6},
        {"kind": "t-type", "dead_time_s": 2e-6},
        {"carrier_hz": 20e3, "updates": 2, "V_switch": 1.0, "R_diode": 0.1},
    ],
)
def test_each_phase_obeys_its_inductor(bridge):
    """L_f di/dt = u - v - R_f i from piece to piece, with u against the star point of the legs; at
    the ticks the phases are those of the recording."""
    one = run(bridge=bridge)
    found = one.between_ticks(0.4, 0.42)
    r = make_plant(Plant.model_validate(one.scenario.plant.model_dump()), T_S).par[0]
    u = 1.5 * r["leg"] * (found.legs - found.legs.mean(axis=1, keepdims=True))
    h = np.diff(found.t)
    assert h.max() < 1.001e-6 and len(h) > 20_000
    for k, phase in enumerate("abc"):
        i, v = (found.columns[f"{name}_{phase}"] for name in "iv")
        drop = (v[1:] + v[:-1]) / 2 + r["R_f"] * (i[1:] + i[:-1]) / 2
        away = np.diff(i) - h * W / r["L_f"] * (u[:, k] - drop)
        assert np.quantile(np.abs(away), 0.98) < 3e-7  # else a current's zero inside a piece
        waves = one.three_phase(0.4, 0.42)
        at = np.searchsorted(found.t, waves["t"] - 1e-9)
        for name in (f"i_{phase}", f"v_{phase}", f"i_o{phase}"):
            np.testing.assert_allclose(found.columns[name][at], waves[name], atol=1e-9)


def test_the_run_is_not_touched(tmp_path):
    """A law object in memory and a folder give the same window; another recording is refused."""
    law = gfmhil.Law.load("droop-3")
    one = run(law, duration=0.1)
    one.save(tmp_path / "run")
    a, b = (r.between_ticks(0.05, 0.06) for r in (one, gfmhil.load_run(tmp_path / "run")))
    assert np.array_equal(a.legs, b.legs) and np.array_equal(a.columns["i_a"], b.columns["i_a"])
    one.columns["true_i_re"] = one.columns["true_i_re"] + 1e-9
    with pytest.raises(UserError, match=r"window 0\.05:0\.06: true_i_re differs when the run"):
        one.between_ticks(0.05, 0.06)


def test_the_capacitors_current_is_that_of_kolar_and_round(quiet):
    """Kolar and Round, IEE Proc. Electr. Power Appl. 153 (2006), for sinusoidal currents:
    I sqrt(2 M (sqrt(3)/(4 pi) + cos^2 phi (sqrt(3)/pi - 9/16 M)))."""
    i, u = fundamental(quiet.t, quiet.columns["i_a"]), of_leg(quiet)
    M, c = 2 * abs(u), math.cos(np.angle(u / i))
    said = abs(i) / math.sqrt(2) * math.sqrt(2 / 3) * 4000 / 380
    said *= math.sqrt(
        2 * M * (math.sqrt(3) / 4 / math.pi + c**2 * (math.sqrt(3) / math.pi - 9 / 16 * M))
    )
    assert 4000 / 700 * quiet.capacitor_rms() == pytest.approx(said, rel=2e-3)


def test_losses_are_those_of_the_closed_forms(quiet):
    """Of a sinusoidal current and duty: V_0 I (1/2pi +- M cos phi/8) + r I^2 (1/8 +- M cos phi/3pi)
    a device, and E f_c/pi I/I_ref V/V_ref a commutating pair; the ripple of a current is smaller
    where a switch turns on and larger where it turns off."""
    sheet = DataSheet(
        source="", V_switch=1.0, r_switch=0.05, V_diode=0.9, r_diode=0.03, E_on=1e-3, E_off=1e-3,
        E_rr=5e-4, V_ref=600.0, I_ref=15.0,
    )  # fmt: skip
    found = losses(quiet, sheet)
    i, u = fundamental(quiet.t, quiet.columns["i_a"]), of_leg(quiet)
    peak, m = abs(i) * math.sqrt(2 / 3) * 4000 / 380, 2 * abs(u) * math.cos(np.angle(u / i))
    for device, sign, V, r in (("switch", 1, 1.0, 0.05), ("diode", -1, 0.9, 0.03)):
        said = V * peak * (1 / 2 / math.pi + sign * m / 8)
        said += r * peak**2 * (1 / 8 + sign * m / 3 / math.pi)
        assert found.conduction[device] == pytest.approx(6 * said, rel=0.02)
    said = 6 / math.pi * 1e4 * 1e-3 * peak / 15 * 700 / 600
    on, off = found.switching["on"], found.switching["off"]
    assert (on + off) / 2 == pytest.approx(said, rel=5e-3) and on < said < off
    assert found.switching["recovery"] == pytest.approx(on / 2)
    assert found.total == pytest.approx(
        sum([*found.conduction.values(), *found.switching.values()])
    )


def synthetic(x, t):
    """A window whose column i_a is this."""
    none = np.zeros((len(t) - 1, 3))
    return BetweenTicks(t, {"i_a": x}, none, none.astype(np.int8), Bases(), 1.0, T_S, 1e-6)


def test_groups_are_those_of_iec_61000_4_7():
    """Of lines put there: a group takes the lines around its harmonic, those half way with half of
    their square; a subgroup the neighbours alone."""
    t = np.arange(200_001) * 1e-6
    lines = {50: 10.0, 250: 1.0, 245: 0.3, 240: 0.2, 225: 0.4, 350: 0.5}
    x = sum(math.sqrt(2) * a * np.sin(2 * np.pi * f * t + f) for f, a in lines.items())
    found = spectrum(synthetic(x, t), "i_a")
    assert found.harmonic(5) == pytest.approx(1.0, rel=1e-5)
    assert found.subgroup(5) == pytest.approx(math.hypot(1.0, 0.3), rel=1e-5)
    squares = 1.0 + 0.3**2 + 0.2**2 + 0.4**2 / 2
    assert found.group(5) == pytest.approx(math.sqrt(squares), rel=1e-5)
    assert found.group(4) == pytest.approx(0.4 / math.sqrt(2), rel=1e-5)
    thd = found.distortion()
    assert thd["THD"] == pytest.approx(math.hypot(1.0, 0.5) / 10, rel=1e-5)
    assert thd["THDS"] == pytest.approx(math.sqrt(1.0 + 0.3**2 + 0.5**2) / 10, rel=1e-5)
    assert thd["THDG"] == pytest.approx(math.sqrt(squares + 0.4**2 / 2 + 0.5**2) / 10, rel=1e-5)
    with pytest.raises(UserError, match=r"IEC 61000-4-7 takes 10 cycles, 0\.2 s"):
        spectrum(synthetic(x[:1000], t[:1000]), "i_a")
    with pytest.raises(UserError, match="name = 'i_x': must be one of i_a, u_a, u_b, u_c"):
        spectrum(synthetic(x, t), "i_x")


def test_sidebands_of_the_carrier_are_those_of_its_pulses(quiet):
    """Parseval: all lines of a leg hold the mean square of its two voltages."""
    one: Spectrum = quiet.spectrum("u_a")
    assert np.sum(one.rms[one.f < 450e3] ** 2) == pytest.approx(0.25, rel=0.02)
    assert one.harmonic(1) == pytest.approx(abs(of_leg(quiet)) / math.sqrt(2), rel=1e-6)


def test_ripple_of_a_triangle_is_its_height():
    t = np.arange(201) * 1e-5
    x = np.abs((t / T_S + 0.5) % 1 - 0.5) + 3.0 * t  # a slope beside it
    assert synthetic(x, t).ripple("i_a") == pytest.approx(0.5, rel=1e-9)


@pytest.mark.full
def test_the_command_prints_writes_and_refuses(tmp_path, capsys, refused):
    run(duration=0.25).save(tmp_path / "run")
    words = ["waveforms", str(tmp_path / "run"), "0.05:0.25", "--data-sheet", str(SHEET), "--json"]
    words += ["--step", "5e-6"]
    files = [tmp_path / f"out{ending}" for ending in (".png", ".csv", ".npz")]
    assert main([*words, *(word for file in files for word in ("-o", str(file)))]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["losses_W"]["total"] > 10 and 0.1 < found["u_a"]["THDG"] < 0.5
    assert files[0].stat().st_size > 50_000
    table = np.load(files[2])
    head, first = files[1].read_text(encoding="utf-8").splitlines()[:2]
    assert head.split(",") == list(table) and "u_a_V" in table and "i_oa_A" in table
    np.testing.assert_allclose([float(x) for x in first.split(",")], [x[0] for x in table.values()])
    assert np.abs(table["u_a_V"]).max() == pytest.approx(350.0, rel=1e-2)
    folder = str(tmp_path / "run")
    assert "must lie within the run, 0 to 0.25 s" in refused("waveforms", folder, "0.2:0.4")
    assert "step = 1: must lie in [1e-08, 0.0001] s" in refused(
        "waveforms", folder, "0.06:0.1", "--step", "1"
    )
    assert "must end in one of .png" in refused("waveforms", folder, "0.06:0.08", "-o", "x.txt")
    bad = tmp_path / "bad.toml"
    bad.write_text(SHEET.read_text(encoding="utf-8").replace("E_on = 2.0e-3", "E_on = -1.0"))
    said = refused("waveforms", folder, "0.06:0.08", "--data-sheet", str(bad))
    assert said.strip().endswith("bad.toml: E_on: must be greater than or equal to 0, not -1.0")
    gfmhil.run("pref_step", duration=0.1, events=[]).save(tmp_path / "average")
    assert "kind = 'average': has nothing between" in refused(
        "waveforms", str(tmp_path / "average"), "0.01:0.02"
    )
