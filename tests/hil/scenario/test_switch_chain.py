"""Six laws in one run, switched during a change of power: no bump, no trip."""

import numpy as np
import pytest

from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import load_scenario

CHAIN = ["mimo-gfm", "vsg-2", "droop-1", "matching-1", "dvoc", "mimo-gfm"]
COMMANDS = ("u_i_u", "u_omega_u", "u_E_u")


@pytest.fixture(scope="module")
def chain(tmp_path_factory):
    scenario = load_scenario("switch_chain", link__type="inproc")
    return run_scenario(scenario, tmp_path_factory.mktemp("chain") / "run")


def test_every_law_was_in_force_in_its_turn_and_nothing_tripped(chain):
    assert chain.summary["status"] == "completed"
    assert chain.summary["reason"] == ""
    assert chain.summary["laws"] == CHAIN
    assert (chain.signals["true_trip"] == 0).all()
    order = chain.signals["law"][np.append(True, np.diff(chain.signals["law"]) != 0)]
    assert len(order) == len(CHAIN)


def test_each_bump_is_below_a_millionth(chain):
    assert len(chain.summary["bump_pu"]) == len(CHAIN) - 1
    assert max(chain.summary["bump_pu"]) <= 1e-6


def test_the_commands_themselves_show_no_step(chain):
    """Measured, not reported: u continues from the ticks before, within its own curvature."""
    changes = [e["tick"] for e in chain.summary["events"] if e["type"] == "law"]
    for tick in changes:
        for name in COMMANDS:
            u = chain.signals[name]
            before = np.diff(u[tick - 20 : tick])
            assert abs(u[tick] - u[tick - 1]) <= 2 * np.abs(before).max() + 1e-6


def test_the_power_moves_at_each_change(chain):
    """Else the chain would prove nothing: a switch in a steady state is easy."""
    for event in chain.summary["events"]:
        if event["type"] == "law":
            window = chain.signals["true_p"][event["tick"] - 1000 : event["tick"]]
            assert np.ptp(window) > 1e-4


def test_every_law_leads_the_power_towards_its_reference(chain):
    final = {e["tick"]: e["p_final"] for e in chain.summary["events"]}
    start = chain.signals["true_p"][0]
    assert start == pytest.approx(0.5, abs=1e-9)
    assert all(0.3 < p < 1.0 for p in final.values())
    assert final[50000] == pytest.approx(0.8, abs=0.05)
