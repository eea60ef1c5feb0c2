"""The scope in Chromium: a run is shown, commanded, trips, and is reset."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.sync.client import connect

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


@pytest.fixture
def page(going: Rig) -> Iterator[Browser]:
    """A page with the token and moving traces."""
    with Browser() as browser:
        browser.driver.get(going.control)
        wait_for_state(browser)
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


def test_drive(page):
    assert page.text("#title") == "A rig that is told what to do"
    assert "token" not in page.driver.current_url
    moves(page)

    page.write("#set-P_ref", "0.8")
    page.write("#set-ramp", "0.1")
    page.click("#apply")
    assert "P_ref = 0.8 at tick" in wait_for(lambda: said(page, "Set-points").strip("…"))
    wait_for(lambda: page.text("#now-P_ref") == "0.800")
    wait_for(lambda: abs(float(page.text("[data-strip=power] .now").replace("−", "-")) - 0.8) < 0.1)

    page.click("[data-law=mimo-gfm-deployable]")
    wait_for(lambda: page.text("#law") == "mimo-gfm-deployable")
    assert page.js("return document.querySelector('[aria-pressed=true].law').dataset.law") == (
        "mimo-gfm-deployable"
    )

    page.click("[data-law=vsg-2]")  # unstable with this rig's small resistance
    wait_for(lambda: page.text("#state") == "SAFE")
    assert "over-current" in wait_for(lambda: page.text("#knobs .why"))
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
    assert page.text("#now-P_ref") == "0.500"


def test_grid(page):
    page.write("#set-f_hz", "50.02")
    page.write("#set-rate", "0.5")
    page.click("#set-frequency")
    wait_for(lambda: "grid 50.02 Hz at 0.5 Hz/s at tick" in said(page, "Grid"))
    wait_for(lambda: page.text("#now-f_g") == "50.020")
    page.write("#set-degrees", "-1")
    page.click("#jump")
    wait_for(lambda: "phase jump -1° at tick" in said(page, "Grid"))
    page.write("#set-f_hz", "50")
    page.click("#set-frequency")
    wait_for(lambda: page.text("#now-f_g") == "50.000")


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


def test_a_wrong_token_is_none(going):
    with connect(going.look.replace("http", "ws") + "socket") as socket:
        socket.send(json.dumps({"kind": "hello", "token": going.token[::-1]}))
        socket.send(json.dumps({"kind": "command", "id": 5, "event": {"type": "reset"}}))
        heard = [json.loads(socket.recv(10)) for _ in range(4)]
    assert {"kind": "control", "granted": False} in heard
    assert [m["ok"] for m in heard if m["kind"] == "answer"] == [False]


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


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1024, 700), (390, 844)])
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
