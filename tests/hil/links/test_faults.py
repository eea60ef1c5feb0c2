"""Deliberate faults on every link, in lockstep: each is counted, none changes a result.

With GFMHIL_FAULTS_REPORT=FILE runs have 100,000 ticks, and each appends its row of the table in
docs/protection.md to the file.
"""

import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.roles import ROLES
from gfm_hil.scenario import check_scenario

from ...support.links import LINKS, PATIENT, Pair, run_pair

pytestmark = [pytest.mark.processes, pytest.mark.timeout(900)]

REPORT = os.environ.get("GFMHIL_FAULTS_REPORT")
TICKS = 100_000 if REPORT else 1_000
IMPAIRMENTS: dict[str, dict[str, Any]] = {
    "loss": {"loss": 0.01},
    "burst": {"loss": 0.01, "burst": 4.0},
    "corrupt": {"corrupt": 0.01},
    "corrupt-bits": {"corrupt": 0.01, "bits": 16},
    "duplicate": {"duplicate": 0.01},
    "reorder": {"reorder": 0.01},
    "delay": {"delay": 50e-6},
    "jitter": {"delay": 20e-6, "jitter": 100e-6},
    "pause": {"pause_at": 700, "pause": 0.05},
    "all": {"loss": 0.005, "burst": 2.0, "corrupt": 0.005, "duplicate": 0.005, "reorder": 0.005},
}


def lockstep(place: Path, link: str, impairment: dict[str, Any] | None) -> Pair:
    """A run with a step of the power reference over one of ``LINKS``."""
    name, options = LINKS[link]
    content = {
        "title": "faults",
        "duration": TICKS * 1e-4,
        "seed": 5,
        "law": "mimo-gfm",
        "link": {**PATIENT, "repeat_s": 0.01, "impairment": impairment},
        "plant": {"sensors": {"noise_std": {"p": 1e-4, "V": 1e-4}}},
        "events": [{"tick": TICKS // 3, "type": "reference", "P_ref": 0.6}],
    }
    return run_pair(check_scenario(content, "test"), place, name, options)


@cache
def unharmed(link: str) -> dict[str, np.ndarray]:
    """The signals of the run without faults."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as folder:
        return lockstep(Path(folder), link, None).signals


def check(pair: Pair, link: str) -> None:
    """Check that the signals are unchanged, and that exactly the injected faults are counted."""
    assert {role: end[0] for role, end in pair.ends().items()} == dict.fromkeys(ROLES, "completed")
    plain = unharmed(link)
    for name in plain:
        assert pair.signals[name].tobytes() == plain[name].tobytes(), name
    for role, other in zip(ROLES, reversed(ROLES), strict=True):
        i, faults = pair.injected[role], pair.faults[role]
        assert i["seen"] >= TICKS
        assert faults["crc"] == i["corrupted"]
        gone = i["lost"] + i["corrupted"] + i["reordered"] + i["dropped"]
        refused = pair.injected[other]["refused"]  # the link had no room, on a crowded machine
        assert gone <= faults["lost"] <= gone + refused
        late = faults["repeated"] + faults["out_of_sequence"]
        assert late <= i["duplicated"] + i["reordered"] <= late + i["waiting"]
        assert not any(faults[f] for f in ("size", "magic", "version", "source", "tick", "state"))


#: the stage stands before every link: each fault hits one link with a port; one without a port, and
#: the others, have those of which each acts in another way, for a part of them or all together
CASES = [
    (link, kind)
    for link in LINKS
    for kind in IMPAIRMENTS
    if REPORT
    or kind == "all"
    or link == "shm"
    or (link == "zmq-portable" and kind in ("corrupt-bits", "jitter", "pause"))
]


@pytest.mark.parametrize(("link", "kind"), CASES)
def test_every_fault_is_counted_and_no_result_changes(link, kind, place):
    pair = lockstep(place, link, IMPAIRMENTS[kind])
    check(pair, link)
    if "delay" not in IMPAIRMENTS[kind]:
        hit = ("lost", "corrupted", "duplicated", "reordered", "paused")
        assert all(sum(pair.injected[role][h] for h in hit) > 0 for role in ROLES)
    if REPORT:
        with Path(REPORT).open("a", encoding="utf-8") as file:
            file.write(row(link, kind, pair) + "\n")


def row(link: str, kind: str, pair: Pair) -> str:
    """The sum of both sides' counters as a row of a table in Markdown."""
    i = {name: sum(pair.injected[s][name] for s in ROLES) for name in pair.injected["plant"]}
    f = {name: sum(pair.faults[s][name] for s in ROLES) for name in pair.faults["plant"]}
    told = [i[n] for n in ("seen", "lost", "corrupted", "duplicated", "reordered", "refused")]
    counted = [f[n] for n in ("lost", "crc", "repeated", "out_of_sequence")]
    return f"| {link} | {kind} | " + " | ".join(f"{n:,}" for n in (*told, *counted)) + " |"
