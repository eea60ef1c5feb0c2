"""Runs with a PV array behind the DC link."""

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError

SHEET = {"V_oc": 1.25, "I_sc": 1.08, "V_mp": 1.0, "I_mp": 1.0}
ACROSS = {"mode": "array", "pv": SHEET}


def at(run: gfmhil.Run, name: str, t: float) -> float:
    return float(run.signals[name][np.searchsorted(run.signals["t"], t)])


@pytest.fixture(scope="module")
def cloud() -> gfmhil.Run:
    return gfmhil.run("cloud_over_pv")


def test_a_matching_law_holds_v_dc_and_hands_on_what_the_array_gives(cloud):
    """At v_dc = 1 it gives 1 p.u. less 0.7 of I_sc = 1.08 under the cloud: 0.244 p.u."""
    assert cloud.status == "completed"
    s = cloud.signals
    for name in ("true_v_dc", "true_p", "true_omega_u"):
        assert np.abs(s[name][:9000] - s[name][0]).max() < 1e-9  # it starts at rest
    for t, gives in ((0.5, 1.0), (4.4, 1.0 - 0.7 * 1.08), (7.9, 1.0)):
        assert at(cloud, "true_v_dc", t) == pytest.approx(1.0, abs=1e-9)
        assert at(cloud, "true_i_dc", t) == pytest.approx(gives, abs=5e-6)
        assert gives - 2e-3 < at(cloud, "true_p", t) < gives  # R_f takes the rest
    assert np.abs(s["true_v_dc"] - 1.0).max() < 5e-3


def test_energy_of_a_run(cloud):
    """What the array gives is what the grid gets, what R_f takes, and what C_dc keeps."""
    s, T_s = cloud.signals, 1e-4
    r_f, c_dc, omega_b = 0.0016620, 19.242, 100 * np.pi
    power = s["true_i_dc"] * s["true_v_dc"] - s["true_p"] - r_f * s["true_i"] ** 2
    given = (power[1:] + power[:-1]).sum() * T_s / 2
    kept = c_dc / (2 * omega_b) * (s["true_v_dc"][-1] ** 2 - s["true_v_dc"][0] ** 2)
    assert given == pytest.approx(kept, abs=2e-5)
    dark = 3.0 + 0.5  # s of the cloud, with its ramps
    energy = (s["true_i_dc"] * s["true_v_dc"]).sum() * T_s
    assert energy == pytest.approx(8.0 - dark * 0.7 * 1.08, abs=2e-3)


def test_a_law_that_holds_p_rests_beyond_the_maximum_and_falls_with_the_light():
    """VSG-2 at 0.5 p.u.: v_dc i(v_dc) = p there; more than the array gives empties C_dc."""
    run = gfmhil.run("cloud_over_pv", law="vsg-2", references__P_ref=0.5, expect="tripped")
    s = run.signals
    assert run.status == "tripped" and "dc-under-voltage" in run.summary["reason"]
    assert 1.15 < s["true_v_dc"][0] < 1.25
    assert np.abs(s["true_v_dc"][:9000] - s["true_v_dc"][0]).max() < 1e-9
    assert s["true_v_dc"][0] * s["true_i_dc"][0] == pytest.approx(0.5005, abs=5e-4)


def test_no_rest_with_more_than_the_array_gives():
    with pytest.raises(UserError, match=r"the PV array gives at most 1.001 p.u., at v_dc = 1.015"):
        gfmhil.run("cloud_over_pv", law="vsg-2")


def test_a_regulated_source_gives_what_its_array_can():
    """With a tracker ahead of it: 0.28 p.u. under 0.3 of the light. VSG-2 then asks too much."""
    source = {"mode": "regulated", "pv": SHEET}
    run = gfmhil.run(
        "cloud_over_pv", law="vsg-2", references__P_ref=0.25, plant__dc_source=source, duration=5.0
    )
    assert run.status == "completed"
    assert np.abs(run.signals["true_v_dc"] - 1.0).max() < 1e-3


def test_it_does_not_begin_beyond_what_the_array_behind_it_gives():
    source = {"mode": "regulated", "pv": {**SHEET, "irradiance": 0.2}}
    with pytest.raises(UserError, match=r"the PV array behind it gives 0 to 0.17 p.u."):
        gfmhil.run("pref_step", plant__dc_source=source)


def test_of_two_converters_one_is_in_the_shade():
    """By name; the other keeps its power, and the grid gives what is missing."""
    content = {
        "title": "", "duration": 1.5, "link": {"type": "inproc"}, "law": "matching-2",
        "plant": {"dc_source": ACROSS, "factors": {"L_g": 3.0, "R_g": 3.0}},
        "network": {
            "grid": "g",
            "converters": {"A": {"node": "bus"}, "B": {"node": "bus"}},
            "lines": {"cable": {"start": "bus", "end": "g", "L": 0.05, "R": 0.005}},
        },
        "events": [{"t": 0.1, "type": "irradiance", "irradiance": 0.5, "converter": "B"}],
    }  # fmt: skip
    run = gfmhil.run_network(content)
    A, B = (run.runs[name].signals for name in "AB")
    for s in (A, B):
        assert np.abs(s["true_v_dc"][:900] - 1.0).max() < 1e-9
        assert s["true_v_dc"][-1] == pytest.approx(1.0, abs=1e-4)
    assert A["true_i_dc"][-1] == pytest.approx(1.0, abs=1e-3)
    assert B["true_i_dc"][-1] == pytest.approx(1.0 - 0.5 * 1.08, abs=1e-3)


def test_a_grid_following_law_holds_v_dc_by_its_power():
    run = gfmhil.run("cloud_over_pv", law="grid-following-pv")
    t, v_dc, p = (run.signals[name] for name in ("t", "true_v_dc", "true_p"))
    assert run.status == "completed" and np.abs(v_dc - 1.0).max() < 0.1
    assert v_dc[t < 0.9] == pytest.approx(1.0, abs=1e-9)
    gives = {0.9: 1.0, 4.0: 0.3 * 1.08 - 0.08}  # I_sc times the light, less the diode's current
    for when, power in gives.items():  # less than 3 per mille of it is the filter's
        assert p[t < when][-1] == pytest.approx(power, rel=3e-3)
    with pytest.raises(UserError, match=r"k_dci = 20: the DC source holds v_dc too"):
        gfmhil.run("pref_step", law="grid-following-pv")
    event = {"t": 0.5, "type": "law", "law": "grid-following-pv"}
    with pytest.raises(UserError, match=r"k_dci = 20: the DC source holds v_dc too"):
        gfmhil.run("pref_step", events=[event])


@pytest.mark.processes
def test_over_a_link_the_bits_are_the_same(cloud, tmp_path):
    code = main(
        ["run", "cloud_over_pv", "--link", "shm", "--out", str(tmp_path / "run"), "--quiet",
         "--no-figures"]
    )  # fmt: skip
    assert code == 0
    there = gfmhil.load_run(tmp_path / "run")
    for name in ("true_p", "true_v_dc", "true_i_dc"):
        assert there.signals[name].tobytes() == cloud.signals[name].tobytes()


def test_the_event_needs_an_array_of_the_converter():
    event = [{"t": 0.1, "type": "irradiance", "irradiance": 0.5}]
    with pytest.raises(UserError, match=r"plant.dc_source.pv: not set; there is no PV array"):
        gfmhil.run("pref_step", events=event)
    with pytest.raises(UserError, match=r"irradiance.*less than or equal to 1.5"):
        gfmhil.run("cloud_over_pv", events=[{**event[0], "irradiance": 2.0}])
