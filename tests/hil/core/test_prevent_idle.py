"""A thread of idle priority keeps a processor busy, and ends with its context."""

import os
import threading
from pathlib import Path

import pytest

from gfm_hil.realtime import prevent_idle as module
from gfm_hil.realtime.prevent_idle import prevent_idle

from ...support.processes import wait_for

pytestmark = pytest.mark.processes

HERE = sorted(os.sched_getaffinity(0))[0]
_IDLE = 5  # SCHED_IDLE


def spinner() -> threading.Thread | None:
    return next((t for t in threading.enumerate() if t.name == "prevent-idle"), None)


def used_s(thread: threading.Thread) -> float:
    """Processor time of a thread, proc_pid_stat(5) fields 14 and 15."""
    stat = Path(f"/proc/self/task/{thread.native_id}/stat").read_text().rpartition(")")[2].split()
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")


def test_a_thread_of_idle_priority_spins_on_that_processor_meanwhile():
    policy, affinity = os.sched_getscheduler(0), os.sched_getaffinity(0)
    with prevent_idle(HERE, "always") as busy:
        assert busy
        thread = spinner()
        assert thread is not None and thread.native_id is not None
        assert os.sched_getscheduler(thread.native_id) == _IDLE
        assert os.sched_getaffinity(thread.native_id) == {HERE}
        wait_for(lambda: used_s(thread) >= 0.05)  # on a crowded machine it gets little time
    thread.join(60)
    assert not thread.is_alive()
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == (policy, affinity)


@pytest.mark.parametrize(
    ("processor", "wanted", "machine", "busy"),
    [
        (HERE, "auto", "KVM", True),
        (HERE, "auto", "no", False),
        (HERE, "never", "KVM", False),
        (None, "always", "KVM", False),
    ],
)
def test_where_it_is_wanted(processor, wanted, machine, busy, monkeypatch):
    monkeypatch.setattr(module, "virtual_machine", lambda: machine)
    with prevent_idle(processor, wanted) as found:
        assert found is busy
        assert (spinner() is not None) is busy


def test_without_the_policy_it_goes_on_without(monkeypatch):
    monkeypatch.setattr(module, "_spin", lambda flags: None)  # as if refused
    monkeypatch.setattr(module, "warm_up", lambda: None)
    with prevent_idle(HERE, "always") as busy:
        assert busy is False
