"""The server beside runs that begin and end, and without a run."""

from __future__ import annotations

import json
import signal
import socket
import subprocess

import pytest
import sunspec2.device as sunspec
from pymodbus.client import ModbusTcpClient
from sunspec2.modbus.client import SunSpecModbusClientDeviceTCP

from gfm_hil.ports.modbus.image import VENDOR

from ..support.modbus import MODELS, SCENARIO, SUNS, at, end, start
from ..support.processes import GFMHIL, PATIENCE_S, free_port, running

pytestmark = [pytest.mark.processes, pytest.mark.alone]


def test_a_folder_without_a_run(tmp_path):
    done = subprocess.run([*GFMHIL, "modbus", str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 2 and "no run is going on there" in done.stderr


def test_the_vendor_model_is_a_file_for_clients():
    done = subprocess.run([*GFMHIL, "modbus", "--vendor-model"], capture_output=True, text=True)
    assert json.loads(done.stdout)["id"] == VENDOR


def test_stop_ends_the_run_and_the_server_with_it(tmp_path):
    folder = tmp_path / "run"
    with running(folder, SCENARIO) as run:
        server, port = start(folder)
        with ModbusTcpClient("127.0.0.1", port=port) as plain:
            sunspec.set_model_defs_path([MODELS, sunspec.models_dir])
            device = SunSpecModbusClientDeviceTCP(slave_id=1, ipport=port, timeout=20)
            device.scan()
            plain.write_register(at(device, 715, "OpCtl"), 0, device_id=1)
        assert run.wait(PATIENCE_S) == 130
        assert server.wait(PATIENCE_S) == 0
    assert json.loads((folder / "summary.json").read_text())["status"] == "interrupted"


def test_a_server_beside_a_run_begins_and_ends_with_it(tmp_path):
    (tmp_path / "served.toml").write_text(SCENARIO, encoding="utf-8")
    port = free_port()
    command = [*GFMHIL, "run", str(tmp_path / "served.toml"), "--out", str(tmp_path / "run")]
    options = ["--modbus", str(port), "--no-figures", "--quiet"]
    run = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert f"Modbus/TCP on 127.0.0.1:{port}" in run.stderr.readline().decode()
        with ModbusTcpClient("127.0.0.1", port=port) as plain:
            assert plain.read_holding_registers(SUNS, count=2, device_id=1).registers[0] == 0x5375
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE_S) == 130
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), timeout=20)
    finally:
        end(run)


def test_a_run_in_process_cannot_be_served():
    command = [*GFMHIL, "run", "pref_step", "--link", "inproc", "--modbus"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "--modbus: a run in process takes no commands" in done.stderr


def test_a_port_in_use_is_refused_before_anything_starts(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        command = [*GFMHIL, "run", "pref_step", "--out", str(tmp_path / "run"), "--modbus"]
        done = subprocess.run([*command, str(port)], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and f"--modbus {port}: Address already in use" in done.stderr
    assert not (tmp_path / "run").exists()
