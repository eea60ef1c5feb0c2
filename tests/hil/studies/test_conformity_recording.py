"""A recording is judged as the run that it was made of, or cannot be; a changed one fails its
clause, and one that is no recording of the test is told before anything is judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.results.export.comtrade import write_cfg, write_dat
from gfm_hil.run.runner import run_in_memory
from gfm_hil.studies.conformity.criteria.base import judge
from gfm_hil.studies.conformity.result import explain_counts
from gfm_hil.studies.conformity.sets import load_cases, load_under_test, scenario_of
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, PASS

TEST, PART, F_N = "ercot/2-phase-jump", "-10", 60.0
CONVERTER = """\
P_max = 1.0
P_min = -1.0
droop = 0.05
plant = { converter = "paper", delay = { samples = 1, fraction = 0.3 } }
"""
BASES = "S_n = 4000.0\nV_n = 380.0\n"
WAVES = """\
v = { phases = ["v_a_V", "v_b_V", "v_c_V"], unit = "V" }
i = { phases = ["i_oa_A", "i_ob_A", "i_oc_A"], unit = "A" }
"""
PHASORS = """\
v = { magnitude = "VM", angle = "VA", unit = "V" }
i = { magnitude = "IM", angle = "IA", unit = "A" }
meter = { window_s = 0.016666666666666666 }
"""
CHANNELS = """\
[channels]
p = { channel = "P", unit = "kW" }
q = { channel = "Q", unit = "var" }
V = "V"
f = { channel = "f", unit = "Hz" }
"""
Columns, Verdicts = dict[str, np.ndarray], dict[str, str]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    (folder / "converter.toml").write_text(CONVERTER)
    (folder / "waves.toml").write_text(BASES + WAVES)
    (folder / "phasors.toml").write_text(BASES + PHASORS)
    return folder


@pytest.fixture(scope="module")
def run(place: Path) -> Run:
    """The run of which recordings are made."""
    (case,), under = load_cases([TEST]), load_under_test(place / "converter.toml")
    part = next(part for part in case.test.runs() if part.name == PART)
    law = "mimo-gfm-deployable"
    return run_in_memory(scenario_of(case, part, under, law, None, place))


@pytest.fixture(scope="module")
def verdicts(run: Run, place: Path) -> Verdicts:
    """What conform says of the run itself, by the kind of clause."""
    (case,), under = load_cases([TEST]), load_under_test(place / "converter.toml")
    part = next(part for part in case.test.runs() if part.name == PART)
    return {v.kind: v.verdict for v in judge(run, case.test.clauses(part), under)}


@pytest.fixture(scope="module")
def waves(run: Run) -> Columns:
    return run.three_phase(si=True)


def write_csv(file: Path, columns: Columns) -> None:
    head, rows = ",".join(columns), np.stack([*columns.values()], 1)
    np.savetxt(file, rows, "%.9g", ",", header=head, comments="")


def write_parquet(file: Path, columns: Columns) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table(columns), file)


def write_mf4(file: Path, columns: Columns) -> None:
    mdf = pytest.importorskip("asammdf")
    signals = [mdf.Signal(x, columns["t"], name=n) for n, x in columns.items() if n != "t"]
    with mdf.MDF(version="4.10") as made:
        made.append(signals)
        made.save(file, overwrite=True)


def write_float_comtrade(file: Path, columns: Columns) -> None:
    """COMTRADE 2013 of 32-bit floating-point numbers."""
    pytest.importorskip("comtrade")
    names = [n for n in columns if n != "t"]
    t, x = columns["t"], np.stack([columns[n] for n in names], 1)
    each = [f"{k},{n},,,V,1,0,0,-1e9,1e9,1,1,P" for k, n in enumerate(names, 1)]
    size = f"{len(names)},{len(names)}A,0D"
    when = ["01/01/2026,00:00:00.000000"] * 2
    rate = f"{1 / (t[1] - t[0]):.6f},{len(t)}"
    lines = ["site,1,2013", size, *each, "60", "1", rate, *when, "FLOAT32", "1", "0,0", "0,0"]
    file.write_text("\r\n".join(lines) + "\r\n")
    rows = np.empty(len(t), [("n", "<u4"), ("t", "<u4"), ("x", "<f4", (len(names),))])
    rows["n"], rows["t"], rows["x"] = np.arange(1, len(t) + 1), np.round(t * 1e6), x
    file.with_suffix(".dat").write_bytes(rows.tobytes())


WRITERS: dict[str, Callable[[Path, Columns], None]] = {
    "csv": write_csv, "mat": savemat, "parquet": write_parquet, "mf4": write_mf4,
    "cfg": write_float_comtrade,
}  # fmt: skip


def judged(place: Path, columns: Columns, of: str = "waves.toml", kind: str = "mat") -> Verdicts:
    """The verdicts of the clauses on a recording of such columns, by kind."""
    file = place / f"recording.{kind}"
    if columns:  # or the file is there
        WRITERS[kind](file, columns)
    converter = place / "converter.toml"
    made = gfmhil.judge_recording(file, place / of, TEST, PART, converter=converter)
    return {v.kind: v.verdict for v in made.parts[0].verdicts}


def phasors(waves: Columns) -> Columns:
    """What a meter of one-cycle phasors, 50 a second, shows of the waves."""
    t, turns = waves["t"], np.exp(2j * np.pi / 3 * np.arange(3))
    made = {"t": np.arange(0.02, t[-1], 0.02)}
    edges = [np.clip(made["t"] + side, t[0], t[-1]) for side in (-0.5 / F_N, 0.5 / F_N)]
    for letter, names in (("V", "v_a_V v_b_V v_c_V"), ("I", "i_oa_A i_ob_A i_oc_A")):
        x = sum(waves[n] * turn for n, turn in zip(names.split(), turns, strict=True)) * 2 / 3
        area = np.cumsum(x * np.exp(-2j * np.pi * F_N * t)) * (t[1] - t[0])
        ends = [np.interp(e, t, area) for e in edges]
        mean = (ends[1] - ends[0]) * F_N / np.sqrt(2)
        made |= {f"{letter}M": np.abs(mean), f"{letter}A": np.degrees(np.angle(mean))}
    return made


@pytest.mark.parametrize("kind", WRITERS)
def test_the_phases_of_a_run_have_the_verdicts_of_the_run(
    place: Path, waves: Columns, verdicts: Verdicts, kind: str
) -> None:
    found = judged(place, waves, kind=kind)
    assert found.pop("stays_in_step") == CANNOT  # the angle of a converter shows outside nowhere
    assert found == {kind: verdicts[kind] for kind in found}
    assert PASS in found.values()


def test_comtrade_at_4_khz_has_the_verdicts_of_the_run(
    place: Path, run: Run, waves: Columns, verdicts: Verdicts
) -> None:
    pytest.importorskip("comtrade")
    t = np.arange(0.0, waves["t"][-1], 1 / 4000)
    slower = {n: np.interp(t, waves["t"], x) for n, x in waves.items() if n != "t"}
    content = {"t": t, "tick": np.arange(len(t)), **slower}
    scenario = run.scenario.model_copy(update={"T_s": 1 / 4000})
    export = replace(run, scenario=scenario, columns=content, timing={})
    write_cfg(export, place / "recording.cfg")
    write_dat(export, place / "recording.dat")
    found = judged(place, {}, kind="cfg")
    assert found.pop("stays_in_step") == CANNOT
    assert found == {kind: verdicts[kind] for kind in found}


def test_the_first_page_is_about_the_recording(place: Path, waves: Columns) -> None:
    file = place / "page.mat"
    savemat(file, waves)
    converter = place / "converter.toml"
    made = gfmhil.judge_recording(file, place / "waves.toml", TEST, PART, converter=converter)
    facts = dict(made.about("page"))
    assert facts["part"] == f"{PART}; not judged: +10"
    assert not facts.keys() & {"law", "inner stage"}
    others = facts["not run"].split(", ")
    assert len(others) == len([*load_cases(["ercot"])]) - 1
    assert TEST not in others and all(one.startswith("ercot/") for one in others)
    assert "about what was recorded" in explain_counts(made, "page")


def test_a_clock_of_its_own_changes_no_verdict(
    place: Path, waves: Columns, verdicts: Verdicts
) -> None:
    found = judged(place, waves | {"t": waves["t"] + 1234.5})
    assert all(verdict in (CANNOT, verdicts[kind]) for kind, verdict in found.items())
    assert list(found.values()).count(CANNOT) == 1


def test_phasors_show_what_they_can(place: Path, waves: Columns, verdicts: Verdicts) -> None:
    found = judged(place, phasors(waves), "phasors.toml")
    told = {kind: verdict for kind, verdict in found.items() if verdict != CANNOT}
    assert told == {kind: verdicts[kind] for kind in told}
    assert {"settles", "no_trip", "peak_delta"} <= {*told}
    assert found["damped"] == found["no_oscillation"] == CANNOT


def _swing(t: np.ndarray, since: float, size: float, hz: float, ratio: float) -> np.ndarray:
    """A swing that begins at a time and decays with a damping ratio."""
    after = np.clip(t - since, 0.0, None)
    decays = np.exp(-2 * np.pi * hz * ratio * after)
    return size * decays * np.sin(2 * np.pi * hz * after)


#: what changes p, of which nothing else is made, and the clause that it breaks
MUTATIONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "peak_delta": lambda p, t: p[0] + 0.25 * (p - p[0]),
    "settles": lambda p, t: p + 0.1 * np.clip(t - 3.0, 0.0, 1.0),
    "damped": lambda p, t: p + _swing(t, 2.1, 0.045, 3.0, 0.02),
    "no_oscillation": lambda p, t: p + _swing(t, 5.0, 0.03, 15.0, 0.0),
    "no_trip": lambda p, t: p * (t < 6.5),
}


@pytest.mark.parametrize("kind", MUTATIONS)
def test_a_changed_recording_fails_its_clause(place: Path, run: Run, kind: str) -> None:
    s = run.signals
    columns = {"t": s["t"], "P": 4.0 * MUTATIONS[kind](s["p"], s["t"]), "Q": 4e3 * s["q"]}
    columns |= {"V": s["V"], "f": s["f_hz"]}
    if kind == "no_trip":
        columns["Q"] = columns["Q"] * (s["t"] < 6.5)
    (place / "channels.toml").write_text(BASES + CHANNELS)
    found = judged(place, columns, "channels.toml")
    assert [k for k, verdict in found.items() if verdict == FAIL] == [kind]


WRONG: dict[str, tuple[Callable[[Columns], Columns], str, str]] = {
    "base": (dict, "S_n = 40e3\nV_n = 380.0\n" + WAVES, r"p = 0\.05 p\.u\..*see S_n"),
    "volts": (dict, BASES.replace("380", "690") + WAVES, r"V = 0\.5.* p\.u\..*V_n"),
    "swapped": (lambda w: w | {"v_a_V": w["v_b_V"], "v_b_V": w["v_a_V"]}, BASES + WAVES, "swapped"),
    "late": (dict, BASES + "event_s = 3.0\n" + WAVES, "event_s = 3 of its map: no event"),
    "shift": (dict, BASES + "event_s = 1.5\n" + WAVES, "shifted"),
    "channel": (lambda w: {n: x for n, x in w.items() if n != "i_oc_A"}, BASES + WAVES, "i_oc_A"),
    "rest": (lambda w: {n: x[:15000] for n, x in w.items()}, BASES + WAVES, "no event"),
    "cut": (lambda w: {n: x[19990:] for n, x in w.items()}, BASES + WAVES, "no event.*at rest"),
    "clock": (lambda w: {n: np.delete(x, 900) for n, x in w.items()}, BASES + WAVES, "not even"),
    "unit": (dict, BASES + WAVES.replace('"A"', '"kW"'), "unit = 'kW'"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_in_one_line(place: Path, waves: Columns, name: str) -> None:
    change, text, words = WRONG[name]
    (place / "wrong.toml").write_text(text)
    with pytest.raises(UserError, match=words) as found:
        judged(place, change(waves), "wrong.toml")
    assert "\n" not in str(found.value)


def test_a_recording_of_which_the_end_is_missing_is_refused(place: Path, waves: Columns) -> None:
    """The package that reads COMTRADE has zeros there, which would be judged as a trip."""
    write_float_comtrade(place / "recording.cfg", waves)
    data = place / "recording.dat"
    kept = data.read_bytes()[:-5000]
    data.write_bytes(kept)
    rows = len(kept) // (8 + 4 * (len(waves) - 1))
    with pytest.raises(UserError, match=f"data end after {rows} of {len(waves['t'])} samples"):
        judged(place, {}, kind="cfg")


@pytest.mark.parametrize("text", ["", "t,v_a_V\n"])
@pytest.mark.filterwarnings("error")
def test_an_empty_recording_is_told_without_a_warning(place: Path, text: str) -> None:
    (place / "recording.csv").write_text(text)
    with pytest.raises(UserError, match="nothing below its first line"):
        judged(place, {}, kind="csv")
