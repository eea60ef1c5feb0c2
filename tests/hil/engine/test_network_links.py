"""Networks over links: one plant process, and a controller process for each converter."""

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_hil.api.runs import explain_and_report
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_hil.recording.log import read_log
from gfm_hil.run.run_folder import merge_roles
from gfm_hil.run.runner import run_network
from gfm_hil.scenario import load_scenario, toml_text

from ...support.processes import (
    GFMHIL,
    PATIENCE_S,
    end,
    free_port,
    has_run,
    roles_of,
    signals,
    summary,
    takes_commands,
    wait_for,
)

pytestmark = [pytest.mark.processes, pytest.mark.timeout(900)]  # the first one compiles


def over(link: str, patience_s: float = 30.0) -> dict[str, Any]:
    """A link whose peers may be slow: the machine may be busy."""
    return {"type": link, "peer_timeout_s": patience_s}


def content(**changes: Any) -> dict[str, Any]:
    """Two converters that feed a load."""
    made: dict[str, Any] = {
        "title": "two", "duration": 0.5, "law": "droop-3", "link": over("shm"),
        "references": {"P_ref": 0.3},
        "network": {
            "converters": {"A": {"node": "bus", "law": "vsg-2"}, "B": {"node": "bus"}},
            "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.1},
                      "step": {"node": "bus", "P": 0.2, "Q": 0.0, "closed": False}},
        },
        "events": [{"type": "breaker", "name": "step", "t": 0.2, "closed": True}],
    }  # fmt: skip
    return made | changes


def with_members(**of: dict[str, Any]) -> dict[str, Any]:
    """The network of ``content`` with more of its converters."""
    network = content()["network"]
    for name, more in of.items():
        network["converters"][name] |= more
    return network


def log(folder: Path, kind: str) -> list[dict[str, Any]]:
    return [line for line in read_log(folder / "events.jsonl") if line["event"] == kind]


@contextmanager
def started(folder: Path, given: dict[str, Any]) -> Iterator[subprocess.Popen[str]]:
    """A run that is going on, ended as Ctrl-C does."""
    file = folder.with_suffix(".toml")
    file.write_text(toml_text(given), "utf-8")
    command = [*GFMHIL, "run", str(file), "--out", str(folder), "--quiet", "--no-figures"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, **pipes)  # type: ignore[call-overload]
    try:
        wait_for(lambda: all(takes_commands(folder / name) for name in "AB"), process)
        wait_for(lambda: has_run(folder / "A", 10), process)
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


def test_over_links_a_run_is_that_in_process(tmp_path):
    """Over two links at a time, and with a trip on the way, after which the other goes on until the
    converter is reset."""
    trip = {"plant": {"protection": {"over_current": {"threshold": 0.55, "delay_s": 0.05}}}}
    events = [
        *content()["events"],
        {"type": "breaker", "name": "step", "t": 0.3, "closed": False},
        {"type": "reset", "t": 0.4, "converter": "B"},
    ]
    members = with_members(A={"link": over("zmq")}, B=trip)
    members["loads"]["step"]["P"] = 0.6
    given = load_scenario(content(network=members, events=events, after_trip="wait", duration=2.0))
    found = run_network(given, tmp_path / "run")
    memory = gfmhil.run_network(given)
    assert found.status == memory.status == "completed"
    for name in "AB":
        columns = signals(tmp_path / "run" / name)
        assert set(memory[name].columns) <= set(columns)
        for key, there in memory[name].columns.items():
            np.testing.assert_array_equal(columns[key], there[:], err_msg=f"{name} {key}")
        assert len(log(tmp_path / "run" / name, "breaker")) == 2
    assert [found[name].summary["link"] for name in "AB"] == ["zmq", "shm"]
    (tripped, *_) = log(tmp_path / "run" / "B", "tripped")
    assert "over-current" in tripped["reason"] and tripped["tick"] < 4000
    assert {line["tick"] for line in log(tmp_path / "run" / "B", "recovered")} == {4000}


def test_a_controller_that_is_killed_trips_its_converter_and_no_other(tmp_path):
    folder = tmp_path / "run"
    with started(folder, content(duration=150.0, link=over("zmq", 3.0))) as process:
        os.kill(roles_of(folder / "B")["controller"], signal.SIGKILL)
        lost = wait_for(lambda: log_of_plant(folder / "B", "end"), process)
        before = int(lost[0]["tick"])
        wait_for(lambda: has_run(folder / "A", before + 1000), process)
        Operator(folder / "A").stop()
        code, said, _ = end(process)
    assert code == 130
    assert "the controller of B was ended by SIGKILL" in said
    assert lost[0]["reason"] == "the controller's process is gone"
    a, b = signals(folder / "A"), signals(folder / "B")
    assert summary(folder / "B")["status"] == "safe" and not summary(folder / "B")["stopped"]
    assert len(a["y_p"]) == len(b["y_p"]) > before + 1000
    after = slice(before + 500, before + 1000)
    assert np.abs(b["true_i"][after]).max() == 0.0
    assert np.isnan(b["ref_P_ref"][after]).all()
    assert a["y_p"][after].min() > 0.4  # it has the whole load


def log_of_plant(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Lines of a kind that the plant has written so far."""
    return [line for line in read_log(folder / "events_plant.jsonl") if line["event"] == kind]


def test_in_real_time_a_lost_controller_trips_its_converter_and_no_other(tmp_path):
    """On a busy machine A may be late for as long as it likes."""
    folder = tmp_path / "run"
    patient = {"hold": 10**6}
    given = content(
        duration=60.0, mode="realtime", link=over("shm"), events=[],
        network=with_members(A={"late_policy": patient}, B={"late_policy": {"hold": 3000}}),
    )  # fmt: skip
    with started(folder, given) as process:
        os.kill(roles_of(folder / "B")["controller"], signal.SIGKILL)
        lost = wait_for(lambda: log_of_plant(folder / "B", "end"), process)
        wait_for(lambda: has_run(folder / "A", int(lost[0]["tick"]) + 200), process)
        Operator(folder / "A").stop()
        end(process)
    assert lost[0]["reason"] == "no fresh u for longer than late_policy.hold allows"
    assert summary(folder / "A")["status"] == "interrupted"
    assert summary(folder / "B")["status"] == "safe"
    survivor = gfmhil.load_run(folder / "A")
    explain_and_report(survivor)
    words = r"^(green|yellow|red) by its longest row: .*; A \(vsg-2\) bears \d+ in a row here$"
    assert re.search(words, survivor.summary["latency"])


def test_an_operator_speaks_to_one_converter_and_to_the_plant(tmp_path):
    folder = tmp_path / "run"
    with started(folder, content(duration=150.0, link=over("zmq"), events=[])) as process:
        a, b, both = Operator(folder / "A"), Operator(folder / "B"), Operator(folder)
        told = b.command({"type": "reference", "P_ref": 0.35})
        closed = both.command({"type": "breaker", "name": "step", "closed": True})
        for own in (both.snapshot, lambda: both.command({"type": "reference", "P_ref": 0.35})):
            with pytest.raises(UserError, match=r"is of a network; name the folder of a conv"):
                own()
        with pytest.raises(UserError, match="name = 'stop': must be one of"):
            a.command({"type": "breaker", "name": "stop", "closed": True})
        wait_for(lambda: has_run(folder / "A", closed["tick"] + 100), process)
        both.stop()
        code, *_ = end(process)
        a.close(), b.close(), both.close()
    assert code == 130 and summary(folder)["stopped"]
    for name in "AB":
        assert (
            summary(folder / name)["status"] == "interrupted" and summary(folder / name)["stopped"]
        )
        (line,) = log(folder / name, "breaker")
        assert (line["tick"], line["by"]) == (closed["tick"], "operator")
    assert not log(folder / "A", "reference")
    (line,) = log(folder / "B", "reference")
    assert line["tick"] == told["tick"]
    assert signals(folder / "A")["ref_P_ref"][-1] == 0.3
    assert signals(folder / "B")["ref_P_ref"][-1] == 0.35


def by_hand(tmp_path: Path, file: Path, *more: str) -> dict[str, subprocess.Popen[str]]:
    """The three processes of a network, started one by one; ``more`` goes to the one of B."""
    places = {name: f"tcp://127.0.0.1:{free_port()}" for name in "AB"}
    ends = [f"--endpoint={name}={place}" for name, place in places.items()]
    commands = {"plant": ["plant", str(file), *ends, "--out", str(tmp_path / "plant")]}
    for name, place in places.items():
        own = ["--converter", name, "--endpoint", place, "--out", str(tmp_path / name)]
        commands[name] = ["controller", str(file), *own, *(more if name == "B" else ())]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return {
        name: subprocess.Popen([*GFMHIL, *words], **pipes)  # type: ignore[call-overload]
        for name, words in commands.items()
    }


def test_roles_started_by_hand_meet(tmp_path, refused):
    file = tmp_path / "two.toml"
    file.write_text(toml_text(content(link=over("zmq"), duration=0.3)), "utf-8")
    ended = {name: end(process) for name, process in by_hand(tmp_path, file).items()}
    assert {name: code for name, (code, *_) in ended.items()} == {"plant": 0, "A": 0, "B": 0}
    with pytest.raises(UserError, match="are of different converters: A, B"):
        merge_roles(tmp_path / "plant" / "A", tmp_path / "B", tmp_path / "mixed")
    merge_roles(tmp_path / "plant" / "B", tmp_path / "B", tmp_path / "whole")
    memory, found = gfmhil.run_network(content(duration=0.3))["B"], signals(tmp_path / "whole")
    for key, column in memory.columns.items():
        np.testing.assert_array_equal(found[key], column[:], err_msg=key)
    plant, a, b = (str(tmp_path / name) for name in ("plant", "A", "B"))
    for folders, said in (
        ([a], "the folder of the controller of B is missing"),
        ([a, a], "A: has the controller of A, as "),
        ([a, b, plant], "plant: has the controller of None, none of ['A', 'B']"),
    ):
        assert said in refused("merge", plant, *folders, "--out", str(tmp_path / "none"))
    assert main(["merge", plant, b, a, "--out", str(tmp_path / "network")]) == 0
    network = gfmhil.NetworkRun.load(tmp_path / "network")
    assert network.status == "completed" and (tmp_path / "network" / "report.html").is_file()
    np.testing.assert_array_equal(network["B"].columns["true_p"][:], found["true_p"])


def test_a_controller_of_another_scenario_is_refused(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(toml_text(content(link=over("zmq", 3.0))), "utf-8")
    processes = by_hand(tmp_path, file, "--seed", "7")
    _, out, _ = end(processes["plant"])
    end(processes["A"]), end(processes["B"])
    assert "B: the controller runs another scenario" in out
    assert json.loads((tmp_path / "plant" / "summary.json").read_text())["status"] == "safe"
