"""Both servers beside one run: hundreds of silent pages, thousands of half-open connections."""

import json
import resource
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import sunspec2.device as sunspec
from pymodbus.client import ModbusTcpClient
from sunspec2.modbus.client import SunSpecModbusClientDeviceTCP
from websockets.sync.client import ClientConnection, connect

from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.image import VENDOR

from ...support.modbus import MODELS, SCENARIO, at
from ...support.processes import GFMHIL, PATIENCE_S, takes_commands, wait_for
from ...support.scope import addresses, mute

pytestmark = [pytest.mark.processes, pytest.mark.alone]

PAGES, CONNECTIONS, DESCRIPTORS = 200, 2000, 1024
TURN_S = 3.0
LOOK = {"kind": "look", "id": 1, "channels": ["p"], "bins": 50, "mode": "roll", "span": 2.0}


@pytest.fixture
def lab(tmp_path) -> Iterator[tuple[Path, list[subprocess.Popen[str]]]]:
    """A run and the servers beside it, each limited to 1,024 descriptors."""
    (tmp_path / "served.toml").write_text(SCENARIO, encoding="utf-8")
    folder = tmp_path / "run"
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] < 4096:
        pytest.skip("needs 4,096 descriptors")

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))

    def begin(*words: str, **more: Any) -> subprocess.Popen[str]:
        return subprocess.Popen([*GFMHIL, *words], text=True, stdout=subprocess.PIPE, **more)

    run = begin(
        "run", str(tmp_path / "served.toml"), "--out", str(folder), "--quiet", "--no-figures"
    )
    started = [run]
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (4096, before[1]))
        wait_for(lambda: takes_commands(folder))
        for server, *options in (["scope"], ["modbus", "--heartbeat", "30000"]):
            command = [server, str(folder), "--port", "0", *options]
            started.append(begin(*command, preexec_fn=few))
        yield folder, started
    finally:
        for process in reversed(started):
            process.send_signal(signal.SIGINT)
        for process in started:
            process.wait(PATIENCE_S)
            process.stdout.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


class Page(threading.Thread):
    """The operator's page: reads all messages, and stores answers and the number of pictures."""

    def __init__(self, socket: ClientConnection) -> None:
        super().__init__(daemon=True)
        self.socket, self.answers, self.pictures, self.granted = socket, [], 0, False

    def run(self) -> None:
        for message in self.socket:
            if isinstance(message, bytes):
                self.pictures += 1
                continue
            content = json.loads(message)
            self.granted |= content.get("granted", False)
            if content["kind"] == "answer":
                self.answers.append(content["ok"])

    def say(self, **content: Any) -> None:
        self.socket.send(json.dumps(content))


@pytest.mark.full
@pytest.mark.attack(
    "4.9",
    f"{PAGES} mute pages and {CONNECTIONS} half-open Modbus connections, {DESCRIPTORS} descriptors",
    "Modbus ends for good, the scope tells of no event, the operator is locked out",
)
def test_the_operator_goes_on_in_a_crowd(lab, attack_now):
    folder, (_, scope, modbus) = lab
    look, control = addresses(iter(scope.stdout))
    port = int(modbus.stdout.readline().partition(",")[0].rpartition(":")[2])
    watch = Operator(folder)
    with ExitStack() as stack:
        stack.callback(watch.close)
        plain = stack.enter_context(ModbusTcpClient("127.0.0.1", port=port, timeout=PATIENCE_S))
        sunspec.set_model_defs_path([MODELS, sunspec.models_dir])
        device = SunSpecModbusClientDeviceTCP(slave_id=1, ipport=port, timeout=PATIENCE_S)
        device.scan()
        beat, lost = at(device, 715, "ControllerHb"), at(device, VENDOR, "HbLost")
        device.close()

        def turn(page: Page, number: int) -> tuple[int, int, int]:
            """Send commands and heartbeats for a while; returns ticks, misses and pictures."""
            first, pictures, answers = watch.snapshot(), page.pictures, len(page.answers)
            until, k = time.monotonic() + TURN_S, 0
            while time.monotonic() < until:
                k += 1
                assert not plain.write_registers(beat, [number, k], device_id=1).isError()
                event = {"type": "reference", "P_ref": 0.4 + 0.01 * (k % 2)}
                page.say(kind="command", id=k, event=event)
                wait_for(lambda given=answers + k: len(page.answers) == given)
                time.sleep(0.2)
            assert all(page.answers)
            last = watch.snapshot()
            done = last["tick"] - first["tick"], last["misses"] - first["misses"]
            return *done, page.pictures - pictures

        where = look.replace("http", "ws") + "socket?control"
        page = Page(stack.enter_context(connect(where)))
        page.start()
        page.say(kind="hello", token=control.partition("#token=")[2])
        page.say(**LOOK)
        wait_for(lambda: page.granted and page.pictures)
        alone = turn(page, 1)
        at_scope = int(look.rstrip("/").rpartition(":")[2])
        for _ in range(PAGES):
            stack.enter_context(mute(at_scope, json.dumps({**LOOK, "bins": 4000})))
        for _ in range(CONNECTIONS):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
        crowded = turn(page, 2)
        later = Page(stack.enter_context(connect(where)))  # there is still room for the operator
        later.start()
        later.say(kind="hello", token=control.partition("#token=")[2])
        wait_for(lambda: later.granted)
        assert plain.read_holding_registers(lost, count=2, device_id=1).registers == [0, 0]
        assert crowded[2] > 0 and scope.poll() is None and modbus.poll() is None
    attack_now(
        f"the page's commands, its {crowded[2]} pictures and the heartbeat go on; misses "
        f"{alone[1]} of {alone[0]} ticks before, {crowded[1]} of {crowded[0]} within"
    )
