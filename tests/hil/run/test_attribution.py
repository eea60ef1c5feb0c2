"""Causes of missed ticks, on synthetic timing with one fault at a time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.run.attribution import CAUSES, attribute, bursts, counts, missed_ticks

T = 100_000  # ns
TICKS = 500


def good() -> dict[str, np.ndarray]:
    """Every tick on time: wake-up 300 ns late, 800 ns of work per side, 15 µs each way."""
    due = 1_000_000 + T * np.arange(TICKS)
    heard = due + 300 + 800 + 15_000
    return {
        "plant_scheduled": due,
        "plant_woke": due + 300,
        "plant_measured": due + 1_000,
        "plant_sent": due + 1_100,
        "plant_received": heard + 800 + 15_000,
        "plant_stall": np.full(TICKS, 200),
        "controller_scheduled": due.copy(),
        "controller_received": heard,
        "controller_computed": heard + 500,
        "controller_sent": heard + 800,
        "controller_stall": np.full(TICKS, 200),
    }


def found(timing: dict[str, np.ndarray], *events: int) -> list[str]:
    return [CAUSES[k] for k in attribute(timing, T, events).causes]


def test_a_run_without_misses_has_no_causes():
    assert found(good()) == []
    assert counts(attribute(good(), T).causes) == dict.fromkeys(CAUSES, 0)


PLANT = ("plant_woke", "plant_measured", "plant_sent")
CONTROLLER = ("controller_received", "controller_computed", "controller_sent")
ONE, FIFTH = slice(7, 8), slice(None, None, 5)  # every fifth tick: not an outlier


@pytest.mark.parametrize(
    ("late", "ns", "ticks", "events", "cause"),
    [
        pytest.param((*PLANT, *CONTROLLER), 90_000, ONE, (), "late wake-up", id="woken late"),
        pytest.param(("plant_stall",), 85_000, ONE, (), "stalled host", id="plant stood still"),
        # u came 68.1 µs too late at least (30.4 µs is usual): a gap within the wait, or the wire?
        pytest.param(("plant_stall",), 35_000, ONE, (), "stalled host", id="most of the wait"),
        pytest.param(("plant_stall",), 33_000, ONE, (), "link", id="less than half of the wait"),
        pytest.param(("controller_stall", *CONTROLLER), 85_000, ONE, (), "stalled host",
                     id="controller stood still"),
        pytest.param(CONTROLLER[1:], 95_000, FIFTH, (), "own work", id="too much work"),
        pytest.param(CONTROLLER[1:], 95_000, ONE, (), "stalled host", id="work interrupted"),
        pytest.param(PLANT, 90_000, ONE, (7,), "own work", id="event on the tick"),
        # a write to a pseudo terminal may take longer than a tick: it is no work of ours
        pytest.param(("plant_sent",), 95_000, FIFTH, (), "link", id="plant's send"),
        pytest.param(("controller_sent",), 95_000, FIFTH, (), "link", id="controller's send"),
    ],
)  # fmt: skip
def test_a_late_tick_has_one_cause(late, ns, ticks, events, cause):
    timing = good()
    for name in late:
        timing[name][ticks] += ns
    timing["plant_received"][ticks] = -1
    assert found(timing, *events) == [cause] * len(range(TICKS)[ticks])


def test_frame_that_never_came_is_the_links():
    timing = good()
    for name in (*CONTROLLER, "plant_received"):
        timing[name][7] = -1
    assert found(timing) == ["link"]


def catches_up(timing: dict[str, np.ndarray], ticks: range, back: int) -> None:
    """The controller is back, and processes the frames of these ticks, 900 ns each."""
    for k in ticks:
        timing["controller_received"][k] = back + 900 * (k - ticks[0])
        timing["controller_computed"][k] = timing["controller_received"][k] + 500
        timing["controller_sent"][k] = timing["controller_received"][k] + 800


def test_ticks_that_follow_have_the_cause_of_the_first():
    """The controller stalls for three ticks, then processes the queued frames."""
    timing = good()
    back = timing["plant_scheduled"][7] + 3 * T + 20_000
    catches_up(timing, range(7, 11), back)
    timing["controller_stall"][7] = 3 * T
    timing["plant_received"][[7, 8, 9]] = -1
    assert found(timing) == ["stalled host"] * 3


def test_frames_lost_while_the_controller_stood_still_are_not_the_links():
    """It stalled for six ticks; the ring had room for two of the frames sent meanwhile."""
    timing = good()
    back = timing["plant_scheduled"][12] + 95_000
    catches_up(timing, range(7, 9), back)
    timing["controller_stall"][7] = back - timing["plant_scheduled"][6] - 20_000
    for name in CONTROLLER:
        timing[name][9:13] = -1
    timing["controller_stall"][9:13] = -1
    timing["plant_received"][7:13] = -1
    assert found(timing) == ["stalled host"] * 6


def test_answer_that_was_held_up_with_its_sender_is_not_the_links():
    """The controller stalls after its send of u, before the link's own thread has sent it."""
    timing = good()
    back = timing["plant_scheduled"][9] + 80_000
    catches_up(timing, range(8, 10), back)
    timing["controller_stall"][8] = back - timing["controller_sent"][7]
    timing["plant_received"][[7, 8]] = -1
    assert found(timing) == ["stalled host"] * 2


def test_wait_that_was_longer_than_the_gap_in_it():
    """y arrives 50 µs after a gap of 600 µs: the gap caused all nine misses."""
    timing = good()
    back = timing["plant_scheduled"][7] + 750_000
    for k in range(7, 16):
        timing["controller_received"][k] = max(back, timing["plant_sent"][k] + 15_000) + 900 * k
        timing["controller_sent"][k] = timing["controller_received"][k] + 800
        timing["controller_computed"][k] = timing["controller_sent"][k] - 300
    timing["controller_stall"][7] = 600_000
    timing["plant_received"][7:15] = -1
    assert found(timing) == ["stalled host"] * 8


def test_plant_that_is_behind_does_not_blame_its_timer():
    timing = good()
    timing["plant_stall"][7] = 2 * T
    for k, late in ((8, 190_000), (9, 95_000)):
        timing["plant_woke"][k] += late
        timing["plant_sent"][k] += late
        timing["plant_measured"][k] += late
    timing["plant_received"][[7, 8, 9]] = -1
    assert found(timing) == ["stalled host"] * 3


@given(st.sets(st.integers(0, TICKS - 1)))
def test_every_miss_has_one_cause_and_is_in_one_burst(ticks):
    timing = good()
    timing["plant_received"][sorted(ticks)] = -1
    assert sum(counts(attribute(timing, T).causes).values()) == len(ticks)
    lengths = dict(bursts([missed_ticks(timing)]))
    assert sum(n * c for n, c in lengths.items()) == len(ticks)
    assert sum(lengths.values()) == len(ticks - {k + 1 for k in ticks})
