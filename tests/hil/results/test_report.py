"""The report of a run: in words, in light and dark, on a screen and on a phone."""

import re
from pathlib import Path

import pytest

import gfmhil
from gfm_hil.recording.columns import printed

from ...support.scope import HAS_BROWSER, Browser


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a run with frames lost, with a title longer than a line, and an event at its end."""
    scenario = gfmhil.load_scenario("pref_step", duration=1.2, in_process=True)
    title = "P_ref steps from 0.5 to 1 p.u., and the title of this run goes on and on, " * 2
    run = gfmhil.run(scenario.model_copy(update={"title": title}))
    run.summary["faults"] = {"controller": {"lost": 12, "crc": 1}, "plant": {}}
    run.summary["date"] = "2026-11-24T03:15:21+00:00"
    return run.save(tmp_path_factory.mktemp("report") / "run") / "report.html"


def test_it_is_in_words(report):
    text = report.read_text("utf-8")
    assert "controller: 12 lost, 1 crc; plant: none" in text and "{'" not in text
    assert "2026-11-24 03:15:21 UTC" in text
    assert text.count('class="plot"') == 6 and text.count("<svg") == 3  # those of the waveforms


def test_names_of_signals_are_printed_in_the_notation_of_the_field():
    names = ("f_hz", "omega_u", "omega_g", "delta", "v_dc", "p")
    assert [printed(name) for name in names] == ["f", "ω_u", "ω_g", "δ", "v_dc", "p"]


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 1200])
def test_it_is_readable_in_a_browser(report, width, dark):
    with Browser(width, 900, dark=dark, phone=width < 500) as page:
        page.driver.get(report.as_uri())
        assert page.js("return document.documentElement.scrollWidth <= innerWidth")
        # no text of a panel is cut, and none is smaller than 7.5 pixels
        cut, least = page.js("""
            let cut = [], least = 99;
            for (const svg of document.querySelectorAll("svg")) {
              const box = svg.getBoundingClientRect();
              for (const text of svg.querySelectorAll("text")) {
                const r = text.getBoundingClientRect();
                if (!r.width) continue;
                least = Math.min(least, parseFloat(getComputedStyle(text).fontSize)
                                        * box.width / svg.viewBox.baseVal.width);
                if (r.left < box.left - 1 || r.right > box.right + 1 || r.top < box.top - 1 ||
                    r.bottom > box.bottom + 1) cut.push(text.textContent);
              }
            }
            return [cut, least];""")
        assert cut == [] and least > 7.5
        paper = page.js("return getComputedStyle(document.body).backgroundColor")
        lightness = sum(map(int, re.findall(r"\d+", paper))) / 3
        assert lightness < 50 if dark else lightness > 200
