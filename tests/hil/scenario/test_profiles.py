"""Courses of the grid from CSV files: what the plant makes of them, and wrong files."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

import gfmhil
from gfm_hil.api.runs import load_run
from gfm_hil.core.errors import UserError
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario, load_scenario
from gfm_hil.scenario.events.grid_profile import GridProfile, read_profile

TEXT = """# a fall of the frequency and of the voltage
t, f_hz, V_g
0.01, 50.0, 1.0
0.03, 49.9, 0.99
0.05, 49.9, 1.0

0.0512, 50.05, 1.0
"""


def content(file: Path | str, **changed: Any) -> dict[str, Any]:
    event = {"t": 0.02, "type": "grid-profile", "file": str(file)}
    return {"title": "course", "duration": 0.1, "law": "vsg-2", "events": [event], **changed}


@pytest.fixture
def course(tmp_path: Path) -> Path:
    path = tmp_path / "course.csv"
    path.write_text(TEXT, encoding="utf-8")
    return path


def expected(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """omega_g and V_g by NumPy's interpolation of the file's lines."""
    since = t - 0.02
    omega = np.interp(since, [0.01, 0.03, 0.05, 0.0512], np.array([50, 49.9, 49.9, 50.05]) / 50)
    return omega, np.interp(since, [0.01, 0.03, 0.05], [1.0, 0.99, 1.0])


def test_the_grid_follows_the_lines_at_every_tick(course):
    run = gfmhil.run(content(course))
    omega, V = expected(run.signals["t"])
    # the plant's value at a tick is that of the tick, which the point before it set out for
    assert run.signals["omega_g"] == pytest.approx(omega, abs=1e-12)
    assert run.signals["V_g"] == pytest.approx(V, abs=1e-12)
    (event,) = run.summary["events"]
    assert event["label"] == "grid profile course"


def test_a_file_is_taken_apart_once_until_it_changes(course):
    first = read_profile(str(course), 50.0)
    assert read_profile(str(course), 50.0) is first
    course.write_text(TEXT.replace("49.9", "49.8"), encoding="utf-8")
    assert read_profile(str(course), 50.0).omega_g[1] == 49.8 / 50


@pytest.mark.processes
def test_it_is_the_same_over_a_link_and_its_file_is_kept(course, tmp_path):
    here = gfmhil.run(content(course))
    scenario = check_scenario(content(course, link={"type": "shm"}), "test")
    run = run_scenario(scenario, tmp_path / "run")
    for name in ("omega_g", "V_g", "p"):
        np.testing.assert_array_equal(run.signals[name], here.signals[name])
    copy = tmp_path / "run" / "profiles" / "course.csv"
    assert copy.read_text() == TEXT
    course.unlink()
    shutil.move(tmp_path / "run", tmp_path / "moved")  # the folder is whole wherever it is
    again = load_scenario(str(tmp_path / "moved" / "scenario.toml"), in_process=True)
    np.testing.assert_array_equal(gfmhil.run(again).signals["p"], here.signals["p"])
    assert load_run(tmp_path / "moved").scenario.events[0].lasts() == 0.0512
    here = gfmhil.run(again)
    here.save(tmp_path / "saved")
    assert (tmp_path / "saved" / "profiles" / "course.csv").read_text() == TEXT


def test_the_content_of_the_file_is_what_both_sides_agree_on(course, tmp_path):
    other = tmp_path / "elsewhere.csv"
    other.write_text(TEXT)
    one, two = (check_scenario(content(f), "test").digest() for f in (course, other))
    assert one == two
    other.write_text(TEXT.replace("49.9, 1.0", "49.8, 1.0"))
    assert check_scenario(content(other), "test").digest() != one


def test_the_file_is_looked_for_beside_the_scenario(course, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    (tmp_path / "s.toml").write_text(
        'title = "s"\nduration = 0.1\n[[events]]\nt = 0\ntype = "grid-profile"\n'
        'file = "course.csv"\n'
    )
    event = load_scenario(str(tmp_path / "s.toml"), in_process=True).events[0]
    assert isinstance(event, GridProfile) and Path(event.file) == course
    assert event.lasts() == 0.0512


WRONG = {
    "t,f_hz\n0,50\n0,50\n": "line 3: t = 0: must be larger than in the line before",
    "t,f_hz\n0,50\n1,nan\n": "line 3: f_hz = nan: must lie in [40, 60]",
    "t,f_hz\n0,70\n": "line 2: f_hz = 70: must lie in [40, 60]",
    "t,omega_g\n0,50\n": "line 2: omega_g = 50: must lie in [0.8, 1.2]",
    "t,V_g\n-1,1\n": "line 2: t = -1: must lie in [0, 86400]",
    "t,V_g\n0,1.6\n": "line 2: V_g = 1.6: must lie in [0, 1.5]",
    "# c\nt,V_g\n0,x\n": "line 3: V_g = 'x': must be a number",
    "t,V_g\n0,1,2\n": "line 2: has 3 fields, but the first line has 2",
    "V_g,t\n1,0\n": "columns V_g,t: must be t, then",
    "t,f\n0,1\n": "columns t,f: must be t, then",
    "t,f_hz,omega_g\n0,50,1\n": "columns t,f_hz,omega_g: must be t, then",
    "t\n0\n": "columns t: must be t, then",
    "t,V_g\n": "has no line with numbers",
    "": "has no line with numbers",
}


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_file_is_refused_with_its_line(text, tmp_path):
    path = tmp_path / "wrong.csv"
    path.write_text(text)
    with pytest.raises(UserError) as found:
        check_scenario(content(path), "test.toml")
    said = str(found.value)
    assert "\n" not in said and "events.0: " in said and "wrong.csv" in said
    assert WRONG[text] in said


def test_files_that_are_none_are_refused(tmp_path):
    (tmp_path / "bytes.csv").write_bytes(b"t,V_g\n\xff\xfe,1\n")
    for file in ("none.csv", "bytes.csv", ".", "x" * 5000):
        with pytest.raises(UserError, match=r"events\.0: "):
            check_scenario(content(tmp_path / file), "test.toml")


def test_a_finite_grid_takes_a_voltage_only(course, tmp_path):
    finite = {"grid": {"finite": {"S": 5.0, "H": 4.0}}}
    with pytest.raises(UserError, match="such a grid sets its own frequency"):
        check_scenario(content(course, plant=finite), "test")
    (tmp_path / "v.csv").write_text("t,V_g\n0,1.0\n0.02,0.98\n")
    run = gfmhil.run(content(tmp_path / "v.csv", plant=finite))
    assert run.signals["V_g"][-1] == 0.98


def test_a_recorded_voltage_is_played_as_the_grid_that_made_it(tmp_path):
    events = [
        {"t": 0.1, "type": "grid-phase-jump", "degrees": 10.0},
        {"t": 0.2, "type": "grid-voltage", "V_g": 0.8},
        {"t": 0.3, "type": "grid-frequency", "f_hz": 49.0, "rate": 5.0},
    ]
    asked = {"title": "played", "duration": 0.6, "plant": {"grid": {"scr": 3.0, "x_over_r": 10.0}}}
    run = gfmhil.run(asked | {"events": events}, "vsg-2")
    t, omega_g = run.signals["t"], run.signals["omega_g"]
    angle = 100 * np.pi * (np.cumsum(omega_g) - omega_g) * 1e-4
    angle[t >= 0.09999] += np.radians(10.0)
    turns = angle - 2 * np.pi / 3 * np.arange(3)[:, None]
    columns = dict(zip(("va", "vb", "vc"), run.signals["V_g"] * np.cos(turns), strict=True))
    savemat(tmp_path / "site.mat", {"t": t, **columns})
    (tmp_path / "map.toml").write_text(
        'S_n = 4e3\nV_n = 380.0\nv.phases = ["va", "vb", "vc"]\ni.phases = ["va", "vb", "vc"]\n'
    )
    with pytest.raises(UserError, match=r"site\.mat: f = 2.* p\.u\..* must lie in \[0\.8, 1\.2\]"):
        gfmhil.grid_profile(tmp_path / "site.mat", tmp_path / "map.toml", tmp_path / "no", f_n=25.0)
    file = gfmhil.grid_profile(tmp_path / "site.mat", tmp_path / "map.toml", tmp_path / "grid.csv")
    played = [{"t": 0.0, "type": "grid-profile", "file": str(file)}]
    again = gfmhil.run(asked | {"events": played}, "vsg-2")
    for name in ("p", "q"):
        off = np.abs(again.signals[name] - run.signals[name]).max()
        assert off < 1e-3 and np.ptp(run.signals[name]) > 0.3, (name, off)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"file": "none.csv"}, r"none\.csv: no such file"),
        ({"map": "none.toml"}, r"none\.toml: cannot be read: No such file"),
        ({"to": "none/grid.csv"}, r"none/grid\.csv: No such file"),
        ({"f": ""}, r"map\.toml: channels\.f: missing; the grid needs it"),
        ({"f": "g"}, r"site\.csv: channel 'g': is not in it"),
        (
            {"V": "volts"},
            r"V = 380 p\.u\. 0\.003 s after its begin: must lie in \[0, 1\.5\]; units",
        ),
        ({"V": "below"}, r"site\.csv: V = -0\.1 p\.u\. 0\.009 s after its begin: must lie in"),
        ({"f_n": 60.0, "f": "slow"}, r"site\.csv: f = 0\.6667 p\.u\. 0 s after .* \[0\.8, 1\.2\]"),
        ({"most": 5}, r"site\.csv: would make 10 lines: must be <= 5; give a larger T_s"),
        ({"f_n": 0.0}, "f_n = 0.0: must be > 0"),
        ({"T_s": float("nan")}, "T_s = nan: must be > 0"),
    ],
)
def test_what_cannot_be_played_as_a_grid_is_refused_in_one_line(
    change, says, tmp_path, monkeypatch
):
    if "most" in change:
        monkeypatch.setattr("gfm_hil.recording.foreign.voltage_profile.MOST_LINES", change["most"])
    columns = {
        "t": 1e-3 * np.arange(10), "p": np.full(10, 0.5), "u": np.ones(10), "hz": np.full(10, 50.0),
        "volts": np.where(np.arange(10) == 3, 380.0, 1.0), "below": 0.8 - 0.1 * np.arange(10),
        "slow": np.full(10, 40.0),
    }  # fmt: skip
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
    (tmp_path / "site.csv").write_text("\n".join(lines))
    channels = f'p = "p"\nq = "p"\nV = "{change.get("V", "u")}"\n'
    if f := change.get("f", "hz"):
        channels += f'f = {{ channel = "{f}", unit = "Hz" }}\n'
    (tmp_path / "map.toml").write_text(f"S_n = 4e3\nV_n = 380.0\n[channels]\n{channels}")
    where = {"file": "site.csv", "map": "map.toml", "to": "grid.csv"}
    paths = {key: tmp_path / change.get(key, name) for key, name in where.items()}
    how = {key: change[key] for key in ("f_n", "T_s") if key in change}
    with pytest.raises(UserError, match=says) as found:
        gfmhil.grid_profile(*paths.values(), **how)
    assert "\n" not in str(found.value) and not paths["to"].exists()
