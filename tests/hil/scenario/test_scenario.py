"""Scenario files: shipped ones load, written ones are read back, a mistake gives one line."""

import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import check_scenario, load_scenario, scenario_toml, shipped_scenarios

from ...support.files import text_of

LAW = """
name = "broken"
title = "a law with a mistake"
source = "tests"
[phi]
22 = { type = "PD", k = 0.01, T = 0.1 }
"""
CONVERTER = text_of("broken_converter.toml")


def event(**content: Any) -> dict[str, Any]:
    """The content of a scenario with this one event."""
    return {"events": [{"t": 0.05, **content}]}


WRONG: dict[str, tuple[dict[str, Any], list[str]]] = {
    "unknown law": ({"law": "vsg-99"}, ["law 'vsg-99'", "unknown", "vsg-12"]),
    "unknown law in an event": (event(type="law", law="vsg-99"), ["law 'vsg-99'", "unknown"]),
    "unknown law to compare": ({"compare": ["vsg-99"]}, ["law 'vsg-99'", "unknown"]),
    "law file without its ending": ({"law": "law"}, ["law 'law'", "did you mean 'law.toml'?"]),
    "law file that is not there": ({"law": "nowhere.toml"}, ["nowhere.toml", "No such file"]),
    "improper element": ({"law": "law.toml"}, ["phi_22", "proper"]),
    "negative inductance": ({"plant": {"factors": {"L_f": -1.0}}}, ["factors.L_f = -1.0", "> 0"]),
    "negative inductance of a load": ({"plant": {"grid": {"load_R": 1.0, "load_L": -2.0}}},
        ["plant.grid.load_L", "not -2.0"]),
    "negative inductance of a line": (event(type="grid-impedance", L_g=-3.0, R_g=1.0),
        ["events.0", "L_g", "not -3.0"]),
    "line too fast to resolve": (event(type="grid-impedance", L_g=1e-9, R_g=0.0),
        ["events.0", "too fast", "L_g"]),
    "unknown converter": ({"plant": {"converter": "mine"}}, ["converter = 'mine'", "paper"]),
    "converter file that is not there": ({"plant": {"converter": "nowhere.toml"}},
        ["converter", "nowhere.toml", "No such file"]),
    "converter file with mistakes": ({"plant": {"converter": "converter.toml"}},
        ["L_f: must be greater than 0, not -0.001", "C_dc", "not 'big'"]),
    "unknown key": ({"durration": 3}, ["durration = 3", "unknown key"]),
    "unknown key inside": ({"link": {"baud": 9600}}, ["link.baud = 9600", "unknown key"]),
    "missing key": ({"title": None}, ["title"]),
    "event after the end": ({"events": [{"t": 3.0, "type": "reference", "P_ref": 1.0}]},
        ["events.0", "3 s", "ends at 0.1 s"]),
    "event without a time": ({"events": [{"type": "reference", "P_ref": 1.0}]},
        ["events.0", "t = None, tick = None"]),
    "event with two times": (event(type="law", law="vsg-2", tick=3), ["t = 0.05, tick = 3"]),
    "event of no type": (event(P_ref=1.0), ["events.0.type", "missing"]),
    "event of unknown type": (event(type="tea"), ["events.0.type = 'tea'", "'grid-frequency'"]),
    "wrong type": ({"duration": "3"}, ["duration", "number", "not '3'"]),
    "number in place of a table": ({"link": 3}, ["link: must be a table, not 3"]),
    "not a number": ({"duration": float("nan")}, ["duration", "finite", "nan"]),
    "no tick": ({"duration": 1e-5}, ["duration = 1e-05", "T_s = 0.0001"]),
    "reference out of range": ({"references": {"P_ref": 10.0}}, ["P_ref = 10.0", "[-2, 2]"]),
    "reference out of range in an event": (event(type="reference", V_ref=9.0),
        ["events.0", "V_ref = 9.0", "[0, 1.5]"]),
    "no reference": (event(type="reference"), ["events.0", "no reference given"]),
    "realtime in process": ({"mode": "realtime", "link": {"type": "inproc"}},
        ["link.type = 'inproc'", "lockstep"]),
    "breaker without load": (event(type="grid-breaker", closed=False),
        ["events.0", "breaker", "load_R"]),
    "ramp and sag": (event(type="grid-voltage", V_g=0.5, rate=1.0, duration=0.1),
        ["events.0", "rate = 1.0, duration = 0.1"]),
    "malformed endpoint": ({"link": {"endpoint": "localhost"}}, ["'localhost'", "tcp://host:port"]),
    "endpoint without port": ({"link": {"endpoint": "tcp://127.0.0.1"}},
        ["'tcp://127.0.0.1'", "tcp://host:port"]),
    "port out of range": ({"link": {"endpoint": "tcp://127.0.0.1:99999"}}, ["99999"]),
    "expectation misspelt": ({"expect": "tripped", "expect_reason": "overcurrent"},
        ["did you mean 'over-current'?"]),
    "expectation of no kind": ({"expect": "tripped", "expect_reason": "x"},
        ["expect_reason = 'x'", "'diverged'"]),
    "reason of the other status": ({"expect": "safe", "expect_reason": "over-current"},
        ["expect = 'safe' takes one of"]),
    "reason without a trip": ({"expect_reason": "over-current"},
        ["expect_reason", "needs expect = 'tripped' or 'safe'"]),
    "time without a trip": ({"expect_after": 0.05}, ["expect_after = 0.05", "needs expect"]),
    "time after the end": ({"expect": "tripped", "expect_after": 0.1},
        ["expect_after = 0.1 s", "below duration"]),
}  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to run in, with a law and a converter that are broken."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "law.toml").write_text(LAW)
    (tmp_path / "converter.toml").write_text(CONVERTER)
    return tmp_path


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_line_with_field_and_value(case, here):
    content, parts = WRONG[case]
    with pytest.raises(UserError) as found:
        check_scenario({"title": "test", "duration": 0.1, **content}, "test.toml")
    text = str(found.value)
    assert text.startswith("test.toml: ")
    assert "\n" not in text
    for part in parts:
        assert part in text


def test_every_mistake_is_named_at_once():
    with pytest.raises(UserError) as found:
        check_scenario({"duration": -1.0, "sed": 3, "mode": "fast"}, "test.toml")
    lines = str(found.value).splitlines()
    assert all(line.startswith("test.toml: ") for line in lines)
    for field in ("title: missing", "duration: ", "sed = 3: unknown key", "mode: "):
        assert sum(field in line for line in lines) == 1


@pytest.mark.parametrize(
    ("content", "meant"),
    [
        ({"durration": 3}, "duration"),
        ({"link": {"typ": "zmq"}}, "type"),
        ({"link": {"type": "zmg"}}, "zmq"),
        ({"link": {"type": "can", "options": {"ever": 2}}}, "every"),
        ({"law": "mimo_gfm"}, "mimo-gfm"),
        ({"mode": "real-time"}, "realtime"),
        (event(type="grid-frequenzy", f_hz=49.0), "grid-frequency"),
        (event(type="reference", Pref=0.3), "P_ref"),
        ({"plant": {"protection": {"overcurrent": {"threshold": 2.0}}}}, "over_current"),
    ],
)
def test_a_name_that_is_nearly_right_is_suggested(content, meant):
    with pytest.raises(UserError, match=f"did you mean '{meant}'\\?"):
        check_scenario({"title": "test", "duration": 0.1, **content}, "test.toml")


def test_a_scenario_that_is_nearly_right_is_suggested():
    with pytest.raises(UserError, match=r"did you mean 'pref_step'\?"):
        load_scenario("prefstep")


def gfmhil(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a separate process."""
    return subprocess.run(
        [sys.executable, "-m", "gfm_hil", *arguments], capture_output=True, text=True
    )


def test_nothing_but_one_line_from_the_real_command(here):
    Path("bad.toml").write_text('title = "bad"\nduration = 1.0\nlaw = "vsg-99"\n')
    done = gfmhil("run", "bad.toml")
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "Traceback" not in done.stderr
    assert sorted(p.name for p in Path().iterdir()) == ["bad.toml", "converter.toml", "law.toml"]


def test_a_law_file_in_place_of_a_scenario_is_told(here):
    with pytest.raises(UserError, match=r"law\.toml: is a law file") as found:
        load_scenario("law.toml")
    assert len(str(found.value).splitlines()) == 1


def test_a_scenario_that_is_not_there_names_what_ships():
    with pytest.raises(UserError, match=r"nowhere: no such file.*pref_step"):
        load_scenario("nowhere")


def test_an_override_of_a_table_that_is_none(here):
    Path("bad.toml").write_text('title = "bad"\nduration = 1.0\nlink = "zmq"\n')
    with pytest.raises(UserError, match=r"link: .* not 'zmq'"):
        load_scenario("bad.toml", link__type="inproc")


def test_a_checked_scenario_without_a_change_is_itself():
    one = load_scenario("pref_step")
    assert load_scenario(one) is load_scenario(one, duration=None) is one
    assert load_scenario(one, seed=one.seed + 1).seed == one.seed + 1
    assert load_scenario(one, in_process=True).link.type == "inproc"


def test_a_short_circuit_ratio_comes_in_place_of_the_files_own_line():
    grid = {"scr": 3.0, "x_over_r": 6.0}
    changes = {"plant__grid__scr": 3.0, "plant__grid__x_over_r": 6.0}, {"plant__grid": grid}
    for one in (load_scenario("rig_pref_step", **each) for each in changes):
        was = load_scenario("rig_pref_step").plant.factors
        assert one.plant.factors == {n: by for n, by in was.items() if n not in ("L_g", "R_g")}
    with pytest.raises(UserError, match=r"grid\.scr = 3: sets the line; leave out factors\.L_g"):
        load_scenario("rig_pref_step", plant__factors__L_g=2.0, **changes[0])


def test_a_plant_without_an_operating_point_is_told():
    """Its DC source is regulated: nothing of the law is to blame."""
    with pytest.raises(UserError, match=r"steady state at .*V_g = 3 p\.u\.$"):
        run_in_memory(load_scenario("rig_pref_step", in_process=True, plant__grid__V_g=3.0))


@pytest.mark.parametrize("name", shipped_scenarios())
def test_every_shipped_scenario_loads_and_survives_being_written(name):
    scenario = load_scenario(name)
    assert scenario.title and scenario.description
    assert scenario.events or scenario.ready_laws  # something happens, or an operator can act
    again = check_scenario(tomllib.loads(scenario_toml(scenario)), name)
    assert again == scenario
    assert again.digest() == scenario.digest()


def test_lockstep_waits_longer_than_real_time_unless_the_scenario_says(make):
    """Where no time passes, a busy machine has seconds; what the scenario says holds in both."""
    waits = {}
    for mode in ("lockstep", "realtime"):
        for link in ({"type": "shm"}, {"type": "shm", "peer_timeout_s": 4.0}):
            found = make(mode=mode, link=link)
            waits[mode, len(link)] = found.peer_timeout_s, found.answer_timeout_s
    assert waits == {
        ("lockstep", 1): (20.0, 10.0),
        ("realtime", 1): (0.5, 0.25),
        ("lockstep", 2): (4.0, 2.0),
        ("realtime", 2): (4.0, 2.0),
    }


def test_the_digest_is_of_contents_not_of_places(make, tmp_path):
    good = LAW.replace("PD", "P").replace(", T = 0.1", "")
    digests = []
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        path = tmp_path / folder / "law.toml"
        path.write_text(good)
        digests.append(make(law=str(path)).digest())
    assert digests[0] == digests[1]
    path.write_text(good.replace("0.01", "0.02"))
    assert make(law=str(path)).digest() != digests[0]
    assert make(seed=1).digest() != make().digest()
    assert make(title="other").digest() == make().digest()


def test_a_step_of_the_short_circuit_ratio_gives_the_line_of_that_ratio():
    from gfm_hil.scenario.events.grid_impedance import GridImpedance
    from gfm_plant import Plant, make_plant

    found = make_plant(Plant(), 1e-4)
    event = GridImpedance(type="grid-impedance", t=0.1, scr=3.0, x_over_r=10.0)
    event.apply(found)
    wanted = make_plant(Plant.model_validate({"grid": {"scr": 3.0, "x_over_r": 10.0}}), 1e-4)
    for name in ("L_g", "R_g"):
        assert found.par[name][0] == pytest.approx(wanted.par[name][0], rel=1e-14)
    assert found.wiring.units[0].L_g == pytest.approx(wanted.wiring.units[0].L_g, rel=1e-14)
    assert event.label() == "SCR 3, X/R 10"


@pytest.mark.parametrize("line", [{}, {"L_g": 2.0}, {"scr": 3.0}, {"L_g": 2.0, "x_over_r": 3.0}])
def test_a_line_is_given_by_its_elements_or_by_its_ratio(line):
    content = {"title": "line", "duration": 1.0, **event(type="grid-impedance", **line)}
    with pytest.raises(UserError, match="give L_g and R_g, or scr and x_over_r"):
        check_scenario(content, "test")
