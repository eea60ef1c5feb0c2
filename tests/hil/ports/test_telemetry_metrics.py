"""Metrics of a run, scraped as by Prometheus."""

import socket
import struct
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from gfm_hil.cli import main
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.streams import prometheus
from gfm_hil.ports.streams.port import METRICS, Follower
from gfm_hil.ports.streams.prometheus import RunCollector, serve_metrics
from gfm_hil.recording.parts import RolePart

from ...support.processes import PATIENCE_S, wait_for

pytestmark = pytest.mark.processes

SCENARIO = """
title = "collected"
duration = 600.0
ready_laws = ["vsg-2"]
[link]
options = { portable = true }  # slow: over shared memory it would end with millions of ticks
peer_timeout_s = 30.0
"""


def scraped(port: int | str) -> dict[tuple[str, str], float]:
    """All samples by name and label value."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10.0) as answer:
        text = answer.read().decode()
    return {
        (s.name, next(iter(s.labels.values()), "")): s.value
        for family in text_string_to_metric_families(text)
        for s in family.samples
    }


def test_a_run_is_collected_while_it_goes_on(start, tmp_path):
    file, folder = tmp_path / "collected.toml", tmp_path / "run"
    file.write_text(SCENARIO, encoding="utf-8")
    stream = start("stream", str(folder), "--wait", "--port", "0", "--prometheus", "0")
    run = start("run", str(file), "--out", str(folder), "--quiet", "--no-figures")
    *_, address = [stream.stdout.readline().split()[1] for _ in range(3)]
    port = address.removesuffix("/metrics").rpartition(":")[2]
    wait_for(lambda: scraped(port).get(("gfmhil_ticks_total", "plant"), 0) >= 10)
    first = scraped(port)
    operator = Operator(folder)
    operator.command({"type": "law", "law": "vsg-2"})
    wait_for(lambda: ("gfmhil_law_info", "vsg-2") in scraped(port))
    second = scraped(port)
    operator.stop()
    operator.close()
    run.communicate(timeout=PATIENCE_S)
    stream.communicate(timeout=PATIENCE_S)
    assert (run.returncode, stream.returncode) == (130, 0)
    assert {name for name, _ in second} == set(METRICS) - {"gfmhil_slack_seconds"}
    for role in ("plant", "controller"):
        assert 0 < first["gfmhil_ticks_total", role] < second["gfmhil_ticks_total", role]
    assert second["gfmhil_misses_total", ""] == 0
    assert second["gfmhil_state", "RUNNING"] == 1
    assert second["gfmhil_state", "SAFE"] == 0
    assert ("gfmhil_reason_info", "") in second
    assert (
        0 < second["gfmhil_round_trip_seconds", "0.5"] <= second["gfmhil_round_trip_seconds", "1"]
    )
    assert ("gfmhil_slack_seconds", "0.5") not in second  # lockstep has no deadlines


@pytest.fixture
def recorded(tmp_path: Path) -> Follower:
    """The files of an hour's run in real time after 30 s."""
    (tmp_path / "scenario.toml").write_text('T_s = 1e-4\nmode = "realtime"\n', encoding="utf-8")
    ticks = 300_000
    part = RolePart.create(tmp_path, "plant", ticks + 10)
    due = 5_000_000_000 + np.arange(ticks) * 100_000
    part.times[:ticks, 0] = part.times[:ticks, 2] = due
    part.times[:ticks, 3] = due + 30_000  # slack 70 µs
    part.times[: ticks - 100_000, 3] = due[: ticks - 100_000] + 90_000  # more than 10 s ago
    part.times[ticks - 500 : ticks, 3] = -1
    part.times[ticks - 600, 3] = due[ticks - 600] + 95_000
    part.progress[:2] = ticks, 500
    controller = RolePart.create(tmp_path, "controller", ticks + 10)
    controller.signals[ticks - 1, -3:] = 1.0, 3.0, 0.5
    controller.progress[0] = ticks
    return Follower(tmp_path)


def test_quantiles_are_of_the_last_ten_seconds(recorded):
    with serve_metrics(RunCollector([recorded]), "127.0.0.1", 0) as port:
        found = scraped(port)
    assert found["gfmhil_ticks_total", "plant"] == 300_000
    assert found["gfmhil_misses_total", ""] == 500
    assert found["gfmhil_slack_seconds", "0.5"] == pytest.approx(70e-6)
    assert found["gfmhil_slack_seconds", "0"] == pytest.approx(5e-6)
    assert found["gfmhil_round_trip_seconds", "0.999"] == pytest.approx(30e-6)
    assert found["gfmhil_round_trip_seconds", "1"] == pytest.approx(95e-6)
    # without a command server the law has only a number
    assert found["gfmhil_law_info", "1"] == 1
    assert found["gfmhil_state", "SAFE"] == 1


def test_a_run_without_a_tick_has_no_quantiles(tmp_path):
    (tmp_path / "scenario.toml").write_text('T_s = 1e-4\nmode = "realtime"\n', encoding="utf-8")
    RolePart.create(tmp_path, "plant", 10)
    families = {m.name: m.samples for m in RunCollector([Follower(tmp_path)]).collect()}
    assert families["gfmhil_slack_seconds"] == families["gfmhil_round_trip_seconds"] == []
    assert [s.value for s in families["gfmhil_ticks"]] == [0.0]


def test_before_a_run_there_is_nothing_to_collect():
    with serve_metrics(RunCollector(), "127.0.0.1", 0) as port:
        assert scraped(port) == {}


def test_what_is_missing_is_said(capsys, refused, monkeypatch, recorded):
    with serve_metrics(RunCollector([recorded]), "127.0.0.1", 0) as port:
        words = ["stream", str(recorded.folder), "--port", "0", "--prometheus", str(port)]
        assert main(words) == 2
    assert f"--prometheus {port}: 127.0.0.1: Address already in use" in capsys.readouterr().err
    monkeypatch.setattr("gfm_hil.core.errors.importlib.util.find_spec", lambda name: None)
    assert "pip install 'gfmhil[metrics]'" in refused("stream", "x", "--prometheus", "0")


@pytest.mark.attack(
    "11.3", "a client of the metrics that says nothing and resets the connection",
    "a traceback on stderr for each",
)  # fmt: skip
def test_a_client_that_hangs_up_is_not_worth_a_traceback(capfd, attack_now):
    gone = 20
    with serve_metrics(RunCollector(), "127.0.0.1", 0) as port:
        for _ in range(gone):
            with socket.create_connection(("127.0.0.1", port)) as stranger:
                stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert scraped(port) == {}
    assert capfd.readouterr().err == ""
    attack_now(f"{gone} such clients: nothing is printed, and the next one is served")


_FLOOD = """
import socket, sys, threading
port, ask = int(sys.argv[1]), b"GET /metrics HTTP/1.1\\r\\nHost: x\\r\\n\\r\\n"
silent = [socket.create_connection(("127.0.0.1", port)) for _ in range(int(sys.argv[2]))]
def flood():
    while True:
        try:
            with socket.create_connection(("127.0.0.1", port), 10) as one:
                one.sendall(ask)
                while one.recv(65536):
                    pass
        except OSError:
            pass
for _ in range(40):
    threading.Thread(target=flood, daemon=True).start()
print("on", flush=True)
sys.stdin.read()
"""


@pytest.mark.attack(
    "23.5", "a scraper of the metrics that asks on 40 connections without a pause, and holds 300",
    "each scrape is computed anew, 308 threads; another scraper waits 1.2 s for its connection",
)  # fmt: skip
def test_one_scraper_s_flood_leaves_room_for_another(recorded, spawn, monkeypatch, attack_now):
    times, computed = prometheus._times, []
    monkeypatch.setattr(
        prometheus, "_times", lambda run: computed.append(time.monotonic()) or times(run)
    )
    with serve_metrics(RunCollector([recorded]), "127.0.0.1", 0) as port:
        flood = spawn("-c", _FLOOD, str(port), "300")
        assert flood.stdout is not None and flood.stdout.readline() == "on\n"
        time.sleep(1.0)
        took = []
        for _ in range(10):
            began = time.monotonic()
            assert scraped(port)["gfmhil_misses_total", ""] == 500
            took.append(time.monotonic() - began)
        threads = threading.active_count()
    assert threads < 64 + 40 + 30
    assert (np.diff(computed) > 0.19).all()
    attack_now(f"another scraper waits {max(took):.2f} s at most; {threads} threads")
