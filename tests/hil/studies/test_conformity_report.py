"""The report of conformity: first page, figures of the page, PDF with hashes, and what they say of
limiters."""

import hashlib
import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.terminal import terminal
from gfm_hil.recording.run import Run
from gfm_hil.results.curves import PackedCurves, Panel
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario
from gfm_hil.studies.conformity.panels import panels_of_run
from gfm_hil.studies.conformity.saturation import mark_saturation
from gfm_hil.studies.conformity.verdict import FAIL, PASS, Verdict
from gfm_runtime.lawfile import shipped_law

from ...support.files import text_of
from ...support.page import unpacked
from ...support.processes import wait_for
from ...support.scope import HAS_BROWSER, Browser

#: with one clause, whose words HTML would take for a tag
_TRIP = '[[criteria]]\nkind = "no_trip"\nclause = "lasts"\n\n'
LAB = text_of("jump.toml").replace(_TRIP, "").replace("opposes", "opposes <b>")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report on a law in a test of one run."""
    place = tmp_path_factory.mktemp("report")
    (place / "jump.toml").write_text(LAB)
    asked = ["--law", "droop-3", "--against", str(place / "jump.toml"), "-o", str(place / "out")]
    assert main(["conform", *asked, "--workers", "1", "--quiet"]) == 0
    return place / "out"


def test_the_first_page_says_what_was_judged_and_has_room_to_sign(report):
    text = (report / "report.html").read_text("utf-8")
    first = re.sub(r"<[^>]+>", " ", text[text.index("<h1>") : text.index("<h2")])
    facts = json.loads((report / "results.json").read_text("utf-8"))
    assert facts["digests"]["droop-3"] in first and facts["machine"] in first
    for words in (
        "droop-3",
        f"gfmhil {version('gfmhil')}",
        "droop 1 %, that of the law itself; power -1 to 1 p.u.",
        "ours; no source gives it 1 0",
        "all 1 0",
    ):
        assert words in re.sub(r"\s+", " ", first), words
    assert all(f"<td>{name}</td>" in text for name in ("name", "place", "date", "signature"))
    assert "opposes &lt;b&gt;" in text and "opposes <b>" not in text


def test_hashes_are_those_of_the_files_and_of_what_a_repeated_run_records(report):
    content = json.loads((report / "results.json").read_text("utf-8"))
    hashes = content["hashes"]
    text = shipped_law("droop-3")
    assert text is not None
    assert hashes["law droop-3"] == hashlib.sha256(text.encode()).hexdigest()
    (test,) = (sha for name, sha in hashes.items() if name.endswith("/jump"))
    assert test == hashlib.sha256((report.parent / "jump.toml").read_bytes()).hexdigest()
    assert {"converter under test converter.toml", "converter paper"} < {*hashes}
    (part,) = (p for found in content["laws"]["droop-3"].values() for p in found["parts"])
    (scenario,) = (report / "runs").rglob("scenario.toml")
    again = gfmhil.run(scenario)
    assert again.digest == part["recording"]
    folder = report.parent / "again"
    gfmhil.run(scenario, folder=folder, figures=False)
    assert gfmhil.load_run(folder).digest == part["recording"]
    again.columns["true_p"][5] = np.nextafter(again.columns["true_p"][5], 2.0)
    assert again.digest != part["recording"]


def test_the_pdf_is_there_and_without_its_package_the_rest_is(report, monkeypatch, capsys):
    data = (report / "report.pdf").read_bytes()
    assert data.startswith(b"%PDF-") and b"Conformity of droop-3" in data
    pages = max(int(count) for count in re.findall(rb"/Count (\d+)", data))
    assert pages == 3  # the first page, the test, the hashes
    for name in [name for name in sys.modules if name.partition(".")[0] == "reportlab"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "reportlab", None)
    other = report.parent / "other"
    asked = ["--law", "droop-3", "--against", str(report.parent / "jump.toml"), "-o", str(other)]
    assert main(["conform", *asked, "--workers", "1", "--no-figures"]) == 0
    assert "pip install 'gfmhil[pdf]'" in capsys.readouterr().err
    assert (other / "report.html").is_file() and not (other / "report.pdf").exists()


def test_the_page_shows_what_was_recorded_within_a_level_and_is_small(report):
    page = (report / "report.html").read_text("utf-8")
    power, *_ = unpacked(page)
    (scenario,) = (report / "runs").rglob("scenario.toml")
    run = gfmhil.run(scenario)
    p = run.signals["p_c"]  # at the connection point
    drawn = power["curves"]["every tick"]
    level = np.ptp(p) / 4094
    assert drawn.min() == pytest.approx(p.min(), abs=level)
    assert drawn.max() == pytest.approx(p.max(), abs=level)
    # wherever a point is drawn, the signal has that value within the column that it stands for
    at = np.searchsorted(run.signals["t"], power["x"]).clip(0, len(p) - 1)
    around = np.array(
        [[p[max(0, k - 80) : k + 80].min(), p[max(0, k - 80) : k + 80].max()] for k in at]
    )
    assert np.all(drawn >= around[:, 0] - level) and np.all(drawn <= around[:, 1] + level)
    assert [number for *_, number in power["limits"]] == [1]
    assert len(page) < 90_000  # of which uPlot is 51,000


def run_of(ticks: int, **columns: np.ndarray) -> Run:
    """A run behind the virtual stator, whose power limiter acts beyond 1 p.u."""
    scenario = Scenario.model_validate(
        {"title": "made", "duration": ticks * 1e-4, "law": "vsg-2", "inner": "virtual-stator",
         "link": {"type": "inproc"}}
    )  # fmt: skip
    rest = {"V": 1.0, "i": 0.5, "omega_u": 1.0}
    t = np.arange(ticks) * 1e-4
    every = {
        "tick": np.arange(ticks),
        "t": t,
        "limited": np.zeros(ticks),
        "y_p": np.full(ticks, 0.5),
    }
    every |= {f"true_{name}": np.full(ticks, value) for name, value in rest.items()}
    every |= {"true_p": np.full(ticks, 0.5), **columns}
    return Run(scenario, {"status": "completed", "reason": "", "events": []}, every)


def verdict_in(start: float, stop: float) -> Verdict:
    return Verdict("asked", "settles", "p", start, stop, PASS, 1.0, "s", "within 1 s", "So.")


def test_a_spike_of_one_tick_stays_in_the_figure():
    p = np.full(200_000, 0.5)
    p[123_456] = 3.0
    (power, *_) = panels_of_run(run_of(200_000, true_p=p), [])
    assert power.curves["every tick"].max() == 3.0
    assert len(power.x) < 700
    curves = PackedCurves()
    assert curves.add(power) == 0 and curves.add(Panel("x", p[:0], {}, (0.0, 1.0))) == 1


def test_a_clause_is_marked_by_the_part_of_its_window_in_which_a_limiter_acts():
    """The power limiter by the recursion of the controller; that of the current as recorded."""
    t = np.arange(20_000) * 1e-4
    y_p = 0.95 + 0.2 * np.sin(2 * np.pi * t) + 0.05 * np.sin(2 * np.pi * 7 * t)
    x, acts = 0.0, np.zeros(20_000, bool)
    for k, over in enumerate(y_p - 1.0):
        x = max(x + 1e-4 * 5.0 * over, 0.0)
        acts[k] = 0.1 * over + x > 0
    assert 0.05 < acts.mean() < 0.95
    limited = np.zeros(20_000)
    limited[5_000:6_000] = 1
    run = run_of(20_000, y_p=y_p, limited=limited)
    first, second = mark_saturation(run, [verdict_in(0.0, 2.0), verdict_in(0.7, 0.9)], True)
    assert first.saturated == pytest.approx({"current": 0.05, "power": acts.mean()})
    assert "current" not in second.saturated
    (foreign,) = mark_saturation(run, [verdict_in(0.4, 0.6)], False)
    assert foreign.saturated == pytest.approx({"current": 0.5})


def test_a_status_that_this_version_does_not_know_is_shown(report):
    """As it is, in the page and in the PDF, and counted."""
    (report.parent / "strict.toml").write_text(LAB.replace("least = 0.05", "least = 5.0"))
    found = gfmhil.conform("droop-3", report.parent / "strict.toml", report.parent / "strict")
    (part,) = found.parts
    (verdict,) = part.verdicts
    assert verdict.verdict == FAIL
    object.__setattr__(verdict, "verdict", "limited")
    place = report.parent / "limited"
    found.write(place)
    page = (place / "report.html").read_text("utf-8")
    assert ">limited</span>" in page and "<th>limited</th>" in page
    assert (place / "report.pdf").is_file()


def test_a_converter_file_without_a_plant_is_said_to_be_ideal(report, capsys):
    bare = report.parent / "bare.toml"
    bare.write_text("droop = 0.01\nP_max = 1.0\nP_min = -1.0\n[plant]\n")
    asked = ["--law", "droop-3", "--against", str(report.parent / "jump.toml"), "--no-figures"]
    assert main(["conform", *asked, "--converter", str(bare), "-o", str(report.parent / "i")]) == 0
    assert "converter under test: paper, an ideal plant" in capsys.readouterr().out
    assert "paper, an ideal plant" in (report.parent / "i" / "report.html").read_text("utf-8")


def test_rows_of_a_table_end_in_a_pipe_where_their_text_ends(tmp_path):
    path = tmp_path / "out"
    with path.open("w") as file:
        terminal(file=file).print(Table(("a", "b"), [["x", "y" * 300], ["x", ""]], text=None))
    assert path.read_text() == f"a  b\nx  {'y' * 300}\nx\n"


@pytest.fixture
def browser() -> Iterator[Browser]:
    with Browser() as found:
        yield found


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
def test_the_figures_are_drawn_in_a_browser(report, browser):
    browser.driver.get((report / "report.html").as_uri())
    browser.js("document.querySelector('.plot').scrollIntoView()")
    wait_for(lambda: browser.js("return document.querySelectorAll('.plot canvas').length") == 4)
    assert browser.complaints() == []


@pytest.mark.systems
@pytest.mark.apt
@pytest.mark.skipif(not HAS_BROWSER, reason="needs chromium and chromium-driver")
def test_paper_gets_all_figures_two_in_a_row(report, browser):
    browser.driver.get((report / "report.html").as_uri())
    wait_for(lambda: browser.js("return document.querySelectorAll('.plot canvas').length") > 0)
    browser.js("dispatchEvent(new Event('beforeprint'))")
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    boxes = browser.js(
        "return [...document.querySelectorAll('svg.printed')].map((x) => {"
        "const box = x.getBoundingClientRect(); return [box.left, box.top, box.width] })"
    )
    assert len(boxes) == 4 and min(width for *_, width in boxes) > 200
    assert len({left for left, *_ in boxes}) == len({top for _, top, _ in boxes}) == 2
    assert browser.complaints() == []
