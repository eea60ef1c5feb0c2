"""bench.html: all of a result in one file that needs no network."""

import base64
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.bench.histogram import summary
from gfm_hil.bench.page import all_tables, figures, write_page
from gfm_hil.bench.rounds import spread
from gfm_hil.bench.tables import latency_verdicts
from gfm_hil.realtime.environment import caveats, environment


def times(median_us: float, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    return summary([(1e3 * median_us * rng.lognormal(0, 0.3, 400)).astype(np.int64)] * 3)


@pytest.fixture
def content() -> dict[str, Any]:
    """A synthetic result with all parts."""
    latency = [
        {
            "name": name, "link": link, "peer": peer, "code": code, "mode": mode, "load": load,
            "policy": "fifo", "payload": 64, "baseline": "C shm", "silent_rounds": 0,
            "ratio_to_baseline_p50": ratio, **times(median, k),
        }
        for mode in ("lockstep", "realtime")
        for load in ("idle", "busy")
        for k, (name, link, peer, code, ratio, median) in enumerate(
            [
                ("C shm", "shm", "C", "C", 1.0, 0.5),
                ("shm", "shm", "ours", "compiled", 1.25, 0.6),
                ("<zmq> & Co", "zmq", "ours", "Python", None, 50.0),
            ]
        )
    ]  # fmt: skip
    ns = spread([80.0, 90.0, 100.0])
    badge = environment() | {"steal_pct": 0.3}
    return {
        "bench": "all",
        "results": latency,
        "jitter": [
            {"policy": "fifo", "load": "idle", "wait": wait, "period_us": 100.0, "lost_pct": 0.1,
             **times(1.0, 9)}
            for wait in ("sleep+spin", "spin")
        ],
        "loop": {
            "realtime": [
                {"link": "shm", "load": "idle", "ticks": 9000, "missed": 9, "missed_pct": 0.1,
                 "host_pct": 0.05, "beyond_host_pct": 0.05, "bursts": [(1, 4), (5, 1)],
                 "by_work_or_link_pct": 0.0333,
                 "names": {"irq 24, virtio": 4, "the host": 2}, "method": "trace",
                 "causes": {"own work": 1, "link": 2, "late wake-up": 3, "stalled host": 3},
                 **times(2.0, 3)},
            ],
            "lockstep": [
                {"link": "shm", "delay_samples": 1, "ticks_per_s": ns, "times_real_time": ns,
                 "share_of_plant_alone": spread([0.8])},
            ],
            "laws": [
                {"law": "mimo-gfm", "whole_ns": ns, "plant_ns": ns, "controller_ns": ns,
                 "recording_ns": ns, "times_real_time": ns, "allocations_per_tick": 0.0},
            ],
        },
        "sweep": [
            {"name": "shm", "peer": "ours", "payload": payload, "policy": "fifo", "load": "idle",
             "wait": "both", "khz": khz, "missed_pct": missed, "processor_pct": 98.0,
             "opened_kb": 100, **times(3.0, 4)}
            for payload in (16, 504) for khz, missed in ((1.0, 0.0), (20.0, 12.0))
        ],
        "highest": [
            {"name": "shm", "payload": 16, "policy": "fifo", "load": "idle", "wait": "both",
             "highest_khz": 5.2, "most_missed_pct": 1.0}
        ],
        "kernel": [
            {"law": "mimo-gfm", "real": real, "states": 3, "numba_ns": ns, "c_ns": c, "ratio": c}
            for real, c in (("float64", ns), ("float32", None))
        ],
        "remarks": ["shm < can"],
        "environment": badge,
        "caveats": caveats(badge),
        "seconds": 12.5,
    }  # fmt: skip


class Outline(HTMLParser):
    """The elements of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tables = 0
        self.links: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tables += tag == "table"
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def read(content: dict[str, Any], folder: Path) -> Outline:
    write_page(content, folder / "bench.html")
    page = Outline()
    page.feed((folder / "bench.html").read_text("utf-8"))
    return page


def test_page_holds_every_table_and_figure_and_needs_nothing_else(content, tmp_path):
    """The figures are drawn twice: the same bytes for the same result."""
    page = read(content, tmp_path)
    drawn = [table for _, table in all_tables(content)]
    assert page.tables == len(drawn) == 13
    for table in drawn:
        assert table.title in page.text
        assert all(cell in page.text for row in table.rows for cell in row)
    assert len(page.links) == 6
    assert content["remarks"][0] in page.text
    assert all(caveat in page.text for caveat in content["caveats"])
    assert content["environment"]["cpu"] in page.text
    for link in page.links:
        assert link.startswith("data:image/svg+xml;base64,")
        ET.fromstring(base64.b64decode(link.split(",")[1]))  # is an image
    files = {path.stem: path.read_bytes() for path in tmp_path.glob("*.svg")}
    assert files == figures(content)
    written = (tmp_path / "bench.html").read_text("utf-8")
    assert not re.search(r"<script|@import|url\(|https?://", written)


@pytest.mark.parametrize("kept", ["results", "jitter", "loop", "kernel"])
def test_page_of_one_part(content, kept, tmp_path):
    part = {k: v for k, v in content.items() if k not in ("jitter", "loop", "kernel")}
    part |= {"results": []} if kept != "results" else {}
    part[kept] = content[kept]
    page = read(part, tmp_path)
    assert page.tables == len(list(all_tables(part))) > 0
    assert page.links


def test_link_that_was_silent_has_a_row_and_no_curve(content, tmp_path):
    content["results"][1] |= summary([])
    page = read(content, tmp_path)
    assert "–" in page.text


def test_caveats_follow_the_badge():
    ideal = {
        "virtual_machine": "no", "steal_pct": 0.0, "sched_fifo": True, "isolated_cpus": "2-3",
        "governor": "performance", "cpus": 4, "load_average": [0.1, 0.1, 0.1],
    }  # fmt: skip
    assert caveats(ideal) == []
    for change, word in (
        ({"virtual_machine": "KVM"}, "host"), ({"sched_fifo": False}, "SCHED_FIFO"),
        ({"isolated_cpus": "none"}, "isolated"), ({"governor": "powersave"}, "powersave"),
        ({"steal_pct": 2.0}, "2 %"), ({"load_average": [9.0, 9.0, 9.0]}, "9"),
        ({"cpus": 1, "load_average": [0.0]}, "One processor"),
    ):  # fmt: skip
        (said,) = caveats(ideal | change)
        assert word in said


def test_each_link_gets_a_sentence_with_its_limit(content):
    said = [*latency_verdicts(content)]
    assert len(said) == 8  # two links, two modes, two loads
    (shm,) = (text for text in said if text.startswith("shm, realtime, idle"))
    assert re.search(r"1\.25 × C shm \(0\.\d\d µs\): as quick as its limit", shm)
    assert shm.endswith("100 % of the answers within a tick of 100 µs")
    (other,) = (text for text in said if text.startswith("<zmq> & Co, lockstep, idle"))
    assert " × " not in other and "tick" not in other
