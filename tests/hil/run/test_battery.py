"""A run with a battery and a chopper behind its DC source."""

import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError


def test_a_full_battery_leaves_the_power_to_the_chopper(tmp_path):
    """VSG-2 takes 0.4 p.u. at 50.2 Hz by its droop of 1 %; the battery takes 0.3 of it, until it is
    full: 3 % of 60 s is 1.8 p.u. s."""
    run = gfmhil.run("battery_charges")
    found = gfmhil.load_run(run.save(tmp_path / "run"))
    assert run.status == found.status == "completed"
    s = found.signals
    assert s["p"][-1] == pytest.approx(-0.4, abs=1e-6)
    i_dc, v_dc, soc = s["true_i_dc"], s["v_dc"], s["soc"]
    assert (i_dc * v_dc).min() > -0.3 - 0.02  # the limit samples v_dc once a tick
    assert 1.0 < v_dc.max() < 1.09
    assert soc[0] == 0.92 and soc[-1] == pytest.approx(0.95, abs=1e-5) and i_dc[-1] == 0.0
    full = s["t"][(soc >= 0.95).argmax()]
    assert full == pytest.approx(1.0 + 1.8 / 0.3, abs=0.5)


@pytest.mark.processes
def test_over_a_link_the_charge_is_the_same(tmp_path):
    here = gfmhil.run("battery_charges", duration=4.0)
    code = main(
        ["run", "battery_charges", "--duration", "4", "--link", "shm",
         "--out", str(tmp_path / "run"), "--quiet", "--no-figures"]
    )  # fmt: skip
    assert code == 0
    there = gfmhil.load_run(tmp_path / "run")
    for name in ("soc", "v_dc", "true_i_dc"):
        assert there.signals[name].tobytes() == here.signals[name].tobytes()


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"battery": {}}, "battery.energy_s"),
        ({"battery": {"energy_s": 60.0, "soc_min": 0.96}}, "soc_min = 0.96: must be less than"),
        ({"battery": {"energy_s": 60.0, "R": 0.3}}, "P_discharge = 1: with this R at most 0.8333"),
        ({"chopper": {"v_on": 1.0}}, "v_off = 1.1: must be less than v_on = 1"),
    ],
)
def test_what_cannot_be(source, said):
    with pytest.raises(UserError, match=said):
        gfmhil.run("battery_charges", plant__dc_source=source)
