import os
import threading
import time

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
    with beside(write_its_process, tmp_path / "pid"):
        pass
    assert int((tmp_path / "pid").read_text()) != os.getpid()


def test_a_process_with_threads_is_not_forked(alone, tmp_path, monkeypatch):
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.main_thread(), object()])
    with beside(write_its_process, tmp_path / "pid"):
        pass
    assert int((tmp_path / "pid").read_text()) == os.getpid()


@pytest.mark.parametrize("processors", [1, 2])
def test_its_error_is_raised_here(processors, alone, monkeypatch, capfd):
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    with pytest.raises(ValueError, match="no room"), beside(fail):
        pass
    assert capfd.readouterr().err == ""


def test_after_an_error_in_the_block_it_still_finishes_its_file(alone, tmp_path):
    def write_slowly() -> None:
        (tmp_path / "part").write_text("half")
        time.sleep(0.2)
        (tmp_path / "part").rename(tmp_path / "whole")

    with pytest.raises(KeyError), beside(write_slowly):
        while not (tmp_path / "part").is_file():
            time.sleep(0.01)
        raise KeyError
    assert [path.name for path in tmp_path.iterdir()] == ["whole"]


def test_nothing_is_left_of_it_after_an_error_in_the_block(alone, tmp_path, monkeypatch):
    monkeypatch.setattr("gfm_hil.core.beside._PATIENCE_S", 0.1)

    def write_later() -> None:
        (tmp_path / "pid").write_text(str(os.getpid()))
        time.sleep(600.0)

    with pytest.raises(KeyError), beside(write_later):
        while not (tmp_path / "pid").is_file() or not (tmp_path / "pid").read_text():
            time.sleep(0.01)
        raise KeyError
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
