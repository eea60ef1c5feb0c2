"""What all ports have in common: beside one run with their real clients, and what they refuse."""

import json
import re
import signal
import socket
import struct
import subprocess

import pytest
from pymodbus.client import ModbusTcpClient
from websockets.sync.client import connect

from gfm_hil.ports import PORTS, make_port
from gfm_hil.ports.streams import BlockReader

from ...support.modbus import SCENARIO, SUNS
from ...support.processes import GFMHIL, PATIENCE_S
from ...support.scope import words
from ...support.xcp import CONNECT, datagram

pytestmark = pytest.mark.processes


@pytest.mark.attack(
    "23.6", "`run --scope --modbus --stream`, as in normal use",
    "nine lines of a traceback: a dictionary changed its size",
)  # fmt: skip
def test_every_port_serves_one_run(tmp_path, attack_now):
    (tmp_path / "served.toml").write_text(SCENARIO, encoding="utf-8")
    folder = tmp_path / "run"
    command = [*GFMHIL, "run", str(tmp_path / "served.toml"), "--out", str(folder), "--quiet"]
    for name in PORTS:
        command += [f"--{name}", "0"]
    run = subprocess.Popen(
        [*command, "--no-figures"], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    said: list[str] = []

    def where(pattern: str) -> str:
        """What a port prints of its address."""
        while not (found := re.search(pattern, "".join(said))):
            assert run.stderr is not None
            said.append(run.stderr.readline())
            assert said[-1], said
        return found[1]

    try:
        blocks = where(r"blocks:  (\S+)")
        with BlockReader(blocks) as reader:
            assert (block := reader.receive(PATIENCE_S)) is not None and len(block.rows)
        with connect(f"ws{where(r'to look: http([^ ]+)').strip()}socket") as page:
            assert words(page, "about")["live"]
        at_modbus = int(where(r"Modbus/TCP on 127.0.0.1:(\d+)"))
        with ModbusTcpClient("127.0.0.1", port=at_modbus) as client:
            assert client.read_holding_registers(SUNS, count=2, device_id=1).registers[0] == 0x5375
        at_xcp = int(where(r"XCP on UDP 127.0.0.1:(\d+)"))
        with socket.socket(type=socket.SOCK_DGRAM) as master:
            master.settimeout(PATIENCE_S)
            master.sendto(datagram(CONNECT), ("127.0.0.1", at_xcp))
            assert struct.unpack_from("<HHB", master.recv(100))[2] == 0xFF
        run.send_signal(signal.SIGINT)
        said.append(run.communicate(timeout=PATIENCE_S)[1])
        assert run.returncode == 130
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", at_modbus), timeout=20)
    finally:
        run.kill()
    lines = "".join(said).splitlines()
    expected = r"(scope|with control|samples|blocks|Modbus/TCP|XCP|\d+ ticks sent on)"
    assert [line for line in lines if not re.match(expected, line)] == []
    assert json.loads((folder / "summary.json").read_text())["status"] == "interrupted"
    attack_now(f"{len(lines)} lines, of {len(PORTS)} ports; all clients are answered")


@pytest.mark.parametrize("name", PORTS)
def test_a_port_in_use_is_refused_before_anything_starts(name, tmp_path, refused):
    out = tmp_path / "run"
    with socket.socket(type=make_port(name).socket) as taken:
        taken.bind(("127.0.0.1", 0))
        if taken.type == socket.SOCK_STREAM:
            taken.listen()
        number = taken.getsockname()[1]
        line = refused("run", "pref_step", "--out", str(out), f"--{name}", str(number))
    assert f"--{name} {number}: Address already in use" in line
    assert not out.exists()


@pytest.mark.parametrize("name", [name for name in PORTS if make_port(name).commands])
def test_a_run_in_process_takes_no_commands(name, refused):
    line = refused("run", "pref_step", "--link", "inproc", f"--{name}")
    assert f"--{name}: a run in process takes no commands" in line


@pytest.mark.parametrize("name", PORTS)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--host", "0.0.0.0"], "--host 0.0.0.0: goes beyond this machine"),
        (["--port", "70000"], "--port 70000: must be 0 (any) to 65535"),
        ([], "nowhere: no"),
    ],
)
def test_what_cannot_be_served_is_said_in_a_line(name, options, message, refused, monkeypatch):
    monkeypatch.setattr("os.nice", lambda by: by)  # it would last for all of pytest
    assert message in refused(name, "nowhere", *options)
