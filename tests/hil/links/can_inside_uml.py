"""Real SocketCAN: ``test_can_uml`` runs it inside user-mode Linux, where vcan0 is a CAN FD bus.

GFMHIL_TEST_BUS: an endpoint to use instead, to compile everything where that is faster.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.core.roles import ROLES
from gfm_hil.links.can.dbc import write_dbc
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import load_scenario, toml_text

from ...support.can_reference import quantised_run

PATIENCE_S = 600  # a run may have to compile everything, on one processor
ENDPOINT = os.environ.get("GFMHIL_TEST_BUS", "can://vcan0")
LINK = {"type": "can", "endpoint": ENDPOINT, "peer_timeout_s": 60.0, "start_timeout_s": 300.0}
EVENTS = [
    {"tick": 20, "type": "reference", "P_ref": 0.55},
    {"tick": 60, "type": "grid-frequency", "f_hz": 49.99},
]

pytestmark = pytest.mark.timeout(700)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def write(name: str, link: dict[str, Any], **content: Any) -> str:
    # a tick takes 0.1 s: each poll is a system call, and both loops share one processor
    base = {"title": "test", "duration": 0.01, "events": EVENTS, "link": LINK | link}
    Path(name).write_text(toml_text(base | content))
    return name


def run_while(scenario: str, ticks: int, meanwhile: Callable[[], None]) -> dict[str, Any]:
    """Run it; calls ``meanwhile`` after that many ticks; returns the summary.

    Two processes and not three: a process takes long to start here.
    """
    waiting = [meanwhile]

    def progress(done: int, misses: int) -> None:
        if done >= ticks and waiting:
            waiting.pop()()

    run_scenario(load_scenario(scenario), Path("out"), progress)
    for log in Path("out").glob("*.log"):
        assert "Traceback" not in log.read_text(encoding="utf-8")
    return json.loads(Path("out/summary.json").read_text(encoding="utf-8"))


def assert_as_in_process(scenario: str, summary: dict[str, Any]) -> None:
    assert (summary["status"], summary["ticks"]) == ("completed", 100), summary
    found = load_scenario(scenario)
    expected = quantised_run(found, Path(), found.link.options.get("every", 1))
    with np.load("out/signals.npz") as signals:
        for name, column in expected.items():
            assert signals[name].tobytes() == column.tobytes(), name


@pytest.mark.parametrize("options", [{"portable": True}, {"fd": False, "every": 4, "heartbeat": 7}])
def test_lockstep_over_vcan_is_a_run_in_process_in_counts(options):
    """As the flooded bus below is with no option."""
    scenario = write("scenario.toml", {"options": options})
    assert_as_in_process(scenario, run_while(scenario, 0, lambda: None))


def test_a_flooded_bus():
    """A third process, which wins every arbitration, sends bursts during the whole run."""
    scenario = write("scenario.toml", {})
    with subprocess.Popen([sys.executable, "-c", _FLOOD], stdout=subprocess.PIPE) as flooder:
        assert flooder.stdout is not None and flooder.stdout.readline()
        try:
            summary = run_while(scenario, 0, lambda: None)
            assert flooder.poll() is None
        finally:
            flooder.kill()
    assert_as_in_process(scenario, summary)


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


def test_another_dbc_is_refused_by_both_processes(capsys):
    Path("other.dbc").write_text(write_dbc(True).replace("(0.0002,0.0)", "(0.0004,0.0)"))
    command = [sys.executable, "-m", "gfm_hil", "controller", write("one.toml", {}), "--out", "one"]
    with subprocess.Popen(
        command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as controller:
        two = write("two.toml", {"options": {"dbc": "other.dbc"}})
        codes = {"plant": main(["plant", two, "--out", "two"])}
        said = {"plant": "".join(capsys.readouterr())}
        said["controller"] = controller.communicate(timeout=PATIENCE_S)[0]
        codes["controller"] = controller.returncode
    for role in ROLES:
        other = ROLES[1 - ROLES.index(role)]
        assert f"the {other} uses another DBC" in " ".join(said[role].split())
        assert codes[role] == 3


def test_an_interface_that_goes_down_ends_the_run_in_safe():
    scenario = write("scenario.toml", {}, duration=60.0)
    try:
        summary = run_while(scenario, 30, lambda: link("down"))
    finally:
        link("up")
    assert summary["status"] == "safe"
    # either a send or a poll detects it first
    assert re.match("the CAN bus vcan0 is gone: .*Network is down", summary["reason"])


def link(state: str) -> None:
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True)


def test_bus_off_ends_the_run_in_safe():
    def bus_off() -> None:
        with can.Bus(interface="socketcan", channel="vcan0", fd=True) as bus:
            bus.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))

    summary = run_while(write("scenario.toml", {}, duration=60.0), 30, bus_off)
    assert summary["status"] == "safe"
    assert summary["reason"] == "the CAN controller of vcan0 went bus off"


@pytest.mark.parametrize(
    ("endpoint", "mtu", "said"),
    [
        ("can://vcan7", 72, "'can://vcan7': cannot be opened: "),
        (ENDPOINT, 16, "not set up for CAN FD (mtu 72); link.options.fd = false?"),
    ],
)
def test_a_bus_that_is_not_to_be_had(endpoint, mtu, said, capsys):
    def set_mtu(size: int) -> None:
        link("down")
        subprocess.run(["ip", "link", "set", "vcan0", "mtu", str(size)], check=True)
        link("up")

    set_mtu(mtu)
    try:
        scenario = write("scenario.toml", {"endpoint": endpoint})
        assert main(["plant", scenario, "--out", "out"]) == 2
    finally:
        set_mtu(72)
    output = "".join(capsys.readouterr())
    assert said in output
    assert output.count("\n") == 1
