"""The command server: arbitrary messages to its socket, and situations like the end of a run."""

import errno
import json
import os
from pathlib import Path
from typing import Any

import pytest
import zmq

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.rate import Rate
from gfm_hil.engine.announcement import read_announcement, running_roles
from gfm_hil.engine.command_server import CommandServer
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.recording.log import read_log
from gfm_hil.scenario.events.reference import Reference

pytestmark = pytest.mark.processes


class Ends:
    """A command server without a loop; its timeline carries out commands at once."""

    def __init__(self, folder: Path, bench: Any) -> None:
        self.timeline = Timeline(bench, folder / "events_controller.jsonl", ("controller",))
        self.stops, self.tick = 0, 0
        self.server = CommandServer(
            "controller", [(folder, bench)], [self.timeline], self.wake, self.stop
        )

    def wake(self) -> None:
        self.tick += 1
        self.timeline.carry_out(self.tick)

    def stop(self) -> None:
        self.stops += 1
        self.timeline.end("interrupted", "stopped by the operator", self.tick)


@pytest.fixture
def ends(make, tmp_path):
    found = Ends(tmp_path, make_bench(make()))
    with found.server:
        yield found
    found.timeline.close()


def ask(folder: Path, *messages: bytes) -> list[dict[str, Any]]:
    """The command server's answers to raw messages."""
    server = read_announcement(folder, "controller")
    assert server is not None
    answers = []
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.set(zmq.LINGER, 0)
        socket.connect(server["endpoint"])
        for message in messages:
            socket.send(message)
            assert socket.poll(60_000), message
            answers.append(json.loads(socket.recv()))
    return answers


P_REF = {"type": "reference", "P_ref": 0.6}


def test_no_command_ends_the_command_server(ends, tmp_path):
    digits = b"9" * 400
    messages = [
        b'{"type": []}',
        b'{"type": {}}',
        b'{"type": null}',
        b'{"type": {"type": []}}',
        b'{"type": "reference", "P_ref": ' + digits + b"}",
        b'{"type": "gains", "values": {"D_p": ' + digits + b"}}",
        b'{"type": "reference", "P_ref": 0.6, "tick": ' + digits + b"}",
        b'{"type": "law", "law": "\\ud800"}',
        b"[" * 5000,
        b"[]",
        b"\xff\xfe",
        b'{"type": "reference", "P_ref": 0.6, "by": {"through": []}}',
    ]
    answers = ask(tmp_path, *messages, json.dumps(P_REF).encode())
    assert [a["ok"] for a in answers] == [False] * 12 + [True]
    assert all(len(a["error"]) < 2000 for a in answers[:-1])


@pytest.mark.attack(
    "3.5", "a command that raises what the command server does not expect",
    "its thread ends: no command passes any more",
)  # fmt: skip
def test_an_exception_of_ours_is_answered(ends, tmp_path, monkeypatch, caplog, attack_now):
    def fails(self: Any, content: Any) -> Any:
        raise KeyError("a mistake of ours")

    with monkeypatch.context() as patch:
        patch.setattr(CommandServer, "_checked", fails)
        answer = ask(tmp_path, json.dumps(P_REF).encode())[0]
    assert not answer["ok"] and "a mistake of ours" in answer["error"] + caplog.text
    assert ask(tmp_path, json.dumps(P_REF).encode())[0]["ok"]
    attack_now("answered and logged; the next command is carried out")


@pytest.mark.attack(
    "4.4", "no descriptor left (EMFILE) where a server looks whether the run goes on",
    "taken for the end of the run: Modbus ends, with its heartbeat and timers, as if regular",
)  # fmt: skip
def test_no_descriptor_left_is_not_the_end_of_a_run(ends, run, tmp_path, monkeypatch, attack_now):
    record = open_recording(run().folder)
    record.folder = tmp_path
    assert running_roles(tmp_path) == ["controller"] and record.ended() is None

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.EMFILE, "Too many open files")

    checks = (lambda: running_roles(tmp_path), lambda: Operator(tmp_path), record.ended)
    with monkeypatch.context() as patch:
        patch.setattr(os, "open", full)
        for check in checks:
            with pytest.raises((UserError, OSError), match="Too many open files"):
                check()
    assert running_roles(tmp_path) == ["controller"] and record.ended() is None
    attack_now("reported as what it is, 3 of 3 times; then the run goes on")


def test_only_a_folder_that_is_gone_is_gone(tmp_path):
    with scratch.temporary("gfmhil-commands-") as place:
        assert scratch.held(place)
        (tmp_path / "commands_plant.json").write_text("[1]", encoding="utf-8")
        with pytest.raises(UserError, match=r"commands_plant\.json: must be an object"):
            running_roles(tmp_path)
    assert not scratch.held(place)


@pytest.mark.attack(
    "10.3", "1,000 commands at once to the command server, then a stop", "1,000 carried out"
)
def test_the_command_server_has_a_limit_and_stop_passes(ends, tmp_path, attack_now):
    ends.server._rate._clock = lambda: ends.server._rate._since  # on a machine of any speed
    answers = ask(tmp_path, *[json.dumps(P_REF).encode()] * 1000, b'{"type": "stop"}')
    refused = [a["error"] for a in answers if not a["ok"]]
    assert all(a["ok"] for a in answers[:200]) and answers[-1] == {"ok": True}
    assert len(refused) == 800 and "800 refused" in refused[-1] and ends.stops == 1
    attack_now(f"{1000 - len(refused)} carried out, {len(refused)} refused, the stop passes")


@pytest.mark.attack("10.4", "who told the run to stop?", "nothing in events.jsonl")
def test_the_log_says_who_told_and_who_stopped(ends, tmp_path, attack_now):
    operator = Operator(tmp_path, through="command")
    operator.command(P_REF)
    operator.stop()
    operator.close()
    who = {"through": "command", "uid": os.getuid(), "pid": os.getpid()}
    told, end = read_log(tmp_path / "events_controller.jsonl")
    for line in (told, end):
        assert {k: v for k, v in line["operator"].items() if k != "name"} == who
    assert (told["by"], end["event"]) == ("operator", "end")
    attack_now(f"`{json.dumps(end['operator'])}`")


def test_events_of_the_scenario_have_no_operator(make, tmp_path):
    event = {"type": "reference", "tick": 0, "P_ref": 0.6}
    timeline = Timeline(make_bench(make(events=[event])), tmp_path / "log", ("controller",))
    timeline.carry_out(0)
    timeline.insert(Reference(type="reference", tick=0, P_ref=0.7), {"through": "python"})
    timeline.carry_out(1)
    timeline.close()
    planned, told = read_log(tmp_path / "log")
    assert "operator" not in planned and "by" not in planned
    assert told["operator"] == {"through": "python"}


def test_a_rate_lets_a_burst_through_and_fills_up_again():
    now = [0.0]
    rate = Rate("a page", per_s=10.0, burst=3, clock=lambda: now[0])

    def passed(count: int) -> int:
        done = 0
        for _ in range(count):
            try:
                rate.take()
                done += 1
            except UserError as problem:
                assert str(problem).startswith("more than 10 commands a second from a page")
        return done

    assert (passed(5), rate.refused) == (3, 2)
    now[0] += 0.25
    assert passed(5) == 2
    now[0] += 1e6
    assert (passed(5), rate.refused) == (3, 7)
