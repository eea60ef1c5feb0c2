"""The XCP slave: packets by the tables of ASAM MCD-1 XCP, and pyxcp as the master of a run."""

import contextlib
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.ports.xcp.memory import Memory
from gfm_hil.ports.xcp.port import CanFd, xcp_section
from gfm_hil.recording.columns import TABLE
from gfm_hil.recording.log import read_log
from gfm_runtime import law_file

from ...support.modbus import SCENARIO
from ...support.processes import GFMHIL, PATIENCE_S, free_port, running
from ...support.xcp import (
    CONNECT,
    LAWS,
    MASTER,
    MadeUpRun,
    datagram,
    download,
    set_mta,
    short_download,
    short_upload,
    slave,
)

REFERENCES, LAW, GAINS, EACH = 0x8000, 0x9000, 0x10000, 0x1000
VSG_5 = list(law_file("vsg-5").parameters)
D_P = GAINS + EACH + 8 * VSG_5.index("D_p")
A2LTOOL = shutil.which("a2ltool", path=str(Path(sys.executable).parent)) or "a2ltool"


class Line:
    """A master that sends one packet at a time to a slave in this process."""

    def __init__(self, run: MadeUpRun, **more: Any) -> None:
        self.slave = slave(run, **more)
        self.sent = self.answers = 0

    def __call__(self, packet: bytes, peer: Any = MASTER) -> bytes:
        answer = self.slave.take(datagram(packet, counter=self.sent), peer)
        self.sent += 1
        if not answer:
            return b""
        length, counter = struct.unpack_from("<HH", answer)
        assert (length, counter) == (len(answer) - 4, self.answers)
        self.answers += 1
        return answer[4:]

    def numbers(self, address: int, count: int) -> tuple[float, ...]:
        answer = self(short_upload(address, 8 * count))
        assert answer[:1] == b"\xff", answer
        return struct.unpack(f"<{count}d", answer[1:])


@pytest.fixture
def run() -> MadeUpRun:
    return MadeUpRun()


@pytest.fixture
def line(run: MadeUpRun) -> Line:
    made = Line(run)
    made(CONNECT)
    return made


def test_the_answers_of_a_session_are_those_of_the_tables(run):
    line = Line(run)
    assert line(b"\xfd") == b""  # not connected: only CONNECT is answered
    # RESOURCE = CAL, COMM_MODE_BASIC = Intel, bytes, optional; MAX_CTO, MAX_DTO, versions
    assert line(CONNECT) == bytes.fromhex("ff 01 80 ff ff00 01 01")
    assert line(b"\xfd") == bytes.fromhex("ff 00 00 00 0000")  # GET_STATUS
    assert line(b"\xfb") == bytes.fromhex("ff 00 00 00 00 00 00 10")  # GET_COMM_MODE_INFO
    assert line(b"\xfa\x00") == bytes.fromhex("ff 01 0000 06000000") + b"gfmhil"  # GET_ID
    epk = line(b"\xfa\x05")  # what the memory is of; also where the A2L file says
    assert re.fullmatch(rb"gfmhil [\d.]+; [0-9a-f]{32}", epk[8:]) and epk[4] == len(epk) - 8
    assert line(b"\xf4\x07\0\0" + (0x800).to_bytes(4, "little"))[1:] == epk[8:15]
    assert line(b"\xf5\x05")[1:] == epk[15:20]  # and on
    assert line(b"\xf4\x07\0\0" + (0x830).to_bytes(4, "little")) == b"\xfe\x22"
    assert line(b"\xfa\x03") == bytes.fromhex("ff 01 0000 00000000")  # no URL
    assert line(b"\xfc") == b"\xfe\x00"  # SYNCH is answered by ERR_CMD_SYNCH
    assert line(b"\xf8\x00\x01") == b"\xfe\x20"  # GET_SEED: ERR_CMD_UNKNOWN
    assert line(b"\xf6\x00") == b"\xfe\x21"  # SET_MTA too short: ERR_CMD_SYNTAX
    assert line(b"") == b"\xfe\x21"
    assert line(b"\xfe") == b"\xff"  # DISCONNECT
    assert line(b"\xfd") == b""
    assert Line(run, writes=False)(CONNECT)[1] == 0  # no CAL


@pytest.mark.attack(
    "23.5", "a datagram of 1.5 kB from a forged address that connects and uploads",
    "16.5 kB to that address",
)  # fmt: skip
def test_a_datagram_that_connects_brings_no_more_than_its_answer(run, attack_now):
    made = slave(run)
    file, piece = datagram(b"\xfa\x04"), datagram(b"\xf5\xf0")
    asked = datagram(CONNECT) + file + 240 * piece
    said = made.take(asked, MASTER)
    assert said[4:12] == bytes.fromhex("ff 01 80 ff ff00 01 01")
    assert len(said) <= len(asked)
    assert len(made.take(file + 2 * piece, MASTER)) > 2 * 0xF0  # it has connected
    forged = made.take(asked, ("192.0.2.1", 1))
    assert forged[4:] == b"\xfe\x33"  # one master at a time
    attack_now(f"{len(said)} bytes, and {len(forged)} beside a master")


@pytest.mark.attack("23.5", "a master that asks for what there is not, for ever", "a line for each")
def test_the_log_of_refusals_is_bounded(run, attack_now):
    told: list[str] = []
    line = Line(run, notice=told.append)
    line(CONNECT)
    for _ in range(3000):
        assert line(b"\xf8\x00\x01") == b"\xfe\x20"
    assert len(told) == 1000
    assert told[-1].endswith("; further refusals are not told")
    attack_now(f"{len(told)} lines, the last of which says so")


def test_the_file_is_uploaded_in_pieces_and_a_parser_reads_it(line, tmp_path):
    answer = line(b"\xfa\x04")
    assert answer[:4] == bytes.fromhex("ff 00 0000")
    size, text = struct.unpack("<I", answer[4:])[0], b""
    while len(text) < size:
        text += line(bytes([0xF5, min(254, size - len(text))]))[1:]
    assert line(b"\xf5\x01") == b"\xfe\x22"  # behind its end
    file = tmp_path / "bench.a2l"
    file.write_bytes(text)
    subprocess.run([A2LTOOL, file, "--strict", "--check"], check=True, capture_output=True)
    assert b'2 "vsg-2"' in text  # the law in words
    where = dict(re.findall(r"CHARACTERISTIC (\S+) .*\n\s*VALUE (0x\w+)", text.decode()))
    for k, law in enumerate(LAWS):
        for j, name in enumerate(law_file(law).parameters):
            assert int(where[f"{law.replace('-', '_')}.{name}"], 16) == GAINS + EACH * k + 8 * j


def test_measurements_are_read_from_one_tick(line, run):
    plant = [name for name in run.now if name in TABLE and name.startswith(("y_", "u_", "true_"))]
    assert line.numbers(0x1000, 4) == (7.0, *(run.now[name] for name in plant[:3]))
    whole = line(short_upload(0x1000, 32))
    assert line(short_upload(0x1003, 18)) == b"\xff" + whole[4:22]  # tools may read any bytes
    line(set_mta(0x1008))  # UPLOAD goes on where it ended
    halves = line(b"\xf5\x08")[1:] + line(b"\xf5\x08")[1:]
    assert struct.unpack("<2d", halves) == (run.now[plant[0]], run.now[plant[1]])
    assert line.numbers(LAW, 1) == (1.0,)
    assert line.numbers(D_P, 1) == (law_file("vsg-5").parameters["D_p"].value,)
    last = 0x1000 + 8 * sum(name in TABLE for name in run.now)  # the tick is the first
    for packet in (
        short_upload(last, 8), short_upload(0xFFFFFFFC, 8), short_upload(0, 1),
        short_upload(0x1000, 8, extension=2), short_upload(0x1000, 255), short_upload(0x1000, 0),
    ):  # fmt: skip
        assert line(packet) == b"\xfe\x22"
    run.now = {}
    assert line(short_upload(0x1000, 8)) == b"\xfe\x33"  # the run has not begun


def test_a_write_is_one_command_with_all_its_values(line, run):
    assert line(short_download(REFERENCES + 8, 0.8)) == b"\xff"
    line(set_mta(REFERENCES))
    assert line(download(1.0, 0.7, 1.0, 0.1, 1.0)) == b"\xff"
    assert line(download(1.0)) == b"\xfe\x22"  # the next cell is no memory
    assert run.told == [
        {"type": "reference", "P_ref": 0.8},
        {"type": "reference", "V_dcref": 1.0, "P_ref": 0.7, "omega_g": 1.0, "Q_ref": 0.1,
         "V_ref": 1.0},
    ]  # fmt: skip
    assert line.numbers(REFERENCES + 8, 1) == (0.7,)
    run.told.clear()
    assert line(short_download(D_P, 0.02)) == line(short_download(D_P, 0.02)) == b"\xff"
    assert run.told == [{"type": "gains", "values": {"D_p": 0.02}}]  # once: no change later
    assert line.numbers(D_P, 1) == (0.02,)
    assert line(short_download(LAW, 2.0)) == b"\xff"
    assert run.told[-1] == {"type": "law", "law": "vsg-2"}
    assert line.numbers(D_P, 1) == (law_file("vsg-5").parameters["D_p"].value,)
    assert line(short_download(D_P, 0.02)) == b"\xfe\x24"  # not the law in force


def test_what_is_wrong_is_refused_and_changes_nothing(run):
    said: list[str] = []
    line = Line(run, notice=said.append)
    line(CONNECT)
    for packet, code in (
        (short_download(REFERENCES + 8, 9.0), 0x22),
        (short_download(REFERENCES + 8, float("nan")), 0x22),
        (short_download(D_P, float("inf")), 0x22),
        (short_download(LAW, 3.0), 0x22),
        (short_download(LAW, 0.5), 0x22),
        (short_download(REFERENCES + 1, 0.5), 0x22),
        (short_download(REFERENCES + 8, 0.5)[:-1], 0x21),
        (b"\xed\x04\0\0" + struct.pack("<Id", REFERENCES, 1.0), 0x22),  # half a number
        (short_download(REFERENCES), 0x22),
        (short_download(0x1008, 1.0), 0x23),
        (short_download(0x2000, 1.0), 0x22),
    ):
        assert line(packet) == bytes([0xFE, code]), packet
    assert "refused: P_ref = 9.0: must lie in [-2, 2] p.u." in said
    run.refuses = "more than 100 commands a second"
    assert line(short_download(REFERENCES + 8, 0.5)) == b"\xfe\x24"
    assert said[-1] == "refused: more than 100 commands a second"
    reader = Line(run, writes=False)
    reader(CONNECT)
    assert reader(short_download(REFERENCES + 8, 0.5)) == b"\xfe\x23"
    assert not run.told


def test_one_master_at_a_time_until_it_is_silent(run):
    now, other = [0.0], ("127.0.0.1", 40001)
    line = Line(run, clock=lambda: now[0])
    line(CONNECT)
    assert line(b"\xfd", other) == b"" and line(CONNECT, other) == b"\xfe\x33"
    now[0] = 29.0
    assert line(b"\xfd")[:1] == b"\xff"
    now[0] = 58.0
    assert line(CONNECT, other) == b"\xfe\x33"
    now[0] = 60.0
    assert line(CONNECT, other)[:1] == b"\xff" and line(b"\xfd") == b""


def test_several_packets_of_a_datagram_and_what_is_no_packet(run):
    one = slave(run)
    answer = one.take(datagram(CONNECT, b"\xfc", b"\xfd"), MASTER)
    assert answer == datagram(bytes.fromhex("ff0180ffff000101"), b"\xfe\0", b"\xff" + bytes(5))
    for wrong in (b"\x05\0\0\0\xfd", b"\0\0\0\0", struct.pack("<HH", 256, 0) + bytes(256)):
        assert one.take(wrong, MASTER)[4:] == b"\xfe\x21"
    assert one.take(b"\x01\0\0", MASTER) == b""


def test_on_a_can_bus_a_frame_is_a_packet(run, tmp_path):
    line = CanFd("virtual", "xcp", "0x123,0x124")
    one = slave(run, most=line.most)
    with can.Bus(interface="virtual", channel="xcp", fd=True) as bus, line:

        def ask(packet: bytes, arbitration_id: int = 0x123) -> bytes:
            size = next(n for n in (8, 12, 16, 64) if n >= len(packet))
            data = packet.ljust(size, b"\0")
            bus.send(can.Message(
                arbitration_id=arbitration_id, is_extended_id=False, is_fd=True, data=data
            ))  # fmt: skip
            line.answer(one, 0.05)
            heard = bus.recv(0)
            if heard is None:
                return b""
            assert heard.arbitration_id == 0x124 and heard.is_fd
            return bytes(heard.data)

        assert ask(CONNECT) == bytes.fromhex("ff 01 80 40 4000 01 01")  # MAX_CTO, MAX_DTO: 64
        answer = ask(short_upload(0x1000, 16))
        assert struct.unpack_from("<2d", answer, 1) == (7.0, run.now["y_v_dc"])
        assert len(answer) == 20 and answer[17:] == bytes(3)  # 17 bytes fill a frame of 20
        assert ask(short_upload(0x1000, 64))[:2] == b"\xfe\x22"
        assert ask(short_download(REFERENCES + 8, 0.8))[:1] == b"\xff"
        assert run.told == [{"type": "reference", "P_ref": 0.8}]
        assert ask(b"\xfd", arbitration_id=0x200) == b""  # of others on the bus
    file = tmp_path / "can.a2l"
    memory = Memory(run, LAWS, False, lambda: 100)
    file.write_text(memory.a2l("bench", xcp_section(line)))
    shown = subprocess.run(
        [A2LTOOL, file, "--strict", "--show-xcp"], check=True, capture_output=True, text=True
    ).stdout.lower()
    assert "can" in shown and ("0x123" in shown or str(0x123) in shown), shown


@contextlib.contextmanager
def mastered(folder: Path, *options: str) -> Iterator[Any]:
    """pyxcp, connected to a slave of the run in a process of its own."""
    from pyxcp.config import create_application_from_config
    from pyxcp.master import Master

    port = free_port()
    command = [*GFMHIL, "xcp", str(folder), "--wait", "--port", str(port), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as served:
        try:
            assert served.stdout is not None and "XCP on UDP" in served.stdout.readline()
            eth = {"host": "127.0.0.1", "port": port, "protocol": "UDP"}
            settings = {"Transport": {"layer": "ETH", "timeout": PATIENCE_S, "Eth": eth}}
            with Master("eth", config=create_application_from_config(settings)) as master:
                master.connect()
                yield master
                master.disconnect()
        finally:
            served.terminate()


def test_it_waits_for_the_command_server_not_for_the_recording_alone(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    for file in ("scenario.toml", "parts/controller_progress.npy"):
        (tmp_path / file).touch()

    def stop(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gfm_hil.ports.port.time.sleep", stop)
    assert main(["xcp", str(tmp_path), "--wait", "--port", "0"]) == 130


@pytest.mark.processes
def test_pyxcp_measures_and_calibrates_a_run(tmp_path):
    folder = tmp_path / "run"
    with running(folder, SCENARIO) as process:
        with mastered(folder, "--write") as master:
            text = master.identifier(4)
            found = re.findall(
                r"(?:MEASUREMENT|CHARACTERISTIC) (\S+) .*\n.*\s(?:ECU_ADDRESS|VALUE) (0x\w+)"
                r"|MEASUREMENT (\S+) .*\n.*\n\s*ECU_ADDRESS (0x\w+)",
                text,
            )
            where = {a or c: int(b or d, 16) for a, b, c, d in found}

            def read(name: str) -> float:
                return struct.unpack("<d", bytes(master.shortUpload(8, where[name], 0)))[0]

            def write(name: str, value: float) -> None:
                master.setMta(where[name])
                master.download(struct.pack("<d", value))
                assert read(name) == value  # at once, as tools read back

            first = read("tick")
            write("P_ref", 0.8)
            write("active_law", 1.0)
            write("vsg_5_tuned.D_p", 0.012)
            assert read("tick") > first and read("ref_P_ref") == 0.8
            with pytest.raises(BaseException, match="OUT_OF_RANGE"):
                master.setMta(where["P_ref"])
                master.download(struct.pack("<d", 9.0))
            assert read("P_ref") == 0.8
        with mastered(folder) as master, pytest.raises(BaseException, match="WRITE_PROTECTED"):
            master.setMta(where["P_ref"])
            master.download(struct.pack("<d", 0.5))
        a2l = tmp_path / "run.a2l"
        assert main(["xcp", str(folder), "--a2l", str(a2l), "--port", "5556"]) == 0
        shown = subprocess.run(
            [A2LTOOL, a2l, "--strict", "--show-xcp"], check=True, capture_output=True, text=True
        ).stdout
        assert "port: 5556" in shown
        process.send_signal(2)
        process.wait(PATIENCE_S)
    told = [e for e in read_log(folder / "events.jsonl") if e.get("by") == "operator"]
    assert [e["operator"]["through"] for e in told] == ["xcp"] * 3
    with np.load(folder / "signals.npz") as file:
        # the plant may have sampled once more before it ended
        steps = [x[~np.isnan(x)][-1] for x in (file["ref_P_ref"], file["law"])]
    assert steps == [0.8, 3.0]  # the law's fourth entry: vsg-5-tuned with its new gain
