"""A night of round trips: what is kept, how sure it is, and what other tools read of it."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.stats import binom, genpareto

from gfm_hil.bench.export import FORMATS, export
from gfm_hil.bench.histogram import histogram, lower_ends, quantiles
from gfm_hil.bench.night import COLUMNS, Block, Blocks, CellNight, night_of
from gfm_hil.bench.page import write_page
from gfm_hil.bench.tail import beyond, confidence
from gfm_hil.core.errors import UserError
from gfm_hil.realtime.environment import caveats, environment

CELL = ("shm", "realtime", "idle")
SETTINGS = {"policy": "fifo", "payload": 64}


def about():
    badge = environment() | {"steal_pct": 0.0}
    contender = {"link": "shm", "peer": "ours", "code": "compiled", "bench_us": 0.1}
    return {"contenders": {"shm": contender}, "environment": badge, "caveats": caveats(badge)}


def block(seed, n=100_000, at=0.0):
    """A block of simulated time: a round trip of 2 µs each 100 µs, one in 10,000 of 1 ms."""
    rng = np.random.default_rng(seed)
    times = (2000 * rng.lognormal(0, 0.2, n)).astype(np.int64)
    times[rng.random(n) < 1e-4] = 1_000_000
    made = Block(at, 100_000)
    made.add(times, at, "simulated")
    made.seconds += n * 1e-4
    return made


def test_intervals_hold_the_percentile_as_often_as_they_say():
    """Of an exponential distribution, over 400 draws: 95 %, within three sigma."""
    rng, inside = np.random.default_rng(1), {"p50_us_95": 0, "p99_us_95": 0, "p99_9_us_95": 0}
    truth = {"p50_us_95": np.log(2), "p99_us_95": np.log(100), "p99_9_us_95": np.log(1000)}
    for _ in range(400):
        found = confidence(histogram((1e6 * rng.exponential(1, 20_000)).astype(np.int64)))
        for key in inside:
            low, high = found[key]
            inside[key] += low * (1 - 1 / 64) <= 1e3 * truth[key] <= high * (1 + 1 / 64)
    assert min(inside.values()) >= binom.ppf(0.0013, 400, 0.95)
    few = confidence(histogram(np.arange(1, 1001)))
    assert few["p99_9_us_95"][1] is None  # the data end before


@pytest.mark.parametrize("shape", [-0.2, 0.0, 0.4])
def test_the_tail_is_what_scipy_fits(shape):
    rng = np.random.default_rng(2)
    over = genpareto.rvs(shape, scale=3e5, size=5000, random_state=rng)
    times = np.concatenate([rng.uniform(1e4, 1e5, 4_995_000), 1e5 + over]).astype(np.int64)
    found = beyond(histogram(times))
    c, _, scale = genpareto.fit(over, floc=0)
    assert found["fitted"] == pytest.approx(5000, rel=0.05)
    assert found["shape"] == pytest.approx(c, abs=0.05)
    assert found["scale_us"] == pytest.approx(scale / 1e3, rel=0.1)
    (many, us), *_ = found["estimates"]
    expected = 1e5 + genpareto.isf(1 / (10 * 5000), shape, scale=3e5)
    assert many == 10 * len(times) and us == pytest.approx(expected / 1e3, rel=0.5)
    assert beyond(histogram(times[:1000])) is None


def test_a_night_keeps_the_worst_the_bursts_and_the_course():
    night = CellNight()
    for k in range(3 * COLUMNS):
        made = block(k, 500, at=float(k))
        night.add(json.loads(made.line(CELL)))
    row = night.row(CELL)
    heat = row["night"]["heat"]
    assert row["n"] == 500 * 3 * COLUMNS
    assert COLUMNS / 2 < len(heat["at"]) <= COLUMNS
    assert sum(n for column in heat["counts"] for _, n in column) == row["n"]
    assert [us for _, us, _ in row["night"]["worst"]] == [1000.0] * 10
    late = sum(length * count for length, count in row["night"]["bursts"])
    assert late == sum(n for k, n in row["histogram"] if lower_ends()[k] > 100_000)


def test_a_burst_is_one_event():
    times = np.full(1000, 2000)
    times[300:320] = 100_000 * np.arange(20, 0, -1) + 50_000  # a stall of 2 ms
    made = Block(50.0, 100_000)
    made.add(times, 50.0, "a stall")
    assert made.worst[0] == (pytest.approx(50.03), 2050.0, "a stall")
    assert made.worst[1][1] == 2.0
    assert made.bursts == {20: 1}


@pytest.mark.processes
@pytest.mark.timeout(600)
def test_a_hundred_million_exchanges(tmp_path):
    """Memory stays flat, a kill costs at most a block, and the page takes two seconds at most of
    one processor's time."""
    program = (
        "import importlib.util, sys\n"
        "from pathlib import Path\n"
        f"spec = importlib.util.spec_from_file_location('night', {__file__!r})\n"
        "t = importlib.util.module_from_spec(spec)\n"
        "spec.loader.exec_module(t)\n"
        "folder, resume = Path(sys.argv[1]), sys.argv[2] == 'resume'\n"
        "blocks = t.Blocks(folder, t.SETTINGS, t.about(), resume)\n"
        "begin = len((folder / 'blocks.jsonl').read_bytes().splitlines())\n"
        "for k in range(begin, 1000):\n"
        "    blocks.append(t.CELL, t.block(k, at=10.0 * k))\n"
        "    memory = int(Path('/proc/self/statm').read_text().split()[1]) * 4\n"
        "    print(k, memory, flush=True)\n"
    )
    told = []
    for how, blocks in (("new", 300), ("resume", 1000)):
        line = [sys.executable, "-c", program, str(tmp_path), how]
        with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
            told.append([])
            for text in process.stdout:
                told[-1].append([int(word) for word in text.split()])
                if told[-1][-1][0] + 1 == blocks:
                    process.kill()
    assert told[1][0][0] in (300, 301)  # the next one, or the one after if the kill came late
    memory = [kb for _, kb in told[1]]
    assert memory[-1] - memory[50] < 20_000 and memory[-1] < 300_000
    before = time.process_time()
    content = night_of(tmp_path)
    write_page(content, tmp_path / "bench.html")
    assert time.process_time() - before < 20  # docs/bench.md has what it took
    (row,) = content["results"]
    assert row["n"] == 10**8
    assert row["p50_us"] == pytest.approx(2.0, rel=0.03)
    assert row["p99_99_us_95"][0] <= row["p99_99_us"] <= row["p99_99_us_95"][1]


def test_a_line_that_was_cut_off_counts_for_nothing(tmp_path):
    blocks = Blocks(tmp_path, SETTINGS, about(), False)
    for k in range(3):
        blocks.append(CELL, block(k, 1000))
    blocks.close()
    path = tmp_path / "blocks.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    assert night_of(tmp_path)["results"][0]["n"] == 2000
    blocks = Blocks(tmp_path, SETTINGS, about(), True)
    blocks.append(CELL, block(2, 1000))
    blocks.close()
    assert path.read_bytes() == whole
    with pytest.raises(UserError, match="--resume: payload was 64, and is 16 now"):
        Blocks(tmp_path, SETTINGS | {"payload": 16}, about(), True)
    with pytest.raises(UserError, match="holds no night"):
        Blocks(tmp_path / "none", SETTINGS, about(), True)


@pytest.fixture
def content(tmp_path):
    blocks = Blocks(tmp_path, SETTINGS, about(), False)
    blocks.append(CELL, block(1))
    blocks.close()
    return night_of(tmp_path)


def test_other_tools_read_what_is_exported(content, tmp_path):
    path, (row,) = tmp_path / "out", content["results"]
    pytest.importorskip("hdrh")
    export(content, "hdr", path)
    hdr, log = (pytest.importorskip(f"hdrh.{name}") for name in ("histogram", "log"))
    read = log.HistogramLogReader(str(path), hdr.HdrHistogram(1, 3_600_000_000_000, 3))
    found = read.get_next_interval_histogram()
    assert found.get_total_count() == row["n"]
    for share in (50.0, 99.0, 99.99):
        (expected,) = quantiles(histogram_of(row), [share / 100])
        assert found.get_value_at_percentile(share) == pytest.approx(expected, rel=0.01)
    export(content, "github", path)
    (p50, *_) = json.loads(path.read_text("utf-8"))
    assert (p50["name"], p50["unit"], p50["value"]) == (
        "shm, realtime, idle, p50", "µs", row["p50_us"]
    )  # fmt: skip
    export(content, "pytest", path)
    (one,) = json.loads(path.read_text("utf-8"))["benchmarks"]
    assert one["stats"]["median"] == pytest.approx(row["p50_us"] * 1e-6, rel=0.02)
    assert one["stats"]["rounds"] == row["n"]
    export(content, "prometheus", path)
    parser = pytest.importorskip("prometheus_client.parser")
    (family,) = parser.text_string_to_metric_families(path.read_text("utf-8"))
    samples = {(s.name, s.labels.get("quantile")): s.value for s in family.samples}
    assert samples["gfmhil_round_trip_seconds", "0.99"] == pytest.approx(row["p99_us"] * 1e-6)
    assert samples["gfmhil_round_trip_seconds_count", None] == row["n"]


def histogram_of(row):
    counts = np.zeros(1 + max(k for k, _ in row["histogram"]), np.int64)
    for k, n in row["histogram"]:
        counts[k] = n
    return counts


@pytest.mark.parametrize("form", FORMATS)
def test_a_result_without_round_trips_is_refused(form, content, tmp_path):
    with pytest.raises(UserError, match="no round trips"):
        export(content | {"results": []}, form, tmp_path / "out")
