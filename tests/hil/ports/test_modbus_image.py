"""The whole register image: content, scale factors, page, and the server's errors."""

import asyncio
import importlib.util
import struct
from pathlib import Path

import pytest
from pymodbus.simulator import DataType, SimData, SimDevice

from gfm_hil.ports.modbus.grid_forming import NUMBER
from gfm_hil.ports.modbus.image import BASE, VENDOR
from gfm_hil.ports.modbus.port import Server

from ...support.laws import every_law
from ...support.modbus_device import S_N, Bench


def test_the_image_is_a_sunspec_map():
    registers = Bench().device.image.registers
    assert struct.pack(">2H", *registers[:2]) == b"SunS"
    at, found = 2, []
    while registers[at] != 0xFFFF:
        found.append(registers[at])
        at += 2 + registers[at + 1]
    assert found == [1, 701, 702, 704, 705, 711, 714, 715, NUMBER, VENDOR]
    assert at + 2 == len(registers)


@pytest.mark.parametrize("law", every_law())
def test_the_droops_of_every_law_are_those_of_its_file_or_none(law):
    from gfm_hil.ports.modbus.points import LawDroops

    gains = LawDroops([law])
    found = gains.droops(law, {})
    assert found.D_p in (None, 0.01) and found.D_q in (None, 0.05)
    for name in ("D_p", "D_q"):
        if getattr(found, name) is not None:
            gains.event(law, {}, {name: 0.03})
            assert getattr(gains.droops(law, {name: 0.03}), name) == 0.03


def test_scale_factors_are_constant_and_everything_fits():
    bench = Bench()
    scale = {p.path for p in bench.device.image.points.values() if p.type == "sunssf"}
    before = {path: bench.read(path) for path in scale}
    for sign in (1.0, -1.0):  # the ends of the signal table's ranges
        bench.row |= {"y_p": 6.0 * sign, "y_q": -6.0 * sign, "y_V": 3.0, "u_i_u": 6.0 * sign}
        bench.row |= {"y_v_dc": 3.0, "y_omega_u": 1.3}
        assert bench.read("701.W") == 6 * S_N * sign and bench.read("701.Var") == -6 * S_N * sign
        assert bench.read("701.LLV") == 3 * 380 and bench.read("701.Hz") == pytest.approx(65)
        assert bench.read("714.Prt1.DCV") == 3 * 700
        assert bench.read("714.DCW") == pytest.approx(18 * S_N * sign, rel=1e-3)
    assert {path: bench.read(path) for path in scale} == before


def test_the_reference_page_says_what_may_be_written():
    path = Path(__file__).resolve().parents[3] / "docs" / "_ext" / "modbus_pages.py"
    spec = importlib.util.spec_from_file_location("modbus_pages", path)
    pages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pages)
    rows = [line.split(" | ") for line in pages.registers().splitlines() if line.startswith("| 4")]
    said = {int(r[0].strip("| ")): r[5] for r in rows}
    device = Bench().device
    ours = {p.address for p in device.image.points.values() if device.writable(p)}
    assert {address for address, access in said.items() if access == "RW"} == ours


def test_a_fault_of_ours_is_an_exception_for_the_client_and_not_silence(caplog):
    async def broken(*request):
        raise RuntimeError("of ours")

    async def ask() -> bytes:
        block = SimData(BASE, values=[0] * 4, datatype=DataType.REGISTERS)
        server = Server([SimDevice(id=1, simdata=[block], action=broken)], ("127.0.0.1", 0), None)
        await server.serve_forever(background=True)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.peers.port)
        writer.write(struct.pack(">HHHBBHH", 5, 0, 6, 1, 3, BASE, 2))
        answer = await reader.readexactly(9)
        writer.close()
        await server.shutdown()
        return answer

    assert asyncio.run(ask()) == struct.pack(">HHHBBB", 5, 0, 3, 1, 0x83, 4)
    assert "of ours" in caplog.text
