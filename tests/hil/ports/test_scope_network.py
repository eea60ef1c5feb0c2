"""The scope of a network in Chromium: the chosen converter, and the diagram of all of them.

A file of its own, so that no other rig takes the processors meanwhile.
"""

import os
import signal

import pytest

from gfm_hil.ports.commands import Operator
from gfm_hil.recording.log import read_events
from gfm_plant.names import NO_FRESH_U

from ...support.processes import roles_of, wait_for
from ...support.scope import HAS_BROWSER, Browser, rig

pytestmark = [
    pytest.mark.systems,
    pytest.mark.apt,
    pytest.mark.full,
    pytest.mark.alone,
    pytest.mark.timeout(900),  # compiles the loops of a network
    pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver"),
]

NETWORK = """
title = "Four converters that are watched"
duration = 600.0
T_s = 1e-3
mode = "realtime"
law = "droop-5"
[references]
P_ref = 0.3
[late_policy]
hold = 10000
[link]
type = "shm"
peer_timeout_s = 30.0
[plant]
delay = { samples = 1 }
dc_source = { mode = "regulated" }
[network]
record = ["lines", "loads"]
[network.converters.A]
node = "bus"
references = { P_ref = 0.2 }
[network.converters.B]
node = "bus"
[network.converters.C]
node = "bus"
[network.converters.D]
node = "far"
references = { P_ref = 0.5 }
[network.lines.feeder]
start = "bus"
end = "far"
L = 0.1
R = 0.02
[network.loads.base]
node = "bus"
P = 1.3
Q = 0.2
[network.loads.step]
node = "far"
P = 0.1
closed = false
"""

ANSWER = (
    "return [...document.querySelectorAll('#knobs section')].find((s) =>"
    "s.querySelector('h2').textContent === 'Set-points').querySelector('.said').textContent"
)

MAY_WRITE = (
    "const field = document.querySelector('#set-P_ref');"
    "return field !== null && field.checkVisibility() && !field.disabled"
)


def flow(page: Browser, converter: str) -> float:
    """P of a converter in the diagram; nan before the first."""
    text = page.text(f"[data-converter={converter}] .flow").replace("−", "-")
    return float(text.split()[1]) if text.startswith("P ") and "–" not in text else float("nan")


def breaker(page: Browser, part: str) -> str:
    """Whether the breaker of a part is closed in the diagram."""
    return str(page.js(f"return document.querySelector('[data-breaker={part}]').dataset.closed"))


def test_four_converters_of_a_network(tmp_path):
    """One scope of a run of four: the page shows the one that is chosen, commands it, and shows
    the flows of all."""
    with rig(tmp_path, NETWORK) as four, Browser() as page:
        page.driver.get(four.control)
        wait_for(lambda: page.text("#state") == "RUNNING")
        shown = "return [...document.querySelectorAll('#converter option')].map((o) => o.value)"
        assert page.js(shown) == ["A", "B", "C", "D"]
        assert page.js("return document.querySelector('#converter').value") == "A"
        wait_for(lambda: all(flow(page, name) > 0.05 for name in "ABCD"))
        # the droops of 1 % are equal: what the load takes beyond the set-points is shared
        wait_for(lambda: abs(flow(page, "D") - flow(page, "A") - 0.3) < 0.02)
        page.driver.find_element("css selector", "[data-converter=D]").click()
        wait_for(lambda: page.js("return document.title").startswith("D \u00b7 "))
        wait_for(lambda: page.text("#state") == "RUNNING")
        assert page.js("return document.querySelector('#converter').value") == "D"
        wait_for(lambda: page.js(MAY_WRITE))
        page.write("#set-P_ref", "0.4")
        page.click("#apply")
        assert "P_ref = 0.4 at tick" in wait_for(lambda: page.js(ANSWER).strip("…"))
        wait_for(lambda: abs(flow(page, "D") - flow(page, "A") - 0.2) < 0.02)
        told = {
            name: [e["label"] for e in read_events(four.folder / name, 10**6) if "operator" in e]
            for name in "ABCD"
        }
        assert told == {"A": [], "B": [], "C": [], "D": ["P_ref = 0.4"]}
        wait_for(lambda: breaker(page, "base") == "true")
        assert (breaker(page, "feeder"), breaker(page, "step")) == ("true", "false")
        # D, at the end of the feeder, feeds the load at its start: the arrow points there
        tip = "return document.querySelector('[data-flow=feeder]').getBBox()"
        wait_for(lambda: page.js(f"{tip}.width") > 5)
        assert page.text("[data-power=feeder]").startswith("P \u22120.4")
        assert page.text("[data-power=base]").startswith("P 1.")
        before = sum(flow(page, name) for name in "ABCD")
        operator = Operator(four.folder / "A")
        operator.command({"type": "breaker", "name": "step", "closed": True})
        operator.close()
        wait_for(lambda: breaker(page, "step") == "true")
        wait_for(lambda: sum(flow(page, name) for name in "ABCD") > before + 0.05)
        page.driver.save_screenshot(str(tmp_path / "network.png"))
        size = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
        page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        wide = "return document.querySelector('#network svg').viewBox.baseVal.width"
        wait_for(lambda: page.js(wide) < 390)  # drawn anew
        box = "const box = document.querySelector('#network');"
        assert page.js(f"{box} return box.scrollWidth <= box.clientWidth")
        assert breaker(page, "step") == "true" and all(flow(page, name) > 0.05 for name in "ABCD")
        wait_for(lambda: page.js(f"{tip}.width") > 5 and page.js(f"{tip}.x") < 40)  # at the left
        os.kill(roles_of(four.folder / "D")["controller"], signal.SIGKILL)
        assert wait_for(lambda: "tripped" in page.text("[data-converter=D] .head"))
        wait_for(lambda: page.text("#state") == "tripped")
        assert page.text("#reason") in ("the controller's process is gone", NO_FRESH_U)
        assert page.complaints() == []
