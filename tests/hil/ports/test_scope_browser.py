"""The scope in Chromium: a run is shown, commanded, trips, and is reset."""

import math
import re
from collections.abc import Iterator
from typing import Any

import pytest
from PIL import Image

from gfm_hil.recording.log import read_events
from gfm_hil.scenario.events import EVENTS

from ...support.processes import wait_for
from ...support.scope import HAS_BROWSER, Browser, Rig, rig

pytestmark = [
    pytest.mark.systems,
    pytest.mark.apt,
    pytest.mark.full,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver"),
]

FALLEN_OUT = """
const wide = document.documentElement.clientWidth;
const seen = (e) => e.checkVisibility() && !e.closest('#strips canvas, .uplot');
return [...document.querySelectorAll('body *')].filter(seen)
  .filter((e) => e.getBoundingClientRect().right > wide + 1)
  .filter((e) => !e.closest('#measured')).map((e) => e.outerHTML.slice(0, 80));
"""


@pytest.fixture(scope="module")
def going(tmp_path_factory) -> Iterator[Rig]:
    with rig(tmp_path_factory.mktemp("scope")) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser() as found:
        yield found


@pytest.fixture
def page(going: Rig, browser: Browser) -> Iterator[Browser]:
    """A page with the token and moving traces, that knows nothing of those before it."""
    browser.driver.get(going.look)
    browser.js("localStorage.clear(); sessionStorage.clear()")
    browser.driver.get("about:blank")
    browser.complaints()  # of a test that has failed
    browser.driver.get(going.control)
    wait_for_state(browser)
    if browser.text("#state") == "SAFE":
        browser.click("#reset")
        wait_for(lambda: browser.text("#state") == "RUNNING")
    yield browser
    assert browser.complaints() == []


def wait_for_state(page: Browser) -> None:
    """Wait until the page shows the run, which ends in SAFE on a machine that stood still."""
    wait_for(lambda: page.text("#state") in ("RUNNING", "SAFE"))


def said(page: Browser, title: str) -> str:
    """The answer under a heading of the panel."""
    return str(
        page.js(
            "return [...document.querySelectorAll('#knobs section')].find((s) =>"
            f"s.querySelector('h2').textContent === {title!r}).querySelector('.said').textContent"
        )
    )


def moves(page: Browser) -> None:
    """Wait until the traces and the time change."""
    before, time = page.picture("power"), page.text("#time")
    wait_for(lambda: page.picture("power") != before and page.text("#time") != time)


def value_now(page: Browser, strip: str) -> float:
    """The newest value beside a strip; nan before the first."""
    text = page.text(f"[data-strip={strip}] .now").replace("−", "-")
    return float(text) if text.strip("–") else math.nan


def test_drive(page):
    assert page.text("#title") == "A rig that is told what to do"
    assert "token" not in page.driver.current_url
    moves(page)

    page.write("#set-P_ref", "0,8")  # as it is written in half of the world
    page.write("#set-ramp", "0.1")
    page.click("#apply")
    assert "P_ref = 0.8 at tick" in wait_for(lambda: said(page, "Set-points").strip("…"))
    wait_for(lambda: page.text("#now-P_ref") == "0.800")
    wait_for(lambda: abs(value_now(page, "power") - 0.8) < 0.1)

    page.click("[data-law=mimo-gfm-deployable]")
    wait_for(lambda: page.text("#law") == "mimo-gfm-deployable")
    assert page.js("return document.querySelector('[aria-pressed=true].law').dataset.law") == (
        "mimo-gfm-deployable"
    )

    page.click("[data-law=vsg-2]")  # unstable with this rig's small resistance
    wait_for(lambda: page.text("#state") == "SAFE")
    wait_for(lambda: "over-current" in page.text("#knobs .why"))  # at first that the plant tripped
    wait_for(lambda: "tripped: over-current" in page.text("#log"))

    page.click("#reset")
    wait_for(lambda: page.text("#state") == "RUNNING")
    wait_for(lambda: page.text("#law") == "droop-5" and page.text("#now-P_ref") == "0.500")
    moves(page)


def test_a_refused_command_says_why(page):
    page.write("#set-P_ref", "9")
    page.click("#apply")
    why = "P_ref = 9.0: must lie in [-2, 2] p.u."
    wait_for(lambda: why in said(page, "Set-points"))
    assert why in page.text("#log .refused")
    page.write("#set-P_ref", "0.1.2")
    page.click("#apply")
    wait_for(lambda: "'0.1.2'" in said(page, "Set-points"))
    assert page.text("#now-P_ref") == "0.500"


def opened(page: Browser, kind: str) -> None:
    """Open the panel of a kind of event."""
    if not page.js(f"return document.querySelector('[data-event={kind}]').open"):
        page.click(f"[data-event={kind}] summary")


def answer(page: Browser, kind: str, text: str) -> None:
    """Wait until the run has answered a panel."""
    wait_for(lambda: text in page.text(f"[data-event={kind}] .said"))


def test_every_kind_of_event_has_a_panel_by_its_schema(going, page):
    kinds = page.js(
        "return [...document.querySelectorAll('[data-event]')].map((e) => e.dataset.event)"
    )
    page.click("#run")  # a still picture leaves the processors to the panels
    # the others have sections of their own, and this run has no network
    elsewhere = ("reference", "law", "reset", "breaker", "plant-reference")
    assert [*kinds] == [k for k in EVENTS if k not in elsewhere]
    opened(page, "grid-frequency")
    page.write("#set-grid-frequency-f_hz", "50.02")
    page.write("#set-grid-frequency-rate", "0.5")
    page.click("#do-grid-frequency")
    answer(page, "grid-frequency", "grid 50.02 Hz at 0.5 Hz/s at tick")
    page.write("#set-grid-frequency-rate", "")
    page.write("#set-grid-frequency-f_hz", "50")
    page.click("#do-grid-frequency")
    answer(page, "grid-frequency", "grid 50 Hz at tick")
    opened(page, "gains")
    page.write("#set-gains-values", "D_p = 0.0101")
    page.click("#do-gains")
    answer(page, "gains", "D_p = 0.0101 at tick")
    opened(page, "grid-unbalance")
    page.write("#set-grid-unbalance-retained", "0.98, 1, 1")  # deeper trips this rig
    page.write("#set-grid-unbalance-duration", "0.01")
    page.click("#do-grid-unbalance")
    answer(page, "grid-unbalance", "at tick")
    opened(page, "fault")
    page.choose("#set-fault-kind", "LG")
    page.write("#set-fault-R", "-1")
    page.click("#do-fault")
    answer(page, "fault", "R: must be greater than or equal to 0, not -1")
    opened(page, "note")
    page.write("#set-note-text", "the lab is warm")
    page.click("#do-note")
    answer(page, "note", "the lab is warm at tick")
    wait_for(lambda: "the lab is warm" in page.text("#log .operator"))
    (note,) = [e for e in read_events(going.folder, 300_000) if e["event"] == "note"]
    assert note["operator"]["name"] == "operator"
    assert page.text("#state") == "RUNNING"


def test_a_desk_of_ones_own(page, tmp_path):
    """Single signals, SI units, kept layouts, a picture and a table of the window."""
    page.driver.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)}
    )
    page.click("#si")
    wait_for(lambda: abs(value_now(page, "voltage") - 380.0) < 20.0)
    page.click("#signals summary")
    for strip in ("power", "frequency", "dc", "inputs", "loop", "one-d_V_g"):
        page.click(f"#signal-list [data-strip={strip}]")
    page.click("#layouts summary")
    page.write("#layout-name", "voltages")
    page.click("#keep button")
    page.click("#si")
    page.click("#signals summary")
    page.click("#signal-list [data-strip=voltage]")
    wait_for(lambda: page.text("[data-strip=one-d_V_g] .now") == "1.000")
    page.driver.refresh()
    wait_for_state(page)
    assert page.js("return document.querySelectorAll('.strip').length") == 6
    page.click("#layouts summary")
    page.click("[data-layout=voltages]")
    shown = "return [...document.querySelectorAll('.strip')].map((e) => e.dataset.strip)"
    wait_for(lambda: page.js(shown) == ["voltage", "one-d_V_g"])
    wait_for(lambda: page.text("[data-strip=one-d_V_g] .now") == "380.0")
    page.click("#files summary")
    page.click("#png")
    page.click("#csv")
    (picture,) = wait_for(lambda: [*tmp_path.glob("A-rig-*s.png")])
    (table,) = wait_for(lambda: [*tmp_path.glob("A-rig-*s.csv")])
    with Image.open(picture) as image:
        assert image.width > 600 and len(image.convert("RGB").getcolors(2**20) or ()) > 8
    heads, *rows = [line.split(",") for line in table.read_text("utf-8").splitlines()]
    assert heads[0] == "t [s]" and heads[1].startswith("V [V]") and len(rows) > 100
    assert 360.0 < float(rows[-1][1]) < 400.0
    assert re.fullmatch(r"[0-9.e+-]+/s", page.text("#miss-rate"))


def test_without_the_token_one_may_look_not_touch(going, page):
    with Browser() as other:
        other.driver.get(going.look)
        wait_for(lambda: other.text("#state") == page.text("#state"))
        moves(other)
        assert "Looking only" in other.text("#permission")
        knobs = "#knobs button, #knobs input"
        assert other.js(
            f"return [...document.querySelectorAll('{knobs}')].every((k) => k.disabled)"
        )
        assert page.js(
            f"return [...document.querySelectorAll('{knobs}')].filter((k) => !k.disabled).length"
        )
        # the server refuses even a page that disables nothing
        other.js("document.querySelectorAll('button').forEach((b) => { b.disabled = false; })")
        other.js("document.getElementById('set-P_ref').disabled = false")
        other.write("#set-P_ref", "1")
        other.click("#apply")
        wait_for(lambda: "may look, not touch" in said(other, "Set-points"))
        assert other.complaints() == []
    assert page.text("#now-P_ref") == "0.500"


def test_pause_zoom_cursors(page):
    page.click("#run")
    wait_for(lambda: page.text("#run") == "Run")
    before = page.picture("power")
    held = page.js("return document.querySelector('#span').value")
    assert held == "2"
    page.drag("[data-strip=power] .u-over", (-200, 0), (300, 4))
    wait_for(lambda: page.picture("power") != before)
    wait_for(lambda: page.js("return document.querySelector('#span').value") == "")
    wide = page.js("return document.querySelector('[data-strip=power] .u-over').clientWidth")
    shown = page.js("return document.querySelector('#span').selectedOptions[0].textContent")
    assert float(shown.split()[0]) == pytest.approx(2e3 * 300 / wide, rel=0.03)  # ms

    page.click("#cursors")
    delta = wait_for(lambda: page.text("#readout .delta"))
    page.drag("[data-strip=power] .u-over", (round(-0.15 * wide), 0), (round(-0.1 * wide), 0))
    moved = wait_for(lambda: (now := page.text("#readout .delta")) != delta and now)
    ms = float(moved.removeprefix("B − A").split(" ms")[0])
    assert ms == pytest.approx(0.4 * float(shown.split()[0]), rel=0.05)
    symbols = "return [...document.querySelectorAll('#readout th i')].map((e) => e.textContent)"
    assert page.js(symbols)[:4] == ["t", "p", "q", "V"]

    page.click("#whole")
    wait_for(lambda: page.js("return document.querySelector('#span').selectedIndex") == 0)
    page.click("#run")
    moves(page)


def test_trigger(page):
    page.choose("#trigger-mode", "single")
    page.choose("#trigger-channel", "p")
    page.write("#trigger-level", "0.6")
    page.choose("#span", "0.5")
    wait_for(lambda: page.text("#doing") == "armed")
    page.write("#set-P_ref", "0.7")
    page.click("#apply")
    wait_for(lambda: page.text("#doing") == "held")
    still, time = page.picture("power"), page.text("#time")
    wait_for(lambda: page.text("#time") != time)
    assert page.picture("power") == still
    page.write("#set-P_ref", "0.5")
    page.click("#apply")
    wait_for(lambda: page.text("#now-P_ref") == "0.500")


def test_signals_can_be_chosen(page):
    count = "return document.querySelectorAll('.strip').length"
    assert page.js(count) == 6
    page.click("#signals summary")
    page.click("#signal-list [data-strip=angle]")
    page.click("#signal-list [data-strip=dc]")
    wait_for(lambda: page.js(count) == 6)
    wait_for(lambda: page.text("[data-strip=angle] .now") not in ("", "–"))
    assert page.text("[data-strip=dc] .now") == ""
    page.click("#signal-list [data-strip=inner]")
    page.click("#signal-list [data-strip=bridge]")
    wait_for(lambda: page.js(count) == 8)
    page.click("#signal-list [data-strip=v-abc]")
    page.click("#signal-list [data-strip=i-abc]")
    wait_for(lambda: page.js(count) == 10)
    for name in ("v-abc", "i-abc"):
        wait_for(lambda name=name: page.text(f"[data-strip={name}] .now") not in ("", "–"))
    # this run has no inner stage
    assert [page.text(f"[data-strip={name}] .now") for name in ("inner", "bridge")] == ["–", "–"]


@pytest.mark.parametrize(
    ("width", "height", "dark"), [(1440, 900, False), (1024, 700, True), (390, 844, False)]
)
def test_it_fits(going, width, height, dark):
    with Browser(width, height, dark=dark, phone=width < 500) as page:
        page.driver.get(going.control)
        wait_for_state(page)
        moves(page)
        assert page.js(FALLEN_OUT) == []
        ground: Any = page.js("return getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, ground[4:-1].split(","))) < 200) is dark
        for place in ("#state", "#law"):
            assert page.js(f"return document.querySelector('{place}').checkVisibility()")
            box = page.js(f"return document.querySelector('{place}').getBoundingClientRect().top")
            assert 0 <= box < height
        assert page.complaints() == []
