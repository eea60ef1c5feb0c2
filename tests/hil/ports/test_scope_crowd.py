"""The scope among many pages, some silent and some malicious: none of them harms another."""

import contextlib
import json
import logging
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from gfm_hil.ports.scope import server, session
from gfm_hil.ports.scope.picture import ScopePicture
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.ports.scope.server import Scope
from gfm_hil.ports.scope.session import Access

from ...support.processes import takes_commands, wait_for
from ...support.scope import Rig, mute, rig, serving, words

pytestmark = pytest.mark.processes

LOOK = {"kind": "look", "id": 1, "channels": ["p"], "bins": 50, "mode": "held", "span": 0.1}


@pytest.fixture
def scope(run) -> Scope:
    """The scope of a finished run."""
    return Scope([open_recording(run().folder)], Access())


@pytest.fixture
def port(scope) -> Iterator[int]:
    with serving(scope) as found:
        yield found


def address(port: int, query: str = "") -> str:
    return f"ws://127.0.0.1:{port}/socket{query}"


def say(socket: ClientConnection, **content: Any) -> None:
    socket.send(json.dumps(content))


def gone(peer: ClientConnection) -> bool:
    """Whether the server has closed the connection; discards what it sent before."""
    with contextlib.suppress(TimeoutError):
        try:
            while True:
                peer.recv(60)
        except ConnectionClosed:
            return True
    return False


@pytest.mark.attack(
    "3.1", "a `look` whose id has 400 digits, without a token", "the scope ends for every page"
)
@pytest.mark.parametrize(
    "more",
    [{"id": 10**400}, {"id": 2**60}, {"channels": ["p" * 5000]}],
    ids=["400 digits", "61 bits", "long name"],
)
def test_numbers_without_bounds_are_refused(port, more, attack_now):
    with connect(address(port)) as page, connect(address(port)) as other:
        say(page, **{**LOOK, **more})
        assert next(iter(more)) in words(page, "error")["text"]
        for each in (page, other):
            say(each, **LOOK)
            while isinstance(each.recv(60), str):
                pass
    attack_now("refused in one line; both pages still get pictures")


@pytest.mark.attack(
    "3.2", "a page whose picture raises an exception", "the scope ends for every page"
)
def test_an_exception_ends_its_own_page_alone(port, monkeypatch, caplog, attack_now):
    frame = ScopePicture.frame

    def fails(self: ScopePicture, head: int) -> bytes | None:
        if self._request.id == 13:
            raise ZeroDivisionError("of this page")
        return frame(self, head)

    monkeypatch.setattr(ScopePicture, "frame", fails)
    with connect(address(port)) as page, connect(address(port)) as other:
        say(page, **{**LOOK, "id": 13})
        assert gone(page)
        say(other, **LOOK)
        while isinstance(other.recv(60), str):
            pass
    said = [r for r in caplog.records if r.levelno >= logging.ERROR]
    assert len(said) == 1 and "of this page" in caplog.text
    attack_now("1 page ends, 1 line in the log, the other page still gets pictures")


@pytest.mark.attack(
    "3.3", "one exception in the scope's follower of the log", "no page hears of an event again"
)
def test_a_follower_that_ends_begins_again(port, scope, monkeypatch, caplog, attack_now):
    lines = [{"t": 0.0, "tick": 0, "event": "reset", "label": "late news"}]
    failures = iter([OSError(24, "Too many open files"), ValueError("not a log")])

    def events() -> list[dict[str, Any]]:
        for problem in failures:
            raise problem
        return lines

    with connect(address(port)) as page:
        words(page, "events")
        monkeypatch.setattr(scope._runs[""].record, "events", events)
        assert words(page, "events")["events"] == lines
    assert "Too many open files" in caplog.text and "not a log" in caplog.text
    attack_now("2 failures reported, the follower begins again, the event arrives")


@pytest.mark.attack("4.1", "one page that never reads", "no other page hears of any event again")
def test_a_page_that_never_reads_is_dropped(port, scope, monkeypatch, caplog, attack_now):
    big = {"t": 0.0, "tick": 0, "event": "reset", "label": "x" * 6_000_000}
    with mute(port), connect(address(port), max_size=None) as other:
        wait_for(lambda: len(scope._sessions) == 2)
        words(other, "events")
        for k in range(3):
            more = [{**big, "tick": k}]
            monkeypatch.setattr(scope._runs[""].record, "events", lambda more=more: more)
            assert words(other, "events")["events"][0]["tick"] == k
        wait_for(lambda: len(scope._sessions) == 1)
    assert "dropped" in caplog.text
    attack_now(f"dropped after {session.SEND_S:g} s; the other page got 3 of 3 events")


@pytest.mark.attack(
    "4.2", "16 pages that look, then the operator with the token", "503, locked out for good"
)
def test_the_token_s_holder_gets_in_among_pages_that_look(port, scope, attack_now):
    with contextlib.ExitStack() as stack:
        for _ in range(16):
            stack.enter_context(connect(address(port)))
        wait_for(lambda: len(scope._sessions) == 16)
        with pytest.raises(InvalidStatus) as refused, connect(address(port)):
            pass
        assert refused.value.response.status_code == 503
        with connect(address(port, "?control")) as page:
            say(page, kind="hello", token=scope.access.tokens["operator"])
            assert words(page, "control")["granted"] is True
            assert words(page, "about")["title"] == "test"
        with connect(address(port, "?control")) as page:
            say(page, kind="hello", token="wrong")
            assert words(page, "control")["granted"] is False
            assert gone(page)
    attack_now("the holder gets in beside 16 pages, a wrong token does not")


@pytest.mark.attack(
    "23.5", "16 pages that never read, then a page that looks", "503 until their pings time out"
)
@pytest.mark.parametrize("query", ["", "?control"])
def test_pages_that_never_read_make_room_for_a_newcomer(query, port, scope, attack_now):
    with contextlib.ExitStack() as stack:
        reader = stack.enter_context(connect(address(port)))
        for _ in range(15):
            stack.enter_context(mute(port))
        wait_for(lambda: len(scope._sessions) == 16)
        with connect(address(port, query)) as page:
            say(page, kind="hello", token="none")
            assert words(page, "about")["title"] == "test"
            assert len(scope._sessions) == 2
            say(reader, kind="hello", token="none")
            assert words(reader, "control")["granted"] is False
    attack_now("the 15 that do not answer a ping in 1 s are dropped; the one that does stays")


@pytest.mark.attack(
    "4.3", "300 connections that send nothing", "each holds a descriptor of the scope"
)
def test_half_open_connections_make_room(port, scope, attack_now):
    with contextlib.ExitStack() as stack:
        page = stack.enter_context(connect(address(port)))
        words(page, "events")
        peers = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(300)
        ]
        ended = 0
        for peer in peers[: -server.WAITING]:
            peer.settimeout(60)
            ended += peer.recv(1) == b""
        assert ended == 300 - server.WAITING
        say(page, **LOOK)
        while isinstance(page.recv(60), str):
            pass
        with connect(address(port)) as late:
            words(late, "about")
    attack_now(f"{ended} of 300 ended, the oldest first; the pages go on")


def test_half_open_connections_end_by_themselves(scope, monkeypatch):
    monkeypatch.setattr(server, "HALF_OPEN_S", 0.3)
    with serving(scope) as port, connect(address(port)) as page:
        with socket.create_connection(("127.0.0.1", port)) as peer:
            peer.settimeout(60)
            assert peer.recv(1) == b""
        time.sleep(0.5)
        say(page, **LOOK)
        assert page.recv(60)


@pytest.fixture(scope="module")
def lab(tmp_path_factory) -> Iterator[Rig]:
    """A run in progress with its scope."""
    with rig(tmp_path_factory.mktemp("crowd")) as found:
        wait_for(lambda: takes_commands(found.folder))
        yield found


@contextlib.contextmanager
def operator(lab: Rig) -> Iterator[ClientConnection]:
    where = lab.look.replace("http", "ws") + "socket?control"
    with connect(where) as page:
        say(page, kind="hello", token=lab.token)
        assert words(page, "control")["granted"] is True
        yield page


def told(lab: Rig) -> list[dict[str, Any]]:
    text = "".join(p.read_text("utf-8") for p in sorted(lab.folder.glob("events_*.jsonl")))
    return [e for e in map(json.loads, text.splitlines()) if e.get("by") == "operator"]


@pytest.mark.attack(
    "3.4", "an event whose type is a list, from the token's holder", "his page is closed"
)
@pytest.mark.parametrize(
    ("event", "text"),
    [
        ({"type": []}, "type = []"),
        ({"type": {}}, "type = {}"),
        ({"type": "reference", "P_ref": 10**400}, "P_ref"),
        ({"type": "gains", "values": {"D_p": 10**400}}, "D_p"),
        ({"type": "grid-frequency", "f_hz": 1e308}, "f_hz"),
        ({}, "missing"),
    ],
    ids=["list", "object", "400 digits", "400 digits of a gain", "huge", "nothing"],
)
def test_whatever_an_event_is_it_is_answered(lab, event, text, attack_now):
    with operator(lab) as page:
        say(page, kind="command", id=1, event=event)
        answer = words(page, "answer")
        assert not answer["ok"] and text in answer["text"]
        say(page, kind="command", id=2, event={"type": "reference", "Q_ref": 0.01})
        assert words(page, "answer")["ok"]
    attack_now("refused in one line; the next command from the same page is carried out")


@pytest.mark.attack("10.1", "who gave this command?", '`by`: "operator", with no name')
def test_the_log_says_who_commanded(lab, attack_now):
    with operator(lab) as page:
        host, port = page.local_address[:2]
        say(page, kind="command", id=1, event={"type": "reference", "P_ref": 0.41})
        assert words(page, "answer")["ok"]
    line = wait_for(lambda: [e for e in told(lab) if e["label"] == "P_ref = 0.41"])[0]
    who = {"through": "scope", "name": "operator", "peer": f"{host}:{port}"}
    assert line["operator"] == who
    attack_now(f"`{json.dumps(who)}`")


@pytest.mark.attack(
    "10.2", "400 commands at once from one page", "400 carried out, 400 lines in events.jsonl"
)
def test_a_page_has_a_limit_of_commands(lab, attack_now):
    with operator(lab) as page:
        for k in range(400):
            say(page, kind="command", id=k, event={"type": "reference", "Q_ref": 0.02})
        answers = [words(page, "answer") for _ in range(400)]
    refused = [a["text"] for a in answers if not a["ok"]]
    assert all(a["ok"] for a in answers[: session.BURST])
    assert refused and all("commands a second" in text for text in refused)
    assert f"{len(refused)} refused" in refused[-1]
    attack_now(f"{400 - len(refused)} carried out, {len(refused)} refused and counted")
