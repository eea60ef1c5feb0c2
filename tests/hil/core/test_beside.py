import os
import threading

import pytest

from gfm_hil.core.beside import beside


def write_its_process(path):
    path.write_text(str(os.getpid()))


def fail():
    raise ValueError("no room")


def test_it_is_done_in_another_process_unless_this_one_has_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    beside(write_its_process, tmp_path / "pid")()
    assert int((tmp_path / "pid").read_text()) != os.getpid()
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    beside(write_its_process, tmp_path / "pid")()
    assert int((tmp_path / "pid").read_text()) == os.getpid()


@pytest.mark.parametrize("threads", [1, 2])
def test_its_error_is_raised_here(threads, monkeypatch, capfd):
    monkeypatch.setattr(threading, "active_count", lambda: threads)
    wait = beside(fail)
    with pytest.raises(ValueError, match="no room"):
        wait()
    assert capfd.readouterr().err == ""
