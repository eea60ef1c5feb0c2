"""The report of a run: in words, in light and dark, on a screen and on a phone."""

import re
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.recording.columns import symbol_of
from gfm_hil.recording.run import Run
from gfm_hil.results.report import _commands

from ...support.laws import slow_but
from ...support.page import unpacked
from ...support.processes import wait_for
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
    assert text.count('class="plot"') == 9 and '<p class="scroll diagram"><svg' in text


def test_it_says_which_operator_did_what(tmp_path):
    scope = {"through": "scope", "name": "Ann", "peer": "10.0.0.7:40390"}
    step = {"tick": 50, "t": 0.005, "event": "breaker", "label": "town off", "operator": scope}
    planned = {"tick": 60, "t": 0.006, "event": "reference", "label": "P_ref = 0.4"}
    end = {"tick": 90, "t": 0.009, "event": "end", "reason": "x", "operator": {"through": "xcp"}}
    runs = [Run(None, {}, {}, events=[planned, step, *more]) for more in ([end], [])]
    both = _commands(dict(zip("AB", runs, strict=True)))
    assert both.rows == [
        ["0.005", "town off", "A, B", "scope, Ann, 10.0.0.7:40390"], ["0.009", "stop", "A", "xcp"],
    ]  # fmt: skip
    assert _commands({"": runs[1]}).rows == [["0.005", "town off", "scope, Ann, 10.0.0.7:40390"]]


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of three converters in a mesh, a line that opens and a fault, at 10 kHz."""
    folder = tmp_path_factory.mktemp("report") / "run"
    gfmhil.run_network("dynawo_three_converters", folder, duration=1.7, T_s=1e-4)
    return folder / "report.html"


@pytest.mark.full
def test_a_network_has_one_report(network):
    text = network.read_text("utf-8")
    titles = re.findall(r'<h2 id="([^"]*)"', text)
    assert titles == ["network", "all", "of-droop", "of-dvoc", "of-matching", "scenario"]
    plots = unpacked(text)
    assert len(plots) == 6 + 3 * 9 and {*plots[0]["curves"]} == {"droop", "dvoc", "matching"}
    run = gfmhil.load_run(network.parent / "dvoc")
    V = plots[4]
    assert [label for _, label in V["events"]] == ["line12 off", "fault at node bus4 for 0.15 s"]
    at = np.rint(V["x"] / 1e-4).astype(int)
    assert V["curves"]["dvoc"] == pytest.approx(run.signals["V"][at], abs=2 / 4094)


@pytest.mark.parametrize("opened", slow_but([False], [True, False]))
def test_a_comparison_has_a_report_which_the_command_names_and_opens(
    opened, tmp_path, capsys, monkeypatch
):
    asked = list[str]()
    monkeypatch.setattr("webbrowser.open", lambda url: asked.append(url) or opened)
    words = ["--laws", "vsg-2,droop-5", "--duration", "1.1", "--out", str(tmp_path / "c"), "--open"]
    main(["compare", "pref_step", *words])
    page = tmp_path / "c" / "report.html"
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == f"report: {page}" and asked == [page.as_uri()]
    assert ("there is no browser" in said.err) is not opened
    plots = unpacked(page.read_text("utf-8"))
    assert {*plots[0]["curves"]} == {"vsg-2", "droop-5"} and len(plots) == 6 + 2 * 9


def test_names_of_signals_are_printed_in_the_notation_of_the_field():
    names = ("f_hz", "omega_u", "omega_g", "delta", "v_dc", "p")
    assert [symbol_of(name) for name in names] == ["f", "ω_u", "ω_g", "δ", "v_dc", "p"]


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
@pytest.mark.parametrize(("width", "dark"), [(390, True), (1200, False)])
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


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
@pytest.mark.parametrize("width", [390, 1280])
def test_the_diagram_is_the_entrance_to_the_curves(network, width):
    with Browser(width, 900, phone=width < 500) as page:
        page.driver.get(network.as_uri())
        kind = "narrow" if width < 500 else "wide"
        diagrams, shown = page.js("""
            const all = [...document.querySelectorAll(".diagram svg")];
            const box = document.querySelector(".diagram");
            return [all.filter((s) => s.checkVisibility()).map((s) => s.getAttribute("class")),
                    box.scrollWidth <= box.clientWidth];""")
        assert diagrams == [kind] and shown
        page.click(f".diagram .{kind} a[href='#of-droop']")
        place = "return document.getElementById('of-droop').getBoundingClientRect().top"
        wait_for(lambda: abs(page.js(place)) < 200)  # below the list of contents
        page.js("location.hash = '#only=dvoc,matching'")
        off = (
            "return [...document.querySelectorAll('#all ~ .panels .plot')][0]"
            ".querySelectorAll('.u-series.u-off').length"
        )
        wait_for(lambda: page.js(off) == 1)
        assert page.text("#shown b") == "dvoc, matching"
        page.click("#shown a")
        wait_for(lambda: page.js(off) == 0)
        assert page.js("return document.documentElement.scrollWidth") <= width
        assert page.complaints() == []
