"""The single-line diagram shows what the scenario has."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.text import Annotation

import gfmhil
from gfm_hil.results.diagram import draw_diagram, fill_diagram, fill_narrow
from gfm_hil.results.single_line import Bar, DrawnLine, assign_lanes, assign_rows
from gfm_hil.scenario import Scenario, load_scenario, shipped_scenarios
from gfm_plant import NetworkParts
from gfm_plant.components.part import Component

from ...support.laws import slow_but

Make = Callable[..., Scenario]
FAULT = {"t": 0.02, "type": "fault", "position": 0.25, "R": 0.1}


def texts(scenario: Scenario) -> list[str]:
    return [text.get_text() for text in fill_diagram(Figure(), scenario).texts]


def breakers(scenario: Scenario) -> list[bool]:
    """Of the small squares, whether each is filled."""
    small = [p for p in fill_diagram(Figure(), scenario).patches if isinstance(p, Rectangle)]
    return [p.get_facecolor()[0] < 0.5 for p in small if p.get_width() == pytest.approx(0.22)]


def test_one_converter_at_its_grid(make):
    plant = {"grid": {"scr": 4.0, "x_over_r": 3.0, "omega_g": 0.99, "load_R": 40.0, "load_L": 0.01}}
    shown = texts(make(law="vsg-2", plant=plant))
    assert "vsg-2, 4 kVA" in shown
    # by hand: 1/4 over sqrt(1 + 9), 3 to 1
    assert "$L_g$ 0.237\n$R_g$ 0.079\nSCR 4" in shown
    assert "grid, ideal\n$V_g$ 1 p.u., 49.5 Hz" in shown
    assert "local load\nR 40 Ω, L 10 mH" in shown
    assert not any("fault" in text for text in shown)


def test_a_fault_is_marked_at_its_place(make):
    places = []
    for position in (0.0, 0.25, 0.5):
        axes = fill_diagram(Figure(), make(events=[{**FAULT, "position": position, "R": 0.1}]))
        assert "fault, 0.02 s" in [text.get_text() for text in axes.texts]
        places += [x for line in axes.lines if line.get_marker() == "v" for x in line.get_xdata()]
        dots = [x for line in axes.lines if line.get_marker() == "o" for x in line.get_xdata()]
        assert places[0] == dots[0]  # the terminal, where the capacitor is
    assert places[2] - places[0] == pytest.approx(2 * (places[1] - places[0]))


@pytest.mark.parametrize("node", ["bus", "far"])
def test_the_words_of_a_fault_at_a_load_lie_on_nothing(node):
    feeder = {"start": "bus", "end": "far", "L": 0.1, "R": 0.01}
    loads = {name: {"node": name, "P": 1 / 3} for name in ("bus", "far")}
    network = {"converters": {"A": {"node": "bus"}}, "lines": {"feeder": feeder}, "loads": loads}
    fault = {"t": 0.5, "type": "fault", "node": node, "R": 0.1}
    figure = Figure()
    one = {"title": "two loads", "duration": 1.0, "law": "vsg-2", "network": network}
    axes = fill_narrow(figure, Scenario.model_validate({**one, "events": [fault]}))
    figure.draw_without_rendering()
    (words,) = (text for text in axes.texts if text.get_text() == "fault, 0.5 s")
    arrows = [text.arrow_patch for text in axes.texts if isinstance(text, Annotation)]
    others = [text for text in axes.texts if text.get_text() not in ("", words.get_text())]
    box = words.get_window_extent()
    assert len(arrows) == 2
    assert any("0.3333," in text.get_text() for text in others)
    assert not any(box.overlaps(other.get_window_extent()) for other in [*arrows, *others])
    assert box.y0 > 0


def test_a_transformer_and_a_second_inductor_are_drawn(make):
    unit = {"node": "low", "plant": {"lcl": {"L": 0.08, "R": 0.01}}}
    step_up = {"start": "low", "end": "high", "S": 2.0, "X": 0.12, "X_m": 100.0, "closed": False}
    network = {"grid": "high", "converters": {"A": unit}, "transformers": {"T": step_up}}
    scenario = make(network=network)
    shown = texts(scenario)
    assert "T\nS 2, X 0.12, R 0, $X_m$ 100" in shown and "$L_2$ 0.08\n$R_2$ 0.01" in shown
    assert breakers(scenario) == [True, False]
    outlines = [p for p in fill_diagram(Figure(), scenario).patches if isinstance(p, Circle)]
    assert sum(p.get_radius() == 0.24 and p.get_facecolor()[3] == 0.0 for p in outlines) == 2
    alone = make(plant={"lcl": {"L": 0.08}, "grid": {"scr": 4.0, "x_over_r": 3.0}}, events=[FAULT])
    assert "$L_2$ 0.08\n$R_2$ 0\n$L_g$ 0.237\n$R_g$ 0.079\nSCR 4" in texts(alone)
    lg = {**FAULT, "kind": "LG", "phases": "c"}
    assert "LG fault of c, 0.02 s" in texts(make(events=[lg]))


def test_a_network_has_all_its_parts():
    scenario = load_scenario("three_share_a_load")
    shown = texts(scenario)
    named = ["A: vsg-2, 4 kVA", "B: droop-3, 4 kVA", "C: mimo-gfm-deployable, 4 kVA", "bus", "far"]
    parts = ["feeder\nL 0.1, R 0.02 p.u.", "base\nP 0.9, Q 0.2 p.u.", "step\nP 0.6, Q 0.1 p.u."]
    assert {*named, *parts} <= {*shown} and not any("grid" in text for text in shown)
    assert sorted(breakers(scenario)) == [False, True, True]  # the load step is not on yet
    machine = load_scenario("loss_of_the_last_machine")
    assert {"machine\nS 1, H 3 s, X 0.3", "SM"} <= {*texts(machine)}
    circles = [p for p in fill_diagram(Figure(), machine).patches if isinstance(p, Circle)]
    assert len(circles) == 3  # two DC sources and the machine


def test_a_network_at_a_finite_grid(make):
    """Banks are at their node, and the node of the grid is the last one."""
    network = {
        "grid": "town",
        "converters": {"A": {"node": "farm"}, "B": {"node": "farm"}},
        "lines": {"cable": {"start": "town", "end": "farm", "L": 0.1, "closed": True}},
        "capacitors": {"bank": {"node": "farm", "Q": 0.1}},
    }
    grid = {"finite": {"S": 20.0, "H": 4.0}}
    scenario = make(network=network, plant={"grid": grid})
    axes = fill_diagram(Figure(), scenario)
    at = {text.get_text(): text.get_position()[0] for text in axes.texts}
    assert at["farm"] < at["town"] < at["grid, S 20, H 4 s\n$V_g$ 1 p.u., 50 Hz"]
    assert at["farm"] < at["bank\nQ 0.1 p.u."] and breakers(scenario) == [True, True]


def test_a_component_without_a_symbol_is_a_box_with_its_name(monkeypatch):
    class Shunt(Component):
        node: str

    class Cable(Component):
        start: str
        end: str

    scenario = load_scenario("three_share_a_load")
    assert scenario.network is not None
    known = fill_diagram(Figure(), scenario).patches
    node, own = scenario.network.converters["A"].node, [*scenario.network.components()]
    others = [("s", "shunt", Shunt(node=node)), ("c", "sea", Cable(start=node, end="platform"))]
    monkeypatch.setattr(NetworkParts, "components", lambda self: iter([*own, *others]))
    axes = fill_diagram(Figure(), scenario)
    shown = [text.get_text().strip() for text in axes.texts]
    assert {"shunt", "sea", "platform"} <= {*shown}
    boxes = [p for p in axes.patches if isinstance(p, Rectangle) and p.get_width() == 0.7]
    assert len(boxes) == len([p for p in known if isinstance(p, Rectangle)
                              and p.get_width() == 0.7]) + 2  # fmt: skip


def test_lines_of_a_narrow_page_meet_at_nodes_alone():
    """A ring of four: the line that closes it passes two nodes, on the left of their lines."""
    bars = {name: Bar(column=3 - k, converters=[name]) for k, name in enumerate("abcd")}
    bars["b"].right = [("load", "town", True)]
    ends = {"ab": "ab", "bc": "bc", "cd": "cd", "da": "da"}
    lines = {
        name: DrawnLine((pair[0], pair[1]), "inductor", "", True) for name, pair in ends.items()
    }
    assert assign_rows(bars, lines, stacked=True) == 9
    assert [bars[name].rows for name in "abcd"] == [[0], [2, 3], [5], [8]]
    assert {name: line.row for name, line in lines.items()} == {"ab": 1, "bc": 4, "cd": 6, "da": 7}
    assert assign_lanes(bars, lines) == {"ab": 0, "bc": 0, "cd": 0, "da": 1}


EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
MESHES = [str(EXAMPLES / name / "network.toml") for name in ("ieee9", "ieee39")]


@pytest.mark.parametrize("fill", slow_but([fill_narrow], [fill_diagram, fill_narrow]))
@pytest.mark.parametrize("name", [*shipped_scenarios(), *MESHES])
def test_every_shipped_scenario_is_drawn_within_its_picture(name, fill):
    figure = Figure()
    axes = fill(figure, load_scenario(name))
    figure.draw_without_rendering()
    bars = [(line.get_xdata()[0], *sorted(line.get_ydata()))
            for line in axes.lines if line.get_linewidth() == 3.5]  # fmt: skip
    for (x, _, top), (other_x, low, _) in pairwise(sorted(bars)):  # none is on another
        assert x != other_x or low > top
    narrow = 72 * figure.get_figwidth() * 4 / 3 < 358  # pixels of a phone
    assert fill is fill_diagram or narrow or "ieee39" in name  # it has 18 lines beside each other
    for text in axes.texts:
        box = text.get_window_extent().transformed(figure.transFigure.inverted())
        assert box.x0 >= 0 and box.x1 <= 1 and box.y0 >= 0 and box.y1 <= 1, text.get_text()


def test_the_report_shows_it(make, tmp_path):
    one = gfmhil.run(make(events=[FAULT]), folder=tmp_path / "run")
    report = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "fault, 0.02 s" in report and 'href="#of-' not in report
    drawn = one.file("network.svg").read_bytes()
    assert ET.fromstring(drawn).tag == "{http://www.w3.org/2000/svg}svg"
    (tmp_path / "again").mkdir()
    draw_diagram(tmp_path / "again", one.scenario)
    assert (tmp_path / "again" / "network.svg").read_bytes() == drawn


def test_converters_and_lines_are_links_to_their_curves(tmp_path):
    """Lines of a mesh too, each between columns of its own."""
    scenario = load_scenario("dynawo_three_converters")
    page = ET.fromstring(f"<p>{draw_diagram(tmp_path, scenario, 'report.html')}</p>")
    assert [drawn.attrib["class"] for drawn in page] == ["wide", "narrow"]
    links, narrow = ([link.attrib["href"] for link in drawn.iter("a")] for drawn in page)
    assert sorted(narrow) == sorted(links)
    assert links[:3] == ["#of-droop", "#of-dvoc", "#of-matching"] and len(links) == 3 + 5
    assert "#only=droop,matching" in links  # line12
    alone = (tmp_path / "network.svg").read_text("utf-8")
    assert 'xlink:href="report.html#of-dvoc"' in alone
