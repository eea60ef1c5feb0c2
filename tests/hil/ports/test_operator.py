"""Commands to runs in progress, with two real processes."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.engine.announcement import running_roles
from gfm_hil.ports.commands import Operator
from gfm_hil.recording.log import read_log

from ...support.processes import GFMHIL, PATIENCE_S, running, wait_for

pytestmark = pytest.mark.processes

SCENARIO = """
title = "told"
duration = 600.0
after_trip = "wait"
ready_laws = ["vsg-5"]
[link]
type = "{link}"
options = {options}
peer_timeout_s = 30.0
[[events]]
type = "law"
t = 599.0
law = "vsg-2"
"""


@pytest.fixture
def going(request, tmp_path):
    """The process and the folder of a long run in progress, over a link."""
    folder, (link, options) = tmp_path / "run", request.param
    with running(folder, SCENARIO.format(link=link, options=options)) as process:
        yield process, folder


@pytest.fixture(scope="module")
def slow(tmp_path_factory):
    """The same over the slowest link: over shared memory a run ends with hundreds of thousands of
    ticks."""
    folder = tmp_path_factory.mktemp("slow") / "run"
    with running(folder, SCENARIO.format(link="zmq", options="{portable = true}")) as process:
        yield process, folder


def over(*links):
    """The test's run goes over each of these links, which have options."""
    return pytest.mark.parametrize("going", links, indirect=True)


def rows(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "signals.npz") as file:
        return {name: file[name] for name in file.files if name != "laws"}


@over(("shm", "{}"), ("zmq", "{portable = true}"))
def test_what_is_told_is_carried_out_in_the_tick_that_the_answer_names(going):
    process, folder = going
    operator = Operator(folder)
    wait_for(lambda: operator.snapshot().get("tick", 0) > 100)
    reference = operator.command({"type": "reference", "P_ref": 0.8})
    law = operator.command({"type": "law", "law": "vsg-2"})
    grid = operator.command({"type": "grid-frequency", "f_hz": 49.99})
    assert reference["label"] == "P_ref = 0.8"
    wait_for(lambda: operator.snapshot()["tick"] > grid["tick"] + 100)
    seen = operator.snapshot()
    assert (seen["ref_P_ref"], seen["law"], seen["state"]) == (0.8, 1.0, "RUNNING")
    operator.stop()
    assert process.wait(PATIENCE_S) == 130  # as after Ctrl-C
    operator.close()
    signals = rows(folder)
    assert np.flatnonzero(signals["ref_P_ref"] == 0.8)[0] == reference["tick"]
    assert np.flatnonzero(signals["law"] == 1)[0] == law["tick"]
    assert np.flatnonzero(signals["true_omega_g"] < 0.9999)[0] == grid["tick"]
    told = [e for e in read_log(folder / "events.jsonl") if e.get("by") == "operator"]
    assert [e["tick"] for e in told] == [reference["tick"], law["tick"], grid["tick"]]
    assert not list(folder.glob("commands_*"))


@over(("zmq", "{}"))
def test_a_trip_is_waited_for_and_reset_and_gains_change(going):
    process, folder = going
    operator = Operator(folder)
    wait_for(lambda: operator.snapshot().get("tick", 0) > 100)
    with pytest.raises(UserError, match="the controller is RUNNING, not SAFE"):
        operator.command({"type": "reset"})
    operator.command({"type": "law", "law": "vsg-5"})
    gains = operator.command({"type": "gains", "values": {"D_p": 0.012}})
    wait_for(lambda: operator.snapshot()["tick"] > gains["tick"])
    seen = operator.snapshot()
    assert (seen["active"], seen["gains"]) == ("vsg-5", {"D_p": 0.012})
    assert seen["laws"] == ["mimo-gfm", "vsg-2", "vsg-5"]
    operator.command({"type": "grid-voltage", "V_g": 0.0})
    wait_for(lambda: operator.snapshot()["state"] == "SAFE" and operator.snapshot()["trip"])
    for lost in ({"type": "reference", "P_ref": 0.4}, {"type": "law", "law": "vsg-2"}):
        with pytest.raises(UserError, match="send this after the reset"):
            operator.command(lost)
    seen = operator.snapshot()
    assert (seen["trip"], seen["reason"]) == ("over-current", "the plant's protection tripped")
    reset = operator.command({"type": "reset"})
    wait_for(lambda: operator.snapshot()["tick"] > reset["tick"] + 100)
    seen = operator.snapshot()
    assert (seen["state"], seen["active"], seen["trip"]) == ("RUNNING", "mimo-gfm", "")
    assert seen["true_p"] == pytest.approx(0.5, abs=1e-6)
    operator.stop()
    assert process.wait(PATIENCE_S) == 130
    operator.close()


REFUSED = [
    ({"type": "reference", "P_ref": 9.0}, r"P_ref = 9\.0: must lie in \[-2, 2\]"),
    ({"type": "law", "law": "droop-1"}, "not made ready"),
    ({"type": "reference", "P_ref": 0.6, "t": 1.0}, "t = 1.0: a command is carried out"),
    ({"type": "grid-impedance", "L_g": 1e-9, "R_g": 0.0}, "too fast"),
    ({"type": "grid-breaker", "closed": False}, "load"),
    ({"type": "nonsense"}, "must be one of"),
    ({"type": "gains", "values": {"k_99": 1.0}}, "parameter k_99: unknown"),
    ({"type": "gains", "values": {}}, "at least 1"),
    ({"type": "reset"}, "RUNNING, not SAFE"),
    ({}, "missing"),
]


def test_what_is_refused_changes_nothing(slow):
    _, folder = slow
    operator = Operator(folder)
    wait_for(lambda: operator.snapshot().get("tick", 0) > 100)
    for event, words in REFUSED:
        with pytest.raises(UserError, match=words):
            operator.command(event)
        seen = operator.snapshot()
        assert (seen["ref_P_ref"], seen["law"], seen["true_trip"]) == (0.5, 0.0, 0.0), event
    operator.close()


def test_the_command(slow, refused, capsys):
    process, folder = slow

    def tell(*words: str) -> str:
        assert main(["command", str(folder), *words]) == 0
        return capsys.readouterr().out

    wait_for(lambda: json.loads(tell()).get("tick", 0) > 0)
    assert tell("P_ref=0.7", "--ramp", "0.1").startswith("P_ref = 0.7 at tick ")
    assert tell("--gain", "D_p=0.0101").startswith("D_p = 0.0101 at tick ")
    for words, problem in (
        (["P=1"], "gfmhil: 'P=1': must be NAME=VALUE"),
        (["--gain", "k_21"], "gfmhil: 'k_21': must be NAME=VALUE, NAME a gain"),
        (["--reset"], "gfmhil: reset: the controller is RUNNING, not SAFE"),
        (["--ramp", "1"], "gfmhil: --ramp 1: there is no reference"),
        (["--event", "{"], "gfmhil: --event: not JSON"),
    ):
        assert refused("command", str(folder), *words).startswith(problem)
    stop = [*GFMHIL, "command", str(folder), "--stop"]  # a program of its own, as operators have it
    assert subprocess.run(stop, capture_output=True).returncode == 0
    assert process.wait(PATIENCE_S) == 130
    assert "no run is going on there" in refused("command", str(folder), "P_ref=0.7")


def test_what_a_killed_run_has_announced_is_not_going_on(tmp_path):
    with scratch.temporary("gfmhil-commands-") as place:
        endpoint = {"endpoint": f"ipc://{place}/plant"}
        (tmp_path / "commands_plant.json").write_text(json.dumps(endpoint), encoding="utf-8")
        assert running_roles(tmp_path) == ["plant"]
        Operator(tmp_path).close()
    place.mkdir()  # as after SIGKILL
    try:
        assert running_roles(tmp_path) == []
        with pytest.raises(UserError, match="no run is going on there"):
            Operator(tmp_path)
    finally:
        place.rmdir()
    assert running_roles(tmp_path) == []
    with pytest.raises(UserError, match=r"nowhere: no such folder$"):
        Operator(tmp_path / "nowhere")
