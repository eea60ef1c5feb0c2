"""A side's messages to systemd, received on a real datagram socket in systemd's place."""

import os
import secrets
import signal
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.engine.sd_notify import Watched, notify
from gfm_hil.scenario import toml_text

pytestmark = pytest.mark.processes

PATIENCE_S = 90.0


class Manager:
    """The service manager's end: collects datagrams."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock, self.heard = sock, []
        sock.setblocking(False)

    def lines(self) -> list[str]:
        """All lines received since the last call."""
        fresh = []
        while True:
            try:
                fresh += self.sock.recv(4096).decode().split("\n")
            except BlockingIOError:
                self.heard += fresh
                return fresh

    def wait_for(self, line: str) -> None:
        """Wait until that line arrives after this call."""
        end = time.monotonic() + PATIENCE_S
        while line not in self.lines():
            assert time.monotonic() < end, (line, self.heard)
            time.sleep(0.02)


@pytest.fixture(params=["path", "abstract"])
def manager(request, monkeypatch) -> Iterator[Manager]:
    """Listens on NOTIFY_SOCKET, a path or an abstract name."""
    with (
        tempfile.TemporaryDirectory(prefix="gfmhil-") as folder,  # a socket's path must be short
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock,
    ):
        name = f"@gfmhil-{secrets.token_hex(8)}" if request.param == "abstract" else f"{folder}/n"
        sock.bind(name.replace("@", "\0"))
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        monkeypatch.delenv("WATCHDOG_PID", raising=False)
        yield Manager(sock)


def test_lines_go_in_one_datagram(manager):
    notify("READY=1", "STATUS=grün")
    assert manager.sock.recv(4096).decode() == "READY=1\nSTATUS=grün"


def test_nobody_who_listens_is_no_failure(monkeypatch, tmp_path):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    notify("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("READY=1")


def test_watchdog_is_fed_only_while_the_count_of_ticks_grows(manager, make, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    progress = np.zeros(2, np.int64)
    with Watched(make(link={"type": "inproc", "peer_timeout_s": 0.05}), progress):
        time.sleep(0.4)  # eight polls
        assert manager.lines() == ["READY=1", "STATUS=met the other side"]
        progress[:] = 7, 3
        manager.wait_for("WATCHDOG=1")
        time.sleep(0.4)
        assert "WATCHDOG=1" not in manager.lines()
    assert "STATUS=tick 7 of 1000, 3 misses" in manager.heard
    stopping = ["STOPPING=1", "STATUS=ended after 7 ticks; writing its data"]
    assert manager.lines() == stopping


@pytest.mark.parametrize("pid", ["1", "own"])
def test_watchdog_comes_after_a_silent_peer_and_only_to_whom_it_is_meant_for(
    manager, make, monkeypatch, pid
):
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()) if pid == "own" else pid)
    with Watched(make(link={"type": "inproc", "peer_timeout_s": 3.0}), np.zeros(2, np.int64)):
        assert ("WATCHDOG_USEC=6000000" in manager.lines()) == (pid == "own")


@pytest.mark.parametrize("manager", ["path"], indirect=True)
def test_role_is_ready_after_the_handshake_and_alive_while_the_other_one_is(
    manager, start, endpoint, tmp_path, monkeypatch
):
    scenario = tmp_path / "long.toml"
    scenario.write_text(
        toml_text({"title": "long", "duration": 600.0, "link": {"peer_timeout_s": 60.0}})
    )
    both = ("--endpoint", endpoint, "--mode", "lockstep", "--quiet")
    monkeypatch.setenv("WATCHDOG_USEC", "400000")
    controller = start("controller", str(scenario), *both, "--out", "c")
    manager.wait_for(f"STATUS=waiting for the other side at {endpoint}")
    assert "READY=1" not in manager.heard
    monkeypatch.delenv("NOTIFY_SOCKET")
    plant = start("plant", str(scenario), *both, "--out", "p")
    manager.wait_for("READY=1")
    assert "WATCHDOG_USEC=120000000" in manager.heard
    assert "WATCHDOG=1" not in manager.heard[: manager.heard.index("READY=1")]
    manager.wait_for("WATCHDOG=1")
    manager.wait_for("WATCHDOG=1")  # and goes on
    plant.send_signal(signal.SIGSTOP)
    time.sleep(1.5)  # it may still send what it computed before the stop
    manager.lines()
    time.sleep(1.0)
    assert manager.lines() == []
    plant.send_signal(signal.SIGCONT)
    manager.wait_for("WATCHDOG=1")
    controller.terminate()
    manager.wait_for("STOPPING=1")
    controller.communicate(timeout=PATIENCE_S)
    assert controller.returncode == 130
    assert Path(tmp_path / "c" / "summary.json").exists()
    assert manager.lines() == []
