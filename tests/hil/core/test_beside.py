import os
import threading

import pytest

from gfm_hil.core.beside import beside


def write_its_process(path):
    path.write_text(str(os.getpid()))


def fail():
    raise ValueError("no room")


@pytest.fixture
def alone(monkeypatch):
    """The tests' own threads are not counted."""
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread()])
    monkeypatch.setattr(os, "cpu_count", lambda: 2)


def test_it_is_done_in_another_process(alone, tmp_path):
    wait = beside(write_its_process, tmp_path / "pid")
    wait()
    assert int((tmp_path / "pid").read_text()) != os.getpid()


def test_a_process_with_threads_is_not_forked(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread(), object()])
    wait = beside(write_its_process, tmp_path / "pid")
    wait()
    assert int((tmp_path / "pid").read_text()) == os.getpid()


@pytest.mark.parametrize("processors", [1, 2])
def test_its_error_is_raised_here(processors, alone, monkeypatch, capfd):
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    wait = beside(fail)
    with pytest.raises(ValueError, match="no room"):
        wait()
    assert capfd.readouterr().err == ""
