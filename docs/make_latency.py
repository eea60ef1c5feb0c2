"""Table of docs/bench.md on what laws bear of ticks without a new u.

For every law of the catalogue on the plant of `pref_step` and on that of `rig_pref_step` (without
noise and rounding, so that two runs can be compared), it takes the unstable word with the fewest
misses, n + 1, and the worst word of n, and runs both on the bench: a trace says which ticks are
missed. Two runs that differ by a millionth of P_ref and V_ref show whether a difference grows. They
last the longer the slower it would, but a minute at most. Writes

    docs/tables/latency_words.md        what laws bear by the linear loop, and by the bench

Usage: python docs/make_latency.py [LAW ...]    (all laws: half an hour beside other work)
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import gfmhil
from gfm_design.misses.ticks import MEANWHILE, Meanwhile, ticks
from gfm_design.misses.words import Word, Words
from gfm_design.model.closed_loop import ClosedLoop
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import markdown
from gfm_hil.scenario import Scenario, check_scenario, load_scenario
from gfm_hil.studies.linear_loop import scenario_loop
from gfm_runtime import law_names

DOCS = Path(__file__).resolve().parent
SECONDS, FIRST = (8.0, 60.0), 10  # of a run, least and most; tick at which the words begin
TIMES = 8.0  # the factors of e by which a difference should grow or shrink in a run
STEP, GREW, SMALL = 1e-6, 1e-3, 1e-13  # of both; of a difference, p.u.
BACK, PARTS = 300, 24  # tick at which both are as before; windows of the difference
SHOWN = ("true_p", "true_q", "true_V", "true_v_dc")
SETTINGS = {"ideal": "pref_step", "rig": "rig_pref_step"}


def setting(
    name: str, law: str, trace: str | None, step: float, seconds: float = SECONDS[0]
) -> Scenario:
    """A scenario of ``SETTINGS`` without noise, rounding and its events; P_ref and V_ref have a
    pulse at its start."""
    content: dict[str, Any] = load_scenario(SETTINGS[name]).model_dump(
        mode="json", exclude_unset=True
    )
    plant = content.get("plant", {})
    for key in ("adc", "dac"):
        plant.pop(key, None)
    plant.get("sensors", {}).pop("noise_std", None)
    content |= {"law": law, "duration": seconds, "mode": "lockstep", "expect": "completed"}
    content |= {"late_policy": {"hold": 10**6}, "link": {"type": "inproc"}, "compare": []}
    pulse = ((5, step), (BACK, 0.0))  # of both, so that no mode stays below rounding
    content["events"] = [
        {"tick": k, "type": "reference", "P_ref": 0.5 + by, "V_ref": 1.0 + by} for k, by in pulse
    ]
    if trace is not None:
        content["link"]["impairment"] = {"trace": trace}
    return check_scenario(content, name)


def write_trace(path: Path, word: Word, case: Meanwhile, seconds: float) -> None:
    """The word, again and again: its misses, then its hits."""
    n = round(seconds / 1e-4)
    acts, steps = np.arange(n), np.ones(n, np.int64)
    for begin in range(FIRST, n, word.misses + word.hits):
        missed = slice(begin, min(begin + word.misses, n))
        acts[missed] = begin - 1
        steps[missed] = case == "steps"
    np.savez(path, acts=acts, steps=steps)


def rate(name: str, law: str, trace: str, seconds: float) -> float:
    """How fast the difference of two runs grows, 1/s: until it is large, or over the last third."""
    runs = [
        gfmhil.run(setting(name, law, trace, step, seconds)).signals for step in (STEP, 2 * STEP)
    ]
    count = min(len(one["true_p"]) for one in runs)
    apart = np.array([[one[s][:count] for s in SHOWN] for one in runs])
    d = np.abs(apart[1] - apart[0]).max(axis=0)[BACK:]
    large = np.flatnonzero(d > GREW)
    if len(large):
        return float(np.log(GREW / STEP) / (large[0] * 1e-4))
    tops = np.array([part.max() for part in np.array_split(d, PARTS)])
    every = 1e-4 * len(d) / PARTS
    small = np.flatnonzero(tops < SMALL)
    if len(small):  # below it there is rounding
        return float(np.log(SMALL / STEP) / (small[0] * every))
    last = np.log(tops[-PARTS // 3 :])
    return float(np.polyfit(every * np.arange(len(last)), last, 1)[0])


def cell(loop: ClosedLoop, name: str, law: str, case: Meanwhile, place: Path) -> str:
    """What a law bears in one case, predicted and seen."""
    words, file = Words(ticks(loop, case)), place / "trace.npz"
    lost = words.first_unstable()
    if lost is None:
        return "≥ 1000"

    def grows(word: Word) -> bool:
        seconds = min(max(SECONDS[0], TIMES / abs(word.sigma)), SECONDS[1])
        write_trace(file, word, case, seconds)
        seen = rate(name, law, str(file), seconds)
        print(
            f"{law:24} {name:6} {case:13} {word!s:24} {word.sigma:+9.3f} {seen:+9.3f}", flush=True
        )
        return seen > 0.0

    n = lost.misses - 1
    if grows(lost) and (n == 0 or not grows(words.worst(n))):
        return f"{n} = {n}"
    for seen in (n + 1, n - 1):  # a neighbour may be what the bench bears
        if (
            seen >= 0
            and (seen == 0 or not grows(words.worst(seen)))
            and grows(words.worst(seen + 1))
        ):
            return f"{n}, bench {seen}"
    return f"{n}, bench: neither"


def main() -> None:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for law in sys.argv[1:] or law_names():
            row = [law]
            for name in SETTINGS:
                try:
                    loop, _ = scenario_loop(setting(name, law, None, 0.0))
                    stable = float(loop.sigma()) < -1e-6
                except UserError:
                    stable = False
                for case in MEANWHILE:
                    row.append(cell(loop, name, law, case, Path(folder)) if stable else "–")
            rows.append(row)
    heads = ["law", *(f"{name}: {case}" for name in SETTINGS for case in MEANWHILE)]
    text = markdown(heads, [row for row in rows if {*row[1:]} != {"–"}])
    (DOCS / "tables" / "latency_words.md").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
