"""The measured admittance: against the linear model, closed forms, and the poles of other grids."""

import csv
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_design.margins.admittance import line_impedance
from gfm_design.margins.certificate import GridClass
from gfm_hil.cli.main import main
from gfm_hil.studies.scan import _bands
from gfm_plant import Plant, load_converter

OWN = Path(__file__).parents[3] / "examples/own_controller/controller.py"
#: one sample of delay and a fraction, band-limited sensors, a frequency that is not nominal
REAL = {
    "title": "with delay and sensors",
    "duration": 1.0,
    "references": {"P_ref": 0.4, "Q_ref": 0.1, "omega_g": 1.002},
    "plant": {
        "delay": {"samples": 1, "fraction": 0.25},
        "sensors": {"bandwidth_hz": 300.0},
        "grid": {"omega_g": 1.002, "scr": 8.0, "x_over_r": 8.0},
    },
}


@pytest.fixture(scope="module")
def measured() -> gfmhil.FrequencyScan:
    law = gfmhil.Law.load("droop-2")
    return gfmhil.scan(law, "pref_step", start_hz=100, stop_hz=1000, points=7, settle_s=0.2)


def test_agrees_with_the_linear_model(measured):
    assert measured.name == "droop-2" and len(measured.frequency) == 7
    assert measured.deviation is not None and measured.deviation.max() < 0.01
    assert measured.nfp == pytest.approx(measured.nfp_model, rel=0.01)


def test_is_the_filter_alone_where_the_law_is_slow(measured):
    pu, hz = load_converter("paper").pu(), measured.frequency
    omega_b = 100 * math.pi
    choke = np.linalg.inv(line_impedance(hz, pu["R_f"], pu["L_f"], omega_b))
    Y = choke + line_impedance(hz, 0.0, pu["C_f"], omega_b)  # a capacitor's dual
    fast = hz > 600.0
    off = np.linalg.norm(measured.Y - Y, axis=(1, 2)) / np.linalg.norm(Y, axis=(1, 2))
    assert fast.any() and off[fast].max() < 0.02


@pytest.mark.parametrize("more", [{}, {"lcl": {"L": 0.15, "R": 0.005, "earthed": True}}])
def test_stage_delay_sensors_and_frequency(more):
    scenario = gfmhil.load_scenario({**REAL, "plant": {**REAL["plant"], **more}})
    found = gfmhil.scan(
        "droop-5", scenario, inner="virtual-stator",
        start_hz=100, stop_hz=900, points=6, settle_s=0.2,
    )  # fmt: skip
    assert found.deviation is not None and found.deviation.max() < 0.01


@pytest.mark.full
def test_one_percent_from_1_hz_on_and_a_certificate_as_of_the_model():
    found = gfmhil.scan("mimo-gfm", inner="virtual-stator", stop_hz=4500.0, settle_s=1.0)
    assert len(found.frequency) == 40
    assert found.frequency[[0, -1]] == pytest.approx([1.0, 4500.0], rel=0.01)
    assert found.deviation is not None and found.deviation.max() < 0.01
    low = found.frequency < 1000.0
    assert found.nfp[low] == pytest.approx(found.nfp_model[low], rel=0.01)
    (R, L), grids = found.line, GridClass(1.5, 100.0, (5.0, 15.0))
    assert found.certificate(grids).holds
    with pytest.raises(gfmhil.UserError, match="must be one of the class"):
        found.certificate(GridClass(1.5, 0.5 / math.hypot(R, L), (5.0, 15.0)))


def switched(law, bridge, settle_s=0.5, **how):
    """A scan with a bridge of 10 kHz and 10,000 counts, one sample of delay and real sensors."""
    plant = {**REAL["plant"], "delay": {"samples": 1}, "dc_source": {"mode": "regulated"}}
    plant |= {"bridge": {"kind": "two-level", **bridge}, "grid": {}}
    scenario = gfmhil.load_scenario("pref_step", plant=plant)
    return gfmhil.scan(law, scenario, settle_s=settle_s, **how)


@pytest.mark.full  # two scans of a switched bridge
def test_a_switched_bridge_has_the_admittance_of_its_average():
    """750 Hz is a harmonic of the bridge in this frame, which a run without tones takes away; Y is
    small there."""
    found = switched("mimo-gfm", {}, start_hz=50, stop_hz=1000, points=7, window_s=1.0)
    assert found.amplitude == 1e-3
    assert found.deviation is not None and found.deviation.max() < 0.04
    at = switched("mimo-gfm", {}, start_hz=150, stop_hz=750, points=2, window_s=1.0)
    assert at.deviation is not None and at.deviation.max() < 0.1


@pytest.mark.full
def test_dead_time_changes_the_admittance_as_its_describing_function_says():
    """From 60 Hz on it is off by more, but without it all is wrong. VSG-2 has an unstable swing."""
    how = {"start_hz": 5, "stop_hz": 40, "points": 5}
    with_it = switched("mimo-gfm", {"dead_time_s": 2e-6}, **how)
    without = switched("mimo-gfm", {}, **how)
    assert with_it.deviation is not None and with_it.deviation.max() < 0.17
    unstable = "cannot be scanned because it is unstable on this grid: a mode at 4.1"
    with pytest.raises(gfmhil.UserError, match=rf"vsg-2, 2 µs of dead time: {unstable}"):
        switched("vsg-2", {"dead_time_s": 2e-6}, **how)
    off = np.linalg.norm(with_it.Y - without.model, axis=(1, 2))
    assert np.all(off > 0.8 * np.linalg.norm(without.model, axis=(1, 2)))


@pytest.mark.full
@pytest.mark.parametrize(
    ("law", "how", "most"),
    [("droop-3", {"start_hz": 14}, 0.3), ("droop-5", {"inner": "virtual-stator"}, 0.1)],
)
def test_dead_time_moves_the_operating_point(law, how, most):
    """That of droop-3, which rests at q = -0.6 p.u. instead of 0.1, and was off by more than half;
    and with an inner stage."""
    how = {"start_hz": 5, "stop_hz": 70, "points": 5, "amplitude": 2.5e-3, "window_s": 1.0} | how
    found = switched(law, {"dead_time_s": 2e-6}, **how)
    assert found.deviation is not None and found.deviation.max() < most


@pytest.mark.full
def test_judges_other_grids_as_their_poles_do():
    law = gfmhil.Law.load("droop-5").with_inner("cascaded").with_gains("steep", D_p=0.3)
    plant = {"grid": {"scr": 2.0, "x_over_r": 10.0}}
    found = gfmhil.scan(
        law, gfmhil.load_scenario("pref_step", plant=plant),
        start_hz=1.5, stop_hz=4500, points=50, settle_s=0.5,
    )  # fmt: skip
    for scr in (57.0, 15.0, 3.0, 1.5):
        grid = Plant.model_validate({"grid": {"scr": scr, "x_over_r": 10.0}})
        poles = law.closed_loop(grid).poles()
        judged = found.stability(scr, 10.0)
        assert judged.unstable == int((poles.real > 0.0).sum()), (scr, judged)


@pytest.mark.processes
def test_measures_a_controller_that_is_a_program(tmp_path):
    command = f"{sys.executable} {OWN} {{endpoint}} {{scenario}}"
    options = ["--controller", command, "--from", "200", "--to", "400", "--points", "2"]
    options += ["--settle", "0.2", "-o", str(tmp_path / "out"), "--grid", "2:6", "--quiet"]
    weak = tmp_path / "weak.toml"
    weak.write_text(
        'title = "weak"\nduration = 1.0\nlaw = "droop-5"\n'
        "[plant]\nfactors = { L_g = 3.0, R_g = 1.5 }\ndelay = { samples = 1 }\n"
        'sensors = { bandwidth_hz = 300.0 }\ndc_source = { mode = "regulated" }\n'
    )
    assert main(["scan", str(weak), *options]) == 0
    said = json.loads((tmp_path / "out/identification.json").read_text())
    assert said["name"] == "droop in Python" and "largest_deviation" not in said
    with (tmp_path / "out/admittance.csv").open() as file:
        rows = list(csv.DictReader(file))
    # its droop on p and q has a lag of 20 ms: at 400 Hz the filter is left
    pu = load_converter("paper").pu()
    hz = np.array([float(rows[-1]["f_hz"])])
    Y = np.linalg.inv(line_impedance(hz, pu["R_f"], pu["L_f"], 100 * math.pi))
    Y += line_impedance(hz, 0.0, pu["C_f"], 100 * math.pi)
    Y_dd = complex(float(rows[-1]["Y_dd_re"]), float(rows[-1]["Y_dd_im"]))
    assert Y_dd == pytest.approx(Y[0, 0, 0], rel=0.05)


@pytest.mark.full
def test_the_command_writes_a_folder(tmp_path, capsys):
    options = ["--from", "100", "--to", "800", "--points", "4", "--grid", "5:10"]
    folder = tmp_path / "out"
    assert main(["scan", "droop-2", *options, "-o", str(folder), "--quiet"]) == 0
    said = capsys.readouterr().out
    assert "largest deviation from the linear model: 0." in said
    assert "SCR 5, X/R 10: cannot be judged: " in said
    names = {path.name for path in folder.iterdir()}
    pictures = {"admittance.png", "passivity.png", "nfp.png", "nyquist_scr_5_xr_10.png"}
    assert names == {"admittance.csv", "identification.json", *pictures}
    with (folder / "admittance.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 and float(rows[-1]["f_hz"]) == pytest.approx(800, rel=0.02)
    content = json.loads((folder / "identification.json").read_text())
    assert content["points"] == 4 and content["largest_deviation"] < 0.01
    assert main(["identify", "droop-2", "-o", str(folder)]) == 2  # its name up to version 0.2
    said = capsys.readouterr().err
    assert "is gfmhil scan now" in said and "is not empty" in said


def test_a_limit_that_acts_is_found():
    limited = {**REAL["plant"], "i_peak": 0.31}
    scenario = gfmhil.load_scenario({**REAL, "law": "droop-5", "plant": limited})
    with pytest.raises(gfmhil.UserError, match=r"plant.i_peak or plant.modulation acts"):
        gfmhil.scan(None, scenario, start_hz=100, stop_hz=300, points=3, settle_s=0.1,
                        amplitude=1e-2)  # fmt: skip


def test_an_unstable_loop_is_refused():
    plant = {"delay": {"samples": 2}}
    scenario = gfmhil.load_scenario("pref_step", law="droop-5", plant=plant)
    with pytest.raises(gfmhil.UserError, match="droop-5: cannot be scanned because it is"):
        gfmhil.scan(None, scenario, inner="cascaded")


def test_tones_have_whole_periods_in_their_window():
    for start, stop, points in ((1.0, 1000.0, 40), (0.3, 4400.0, 200), (49.0, 51.0, 5)):
        bands = _bands(start, stop, points, 1e-4, 0.2)
        hz = np.concatenate([band.hz for band in bands])
        assert len(hz) == points and (np.diff(hz) > 0).all()
        assert hz == pytest.approx(np.geomspace(start, stop, points), rel=0.2)
        for band in bands:
            assert band.window % band.every == 0
            cycles = band.hz * band.window * 1e-4
            assert cycles == pytest.approx(np.round(cycles), abs=1e-9)
