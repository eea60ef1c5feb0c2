"""Modbus, streams and metrics of a network: each converter under its own unit, topic and label."""

import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import sunspec2.device as sunspec
from sunspec2.modbus.client import SunSpecModbusClientDeviceTCP

from gfm_hil.cli import main
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.streams import BlockReader

from ...support.modbus import MODELS, end, start
from ...support.processes import GFMHIL, running, wait_for

pytestmark = [pytest.mark.processes, pytest.mark.timeout(900)]  # compiles the loops of a network

NETWORK = """
title = "two"
duration = 300.0
T_s = 1e-3
mode = "realtime"
law = "droop-5"
late_policy = { hold = 100000 }
link = { type = "shm", peer_timeout_s = 30.0 }
[plant]
delay = { samples = 1 }
dc_source = { mode = "regulated" }
[network.converters.A]
node = "bus"
references = { P_ref = 0.2 }
[network.converters.B]
node = "bus"
references = { P_ref = 0.4 }
[network.loads.base]
node = "bus"
P = 0.6
Q = 0.1
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> Iterator[Path]:
    """The folder of a network's run that lasts longer than these tests."""
    folder = tmp_path_factory.mktemp("network") / "run"
    with running(folder, NETWORK, converters="AB"):
        yield folder


def references(run: Path) -> dict[str, float]:
    """P_ref in force by converter."""
    found = {}
    for name in "AB":
        operator = Operator(run / name)
        found[name] = operator.snapshot()["ref_P_ref"]
        operator.close()
    return found


def test_each_converter_is_a_unit_that_is_commanded_alone(two):
    process, port = start(two)
    try:
        sunspec.set_model_defs_path([MODELS, sunspec.models_dir])
        units = {}
        for unit in (1, 2):
            units[unit] = SunSpecModbusClientDeviceTCP(slave_id=unit, ipport=port, timeout=20)
            units[unit].scan()
        common = {unit: device.models[1][0] for unit, device in units.items()}
        assert [(m.points["DA"].value, m.points["Opt"].value) for m in common.values()] == [
            (1, "A"), (2, "B"),
        ]  # fmt: skip
        rated = units[2].models[702][0].points["WMaxRtg"].cvalue
        target = units[2].models[704][0]
        target.points["WSetMod"].value, target.points["WSet"].cvalue = 1, round(0.3 * rated)
        target.points["WSetEna"].value = 1
        target.write()
        wait_for(lambda: references(two)["B"] == pytest.approx(0.3, abs=1e-3))
        assert references(two)["A"] == 0.2
        with pytest.raises(Exception, match=r"(?i)exception|error"):
            SunSpecModbusClientDeviceTCP(slave_id=3, ipport=port, timeout=20).scan()
    finally:
        end(process)


def test_the_streams_name_the_converter(two):
    ports = "--port", "0", "--prometheus", "0"
    process = subprocess.Popen(
        [*GFMHIL, "stream", str(two), *ports], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        said = [process.stdout.readline().split() for _ in range(3)]
        blocks, metrics = said[1][1], said[2][1]
        seen: dict[tuple[str, str], list[int]] = {}
        with BlockReader(blocks) as reader:
            until = time.monotonic() + 30.0
            while len(seen) < 4 or min(map(len, seen.values())) < 1000:
                assert time.monotonic() < until, {key: len(x) for key, x in seen.items()}
                if (block := reader.receive(1.0)) is not None:
                    key = block.converter, block.role
                    seen.setdefault(key, []).extend(block.rows["tick"].tolist())
        assert {*seen} == {(name, role) for name in "AB" for role in ("plant", "controller")}
        assert all((np.diff(ticks) == 1).all() for ticks in seen.values())
        with BlockReader(blocks, "plant", "B") as reader:
            assert {(b.converter, b.role) for _ in range(5) if (b := reader.receive(5.0))} == {
                ("B", "plant")
            }
        text = urllib.request.urlopen(metrics).read().decode()
        assert text.count("# TYPE gfmhil_state gauge") == 1
        for name in "AB":
            assert f'gfmhil_state{{converter="{name}",state="RUNNING"}} 1.0' in text
            assert f'gfmhil_ticks_total{{converter="{name}",role="plant"}}' in text
    finally:
        end(process)


def test_a_port_of_one_converter_says_so(tmp_path, capsys):
    file = tmp_path / "two.toml"
    file.write_text(NETWORK)
    assert main(["run", str(file), "--out", str(tmp_path / "run"), "--xcp"]) == 2
    assert "--xcp: looks at one converter" in capsys.readouterr().err
