"""A run's streams, to a subscriber of PlotJuggler's documented format and to ours."""

import io
import json
import shutil
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zmq

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.streams import BlockReader
from gfm_hil.ports.streams.messages import Sampler, block_dtype, block_messages
from gfm_hil.ports.streams.port import Follower, NewRows, Publisher
from gfm_hil.recording.columns import (
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
    ColumnSet,
    kept_of,
)
from gfm_hil.recording.parts import RolePart
from gfm_plant import BATTERY, CONNECTION
from gfm_runtime.signals import COUNTS, INNER, PLAIN

from ...support.processes import PATIENCE_S, takes_commands, wait_for

pytestmark = pytest.mark.processes

SCENARIO = """
title = "sent on"
duration = 200.0
mode = "{mode}"
late_policy = {{ hold = 100000 }}
[link]
{link}
peer_timeout_s = 30.0
"""
#: in lockstep a slow one: over shared memory a run would end with millions of ticks
LINK = {"lockstep": "options = { portable = true }", "realtime": 'type = "shm"'}


class PlotJuggler:
    """PlotJuggler 3's ZeroMQ subscriber, after its documentation and source: a SUB that connects
    and takes all topics; a single part is a payload, of two parts the first is the topic, a third
    would be the time; JSON whose numbers become series by their path below the topic."""

    def __init__(self, port: str) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.SUB)
        self.socket.subscribe(b"")
        self.socket.connect(f"tcp://localhost:{port}")
        self.series: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def receive(self, timeout_s: float) -> bool:
        if not self.socket.poll(timeout_s * 1e3):
            return False
        parts = self.socket.recv_multipart()
        assert len(parts) in (1, 2)  # its versions to date corrupt the payload if there is a third
        topic = parts[0].decode() if len(parts) == 2 else ""
        sample = json.loads(parts[-1], parse_constant=pytest.fail)  # NaN is not JSON
        self._flatten(topic, sample, sample["timestamp"])
        return True

    def receive_until(self, done: Callable[[], object]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < until
            self.receive(1.0)

    def _flatten(self, path: str, value: object, t: float) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                self._flatten(f"{path}/{key}", inner, t)
        elif isinstance(value, (int, float)):
            self.series[path].append((t, float(value)))


@pytest.fixture
def listen() -> Iterator[Callable[[str], PlotJuggler]]:
    """Makes subscribers and closes them: the garbage collector would wait for their sockets."""
    made = []

    def call(port: str) -> PlotJuggler:
        made.append(PlotJuggler(port))
        return made[-1]

    yield call
    for juggler in made:
        juggler.context.destroy(linger=0)


def run_and_stream(start, folder: Path, mode: str, *options: str):
    """Start a run and its stream; returns both processes and the ports of samples and blocks."""
    file = folder.parent / "sent.toml"
    file.write_text(SCENARIO.format(mode=mode, link=LINK[mode]), encoding="utf-8")
    stream = start("stream", str(folder), "--wait", "--port", "0", *options)
    run = start("run", str(file), "--out", str(folder), "--quiet", "--no-figures")
    ports = [stream.stdout.readline().split()[1].rpartition(":")[2] for _ in range(2)]
    return run, stream, ports


def stop(folder: Path, run: subprocess.Popen, stream: subprocess.Popen) -> dict[str, np.ndarray]:
    """Stop the run; returns its recording."""
    wait_for(lambda: takes_commands(folder))
    operator = Operator(folder)
    wait_for(lambda: operator.snapshot().get("tick", 0) >= 10)
    operator.stop()
    operator.close()
    run.communicate(timeout=PATIENCE_S)
    _, said = stream.communicate(timeout=PATIENCE_S)
    assert (run.returncode, stream.returncode) == (130, 0)
    assert said.endswith(" ticks sent on\n")
    with np.load(folder / "signals.npz") as signals, np.load(folder / "timing.npz") as times:
        return {**signals, **times}


def test_plotjuggler_reads_what_was_recorded_and_blocks_have_every_tick(start, listen, tmp_path):
    folder = tmp_path / "run"
    run, stream, (port, other) = run_and_stream(start, folder, "lockstep", "--rate", "500")
    juggler, blocks = listen(port), defaultdict(list)
    ticks = [juggler.series[f"gfmhil/{role}/tick"] for role in ROLES]
    with BlockReader(f"tcp://127.0.0.1:{other}") as reader:
        until = time.monotonic() + PATIENCE_S
        while min(map(len, ticks)) < 200 or min(len(blocks[role]) for role in ROLES) < 10:
            assert time.monotonic() < until
            juggler.receive(0.1)
            if block := reader.receive(0.1):
                blocks[block.role].append(block.rows)
    recorded = stop(folder, run, stream)
    check_samples(juggler, recorded)
    for role, times in (("plant", PLANT_TIMES), ("controller", CONTROLLER_TIMES)):
        rows = np.concatenate(blocks[role])
        ticks = rows["tick"]
        assert (np.diff(ticks) == 1).all()
        for name in rows.dtype.names[1:]:
            plain = name.removesuffix("_ns")
            whole = recorded[f"{role}_{plain}" if name != plain and plain in times else name]
            np.testing.assert_array_equal(rows[name], whole[ticks], err_msg=name)


def check_samples(juggler: PlotJuggler, recorded: dict[str, np.ndarray]) -> None:
    """Check that they are the recording's, every 20th tick of it."""
    ticks = {role: [int(k) for _, k in juggler.series[f"gfmhil/{role}/tick"]] for role in ROLES}
    for path, points in juggler.series.items():
        _, role, *rest = path.split("/")
        name = "_".join(rest)
        if name in recorded and name != "tick":
            seen = np.array(points)
            np.testing.assert_array_equal(seen[:, 1], recorded[name][ticks[role]])
            np.testing.assert_allclose(seen[:, 0], recorded["t"][ticks[role]], atol=1e-9)
    for path in ("plant/y/p", "plant/u/E_u", "plant/true/omega_g", "controller/ref/P_ref",
                 "controller/state"):  # fmt: skip
        assert len(juggler.series[f"gfmhil/{path}"]) >= 200
    assert {k % 20 for role in ticks.values() for k in role} == {0}  # 500 Hz of 10 kHz
    assert {misses for _, misses in juggler.series["gfmhil/plant/misses"]} == {0.0}
    assert "gfmhil/plant/slack_us" not in juggler.series  # lockstep has no deadlines


def test_samples_of_a_run_in_real_time_tell_misses_and_slack(start, listen, tmp_path):
    folder = tmp_path / "run"
    run, stream, (port, _) = run_and_stream(start, folder, "realtime")
    juggler = listen(port)
    juggler.receive_until(lambda: len(juggler.series["gfmhil/plant/slack_us"]) >= 100)
    recorded = stop(folder, run, stream)
    due, received = recorded["plant_scheduled"], recorded["plant_received"]
    misses = np.cumsum((due >= 0) & (received < 0))
    slack = np.where(received >= 0, (due + 100_000 - received) * 1e-3, np.inf)
    for (_, tick), (_, count) in zip(
        juggler.series["gfmhil/plant/tick"], juggler.series["gfmhil/plant/misses"], strict=True
    ):
        assert misses[int(tick)] == count
    ticks = [int(k) for _, k in juggler.series["gfmhil/plant/tick"]]
    told = dict(juggler.series["gfmhil/plant/slack_us"])
    for before, tick in pairwise(ticks):
        least = slack[before + 1 : tick + 1].min()
        assert told.get(round(tick * 1e-4, 9), np.inf) == pytest.approx(least, abs=1e-3)


def rows(first: int, count: int, **columns: np.ndarray) -> NewRows:
    """NewRows of a plant in real time without misses, with the given changes."""
    times = np.zeros((count, len(PLANT_TIMES)), np.int64)
    times[:, 0] = 1_000_000_000 + (first + np.arange(count)) * 100_000
    times[:, 3] = times[:, 0] + 40_000
    for name, values in columns.items():
        times[:, PLANT_TIMES.index(name)] = values
    return NewRows("plant", first, np.ones((count, len(PLANT_COLUMNS))), times)


def parsed(found: list[list[bytes]]) -> list[dict]:
    return [json.loads(payload) for _, payload in found]


def test_samples_count_misses_on_and_keep_the_least_slack():
    sampler = Sampler(1e-4, 1000.0, misses=5)
    received = rows(3, 25).columns["plant_received"].copy()
    received[[4, 20]] = -1  # ticks 7 and 23
    received[9] += 30_000  # tick 12
    found = parsed(sampler.messages(rows(3, 25, received=received), 25e-4))
    assert [s["tick"] for s in found] == [10, 20]
    assert [s["misses"] for s in found] == [6, 6]
    assert [s["slack_us"] for s in found] == [60.0, 30.0]
    assert parsed(sampler.messages(rows(28, 10), 1e-3))[0]["misses"] == 7


def test_a_run_faster_than_real_time_is_thinned_out():
    sampler = Sampler(1e-4, 1000.0, misses=0)
    assert len(sampler.messages(rows(0, 2000), 0.2)) == 200
    assert len(sampler.messages(rows(2000, 2000), 0.02)) == 20
    assert len(sampler.messages(rows(4000, 2000), 0.19)) == 200  # a short burst does not thin out


def test_ticks_never_recorded_and_numbers_that_json_has_not_are_left_out():
    some = rows(0, 3)
    some.signals[0] = np.nan
    some.signals[1, 2] = np.inf
    found = parsed(Sampler(1e-4, 10_000.0, misses=0).messages(some, 3e-4))
    assert [s["tick"] for s in found] == [1, 2]
    assert set(found[1]["y"]) - set(found[0]["y"]) == {"omega_u"}


def test_large_blocks_are_cut():
    found = block_messages(rows(7, 12_000))
    assert [topic for topic, _ in found] == [b"gfmhil/plant"] * 3
    assert (
        max(len(payload) for _, payload in found)
        < 5010 * block_dtype("plant", PLANT_COLUMNS).itemsize
    )


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize(
    "columns", [ColumnSet(COUNTS), ColumnSet(PLAIN, CONNECTION), ColumnSet(INNER, BATTERY)]
)
def test_blocks_have_the_columns_that_the_run_records(columns, role):
    names = columns.signals(role)
    signals = np.arange(3.0 * len(names)).reshape(3, -1)
    times = np.zeros((3, len(kept_of(role))), np.int64)
    ((_, payload),) = block_messages(NewRows(role, 5, signals, times))
    block = np.load(io.BytesIO(payload))
    assert [n for n in block.dtype.names if n != "tick" and not n.endswith("_ns")] == [*names]
    assert np.array_equal(np.stack([block[n] for n in names], axis=1), signals)


def test_a_role_alone_streams_its_own_columns(start, listen, tmp_path, endpoint):
    file = tmp_path / "sent.toml"
    file.write_text(SCENARIO.format(mode="lockstep", link=""), encoding="utf-8")
    words = [str(file), "--endpoint", endpoint, "--quiet", "--out"]
    roles = [start(role, *words, role) for role in ("controller", "plant")]
    stream = start("stream", "controller", "--wait", "--port", "0")
    juggler = listen(stream.stdout.readline().split()[1].rpartition(":")[2])
    juggler.receive_until(lambda: juggler.series)
    assert {path.split("/")[1] for path in juggler.series} == {"controller"}
    roles[0].terminate()
    for process in (*roles, stream):
        process.communicate(timeout=PATIENCE_S)
    assert [process.returncode for process in (*roles, stream)] == [130, 130, 0]


def test_a_port_that_is_taken_is_named():
    with Publisher("127.0.0.1", 0, 0) as first:
        port = int(first.samples.rpartition(":")[2])
        taken = f"--port {port}: tcp://127.0.0.1:{port}: Address already in use"
        with pytest.raises(UserError, match=taken):
            Publisher("127.0.0.1", port, 0)


@pytest.mark.attack(
    "3.6", "one exception in the stream's follower", "the stream ends while the run goes on"
)
def test_a_follower_that_fails_goes_on(tmp_path, monkeypatch, caplog, attack_now):
    monkeypatch.setattr("gfm_hil.core.supervised.PAUSE_S", 0.01)
    ticks = 3000
    (tmp_path / "scenario.toml").write_text("T_s = 1e-4\n", encoding="utf-8")
    part = RolePart.create(tmp_path, "plant", ticks)
    follower = Follower(tmp_path)
    part.signals[:], part.times[:] = 0.5, -1
    looks = iter(range(100, ticks + 1, 100))

    def stopped() -> bool:
        part.progress[0] = next(looks, ticks)
        if part.progress[0] == ticks:
            shutil.rmtree(tmp_path / "parts", ignore_errors=True)
        return False

    find, calls = RolePart.open, iter(range(100))
    problems = {2: OSError(24, "Too many open files"), 3: ValueError("a mistake of ours")}

    def sometimes(folder: Path, role: Role) -> RolePart | None:
        if problem := problems.get(next(calls, 0)):
            raise problem
        return find(folder, role)

    monkeypatch.setattr(RolePart, "open", sometimes)
    with Publisher("127.0.0.1", 0, 0) as publisher:
        sent = publisher.follow([follower], 500.0, stopped)
    assert sent == ticks
    assert "Too many open files" in caplog.text and "a mistake of ours" in caplog.text
    attack_now(f"2 of 2 reported; {sent} of {ticks} ticks sent on")


def test_a_side_that_begins_while_the_news_are_read_is_in_the_next(tmp_path, monkeypatch):
    """The plant's parts appear between two looks at them of one call."""
    (tmp_path / "scenario.toml").write_text("T_s = 1e-4\n", encoding="utf-8")
    controller, plant = (RolePart.create(tmp_path, role, 10) for role in ROLES)
    find = RolePart.open
    hidden = iter([True] * 3)  # from two looks of the constructor, and from the first of the news

    def begun(folder: Path, role: Role) -> RolePart | None:
        return None if role == "plant" and next(hidden, False) else find(folder, role)

    monkeypatch.setattr(RolePart, "open", begun)
    follower = Follower(tmp_path)
    controller.progress[0], plant.progress[0] = 5, 7
    assert [(rows.role, len(rows.signals)) for rows in follower.news()] == [("controller", 4)]
    assert [(rows.role, len(rows.signals)) for rows in follower.news()] == [("plant", 6)]
