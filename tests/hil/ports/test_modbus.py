"""The SunSpec server in use: a run, the server and its clients as separate processes."""

import json
import socket
import ssl
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import sunspec2.device as sunspec
import trustme
from pymodbus.client import ModbusTcpClient
from sunspec2.modbus.client import SunSpecModbusClientDeviceTCP, SunSpecModbusClientException
from sunspec2.modbus.modbus import ModbusClientException

from gfm_hil.cli import main
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.grid_forming import NUMBER
from gfm_hil.ports.modbus.image import VENDOR

from ...support.modbus import MODELS, SCENARIO, SUNS, at, end, start
from ...support.processes import GFMHIL, PATIENCE_S, running, wait_for

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Iterator[Path]:
    """The folder of a run that lasts longer than these tests."""
    folder = tmp_path_factory.mktemp("modbus") / "run"
    with running(folder, SCENARIO):
        yield folder


@pytest.fixture(scope="module")
def port(run) -> Iterator[int]:
    process, port = start(run)
    yield port
    assert process.poll() is None  # it survived all its clients
    end(process)


@pytest.fixture
def device(port) -> Iterator[SunSpecModbusClientDeviceTCP]:
    """pysunspec2's client, with the vendor model's file."""
    sunspec.set_model_defs_path([MODELS, sunspec.models_dir])
    found = SunSpecModbusClientDeviceTCP(slave_id=1, ipport=port, timeout=20)
    found.scan()
    yield found
    for model, points in ((704, ("WSetEna", "VarSetEna")), (705, ("Ena",)), (711, ("Ena",))):
        for name in points:
            write(found, model, **{name: 0})
    write(found, VENDOR, Law=1)
    found.close()


def write(device, model: int, **values: float) -> None:
    """Write values, in their units, to points of a model, in one write of the model."""
    target = device.models[model][0]
    for name, value in values.items():
        target.points[name].cvalue = value
    target.write()


def read(device, model: int, name: str):
    device.models[model][0].read()
    return device.models[model][0].points[name].cvalue


def last(run: Path) -> dict:
    operator = Operator(run)
    try:
        return operator.snapshot()
    finally:
        operator.close()


def told(run: Path) -> list[dict]:
    lines = (run / "events_controller.jsonl").read_text("utf-8").splitlines()
    return [e for e in map(json.loads, lines) if e.get("by") == "operator"]


def settled(run: Path) -> list[dict]:
    """The same once no more lines come: a run writes its log some time after the command's tick."""
    lines = told(run)
    while True:
        time.sleep(0.3)
        if (now := told(run)) == lines:
            return now
        lines = now


def test_scan_and_read_all_models(device, run):
    there = [m.model_id for m in device.model_list]
    assert there == [1, 701, 702, 704, 705, 711, 714, 715, NUMBER, VENDOR]
    for model in device.model_list:
        model.read()
        assert not model.error_info
    assert device.models[1][0].Mn.value == "gfmhil"
    ac = device.models[701][0]
    assert ac.DERMode.value == 1 << 1 and ac.W.cvalue == pytest.approx(2000, abs=300)
    assert ac.LLV.cvalue == pytest.approx(380, rel=0.05) and ac.Hz.cvalue == pytest.approx(50, 0.05)
    assert device.models[702][0].WMaxRtg.cvalue == 4000
    assert device.models[714][0].Prt[0].DCV.cvalue == pytest.approx(700, rel=0.05)
    ours = device.models[VENDOR][0]
    assert [law.Nm.value for law in ours.Laws] == last(run)["laws"]
    assert ours.Miss.value <= last(run)["misses"] and ours.SlkP50.value < 500  # µs: T_s


def test_p_and_q(device, run):
    write(device, 704, WSetEna=1, WSet=3000)  # the enable has the lower address: first
    write(device, 704, VarSetEna=1, VarSetMod=4, VarSet=400)
    wait_for(lambda: (last(run)["ref_P_ref"], last(run)["ref_Q_ref"]) == (0.75, 0.1))
    wait_for(lambda: abs(read(device, 701, "W") - 3000) < 100)
    assert read(device, VENDOR, "PRef") == 0.75
    assert read(device, NUMBER, "WSet") == 3000
    write(device, NUMBER, WSet=2400)  # the draft's set-point acts at once
    wait_for(lambda: last(run)["ref_P_ref"] == 0.6)
    write(device, 704, WSetEna=0)
    wait_for(lambda: (last(run)["ref_P_ref"], last(run)["ref_Q_ref"]) == (0.5, 0.1))


@pytest.mark.attack(
    "10.6", "who moved the set-point over Modbus?", '`by`: "operator", with no name'
)
def test_the_log_says_who_commanded(device, run, attack_now):
    before = len(settled(run))
    write(device, 704, WSetRvrtTms=1, WSetEna=1, WSet=3100)
    wait_for(lambda: any("name" in line["operator"] for line in told(run)[before:]))
    write(device, 704, WSetRvrtTms=0)
    operators = [line["operator"] for line in told(run)[before:]]
    (timer,) = (one for one in operators if "name" in one)
    assert timer == {"through": "modbus", "name": "timer"}
    clients = [one for one in operators if one is not timer]
    assert clients
    for client in clients:
        assert client.pop("peer").startswith("127.0.0.1:") and client == {"through": "modbus"}
    attack_now(f"address and port of the client; `{json.dumps(timer)}` for the taking back")


def test_droops_and_voltage(device, run):
    control = device.models[711][0]
    for name in ("KOf", "KUf"):
        control.Ctl[1].points[name].cvalue = 0.02
    control.write()
    write(device, 711, Ena=1, AdptCtlReq=2)
    assert last(run)["gains"] == {"D_p": 0.02}
    assert control.Ctl[0].KOf.cvalue == pytest.approx(0.01)
    control.read()
    assert control.Ctl[0].KOf.cvalue == pytest.approx(0.02) and control.AdptCtlRslt.value == 1
    curve = device.models[705][0]
    curve.read()
    for point, V in zip(curve.Crv[1].Pt, (92.0, 108.0), strict=True):
        point.V.cvalue = V
    curve.Crv[1].VRef.cvalue = 101.0
    curve.write()
    write(device, 705, Ena=1, AdptCrvReq=2)
    wait_for(lambda: last(run)["ref_V_ref"] == pytest.approx(1.01))
    assert last(run)["gains"] == {"D_p": 0.02, "D_q": pytest.approx(0.08)}
    assert read(device, VENDOR, "Dq") == pytest.approx(0.08)


def test_the_client_s_heartbeat_and_ours(device, run):
    ours = read(device, 715, "DERHb")
    wait_for(lambda: read(device, 715, "DERHb") > ours)
    timeout_ms = 400
    write(device, VENDOR, HbTms=timeout_ms)
    for beat in range(1, 6):
        write(device, 704, WSetEna=1, WSet=3000)
        lost = read(device, VENDOR, "HbLost")
        before = time.monotonic()
        write(device, 715, ControllerHb=beat)
        wait_for(lambda lost=lost: read(device, VENDOR, "HbLost") > lost)
        seen_ms = (time.monotonic() - before) * 1e3
        wait_for(lambda: last(run)["ref_P_ref"] == 0.5)
        wait_for(lambda: read(device, 704, "WSetEna") == 0)  # once the run has answered
        # never early, except for the rounding to ms. It may be late by at most a tick of the clock:
        # test_modbus_device tests that with a simulated clock, since this machine may be busy.
        assert seen_ms >= timeout_ms and read(device, VENDOR, "HbLate") >= timeout_ms - 1
    write(device, VENDOR, HbTms=0)


def test_a_trip_and_the_reset(device, run):
    operator = Operator(run)
    operator.command({"type": "grid-phase-jump", "degrees": 170.0})
    operator.command({"type": "grid-voltage", "V_g": 0.0})
    wait_for(lambda: read(device, 701, "InvSt") == 6)
    assert read(device, 701, "Alrm") != 0 and read(device, 701, "St") == 0
    assert read(device, VENDOR, "SafeRsn") and read(device, 715, "OpCtl") == 0
    write(device, 715, AlarmReset=1)
    wait_for(lambda: read(device, 701, "InvSt") == 3)
    assert read(device, 701, "Alrm") == 0 and last(run)["ref_P_ref"] == 0.5
    operator.close()


def test_local_control(device, run):
    assert subprocess.run([*GFMHIL, "modbus", str(run), "--control", "local"]).returncode == 0
    wait_for(lambda: read(device, 715, "LocRemCtl") == 1)
    with pytest.raises((ModbusClientException, SunSpecModbusClientException), match="1"):
        write(device, 704, WSetEna=1, WSet=3000)
    assert subprocess.run([*GFMHIL, "modbus", str(run), "--control", "remote"]).returncode == 0
    wait_for(lambda: read(device, 715, "LocRemCtl") == 0)


def frame(payload: bytes, transaction: int = 1, unit: int = 1) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(payload) + 1, unit) + payload


def answer(connection: socket.socket) -> tuple[int, bytes]:
    """Transaction and PDU of the next answer; (-1, b"") if the server has disconnected."""

    def exactly(count: int) -> bytes:
        found = b""
        while len(found) < count:
            more = connection.recv(count - len(found))
            if not more:
                return b""
            found += more
        return found

    header = exactly(7)
    if not header:
        return -1, b""
    transaction, _, length, _ = struct.unpack(">HHHB", header)
    return transaction, exactly(length - 1)


def test_bad_writes_get_exceptions_and_change_nothing(device, run, port):
    def settings() -> dict:
        seen = last(run)
        kept = [k for k in seen if k.startswith("ref_")]
        return {k: seen[k] for k in (*kept, "active", "gains", "state")} | {"told": settled(run)}

    before = settings()
    w_set, law = at(device, 704, "WSet"), at(device, VENDOR, "Law")
    with ModbusTcpClient("127.0.0.1", port=port) as plain:
        for address, registers, code in (
            (w_set, [0x7FFF, 0xFFFF], 3),  # out of range
            (w_set, [0x7FFF], 2),  # part of a point
            (law, [0], 3),
            (law, [99], 3),
            (at(device, 704, "VarSetMod"), [2], 3),
            (at(device, 701, "W"), [0], 2),  # read-only
            (at(device, 702, "WMax"), [1], 2),
            (SUNS, [0, 0], 2),
            (at(device, 704, "WSetEna"), [1] * 60, 2),  # includes read-only points
            (50000, [1], 2),  # no such address
            (65535, [1], 2),
        ):
            found = plain.write_registers(address, registers, device_id=1)
            assert (found.isError(), found.exception_code) == (True, code), address
        assert plain.write_register(law, 77, device_id=1).exception_code == 3
        assert plain.write_coil(law, True, device_id=1).exception_code == 1
        assert plain.mask_write_register(address=law, or_mask=2, device_id=1).exception_code == 1
        assert plain.read_holding_registers(SUNS, count=2, device_id=9).exception_code == 0x0B
        assert plain.read_holding_registers(SUNS, count=2, device_id=1).registers == [
            0x5375,
            0x6E53,
        ]
    many = struct.pack(">HHB", w_set, 124, 248) + bytes(248)
    for pdu, code in (
        (b"\x10" + many, 3),  # oversize
        (b"\x10" + struct.pack(">HHB", w_set, 2, 2) + bytes(4), 3),  # contradictory counts
        (b"\x10" + struct.pack(">HHB", w_set, 0, 0), 3),
        (b"\x10" + struct.pack(">H", w_set), 3),  # cut short
        (b"\x03" + struct.pack(">HH", SUNS, 126), 3),
        (b"\x03" + struct.pack(">HH", SUNS, 0), 3),
        (b"\x03\x9c", 3),
        (b"\x03" + struct.pack(">HH", 65535, 2), 2),
        (b"\x08" + struct.pack(">HH", 4, 0), 1),  # "listen only": not obeyed
        (b"\x2b\x0e\x01\x00", 1),
        (b"\x00", 1),
        (b"\xff" * 40, 1),
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
            raw.sendall(frame(pdu, transaction=7))
            assert answer(raw) == (7, bytes([pdu[0] & 0x7F | 0x80, code])), pdu
    for garbage in (
        b"GET / HTTP/1.1\r\nHost: bench\r\n\r\n",
        struct.pack(">HHHB", 1, 0, 60000, 1) + bytes(600),
        struct.pack(">HHHB", 1, 5, 6, 1) + bytes(5),
        struct.pack(">HHHB", 1, 0, 1, 1),
        bytes(range(255, 0, -1)),
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
            raw.sendall(garbage)
            assert answer(raw) == (-1, b"")  # it has disconnected
    with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
        raw.sendall(frame(b"\x10" + struct.pack(">HHB", law, 1, 2) + b"\0\2")[:-1])  # then silence
    assert settings() == before


def test_requests_sent_without_waiting_are_answered_in_order(device, port, run):
    law, reset = at(device, VENDOR, "Law"), at(device, 715, "AlarmReset")
    requests = [frame(b"\x06" + struct.pack(">HH", reset, 1), transaction=99)]
    for k in range(8):  # the last one wins
        requests.append(frame(b"\x06" + struct.pack(">HH", law, 1 + k % 2), transaction=2 * k))
        requests.append(frame(b"\x03" + struct.pack(">HH", law, 1), transaction=2 * k + 1))
    with socket.create_connection(("127.0.0.1", port), timeout=20) as raw:
        raw.sendall(b"".join(requests))
        assert answer(raw) == (99, b"\x06" + struct.pack(">HH", reset, 1))  # an echo
        for k in range(8):
            assert answer(raw) == (2 * k, b"\x06" + struct.pack(">HH", law, 1 + k % 2))
            assert answer(raw) == (2 * k + 1, b"\x03\x02" + struct.pack(">H", 1 + k % 2))


def test_a_certificate_is_asked_of_every_client(run, tmp_path):
    authority, stranger = trustme.CA(), trustme.CA()
    files = {name: str(tmp_path / name) for name in ("cert", "key", "ca", "mine", "theirs")}
    server = authority.issue_cert("127.0.0.1")
    server.private_key_pem.write_to_path(files["key"])
    server.cert_chain_pems[0].write_to_path(files["cert"])
    authority.cert_pem.write_to_path(files["ca"])
    mine = authority.issue_cert("operator@bench", common_name="Ada")
    mine.private_key_and_cert_chain_pem.write_to_path(files["mine"])
    stranger.issue_cert("nobody@bench").private_key_and_cert_chain_pem.write_to_path(
        files["theirs"]
    )
    process, port = start(run, "--tls", files["cert"], files["key"], files["ca"])
    try:
        sunspec.set_model_defs_path([MODELS, sunspec.models_dir])
        known = SunSpecModbusClientDeviceTCP(
            slave_id=1, ipport=port, timeout=20, tls=True, cafile=files["ca"],
            certfile=files["mine"], keyfile=files["mine"],
        )  # fmt: skip
        known.scan()
        assert known.models[1][0].Mn.value == "gfmhil"
        write(known, 704, WSetEna=1, WSet=2200)
        wait_for(lambda: last(run)["ref_P_ref"] == 0.55)
        # the loop records the reference before the log has the line
        wait_for(lambda: told(run) and "certificate" in told(run)[-1]["operator"])
        assert "commonName=Ada" in told(run)[-1]["operator"]["certificate"]
        write(known, 704, WSetEna=0)
        known.close()
        for certificate in (None, files["theirs"]):
            context = ssl.create_default_context(cafile=files["ca"])
            if certificate:
                context.load_cert_chain(certificate)
            with (
                pytest.raises((ssl.SSLError, ConnectionError)),
                socket.create_connection(("127.0.0.1", port), timeout=20) as raw,
                context.wrap_socket(raw, server_hostname="127.0.0.1") as secure,
            ):
                secure.sendall(frame(b"\x03" + struct.pack(">HH", SUNS, 2)))
                if answer(secure) == (-1, b""):
                    raise ConnectionError
    finally:
        end(process)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--host", "bench"], "--host bench: goes beyond this machine"),
        (["--heartbeat", "-1"], "--heartbeat -1: must be >= 0"),
        (["--tls", "no", "no", "no"], "--tls no no no: "),
        (["--host", "192.0.2.1", "--anyone-may-command"], "cannot listen there"),
    ],
)
def test_wrong_options(run, options, words, refused, monkeypatch):
    monkeypatch.setattr("os.nice", lambda by: by)  # it would last for all of pytest
    assert words in refused("modbus", str(run), *options)


@pytest.mark.parametrize(("number", "option"), [(VENDOR, []), (NUMBER, [str(NUMBER)])])
def test_the_models_that_sunspec_lacks_are_files_for_clients(number, option, capsys):
    assert main(["modbus", "--vendor-model", *option]) == 0
    assert json.loads(capsys.readouterr().out)["id"] == number


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
