"""``gfmhil bench``: its files and its errors. The tests judge no figure."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.bench import outside
from gfm_hil.bench.contenders import FRAME, PEERS, messages, missing_packages
from gfm_hil.bench.jitter import PERIOD_NS, WAITS, WATCHED, at_awaited
from gfm_hil.bench.kernel import compare, compile_twin
from gfm_hil.bench.sweep import highest
from gfm_hil.bench.tables import _agrees
from gfm_hil.bench.tail import median_interval
from gfm_hil.cli import main
from gfm_hil.cli.main import parser
from gfm_runtime import law_names

pytestmark = pytest.mark.processes
alone = pytest.mark.alone  # what measures under SCHED_FIFO takes the processors from others

NONE = ("--peers", "none")
KEYS = {
    "link", "peer", "code", "mode", "load", "policy", "payload", "n", "ratio_to_baseline_p50",
    "p50_us", "p90_us", "p99_us", "p99_9_us", "p99_99_us", "max_us",
}  # fmt: skip


def bench(tmp_path: Path, capsys: Any, kind: str, *options: str) -> dict[str, Any]:
    """Run a benchmark with minimal work; returns its result."""
    line = ["bench", kind, "--rounds", "2", *options, "--out", str(tmp_path / "bench"), "--json"]
    assert main(line) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "bench" / "bench.json").read_text("utf-8"))
    return dict(printed)


@alone
@pytest.mark.apt
def test_latency_puts_every_link_beside_its_limit(tmp_path, capsys):
    short = ("--seconds", "0.02", "--rounds", "1")
    found = bench(tmp_path, capsys, "latency", "--links", "shm,zmq", *short, *NONE)
    rows = found["results"]
    assert {r["link"] for r in rows} == {"shm", "zmq"}
    assert {(r["mode"], r["load"]) for r in rows} == {
        (m, w) for m in ("lockstep", "realtime") for w in ("idle", "busy")
    }
    for row in rows:
        assert row.keys() >= KEYS
        assert row["n"] > 0
        assert 0 < row["p50_us"] <= row["p90_us"] <= row["p99_us"] <= row["max_us"]
        assert row["ratio_to_baseline_p50"] > 0
        assert sum(n for _, n in row["histogram"]) == row["n"]
        if row["peer"] == "C":
            assert row["ratio_to_baseline_p50"] == 1
    assert found["seconds"] > 0
    assert found["environment"]["cpus"] == len(os.sched_getaffinity(0))


@pytest.mark.apt
def test_every_peer_answers_beside_its_limit(tmp_path, capsys):
    short = ("--seconds", "0.05", "--load", "idle", "--mode", "lockstep", "--policy", "other")
    found = bench(tmp_path, capsys, "latency", "--links", "shm", *short)
    rows = {row["link"]: row for row in found["results"] if row["peer"] not in ("ours", "C")}
    expected = {name for name in PEERS if not missing_packages(name)}
    if any("no multicast" in text for text in found["remarks"]):
        expected -= {"lcm"}
    assert rows.keys() == expected
    for row in rows.values():
        assert row["n"] > 0 and row["silent_rounds"] == 0 and row["ratio_to_baseline_p50"] > 0


def test_a_peer_that_is_not_installed(capsys, monkeypatch):
    monkeypatch.setitem(PEERS, "nng", ("no_such_package",))
    assert main(["bench", "latency", "--peers", "nng"]) == 2
    assert "--peers nng: needs no_such_package: pip install" in capsys.readouterr().err


@pytest.mark.apt
def test_the_message_is_the_frame_unless_told_otherwise():
    payload = parser("bench").parse_args(["bench", "latency"]).payload
    there, back = (messages(role, payload) for role in ("plant", "controller"))
    assert (there.shape[1], back.shape[1]) == (payload, 48) == (FRAME, 48)
    assert bytes(there[0, :2]) == bytes(back[0, :2]) == b"GF"
    assert messages("controller", 100).shape[1] == 100


def test_kernel_is_its_twin_in_c_bit_for_bit(tmp_path):
    """All laws, float64 and float32, on inputs that drive each output into its limits."""
    limited: list[list[int]] = []
    for real in ("float64", "float32"):
        twin = compile_twin(tmp_path, law_names(), real)
        found = {name: compare(name, real, twin, rounds=2) for name in law_names()}
        assert {name: ulps for name, (ulps, _) in found.items()} == dict.fromkeys(found, 0)
        limited += [counts for _, counts in found.values()]
    assert all(any(row) for row in zip(*limited, strict=True))


@pytest.mark.apt
def test_kernel_is_timed_beside_c(tmp_path, capsys):
    rows = bench(tmp_path, capsys, "kernel", "--laws", "mimo-gfm,droop-1")["kernel"]
    assert {(r["law"], r["real"]) for r in rows} == {
        (law, real) for law in ("mimo-gfm", "droop-1") for real in ("float64", "float32")
    }
    for row in rows:
        assert row["ulps"] == 0
        assert row["numba_ns"]["median"] > 0
        assert row["ratio"]["median"] > 0


def test_kernel_without_a_compiler(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    found = bench(tmp_path, capsys, "kernel", "--laws", "droop-1")
    assert all(r["numba_ns"]["median"] > 0 and r["ratio"] is None for r in found["kernel"])
    assert any("no C compiler" in remark for remark in found["remarks"])


def test_others_are_compared_at_the_deadlines_that_both_wait_for():
    """The loop of cyclictest, beside ours, with the same two stalls: it skips what has passed."""
    sleeps = np.full(1000, 7_000)  # ns from a deadline to the wake-up
    sleeps[[50, 700]] = 1_234_000, 100_001
    dues = PERIOD_NS * np.arange(1000)
    ours, theirs, now = np.zeros((2, 1000), np.int64), [], -1
    for k, due in enumerate(dues):
        if now <= due:
            now = due + sleeps[k]
            theirs.append(sleeps[k])
        ours[:, k] = now - due
    assert at_awaited(ours).tolist() == 2 * theirs
    assert len(theirs) == 1000 - 12 - 1


def test_the_interval_of_a_median_has_the_ranks_of_the_tables():
    """W. J. Conover, Practical Nonparametric Statistics, table of quantile confidence intervals."""
    for n, ranks in {3: (1, 3), 6: (1, 6), 9: (2, 8), 20: (6, 15), 50: (18, 33)}.items():
        assert median_interval([float(k) for k in range(n, 0, -1)]) == ranks


@pytest.mark.parametrize(
    ("p99", "verdict"),
    [([1.08, 0.9, 1.3], "agree"), ([1.3, 1.2, 1.5], "differ"), ([1.3, 1.0, 1.5], "too few rounds")],
)
def test_agreement_is_told_where_the_rounds_can_tell(p99, verdict):
    assert f": {verdict}" in _agrees({"to_ours": {"p50": [1.0, 0.9, 1.1], "p99": p99}})


def test_jitter_shows_every_way_to_wait(tmp_path, capsys):
    options = ("jitter", "--seconds", "0.02", "--policy", "other", "--load", "idle")
    rows = bench(tmp_path, capsys, *options)["jitter"]
    others = {name for name in outside.PROGRAMS if not outside.missing(name)}
    assert {r["wait"] for r in rows} == {*WAITS, *others}
    for row in rows:
        if row["wait"] in others:
            assert row["n"] > 0
            assert row["to_ours"].keys() == {"p50", "p99"}
            assert all(low <= middle <= high for middle, low, high in row["to_ours"].values())
            continue
        assert (row["method"] is not None) == (row["wait"] == WATCHED)
        assert row["n"] == 2 * row["ticks"] == 2 * 2 * 200  # processors, rounds
        assert row["lost"] == sum(length * count for length, count in row["bursts"])
        assert row["lost_pct"] == pytest.approx(100 * row["lost"] / row["ticks"], abs=1e-3)


def test_sweep_has_every_payload_rate_load_and_wait(tmp_path, capsys):
    short = ("--seconds", "0.02", "--policy", "other", "--links", "shm", *NONE)
    axes = (
        "--payloads",
        "16,505",
        "--rates",
        "1,5",
        "--load",
        "idle,network",
        "--wait",
        "both,sleep",
    )
    found = bench(tmp_path, capsys, "sweep", *short, *axes)
    rows = [row for row in found["sweep"] if row["peer"] == "ours"]
    keys = [(r["payload"], r["khz"], r["load"], r["wait"]) for r in rows]
    wanted = list(product((16,), (1.0, 5.0), ("idle", "network"), ("both", "sleep")))
    assert sorted(keys) == sorted(wanted)
    assert "shm, 505 B: not measured: it carries messages of up to 504 bytes" in found["remarks"]
    for row in rows:
        assert row["n"] > 0
        assert 0 <= row["missed_pct"] <= 100
        assert row["processor_pct"] > 0
    for row in found["highest"]:
        assert row["highest_khz"] is None or 1 <= row["highest_khz"] <= 5


@pytest.mark.parametrize(
    ("bears_to", "found"), [(30.0, 20.0), (0.5, None), (5.0, 5.0)], ids=["all", "none", "some"]
)
def test_the_highest_rate_is_found_by_bisection(bears_to, found):
    rate = highest(lambda khz: 0.0 if khz <= bears_to else 50.0, [1.0, 20.0], 1.0)
    assert rate is found or (rate == pytest.approx(found, rel=0.1) and rate <= found)


@alone
def test_loop_runs_the_product_over_a_link(tmp_path, capsys):
    loop = bench(
        tmp_path, capsys, "loop", "--links", "shm", "--laws", "mimo-gfm", "--seconds", "1",
        "--load", "idle", "--rounds", "1",
    )["loop"]  # fmt: skip
    assert {r["link"] for r in loop["lockstep"]} == {"inproc", "shm"}
    assert all(r["ticks_per_s"]["median"] > 0 for r in loop["lockstep"])
    (row,) = loop["realtime"]
    assert 0 < row["ticks"] < 10_000  # without those before the watch over the processors
    assert row["n"] == row["ticks"] - row["missed"]
    assert sum(row["causes"].values()) == row["missed"]
    ours = row["causes"]["own work"] + row["causes"]["link"]
    assert row["by_work_or_link_pct"] == pytest.approx(100 * ours / row["ticks"], abs=1e-4)
    assert sum(length * count for length, count in row["bursts"]) == row["missed"]
    assert {r["law"] for r in loop["laws"]} == {"mimo-gfm", "mimo-gfm, rig"}
    for row in loop["laws"]:
        assert row["allocations_per_tick"] == 0


def test_loop_that_trips_is_not_timed(tmp_path, capsys):
    line = ["bench", "loop", "--laws", "dvoc", "--mode", "lockstep", "--rounds", "1"]
    line += ["--links", "shm", "--seconds", "0.1"]
    assert main([*line, "--out", str(tmp_path / "bench")]) == 2
    assert capsys.readouterr().err.startswith("gfmhil: dvoc: tripped or safe at tick ")


def test_without_a_compiler_the_links_are_measured_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    short = ("--seconds", "0.02", "--load", "idle", "--policy", "other")
    found = bench(tmp_path, capsys, "latency", "--links", "shm", *short)
    assert "C" not in {r["peer"] for r in found["results"]}
    assert all(r["ratio_to_baseline_p50"] is None and r["n"] for r in found["results"])
    assert any("no C compiler" in remark for remark in found["remarks"])


def processes_with(mark: str) -> int:
    """How many processes have a mark in their environment."""
    found = 0
    for place in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):  # it has ended
            found += mark.encode() in place.read_bytes()
    return found


@alone
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    (
        "kind",
        "everyone",
    ),  # the parent, its folder's guard, the pair, the CPU load; the product's two sides
    [("latency", 4 + len(os.sched_getaffinity(0))), ("loop", 6 + len(os.sched_getaffinity(0)))],
)
def test_ctrl_c_leaves_nothing_behind(kind, everyone, tmp_path):
    mark = f"GFMHIL_TEST={uuid.uuid4()}"
    line = ["bench", kind, "--links", "shm", "--seconds", "8", "--mode", "realtime"]
    process = subprocess.Popen(
        [sys.executable, "-m", "gfm_hil", *line, "--out", str(tmp_path / "bench")],
        env={**os.environ, **dict([mark.split("=")])}, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        until = time.monotonic() + 90
        while processes_with(mark) < everyone and time.monotonic() < until:
            assert process.poll() is None, process.communicate()
            time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        said = process.communicate(timeout=180)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert said == ("", "")
    assert processes_with(mark) == 0


def test_a_killed_benchmark_leaves_no_cpu_load(tmp_path):
    """The load's processes are stopped when their parent is killed: SIGTERM would not end them."""
    mark = f"GFMHIL_TEST={uuid.uuid4()}"
    program = "from gfm_hil.bench.cpu_load import cpu_load\nwith cpu_load():\n    input('ready')"
    with subprocess.Popen(
        [sys.executable, "-c", program], env={**os.environ, **dict([mark.split("=")])},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None and process.stdout.read(5) == b"ready"
            assert processes_with(mark) == 1 + len(os.sched_getaffinity(0))
        finally:
            process.kill()
    until = time.monotonic() + 60
    while processes_with(mark) and time.monotonic() < until:
        time.sleep(0.02)
    assert processes_with(mark) == 0
