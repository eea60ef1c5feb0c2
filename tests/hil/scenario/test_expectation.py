"""A scenario's expected end: status, reason and time; each can fail alone."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import load_scenario, scenario_toml
from gfm_hil.scenario.expectation import END_REASONS

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "own_controller"
SENDS_NAN = f"""
import sys
sys.path.insert(0, {str(EXAMPLE)!r})
import controller
class Nan(controller.Droop):
    ticks = 0
    def step(self, *y):
        self.ticks += 1
        return super().step(*y) if self.ticks <= 280 else (float("nan"),) * 3
controller.Droop = Nan
controller.main(*sys.argv[1:])
"""
LOW = {"over_current": {"threshold": 1.5, "delay_s": 0.0}}
TRIP = {
    "events": [{"t": 0.05, "type": "grid-phase-jump", "degrees": 20.0}],
    "plant": {"protection": LOW},
    "expect": "tripped",
}


def switchover(**changed: Any) -> Any:
    """The shipped experiment, whose law changes at 1 s, in one process."""
    return load_scenario("switchover", mode="lockstep", link__type="inproc", **changed)


@pytest.mark.processes
@pytest.mark.attack(
    "8.1",
    "a controller that sends NaN 28 ms after the start of `switchover`, which expects a trip",
    "exit code 0: any trip was the one expected",
)
def test_a_trip_for_another_reason_is_not_the_one_expected(tmp_path, attack_now):
    (tmp_path / "nan.py").write_text(SENDS_NAN)
    scenario = load_scenario("switchover", mode="lockstep", link__peer_timeout_s=20.0)
    run = run_scenario(
        scenario, tmp_path / "run",
        controller_command=(sys.executable, str(tmp_path / "nan.py"), "{endpoint}", "{scenario}"),
    )  # fmt: skip
    assert run.summary["status"] == "tripped" == run.summary["expected"]
    assert (run.summary["controller"], run.summary["laws"]) == ("droop in Python", [])
    assert "droop in Python" in repr(run)
    assert run.summary["unmet"] == [
        "expect_reason = 'over-current', but the reason was 'command not finite'",
        "expect_after = 1 s, but the end came at 0.0281 s",  # after 280 good commands
    ]
    attack_now(f"exit code 3 at {run.summary['duration_s'] * 1e3:.1f} ms: reason and time named")


def test_the_shipped_experiment_ends_as_it_expects(tmp_path):
    run = run_scenario(switchover(), tmp_path / "run")
    assert (run.summary["status"], run.summary["unmet"]) == ("tripped", [])
    (event,) = run.summary["events"]
    assert event["cut_short"].startswith("over-current at 1.4")
    assert event["p_final"] is event["settling_s"] is event["overshoot_pct"] is None
    assert event["fast_hz"] > 40 and event["p_peak"] is not None  # what led to the trip
    assert run.summary["reason"].startswith("over-current: ")
    assert run.summary["duration_s"] > 1.0


@pytest.mark.parametrize(
    ("expected", "part"),
    [
        ({"expect_reason": "over-current", "expect_after": 0.05}, None),
        ({"expect_reason": "over-voltage"}, "expect_reason = 'over-voltage'"),
        ({"expect_after": 0.06}, "expect_after = 0.06 s"),
        ({"expect": "completed"}, "expect = 'completed'"),
        ({"expect": "safe"}, "expect = 'safe'"),
    ],
)
def test_terminal_summary_report_and_exit_code_agree(expected, part, make, tmp_path, capsys):
    (tmp_path / "trip.toml").write_text(scenario_toml(make(**{**TRIP, **expected})))
    folder = tmp_path / "run"
    code = main(["run", str(tmp_path / "trip.toml"), "--out", str(folder), "--quiet"])
    out = " ".join(capsys.readouterr().out.split())
    unmet = json.loads((folder / "summary.json").read_text())["unmet"]
    report = (folder / "report.html").read_text()
    assert code == (0 if part is None else 3)
    assert len(unmet) == (0 if part is None else 1)
    assert ("not as expected: " + (part or "") in out) is (part is not None)
    assert ("not as expected: " in report) is (part is not None)
    assert ("tripped, as expected" in out) is (", as expected:" in report) is (part is None)
    assert "over-current at 0.05" in out and "over-current at 0.05" in report  # no final values
    if part is not None:
        assert unmet[0].startswith(part + ", but ")


@pytest.mark.parametrize(("after", "met"), [(0.05, True), (0.08, False)])
def test_a_run_that_waits_is_judged_by_its_last_trip(run, after, met):
    done = run(**TRIP, after_trip="wait", expect_reason="over-current", expect_after=after)
    assert [t["reason"][:12] for t in done.summary["trips"]] == ["over-current"]
    assert done.summary["events"][0]["p_final"] is None
    assert done.summary["ticks"] == 1000  # it waited to its end, which is not the time that counts
    assert (not done.summary["unmet"]) is met


@pytest.mark.parametrize("status", END_REASONS)
def test_every_name_of_the_lists_is_accepted(status, make):
    for name in END_REASONS[status]:
        assert make(expect=status, expect_reason=name).expect_reason == name


@pytest.mark.parametrize("after_trip", ["end", "wait"])
def test_a_trip_has_one_time(after_trip):
    """The log and the summary said a tick less than the reason."""
    run = gfmhil.run(
        {
            "title": "", "duration": 0.2, "law": "vsg-2", "after_trip": after_trip,
            "plant": {"grid": {"scr": 3.0, "x_over_r": 6.0}},
            "events": [{"t": 0.1, "type": "grid-phase-jump", "degrees": 60.0}],
        }
    )  # fmt: skip
    (trip,) = run.summary["trips"]
    tick, t = trip["tick"], trip["t"]
    assert f"at tick {tick} (t = {t:g} s)" in trip["reason"]
    first = next(e for e in run.events if "reason" in e)
    assert (first["tick"], first["t"]) == (tick, t)
    assert run.summary["events"][0]["cut_short"] == f"over-current at {t:g} s"
    assert run.summary["events"][0]["i_peak"] == run.signals["i"][1000:tick].max()
    if after_trip == "wait":
        assert (run.signals["trip"][:] > 0).argmax() == tick
    else:
        assert run.ticks == tick
