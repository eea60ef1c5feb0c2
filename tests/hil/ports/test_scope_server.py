"""The scope's server: its files, its access rules, and its answers to messages."""

import json
import shutil
import ssl
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import gfmhil
from gfm_hil.cli import main
from gfm_hil.ports.scope.picture import HEAD
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.ports.scope.server import Scope, static_files
from gfm_hil.ports.scope.session import Access

from ...support.scope import addresses, serving, words

pytestmark = pytest.mark.processes

LOOK = {"kind": "look", "id": 1, "channels": ["p", "omega_u"], "bins": 50, "mode": "held"}


@pytest.fixture
def served(run) -> Iterator[tuple[int, Access, Any]]:
    """A finished run, served; its port, the rules, and the run."""
    done = run(events=[{"type": "reference", "t": 0.05, "P_ref": 0.6}])
    access = Access()
    scope = Scope([open_recording(done.folder)], access)
    with serving(scope) as port:
        yield port, access, done


def fetch(port: int, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as problem:
        return problem.code, dict(problem.headers), problem.read()


def test_page_with_its_policy(served):
    port, _, _ = served
    for path, (kind, content) in static_files().items():
        status, headers, body = fetch(port, path)
        assert (status, headers["Content-Type"], body) == (200, kind, content)
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
    assert b"<style" not in static_files()["/"][1]
    for wrong in ("/../server.py", "/server.py", "/%2e%2e/server.py", "/vendor", "/x.js"):
        assert fetch(port, wrong)[0] == 404


def test_page_and_server_mean_the_same_by_a_picture():
    script = static_files()["/frame.js"][1].decode()
    listed = script.partition("const HEAD = [")[2].partition("]")[0]
    assert [name.strip().strip('"') for name in listed.split(",")] == list(HEAD)


def test_nothing_is_fetched_from_elsewhere():
    for path, (_, content) in static_files().items():
        if not path.startswith("/vendor/"):
            assert b"http://" not in content.replace(b"http://www.w3.org/2000/svg", b"")
            assert b"https://" not in content
            assert b"innerHTML" not in content


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},  # a foreign name that resolves to us
        {"Host": "evil.example:80@127.0.0.1"},
        {"Host": "["},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
    ],
)
def test_others_pages_are_refused(served, headers):
    port, _, _ = served
    status, _, body = fetch(port, "/", **headers)
    assert status == 403
    assert b"not" in body


def test_sockets_of_others_pages_are_refused(served):
    port, _, _ = served
    address = f"ws://127.0.0.1:{port}/socket"
    origin = "http://127.0.0.1:1"
    with pytest.raises(InvalidStatus) as refused, connect(address, origin=origin):  # type: ignore[arg-type]
        pass
    assert refused.value.response.status_code == 403
    with connect(address, origin=f"http://127.0.0.1:{port}") as socket:  # type: ignore[arg-type]
        assert words(socket, "about")["title"] == "test"


def test_it_says_what_there_is_and_shows_it(served):
    port, _, done = served
    with connect(f"ws://127.0.0.1:{port}/socket") as socket:
        about = words(socket, "about")
        assert (about["live"], about["commands"], about["f_b"]) == (False, False, 50.0)
        assert about["labels"][0]["name"] == "mimo-gfm"
        assert {"grid-voltage", "grid-phase-jump", "fault"} <= about["events"].keys()
        assert {c["name"] for c in about["channels"]} >= {"p", "q", "V", "omega_u", "v_dc", "slack"}
        events = words(socket, "events")
        assert [e["label"] for e in events["events"] if "label" in e] == ["P_ref = 0.6"]
        assert events["summary"]["status"] == "completed"
        socket.send(json.dumps({**LOOK, "start": 0.0, "span": 0.1}))
        frame = socket.recv(10)
        assert isinstance(frame, bytes)
        head = dict(zip(HEAD, np.frombuffer(frame, "<f8", len(HEAD)), strict=True))
        assert (head["head"], head["width"], head["bins"]) == (1000, 16, 63)
        values = np.frombuffer(frame, "<f4", 4 * 63, 8 * len(HEAD)).reshape(4, 63)
        p = done.signals["y_p"].astype(np.float32)
        assert (values[0].min(), values[1].max()) == (p.min(), p.max())
        assert values[2, 0] == pytest.approx(50 * done.signals["y_omega_u"][:16].min())


def test_a_page_asks_for_a_converter_of_a_network(tmp_path):
    """Each gets the recording of the converter that it names, one that names none the first."""
    given = {
        "title": "two", "duration": 0.1, "law": "droop-3", "link": {"type": "inproc"},
        "network": {
            "converters": {"A": {"node": "bus", "references": {"P_ref": 0.2}},
                           "B": {"node": "bus", "references": {"P_ref": 0.4}}},
            "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.0},
                      "step": {"node": "bus", "P": 0.1, "closed": False},
                      "other": {"node": "bus", "P": 0.1, "closed": False}},
        },
        "events": [{"t": 0.05, "type": "breaker", "name": "step", "closed": True}],
    }  # fmt: skip
    run = gfmhil.run_network(given, tmp_path / "run", figures=False)
    scope = Scope([open_recording(run.folder / name) for name in run], Access())
    with serving(scope) as port:
        for query, name in (("", "A"), ("?of=A", "A"), ("?of=B", "B"), ("?of=C", "A")):
            with connect(f"ws://127.0.0.1:{port}/socket{query}") as socket:
                about = words(socket, "about")
                assert (about["converter"], about["converters"]) == (name, ["A", "B"])
                assert "fault" in about["events"]
                assert not [kind for kind in about["events"] if "grid" in kind or "jump" in kind]
                (bar,) = words(socket, "network")["bars"]
                assert (bar["name"], bar["converters"]) == ("bus", ["A", "B"])
                flows = words(socket, "flows")
                for other, seen in flows["converters"].items():
                    last = {key: run[other].signals[f"y_{key}"][-1] for key in ("p", "q", "V")}
                    assert {key: seen[key] for key in last} == pytest.approx(last, abs=1e-5)
                    f_hz = 50 * run[other].signals["y_omega_u"][-1]
                    assert seen["omega_u"] == pytest.approx(f_hz, abs=1e-5)
                    assert seen["state"] == "RUNNING"
                closed = {"A": True, "B": True, "base": True, "step": True, "other": False}
                assert flows["closed"] == closed
                socket.send(json.dumps({**LOOK, "start": 0.0, "span": 0.1}))
                frame = next(f for f in iter(lambda: socket.recv(10), None) if isinstance(f, bytes))
                values = np.frombuffer(frame, "<f4", 2 * 63, 8 * len(HEAD)).reshape(2, 63)
                p = run[name].signals["y_p"].astype(np.float32)
                assert (values[0].min(), values[1].max()) == (p.min(), p.max())


def test_a_run_that_is_over_can_be_played(served):
    port, _, _ = served
    with connect(f"ws://127.0.0.1:{port}/socket") as socket:
        socket.send(json.dumps({"kind": "play", "start": 0.02, "speed": 0.1}))
        socket.send(json.dumps({**LOOK, "mode": "roll", "span": 0.01}))
        heads: list[float] = []
        while len(heads) < 4:
            frame = socket.recv(10)
            if isinstance(frame, bytes):
                heads.append(np.frombuffer(frame, "<f8", len(HEAD))[list(HEAD).index("head")])
        assert heads == sorted(heads)
        assert 200 <= heads[0] < heads[-1] < 1000


@pytest.mark.parametrize(
    ("message", "words_of_it"),
    [
        ("no JSON", "JSON"),
        ("[]", "an object"),
        ('{"kind": "fire"}', "fire"),
        ('{"kind": "look"}', "missing"),
        (json.dumps({**LOOK, "span": 0.1, "bins": 10**9}), "bins"),
        (json.dumps({**LOOK, "span": -1.0}), "span"),
        (json.dumps({**LOOK, "span": 0.1, "channels": ["p"] * 100}), "channels"),
        (json.dumps({**LOOK, "span": 0.1, "channels": ["__class__"]}), "unknown"),
        (json.dumps({**LOOK, "span": 0.1, "mode": "trigger"}), "trigger"),
        ('{"kind": "look", "span": NaN}', "span"),
    ],
)
def test_bad_messages_are_answered_and_change_nothing(served, message, words_of_it):
    port, _, _ = served
    with connect(f"ws://127.0.0.1:{port}/socket") as socket:
        socket.send(message)
        assert words_of_it in words(socket, "error")["text"]
        socket.send(json.dumps({**LOOK, "span": 0.1}))
        assert isinstance(socket.recv(10), bytes)


def test_oversized_messages_end_the_connection(served):
    port, _, _ = served
    with connect(f"ws://127.0.0.1:{port}/socket") as socket:
        socket.send("x" * 100_000)
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(10)


def test_control_needs_the_token(served):
    port, access, _ = served
    with connect(f"ws://127.0.0.1:{port}/socket") as socket:
        tell = json.dumps({"kind": "command", "id": 1, "event": {"type": "reset"}})
        for token in ("", "wrong", access.tokens["operator"][:-1], "é"):
            socket.send(json.dumps({"kind": "hello", "token": token}))
            assert words(socket, "control")["granted"] is False
            socket.send(tell)
            assert "may look, not touch" in words(socket, "answer")["text"]
        socket.send(json.dumps({"kind": "hello", "token": access.tokens["operator"]}))
        assert words(socket, "control")["granted"] is True
        socket.send(tell)
        assert words(socket, "answer") == {
            "kind": "answer", "id": 1, "ok": False, "text": "the run is over",
        }  # fmt: skip


@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl to make a certificate")
def test_encrypted(run, start, tmp_path):
    folder = run(duration=0.01).folder
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256",
         "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-keyout", "key.pem", "-out", "cert.pem"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    command = ["scope", str(folder), "--port", "0", "--cert", "cert.pem", "--key", "key.pem"]
    look, _ = addresses(iter(start(*command).stdout))
    assert look.startswith("https://127.0.0.1:")
    context = ssl.create_default_context(cafile=str(tmp_path / "cert.pem"))
    context.check_hostname = False
    address = look.replace("https", "wss") + "socket"
    with connect(address, ssl=context, origin=look.rstrip("/")) as socket:  # type: ignore[arg-type]
        assert words(socket, "about")["kind"] == "about"


def test_scope_waits_for_a_run_that_is_to_come(start, tmp_path):
    scope = start("scope", "run", "--wait", "--port", "0")
    assert main(["run", "pref_step", "--link", "inproc", "--duration", "1.5", "--quiet",
                 "--no-figures", "--out", str(tmp_path / "run")]) == 0  # fmt: skip
    look, _ = addresses(iter(scope.stdout))
    with connect(look.replace("http", "ws") + "socket") as socket:
        assert words(socket, "about")["capacity"] == 15_000


def test_static_files_lie_in_the_package():
    licence = Path(static_files.__code__.co_filename).parent / "static/vendor/uPlot.LICENSE"
    assert "MIT" in licence.read_text("utf-8")
