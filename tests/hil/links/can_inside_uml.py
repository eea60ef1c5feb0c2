"""Real SocketCAN: ``test_can_uml`` runs it inside user-mode Linux, where vcan0 is a CAN FD bus.

GFMHIL_TEST_BUS: an endpoint to use instead, to compile everything where that is faster.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.core.errors import PeerLost
from gfm_hil.recording.parts import RolePart
from gfm_hil.scenario import Scenario, check_scenario, toml_text

from ...support.can_reference import quantised_run
from ...support.links import Pair, run_pair

ENDPOINT = os.environ.get("GFMHIL_TEST_BUS", "can://vcan0")
LINK = {"type": "can", "endpoint": ENDPOINT, "peer_timeout_s": 60.0, "start_timeout_s": 300.0}
EVENTS = [
    {"tick": 50, "type": "reference", "P_ref": 0.55},
    {"tick": 150, "type": "grid-frequency", "f_hz": 49.99},
]

pytestmark = pytest.mark.timeout(700)


def content(duration: float = 0.1, **link: Any) -> dict[str, Any]:
    return {"title": "test", "duration": duration, "events": EVENTS, "link": {**LINK, **link}}


def made(duration: float = 0.1, **options: Any) -> Scenario:
    return check_scenario(content(duration, options=options), "test")


def over_vcan(
    scenario: Scenario, folder: Path, meanwhile: Callable[[], None] = lambda: None
) -> Pair:
    """Run both sides in threads of this process, since one more takes long to start here; calls
    ``meanwhile`` after 100 ticks."""
    waiting = [meanwhile]

    def look() -> bool:
        part = RolePart.open(folder, "plant")
        if part is not None and part.progress[0] >= 100:
            with suppress(IndexError):  # done before
                waiting.pop()()
        return False

    options = scenario.link.options
    return run_pair(scenario, folder, "can", options, stopped=look, endpoint=ENDPOINT)


def assert_as_in_process(scenario: Scenario, folder: Path, signals: dict[str, np.ndarray]) -> None:
    every = scenario.link.options.get("every", 1)
    for name, column in quantised_run(scenario, folder, every).items():
        assert signals[name].tobytes() == column.tobytes(), name


@pytest.mark.parametrize("options", [{"portable": True}, {"fd": False, "every": 4, "heartbeat": 7}])
def test_lockstep_over_vcan_is_a_run_in_process_in_counts(options, tmp_path):
    """As the flooded bus below is with no option."""
    scenario = made(**options)
    assert_as_in_process(scenario, tmp_path, over_vcan(scenario, tmp_path / "out").signals)


def test_a_flooded_bus(tmp_path):
    """A process that wins every arbitration sends bursts during the whole run."""
    scenario = made()
    with subprocess.Popen([sys.executable, "-c", _FLOOD], stdout=subprocess.PIPE) as flooder:
        assert flooder.stdout is not None and flooder.stdout.readline()
        try:
            pair = over_vcan(scenario, tmp_path / "out")
            assert flooder.poll() is None
        finally:
            flooder.kill()
    assert_as_in_process(scenario, tmp_path, pair.signals)


_FLOOD = """
import contextlib, socket, struct, time
with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
    bus.bind(("vcan0",))
    print("flooding", flush=True)
    while True:
        for _ in range(10):
            with contextlib.suppress(OSError):  # no room
                bus.send(struct.pack("=IB3x8x", 1, 8))
        time.sleep(1e-3)
"""


def test_an_interface_that_goes_down_is_a_lost_peer(tmp_path):
    try:
        # either a send or a poll detects it first
        with pytest.raises(PeerLost, match=r"the CAN bus vcan0 is gone: .*Network is down"):
            over_vcan(made(60.0), tmp_path, lambda: link("down"))
    finally:
        link("up")


def link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True)


def test_bus_off_is_a_lost_peer(tmp_path):
    def bus_off() -> None:
        with can.Bus(interface="socketcan", channel="vcan0", fd=True) as bus:
            bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))

    with pytest.raises(PeerLost, match="the CAN controller of vcan0 went bus off"):
        over_vcan(made(60.0), tmp_path, bus_off)


@pytest.mark.parametrize(
    ("endpoint", "mtu", "said"),
    [
        ("can://vcan7", 72, "'can://vcan7': cannot be opened: "),
        (ENDPOINT, 16, "not set up for CAN FD (mtu 72); link.options.fd = false?"),
    ],
)
def test_a_bus_that_is_not_to_be_had(endpoint, mtu, said, tmp_path, capsys):
    def set_mtu(size: int) -> None:
        link("down")
        subprocess.run(["ip", "link", "set", "vcan0", "mtu", str(size)], check=True)
        link("up")

    set_mtu(mtu)
    try:
        scenario = tmp_path / "scenario.toml"
        scenario.write_text(toml_text(content(endpoint=endpoint)), encoding="utf-8")
        assert main(["plant", str(scenario), "--out", str(tmp_path / "out")]) == 2
    finally:
        set_mtu(72)
    output = "".join(capsys.readouterr())
    assert said in output
    assert output.count("\n") == 1
