"""Signals set a flag during a run, and the handlers are restored after it."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from gfm_hil.core.stopping import Interrupt

pytestmark = pytest.mark.processes

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.mark.parametrize("number", SIGNALS)
def test_the_first_signal_is_a_flag_the_second_insists(number):
    with pytest.raises(KeyboardInterrupt), Interrupt() as interrupt:
        assert not interrupt.came
        os.kill(os.getpid(), number)
        assert interrupt.came
        os.kill(os.getpid(), number)


def test_handlers_are_put_back():
    before = [signal.getsignal(number) for number in SIGNALS]
    with Interrupt():
        assert [signal.getsignal(number) for number in SIGNALS] != before
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_nohup_is_respected():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not interrupt.came
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_in_another_thread_it_does_nothing():
    seen = []

    def use() -> None:
        with Interrupt() as interrupt:
            seen.append(interrupt.came)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert seen == [False]
