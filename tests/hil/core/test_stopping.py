"""Signals set a flag during a run, and the handlers are restored after it."""

import json
import os
import signal
import threading
from typing import Any

import pytest

from gfm_hil.cli import main
from gfm_hil.core.stopping import Interrupt
from gfm_hil.run import run_folder, runner

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


@pytest.mark.parametrize("number", SIGNALS)
def test_at_once_the_first_signal_insists(number):
    with pytest.raises(KeyboardInterrupt), Interrupt(at_once=True):
        os.kill(os.getpid(), number)


@pytest.mark.attack(
    "23.5", "Ctrl-C, twice or while the folder is finished", "exit code 130 without a word"
)
@pytest.mark.parametrize("when", ["twice", *SIGNALS])
def test_a_run_that_is_cut_short_says_what_is_left(when, tmp_path, monkeypatch, capsys, attack_now):
    """Two signals while it runs, or one while its folder is finished."""
    run, summarise = runner.run_inproc, run_folder.summarise

    def twice(*given: Any) -> Any:
        def go_on(ticks: int) -> bool:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGINT)
            return True

        return run(*given[:-1], go_on)

    def once(*given: Any) -> Any:
        os.kill(os.getpid(), when)
        return summarise(*given)

    with monkeypatch.context() as patched:
        if when == "twice":
            patched.setattr(runner, "run_inproc", twice)
        else:
            patched.setattr(run_folder, "summarise", once)
        folder = tmp_path / "run"
        command = ["run", "pref_step", "--link", "inproc", "--out", str(folder), "--quiet"]
        assert main([*command, "--no-figures"]) == 130
    said = capsys.readouterr().err
    assert said == (
        f"gfmhil: {folder}: interrupted; all that was recorded is kept: gfmhil recover {folder} "
        "completes the folder\n"
    )
    assert main(["recover", str(folder)]) == 0
    assert json.loads((folder / "summary.json").read_text())["ticks"] > 0
    attack_now("one line names the folder and gfmhil recover, which completes it")
