"""The scope's pictures and the table of what its server costs.

From the top folder of a checkout, with chromium and its driver: ``python -m docs.scope_pictures``.
"""

from __future__ import annotations

import io
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from benchmarks.scope_server import measure
from tests.support.processes import wait_for
from tests.support.scope import RIG, Browser, Rig, rig

HERE = Path(__file__).resolve().parent
NETWORK = """
title = "Three converters and a machine at a weak grid"
duration = 900.0
T_s = 1e-3
mode = "realtime"
law = "droop-5"
[references]
P_ref = 0.4
[late_policy]
hold = 10000
[link]
type = "shm"
peer_timeout_s = 30.0
[plant]
delay = { samples = 1 }
dc_source = { mode = "regulated" }
[network]
grid = "grid"
record = ["lines", "transformers", "loads", "machines", "grid"]
[network.converters.A]
node = "bus"
[network.converters.B]
node = "bus"
[network.converters.C]
node = "far"
references = { P_ref = 0.6 }
[network.lines.feeder]
start = "bus"
end = "far"
L = 0.1
R = 0.02
[network.transformers.step-up]
start = "far"
end = "grid"
S = 2.0
X = 0.1
[network.loads.town]
node = "bus"
P = 0.9
Q = 0.2
[network.loads.mill]
node = "far"
P = 0.4
closed = false
[network.machines.hydro]
node = "far"
S = 1.0
H = 3.0
P = 0.3
"""
IN_THE_LAB = RIG.replace("that is told what to do", "in the lab")


def save(page: Browser, name: str) -> None:
    """What the page shows, in few colours."""
    image = Image.open(io.BytesIO(page.driver.get_screenshot_as_png())).convert("RGB")
    image = image.quantize(128, dither=Image.Dither.NONE)
    image.save(HERE / "_static" / "figures" / f"scope_{name}.png", optimize=True)


def opened(page: Browser, run: Rig) -> None:
    """A page that has seen the run for as long as its window is."""
    page.driver.get(run.control)
    wait_for(lambda: page.text("#state") in ("RUNNING", "SAFE"))
    time.sleep(2.5)


def set_power(page: Browser, value: str) -> None:
    """A step of P_ref that has been carried out."""
    page.write("#set-P_ref", value)
    page.click("#apply")
    wait_for(lambda: float(page.text("#now-P_ref")) == float(value))


def dark(run: Rig) -> None:
    """A step caught by the trigger, with cursors."""
    with Browser(dark=True) as page:
        opened(page, run)
        page.choose("#trigger-mode", "single")
        page.write("#trigger-level", "0.6")
        page.choose("#span", "0.5")
        page.click("#cursors")
        wait_for(lambda: page.text("#doing") == "armed")
        set_power(page, "0.8")
        wait_for(lambda: page.text("#doing") == "held")
        time.sleep(0.5)
        save(page, "trigger")
        page.choose("#trigger-mode", "off")
        set_power(page, "0.5")


def light(run: Rig) -> None:
    """A change of law that the rig does not bear."""
    with Browser() as page:
        opened(page, run)
        page.choose("#span", "5")
        set_power(page, "0.7")
        time.sleep(0.3)
        page.click("[data-law=vsg-2]")
        wait_for(lambda: page.text("#state") == "SAFE")
        time.sleep(0.5)
        save(page, "trip")
        page.click("#reset")
        wait_for(lambda: page.text("#state") == "RUNNING")


def phone(run: Rig) -> None:
    """The page on a phone."""
    with Browser(390, 844, phone=True) as page:
        opened(page, run)
        set_power(page, "0.6")
        time.sleep(0.6)
        page.js("scrollTo(0, 0)")
        time.sleep(0.4)
        save(page, "phone")


def network() -> None:
    """The diagram of a network with the powers of its parts, and on a phone."""
    with TemporaryDirectory() as place, rig(Path(place), NETWORK) as run:
        for name, page in (
            ("network", Browser(1280, 960)),
            ("network_phone", Browser(390, 844, phone=True, dark=True)),
        ):
            with page:
                opened(page, run)
                wait_for(lambda page=page: page.text("[data-power=feeder]"))
                save(page, name)


def costs() -> None:
    """The table of what the server costs."""
    rows = ["| window | pictures a second | kB each | of a core |", "|---|---|---|---|"]
    rows += [
        f"| {r['span_s']:g} s | {r['frames_per_s']:.1f} | {r['kB_per_frame']:.0f} | "
        f"{r['core_pct']:.1f} % |"
        for r in measure([0.1, 2.0, 20.0], 10.0)
    ]
    (HERE / "tables" / "scope_server.md").write_text("\n".join(rows) + "\n", encoding="utf-8")


def main() -> None:
    with TemporaryDirectory() as place, rig(Path(place), IN_THE_LAB) as run:
        for picture in (dark, light, phone):
            picture(run)
    network()
    costs()


if __name__ == "__main__":
    main()
