"""What a page of the scope costs the loop: a network in real time, with and without a page in turn.

One run of four converters with its scope and one headless Chromium. In every round the browser
shows the page for a while and then an empty one; misses and round trips are those of the recording
of each turn, and the pictures are those that the page has drawn.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.realtime.environment import environment
from gfm_hil.recording.live import LiveRun
from gfm_hil.recording.timing import PERCENTILES, ROUND_TRIP, count_misses

PAGE, NONE = "with a page", "without"
_SETTLE_S = 3.0  # of each turn, which do not count
#: four converters that carry a load
NETWORK = """
title = "Four converters that are watched"
duration = 3600.0
T_s = 1e-3
mode = "realtime"
law = "droop-5"
references = { P_ref = 0.3 }
late_policy = { hold = 100000 }
link = { type = "shm", peer_timeout_s = 30.0 }
[plant]
delay = { samples = 1 }
dc_source = { mode = "regulated" }
[network.converters.A]
node = "bus"
references = { P_ref = 0.2 }
[network.converters.B]
node = "bus"
[network.converters.C]
node = "bus"
[network.converters.D]
node = "bus"
references = { P_ref = 0.5 }
[network.loads.base]
node = "bus"
P = 1.3
Q = 0.2
"""


def browser() -> Any:
    """Headless Chromium."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    options.add_argument("--window-size=1440,900")
    return webdriver.Chrome(
        options=options, service=webdriver.ChromeService(shutil.which("chromedriver") or "")
    )


def turn(driver: Any, address: str, runs: list[LiveRun], seconds: float) -> dict[str, Any]:
    """Show a page for a while; ticks, misses and round trips of all converters, µs, and pictures a
    second."""
    driver.get(address)
    time.sleep(_SETTLE_S)
    begin, began = [run.done("plant") for run in runs], time.monotonic()
    pictures = []
    while time.monotonic() - began < seconds:
        time.sleep(1.0)
        if address.startswith("http"):
            said = driver.execute_script("return document.querySelector('#rate').textContent")
            pictures.append(float(said.split()[0]) if said else 0.0)
    end = [run.done("plant") for run in runs]
    missed = [
        count_misses(run.columns, last) - count_misses(run.columns, first)
        for run, first, last in zip(runs, begin, end, strict=True)
    ]
    ticks = sum(last - first for first, last in zip(begin, end, strict=True))
    trips = [
        ROUND_TRIP.us(run.columns, run.T_s, first, last)
        for run, first, last in zip(runs, begin, end, strict=True)
    ]
    trip = np.concatenate(trips)
    return {"ticks": ticks, "missed": sum(missed), "trip": trip[trip == trip], "pictures": pictures}


def measure(seconds: float, rounds: int) -> dict[str, Any]:
    """Everything; plain data."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        file, folder = Path(place) / "four.toml", Path(place) / "run"
        file.write_text(NETWORK, encoding="utf-8")
        command = [sys.executable, "-m", "gfm_hil", "run", str(file), "--out", str(folder)]
        process = subprocess.Popen(
            [*command, "--scope", "0", "--quiet", "--no-figures"],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        driver = browser()
        try:
            assert process.stderr is not None
            address = next(found[0] for line in process.stderr
                           if (found := re.search(r"http://\S+", line)))  # fmt: skip
            runs = [LiveRun(folder / name) for name in "ABCD"]
            while min(run.done("plant") for run in runs) < 2000:
                assert process.poll() is None, "the run has ended"
                time.sleep(0.1)
            turns: dict[str, list[dict[str, Any]]] = {PAGE: [], NONE: []}
            for k in range(rounds):  # which comes first changes
                for kind in (PAGE, NONE) if k % 2 else (NONE, PAGE):
                    where = address if kind == PAGE else "about:blank"
                    turns[kind].append(turn(driver, where, runs, seconds))
        finally:
            driver.quit()
            process.terminate()
            process.wait()
    return {"rows": [row(kind, turns[kind]) for kind in turns], "environment": environment()}


def row(kind: str, turns: list[dict[str, Any]]) -> dict[str, Any]:
    """All turns of one kind together."""
    ticks, missed = (sum(one[key] for one in turns) for key in ("ticks", "missed"))
    pictures = [rate for one in turns for rate in one["pictures"]]
    found = {"what": kind, "ticks": ticks, "missed": missed, "missed_pct": 100 * missed / ticks}
    trip = np.percentile(np.concatenate([one["trip"] for one in turns]), [*PERCENTILES.values()])
    found["trip_us"] = dict(zip(PERCENTILES, trip.tolist(), strict=True))
    found["by_turn_pct"] = [round(100 * one["missed"] / one["ticks"], 3) for one in turns]
    if pictures:
        p5, p50 = np.percentile(pictures, (5, 50))
        found |= {"frames_per_s": {"p50": float(p50), "p5": float(p5)}}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=15.0, help="of a turn")
    parser.add_argument("--rounds", type=int, default=6, help="of two turns each")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(options.seconds, options.rounds)
    if options.json:
        print(json.dumps(found))
        return
    print(f"| | ticks | missed | round trip {', '.join(PERCENTILES)}, µs | frames a second, 5 % |")
    print("|---|--:|--:|--:|--:|")
    for one in found["rows"]:
        us = one["trip_us"].values()
        trip = ", ".join(np.format_float_positional(x, 3, fractional=False, trim="-") for x in us)
        rate = one.get("frames_per_s")
        said = f"{rate['p50']:.0f}, {rate['p5']:.0f}" if rate else "–"
        print(f"| {one['what']} | {one['ticks']} | {one['missed_pct']:.3f} % | {trip} | {said} |")
    turns = [", ".join(f"{x:g}" for x in one["by_turn_pct"]) for one in found["rows"]]
    print(f"\nMissed turn by turn, %: {found['rows'][0]['what']} {turns[0]}; without {turns[1]}.")


if __name__ == "__main__":
    main()
