"""Events with a synchro-check: the grid's breaker of one converter, and the black start."""

from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.recording.log import read_log
from gfm_hil.recording.run import Run
from gfm_hil.run.runner import run_network, run_scenario
from gfm_hil.scenario import load_scenario
from gfm_plant import load_converter

CHECK = {"V": 0.1, "f_hz": 0.5, "degrees": 5.0, "lasting_s": 0.02, "within_s": 5.0}


def content(closes_at: float, **check: Any) -> dict[str, Any]:
    """One converter that the grid leaves at 0.2 s; it gives more than its reference to the load,
    and so its frequency is below the grid's."""
    closes = {"type": "grid-breaker", "t": closes_at, "closed": True}
    return {
        "title": "island", "duration": 8.0, "law": "vsg-2", "inner": "virtual-stator",
        "link": {"type": "inproc"},
        "references": {"P_ref": 0.3},
        "plant": {"grid": {"load_R": 45.0, "load_L": 0.02}},
        "events": [{"type": "grid-breaker", "t": 0.2, "closed": False},
                   closes | ({"check": check} if check else {})],
    }  # fmt: skip


def island(closes_at: float, **check: Any) -> Run:
    return gfmhil.run(content(closes_at, **check))


def test_the_grids_breaker_closes_when_the_angles_meet():
    """Without the check it closes at whatever angle there is; half a turn later that ends a run."""
    checked = island(1.0, **CHECK)
    *_, waits, closed = checked.summary["events"]
    assert waits["label"] == "grid breaker closes when synchronous" and waits["tick"] == 10000
    assert closed["label"] == "grid breaker on, synchronous"
    assert checked.status == "completed"
    assert checked.signals["omega_u"][-1] == pytest.approx(1.0, abs=1e-5)
    slip = 50 * (1 - checked.signals["omega_u"][closed["tick"] - 1])  # Hz
    assert 0.1 < slip < 0.5
    blind = island(closed["t"] + 0.5 / slip)
    assert blind.status in ("tripped", "safe")  # by a current that nothing measures any more


@pytest.mark.processes
@pytest.mark.timeout(900)  # compiles
def test_over_a_link_it_closes_in_the_same_tick(tmp_path):
    given = content(0.4, **CHECK | {"degrees": 60.0, "within_s": 0.2})
    given |= {"duration": 1.0, "link": {"type": "shm", "peer_timeout_s": 30.0}}
    given["events"].append({**given["events"][-1], "t": 0.7, "check": {**CHECK, "within_s": 0.03}})
    found = run_scenario(load_scenario(given), tmp_path / "run")
    memory = gfmhil.run(given)
    labels = [event["label"] for event in memory.summary["events"]]
    assert labels[2] == "grid breaker on, synchronous"
    assert [event["label"] for event in found.summary["events"]] == labels
    for name in ("p", "V", "omega_u"):
        np.testing.assert_array_equal(found.signals[name][:], memory.signals[name][:])


@pytest.mark.full
def test_a_black_start_ends_on_the_grid(tmp_path):
    """The angle of the bus, from what A records at rest, is the one that the log names."""
    scenario = load_scenario("black_start")
    run = run_network(scenario, tmp_path / "run")
    assert run.status == "completed"
    line = read_log(tmp_path / "run" / "A" / "events.jsonl")[-2]
    assert line["label"] == "tie on, synchronous"
    k, s = line["tick"], run["A"].signals
    v = complex(s["true_v_re"][k], s["true_v_im"][k])
    i = complex(s["p"][k], -s["q"][k]) / v.conjugate()
    line_of_a = load_converter("paper").pu()
    bus = v - complex(line_of_a["R_g"], line_of_a["L_g"]) * i  # the grid is at 1
    V, df, dphi = (float(part.split(" ")[2]) for part in line["found"].split(", "))
    assert 0 < s["true_V"][0] < 2e-3 and s["true_V"][29999] == pytest.approx(1.0, abs=0.02)
    assert dphi == pytest.approx(np.degrees(np.angle(bus)), abs=0.05)
    assert pytest.approx(abs(bus) - 1, abs=5e-4) == V
    assert abs(dphi) <= 10 and abs(V) <= 0.03 and abs(df) <= 0.1
    assert df == pytest.approx(50 * (s["omega_u"][k - 1] - 1), abs=2e-3)
    assert run["B"].signals["p"][-1] == pytest.approx(0.56, abs=1e-3)
    assert s["p"][-1] == pytest.approx(0.56, abs=1e-3)
    assert s["omega_u"][-1] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("event", "message"),
    [
        ({"closed": False, "check": {}}, "check: goes with closed = true"),
        ({"closed": True, "check": {"within_s": 0.1}},
         "within_s = 0.1: must be more than lasting_s = 0.1"),
        ({"closed": True, "check": {"degrees": 190.0}}, "degrees"),
        ({"closed": True, "check": {"angle": 5.0}}, "angle"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_that_names_it(event, message):
    content = {
        "title": "island", "duration": 1.0, "link": {"type": "inproc"},
        "plant": {"grid": {"load_R": 45.0, "load_L": 0.02}},
        "events": [{"type": "grid-breaker", "t": 0.2, **event}],
    }  # fmt: skip
    with pytest.raises(UserError, match=r"events\.0") as caught:
        load_scenario(content)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_black_start_cannot_begin_without_any_voltage():
    with pytest.raises(UserError, match=r"network: V = 0.0.*must be > 0 p.u."):
        gfmhil.run_network("black_start", references__V_ref=0.0)
