"""Curves of a page: few points, close to every tick, and what a browser draws of them."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gfmhil
from gfm_hil.results.curves import _PIECE, PackedCurves, Panel, decimated_ticks

from ...support.page import unpacked
from ...support.processes import wait_for
from ...support.scope import HAS_BROWSER, Browser


def test_lines_between_the_points_follow_every_tick():
    t = np.arange(50_000) * 1e-4
    step = np.where(t < 2.0, 0.5, 1.0 - 0.5 * np.exp(-(t - 2.0) / 0.1))
    swing = np.where(t < 2.0, 0.0, np.exp(-(t - 2.0)) * np.sin(2 * np.pi * 4 * t))
    at = decimated_ticks([step, swing])
    assert len(at) < 16_000
    for x, height in ((step, 0.5), (swing, np.ptp(swing))):
        assert np.abs(np.interp(np.arange(len(x)), at, x[at]) - x).max() <= 5e-4 * height


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_no_spike_is_lost_where_there_are_too_many_ticks(seed, curves):
    chance = np.random.default_rng(seed)
    noise = chance.normal(size=(curves, 30_000))
    noise[chance.integers(curves), chance.integers(30_000)] = 50.0
    at = decimated_ticks(list(noise), 1000)
    assert len(at) <= 1000 and (np.diff(at) > 0).all() and at[[0, -1]].tolist() == [0, 29_999]
    assert (noise[:, at].max(axis=1) == noise.max(axis=1)).all()
    assert (noise[:, at].min(axis=1) == noise.min(axis=1)).all()


@pytest.mark.parametrize("ticks", [0, 1, 2, 5, _PIECE + 1])
def test_runs_of_any_length(ticks):
    x = np.sin(np.arange(ticks))
    at = decimated_ticks([x, np.full(ticks, np.nan)], 100)
    assert len(at) <= min(ticks, 102) and (ticks == 0 or at[-1] == ticks - 1)


def test_a_page_holds_times_to_the_tick_and_values_to_its_levels():
    at = np.array([0, 1, 70, 71, 60_000])
    y = np.array([0.0, 1.0, np.nan, -0.5, 0.25])
    curves = PackedCurves()
    curves.add(Panel("a", 3.2 + 1e-4 * at, {"y": y}, (0.0, 1.0), [(3.3, "sag")]))
    curves.add(Panel("b", np.geomspace(1, 100, 5), {"y": y}, (1.0, 100.0), log=(True, False)))
    page = (
        f'<script type="application/json" id="plots">{json.dumps(curves.plots)}</script>'
        f'<script type="text/plain" id="curves">{curves.text()}</script>'
    )
    first, second = unpacked(page)
    assert first["x"] == pytest.approx(3.2 + 1e-4 * at, abs=1e-9)
    assert second["x"] == pytest.approx(np.geomspace(1, 100, 5), abs=100 / 4094)
    assert first["curves"]["y"] == pytest.approx(y, abs=1.5 / 4094, nan_ok=True)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of ten seconds of the rig, with noise."""
    run = gfmhil.run("rig_pref_step", duration=10.0)
    return run.save(tmp_path_factory.mktemp("report") / "run") / "report.html"


def test_the_report_of_a_run_holds_its_curves(report):
    run, page = gfmhil.load_run(report.parent), report.read_text("utf-8")
    plots = unpacked(page)
    assert len(page) < 1_000_000 and len(plots) == 9  # the last three are the phases
    assert "at most 16,000 of the 100,000 ticks" in page
    ticks = np.rint(plots[0]["x"] / 1e-4).astype(int)
    p = np.asarray(run.signals["true_p"])
    assert plots[0]["curves"]["p"] == pytest.approx(p[ticks], abs=np.ptp(p) / 4094)
    assert plots[0]["events"] == [[1.0, "P_ref = 1"]]


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_browser_draws_the_report(report, width, scheme):
    with Browser() as browser:
        command = browser.driver.execute_cdp_cmd
        size = {"width": width, "height": 1600, "deviceScaleFactor": 1, "mobile": width < 500}
        command("Emulation.setDeviceMetricsOverride", size)
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        command("Emulation.setEmulatedMedia", media)
        browser.driver.get(report.as_uri())
        drawn = "return document.querySelectorAll('.plot')[{}].querySelectorAll('canvas').length"
        for k in range(6):
            browser.js(f"document.querySelectorAll('.plot')[{k}].scrollIntoView()")
            wait_for(lambda k=k: browser.js(drawn.format(k)) == 1)
        assert browser.js("return document.documentElement.scrollWidth") <= width
        assert browser.complaints() == []


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
def test_a_report_has_its_figures_when_it_is_loaded(report):
    """``chromium --print-to-pdf`` prints then, however long the curves take to unpack."""
    printed = """
        const unpack = Response.prototype.arrayBuffer;
        Response.prototype.arrayBuffer = async function () {
          await new Promise((done) => setTimeout(done, 300));
          return unpack.call(this);
        };
        addEventListener("load", () => {
          dispatchEvent(new Event("beforeprint"));
          window.printed = document.querySelectorAll(".printed").length;
        });
    """
    with Browser() as browser:
        source = {"source": printed}
        browser.driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", source)
        browser.driver.get(report.as_uri())
        assert browser.js("return window.printed") == 9
        assert browser.complaints() == []
