"""The command line: what each command prints, writes and returns."""

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.scenario import shipped_scenarios, toml_text
from gfm_hil.studies.linear_loop import why_it_ended
from gfm_runtime import law_names, law_titles
from gfm_runtime.inner_file import inner_names

from ...support.laws import every_law

SUMMARY = {
    "title", "status", "reason", "expected", "laws", "link", "mode", "T_s", "ticks", "duration_s",
    "misses", "bump_pu", "events",
}  # fmt: skip
EVENT = {
    "t", "tick", "type", "label", "p_peak", "p_final", "settling_s", "overshoot_pct", "f_nadir_hz",
    "f_peak_hz", "rocof_hz_s", "v_min", "v_max", "damping_ratio", "oscillation_hz",
}  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run each test in its own folder, on a terminal of 80 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    return tmp_path


@pytest.fixture
def call(capsys):
    """Run a command in this process: exit code, stdout, stderr."""

    def run(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def scenario(**content: Any) -> str:
    """Write a short scenario file to the folder."""
    content = {"title": "short [run]", "duration": 0.3, "link": {"type": "inproc"}, **content}
    Path("short.toml").write_text(toml_text(content))
    return "short.toml"


STEP = {"events": [{"t": 0.1, "type": "reference", "P_ref": 0.6}]}
TRIP = {
    "events": [{"t": 0.1, "type": "grid-phase-jump", "degrees": 20.0}],
    "plant": {"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}},
}


def test_ctrl_c_while_a_command_still_imports_is_no_traceback(monkeypatch, capsys):
    def stopped(name: str | None) -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(main.__globals__, "parser", stopped)
    assert main(["conform", "--law", "vsg-2"]) == 130
    assert capsys.readouterr() == ("", "")


def assert_fits(text: str) -> None:
    """Check that the text fits 80 columns: no line is longer and no cell is cut."""
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text


def test_laws_lists_the_catalogue(call):
    code, out, _ = call("laws")
    assert code == 0
    assert_fits(out)
    listed = [line.split()[0] for line in out.splitlines() if line and line[0] != " "]
    assert listed == ["law", *law_names(), "inner", *inner_names()]


def test_laws_as_json_is_a_list_of_objects_with_names(call):
    code, out, _ = call("laws", "--json")
    rows = json.loads(out)
    assert code == 0
    assert [row["name"] for row in rows] == list(law_names())
    by_name = {row["name"]: row for row in rows}
    assert by_name["mimo-gfm"]["order"] == 3
    assert by_name["droop-5"]["elements"]["22"] == "P{IF×D}"


def test_a_law_shows_its_matrix_its_source_and_its_transfer_functions(call):
    code, out, _ = call("laws", "show", "vsg-5")
    assert code == 0
    for part in ("Φ(s)", "omega_u  0     IF  IF       0   0", "Table II", "3 states"):
        assert part in out
    for line in ("φ11 = (90 s + 400)/s", "φ22 = 0.01/(0.1672 s + 1)", "φ35 = (0.02 s + 38.1)/s"):
        assert line in out.splitlines()
    shown = call("laws", "show", str(Path(__file__).parents[3] / "docs/examples/my-law.toml"))[1]
    assert "ψ22 = 0.001 s/((0.05 s + 1) (0.17 s + 1))" in shown.splitlines()
    code, out, _ = call("laws", "show", "vsg-5", "--json", "--T_s", "2e-4")
    law = json.loads(out)
    assert (code, law["name"], law["order"]) == (0, "vsg-5", 3)
    assert law["phi"][1] == ["0", "IF", "IF", "0", "0"]
    assert law["source"]
    discrete = law["discrete"][0]
    assert discrete["T_s"] == 2e-4
    shapes = {n: np.shape(discrete[n]) for n in ("A", "B_r", "B_y", "C", "D_r", "D_y", "u_0")}
    assert shapes == {
        "A": (3, 3), "B_r": (3, 5), "B_y": (3, 5), "C": (3, 3), "D_r": (3, 5), "D_y": (3, 5),
        "u_0": (3,),
    }  # fmt: skip


def test_a_start_file_runs_is_stable_and_is_never_overwritten(call, here):
    assert call("new", "law", "mine")[:2] == (0, "mine.toml\n")
    assert call("new", "scenario", "sag.toml")[:2] == (0, "sag.toml\n")
    assert gfmhil.Law.load("mine.toml").name == "mine"
    assert max(gfmhil.Law.load("mine.toml").closed_loop("sag.toml").poles().real) < 0
    assert gfmhil.design.tune("mine.toml", starts=1, evaluations=20).law.name == "mine-tuned"
    before = Path("mine.toml").read_bytes()
    assert call("new", "law", "mine")[::2] == (
        2, "gfmhil: mine.toml: is there already; choose another name, or delete it\n"
    )  # fmt: skip
    assert Path("mine.toml").read_bytes() == before
    assert call("new", "law", "../Mine")[0] == 2 and not list(here.parent.glob("*.toml"))
    for law in ("vsg-2", "mine.toml"):
        assert gfmhil.run("sag.toml", law).status == "completed"


@pytest.mark.full
def test_other_start_files_run(call, here):
    for kind in ("network", "campaign", "conformity"):
        assert call("new", kind, f"a-{kind}")[:2] == (0, f"a-{kind}.toml\n")
    runs = gfmhil.run_network("a-network.toml", duration=0.7)
    assert {name: run.status for name, run in runs.items()} == {"A": "completed", "B": "completed"}
    code, out, _ = call(
        "conform", "--law", "droop-3", "--against", "a-conformity.toml", "--no-figures",
        "--workers", "1", "-o", "verdict",
    )  # fmt: skip
    assert code == 0 and f"{here.name}/a-conformity  pass" in out
    with_few_runs(Path("a-campaign.toml"))
    assert call("campaign", "a-campaign.toml", "--workers", "1", "-o", "runs")[0] == 0


def with_few_runs(campaign):
    campaign.write_text(campaign.read_text().replace("runs = 200", "runs = 2"))


@pytest.mark.parametrize(("file", "name"), [("mine.toml", "mine"), ("ieee9/network.toml", "ieee9")])
def test_a_run_is_named_after_its_scenario_or_its_case(here, call, file, name):
    (here / file).parent.mkdir(exist_ok=True)
    (here / file).write_text(
        'title = "t"\nduration = 0.01\nlaw = "droop-1"\n[link]\ntype = "inproc"\n'
    )
    assert call("run", file, "--no-figures")[0] == 0
    assert [folder.name.split("-")[0] for folder in (here / "runs").iterdir()] == [name]


@pytest.mark.full
def test_a_new_project_passes_its_own_tests(call, here, monkeypatch):
    assert call("new", "project", "mine")[:2] == (0, "mine\n")
    monkeypatch.chdir("mine")
    tested = subprocess.run([sys.executable, "-m", "pytest", "-q"], capture_output=True, text=True)
    assert "2 passed" in tested.stdout, tested.stdout
    with_few_runs(Path("campaign.toml"))
    for line in re.findall(r"^gfmhil (.*)$", Path("README.md").read_text(), re.M):
        assert call(*line.split())[0] == 0, line


def test_a_scheduled_law_shows_each_stage(call):
    assert len(json.loads(call("laws", "show", "mimo-gfm-scheduled", "--json")[1])["discrete"]) > 1
    assert "stage 1" in call("laws", "show", "mimo-gfm-scheduled")[1]


@pytest.mark.parametrize("name", every_law())
def test_every_law_can_be_shown(name, call):
    assert call("laws", "show", name)[0] == 0


def test_scenarios_lists_what_ships(call):
    code, out, _ = call("scenarios")
    assert code == 0
    assert_fits(out)
    rows = json.loads(call("scenarios", "--json")[1])
    assert [row["name"] for row in rows] == shipped_scenarios()
    assert all(name in out for name in shipped_scenarios())


def test_run_prints_summary_json_and_nothing_else(call):
    code, out, _ = call("run", scenario(**STEP), "--json", "--out", "run")
    found = json.loads(out)
    assert code == 0
    assert found == json.loads(Path("run/summary.json").read_text())
    assert found.keys() >= SUMMARY
    assert found["events"][0].keys() >= EVENT
    assert (found["status"], found["laws"], found["ticks"]) == ("completed", ["mimo-gfm"], 3000)
    assert (found["link"], found["mode"], found["misses"]) == ("inproc", "lockstep", 0)


def test_run_leaves_a_report_that_needs_nothing_else(call, drawn):
    call("run", scenario(**STEP, description="<b>bold</b>"), "--out", "run")
    report = Path("run/report.html").read_text()
    assert Path("run/signals.png").stat().st_size > 30_000
    assert report.count('class="plot"') == 6 + 3  # signals, and the three of the waveforms
    assert "&lt;b&gt;bold&lt;/b&gt;" in report
    elsewhere = r"""(src|href)\s*=\s*["'](?!data:|#)|@import|\bfetch\(|url\((?!#)"""
    assert not re.search(elsewhere, report)
    assert "P_ref = 0.6" in report


def test_run_ends_with_a_table_that_fits_the_terminal(call):
    events = [{"t": 0.02 * k, "type": "reference", "P_ref": 0.5 + 0.01 * k} for k in range(1, 11)]
    code, out, _ = call("run", scenario(events=events), "--out", "run", "--no-figures")
    assert code == 0
    assert_fits(out)
    for part in ("completed", "3000 ticks, 0 misses", "p peak [p.u.]", "V max [p.u.]"):
        assert part in out
    shown = [k for k in range(1, 11) if f"P_ref = {0.5 + 0.01 * k:g} @" in " ".join(out.split())]
    assert shown == [1, 2, 3, 8, 9, 10]
    assert "4 events between 0.06 s and 0.16 s are not shown; summary.json has all of them" in out
    assert out.rstrip().endswith("run folder: run")


def test_without_figures_there_are_none(call, drawn):
    call("run", scenario(), "--out", "run", "--no-figures")
    assert not list(Path("run").glob("*.png")) + list(Path("run").glob("*.html"))


def test_options_override_the_file_and_the_run_folder_says_so(call):
    import tomllib

    code, out, _ = call(
        "run", scenario(link={"type": "zmq"}, mode="realtime"), "--link", "inproc", "--law",
        "vsg-2", "--duration", "0.05", "--seed", "9", "--out", "run", "--json", "--no-figures",
    )  # fmt: skip
    assert code == 0  # --link inproc alone implies lockstep
    found = json.loads(out)
    assert (found["laws"], found["ticks"], found["mode"]) == (["vsg-2"], 500, "lockstep")
    resolved = tomllib.loads(Path("run/scenario.toml").read_text())
    assert (resolved["seed"], resolved["law"], resolved["duration"]) == (9, "vsg-2", 0.05)


def test_a_run_can_be_run_again_from_its_folder(call):
    call("run", scenario(**STEP), "--out", "one", "--no-figures")
    assert call("run", "one/scenario.toml", "--out", "two", "--no-figures")[0] == 0
    with np.load("one/signals.npz") as one, np.load("two/signals.npz") as two:
        for name in one:
            assert one[name].tobytes() == two[name].tobytes()


def test_a_run_without_out_gets_a_folder_of_its_own(call):
    for _ in range(2):
        assert call("run", scenario(duration=0.01), "--no-figures")[0] == 0
    assert len(list(Path("runs").glob("short-*/summary.json"))) == 2


def test_an_earlier_run_is_not_written_over(call, refused):
    call("run", scenario(), "--out", "run", "--no-figures")
    before = Path("run/summary.json").read_text()
    said = refused("run", "short.toml", "--out", "run")
    assert said == "gfmhil: run: is not empty; choose another --out\n"
    assert Path("run/summary.json").read_text() == before


@pytest.mark.parametrize(
    ("content", "expect", "code"),
    [(STEP, "completed", 0), (STEP, "tripped", 3), (TRIP, "completed", 3), (TRIP, "tripped", 0)],
)
def test_the_exit_code_tells_whether_the_run_ended_as_expected(content, expect, code, call):
    found, out, _ = call("run", scenario(**content, expect=expect), "--out", "run", "--no-figures")
    assert found == code
    tripped = "tripped, as expected — over-current" if code == 0 else "tripped — over-current"
    assert out.startswith(tripped if content is TRIP else "completed")


def test_compare_draws_the_laws_side_by_side(call):
    code, out, _ = call(
        "compare", scenario(**STEP, plant={"factors": {"L_g": 10.0}}), "--laws", "vsg-2,droop-5",
        "--out", "both",
    )  # fmt: skip
    assert code == 0
    assert_fits(out)
    assert "vsg-2" in out and "droop-5" in out and "p peak [p.u.]" in out
    assert Path("both/comparison.png").stat().st_size > 30_000
    found = json.loads(Path("both/comparison.json").read_text())
    assert list(found) == ["vsg-2", "droop-5"]
    for law, summary in found.items():
        assert summary["laws"] == [law]
        assert summary == json.loads(Path(f"both/{law}/summary.json").read_text())


def test_compare_takes_the_laws_of_the_scenario_runs_them_in_process_and_prints_json(call):
    content = {"link": {"type": "zmq"}, "mode": "realtime", "duration": 0.02}
    content["compare"] = ["vsg-2", "vsg-5"]
    code, out, _ = call("compare", scenario(**content), "--json", "--out", "x")
    assert code == 0
    found = {law: (one["link"], one["mode"]) for law, one in json.loads(out).items()}
    assert found == dict.fromkeys(content["compare"], ("inproc", "lockstep"))


@pytest.mark.full
def test_compare_lays_a_recording_beside_the_runs(call):
    content = {**STEP, "compare": ["vsg-2"]}
    made = gfmhil.run(scenario(**content), "vsg-2")
    names = {"p": "p", "q": "q", "V": "V"}
    rows = np.stack([made.signals[n] for n in ("t", *names)], 1)
    np.savetxt("site.csv", rows, delimiter=",", header="t,p,q,V", comments="")
    lines = ["S_n = 4e3", "V_n = 380.0", "[channels]", *(f'{n} = "{n}"' for n in names)]
    Path("map.toml").write_text("\n".join(lines))
    command = ("compare", scenario(**content), "--recording", "site.csv", "--out", "x")
    code, out, _ = call(*command, "--map", "map.toml")
    assert code == 0 and out.split()[:2] == ["site.csv", "vsg-2"]
    assert list(json.loads(Path("x/comparison.json").read_text())) == ["site.csv", "vsg-2"]
    assert call(*command)[0] == 2


@pytest.mark.full
def test_names_of_laws_are_whole_in_a_terminal_and_in_a_pipe(call, monkeypatch):
    laws = [f"{law}-tuned" for law in ("mimo-gfm", "droop-5", "vsg-12", "vsg-10", "matching-1")]
    command = ("compare", scenario(duration=0.02), "--laws", ",".join(laws))
    code, out, _ = call(*command, "--out", "narrow")
    assert code == 0
    assert_fits(out)
    assert all(law in out for law in laws)
    monkeypatch.delenv("COLUMNS")
    out = call(*command, "--out", "wide")[1]
    assert out.splitlines()[0].split() == laws  # one table
    rows = [row for row in call("laws")[1].splitlines() if row]
    listed = ["law", *law_names(), "inner", *inner_names()]
    assert [row.split()[0] for row in rows] == listed  # no row is wrapped


def test_compare_returns_the_worst_of_its_runs_and_shows_every_event(call):
    content = {
        "events": [*TRIP["events"], {"t": 0.2, "type": "reference", "P_ref": 0.6}],
        "plant": {"protection": {"over_current": {"threshold": 1.5, "delay_s": 0.0}}},
    }
    code, out, _ = call("compare", scenario(**content), "--laws", "mimo-gfm,vsg-2", "--out", "x")
    assert code == 3
    assert "tripped" in out


@pytest.mark.parametrize("option", ["--duration", "--seed", "--endpoint"])
def test_an_option_is_blamed_for_its_value_and_not_the_scenario(option, refused):
    line = refused("run", scenario(link={"type": "zmq"}), option, "-1")
    assert f"{option} -1" in line.split(": ")[1]


@pytest.mark.parametrize(
    ("arguments", "blamed"),
    [
        (["run"], "--duration 0.05"),
        (["compare", "--laws", "vsg-2"], "--duration 0.05"),
        (["run", "--link", "inproc"], "--link inproc, --duration 0.05"),
    ],
)
def test_options_that_do_not_fit_the_scenario_are_named_with_it(arguments, blamed, refused):
    """Only those that the user gave: not the lockstep that --link inproc implies."""
    command, *options = arguments
    line = refused(command, scenario(**STEP), *options, "--duration", "0.05")
    assert line.startswith(f"gfmhil: short.toml with {blamed}: events.0: ")


def test_an_unknown_command_of_a_group_is_refused_with_the_one_that_was_meant(capsys):
    with pytest.raises(SystemExit):
        main(["design", "pole"])
    assert "did you mean 'poles'?" in capsys.readouterr().err


def test_an_unknown_option_of_a_command_inside_a_group_is_refused_in_one_line(capsys):
    assert main(["bench", "loop", "--to", "x"]) == 2
    assert capsys.readouterr().err.startswith("gfmhil: --to x: gfmhil bench loop does not know it")


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("bench latency", "--for 3parsecs", "--for: '3parsecs': must be as 12h, 90m or 30s"),
        ("design poles", "-o p.gif", "-o/--out: p.gif: must end in one of .png, .svg, .pdf"),
        ("design sweep", "-o no/p.png", "-o/--out: no/p.png: there is no folder no"),
    ],
)
def test_a_value_that_an_option_does_not_take_is_refused_in_one_line(command, option, said, capsys):
    with pytest.raises(SystemExit) as end:
        main([*command.split(), *option.split()])
    assert end.value.code == 2
    line = f"gfmhil {command}: argument {said} (gfmhil {command} --help)\n"
    assert capsys.readouterr().err == line


def test_a_reader_that_has_seen_enough_is_no_error():
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as closed:
        done = subprocess.run(
            [sys.executable, "-m", "gfm_hil", "laws", "--json"],
            stdout=closed, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("arguments", [["laws"], ["--version"], ["--help"], ["run", "--help"]])
def test_a_disk_that_is_full_is_told_in_one_line(arguments, refused, monkeypatch):
    """Where each line is written at once, and where the program's end writes all."""
    full = Path("/dev/full")
    with full.open("wb", buffering=0) as raw, monkeypatch.context() as patch:
        patch.setattr("sys.stdout", io.TextIOWrapper(raw, write_through=True))
        assert refused(*arguments) == "gfmhil: No space left on device\n"
        raw.close()  # what is left in it cannot be written
    with full.open("w") as disk:
        done = subprocess.run(
            [sys.executable, "-m", "gfm_hil", *arguments], stdout=disk, stderr=subprocess.PIPE,
            text=True, env={**os.environ, "PYTHONUNBUFFERED": ""},
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (2, "gfmhil: No space left on device\n")


def test_a_mistake_of_ours_leaves_its_traceback():
    broken = "import sys, gfm_hil.cli; m = sys.modules['gfm_hil.cli.main']"
    broken += "; m.parser = lambda _: 1 / 0; m.program()"
    done = subprocess.run([sys.executable, "-c", broken], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.endswith("ZeroDivisionError: division by zero\n")


def own_law(folder: Path, name: str, **gains: float) -> Path:
    """A law file of VSG-2 in a folder of its own, with another name and other gains."""
    path = folder / "laws of mine" / "file.toml"
    path.parent.mkdir()
    return gfmhil.Law.load("vsg-2").with_gains(name, **gains).save(path)


def test_results_call_a_law_by_its_name_and_never_by_its_path(tmp_path, capsys):
    own = str(own_law(tmp_path, "mine", D_p=0.011))
    content = {
        "title": "own", "duration": 0.03, "law": own, "link": {"type": "inproc"},
        "ready_laws": ["vsg-2"], "plant": {"delay": {"samples": 1}},
        "events": [{"t": 0.01, "type": "law", "law": "vsg-2"},
                   {"t": 0.02, "type": "law", "law": own}],
    }  # fmt: skip
    file = tmp_path / "s.toml"
    file.write_text(toml_text(content))
    run = tmp_path / "run"
    assert main(["run", str(file), "--out", str(run), "--quiet"]) == 0
    printed = capsys.readouterr().out.replace(str(run), "")
    assert "mine → vsg-2 → mine" in printed and str(tmp_path) not in printed
    for name in ("summary.json", "events.jsonl", "report.html", "network.svg"):
        assert str(tmp_path) not in (run / name).read_text(), name
    summary = json.loads((run / "summary.json").read_text())
    assert summary["laws"] == ["mine", "vsg-2", "mine"]
    assert [e["label"] for e in summary["events"]] == ["law vsg-2", "law mine"]
    assert gfmhil.load_run(run).laws == ["mine", "vsg-2"]
    compared = tmp_path / "compared"
    options = ["--laws", f"{own},vsg-2", "--out", str(compared), "--quiet"]
    assert main(["compare", str(file), *options]) == 0
    assert {*json.loads((compared / "comparison.json").read_text())} == {"mine", "vsg-2"}
    assert str(tmp_path) not in capsys.readouterr().out.replace(str(compared), "")
    assert [*gfmhil.compare(file, [own, "vsg-2"])] == ["mine", "vsg-2"]


def test_laws_of_one_name_are_told_apart(tmp_path):
    own = str(own_law(tmp_path, "vsg-2"))
    again = tmp_path / "file.toml"
    again.write_text(Path(own).read_text())
    titles = law_titles([own, "vsg-2", str(again), "gone/mine.toml"])
    assert [*titles.values()] == ["vsg-2 (file.toml)", "vsg-2", "vsg-2 (file.toml, 2)", "mine"]


def test_an_unstable_law_is_told_with_its_mode(tmp_path, capsys):
    """By run, compare and laws show; of a stable one they say nothing."""
    own = str(own_law(tmp_path, "mine", k_34=50.0))
    (tmp_path / "other").mkdir()
    again = str(own_law(tmp_path / "other", "again", k_34=50.0))
    mode = r"[\d.]+ Hz, \+[\d.e+]+ 1/s"
    words = rf"the linear loop of mine has \d unstable modes: {mode}(?:; {mode})+ "
    run, command = tmp_path / "run", r"\(gfmhil design poles --law '.*file.toml' --scenario "
    start = ["run", "pref_step", "--link", "inproc", "--quiet", "--no-figures", "--out"]
    assert main([*start, str(run), "--law", own]) == 3
    assert re.search(words + command + re.escape(f"{run}/scenario.toml)"), capsys.readouterr().out)
    options = ["--laws", f"{own},vsg-2", "--out", str(tmp_path / "compared"), "--quiet"]
    assert main(["compare", "pref_step", *options]) == 3
    assert len(re.findall(words, capsys.readouterr().out)) == 1
    compared = tmp_path / "compared" / "mine"
    summary = json.loads((compared / "summary.json").read_text())
    assert re.match(words + command, summary["unstable_mode"])
    assert re.search(f"T{words[1:]}", (compared / "report.html").read_text())
    assert "unstable_mode" not in json.loads(
        (tmp_path / "compared" / "vsg-2" / "summary.json").read_text()
    )
    begins = {"title": "t", "duration": 3.0, "law": own, "link": {"type": "inproc"},
              "events": [{"type": "law", "tick": 5, "law": again}]}  # fmt: skip
    ended = gfmhil.run(begins, folder=tmp_path / "again", figures=False)
    assert ended.summary["laws"] == ["mine", "again"] and ended.status != "completed"
    assert why_it_ended(ended).startswith("the linear loop of again has")
    assert main(["laws", "show", own]) == 0
    shown = capsys.readouterr().out
    assert re.search(words + command + r"pref_step\)", shown)
    for law in ("vsg-2", "droop-1"):  # droop-1 is for a weaker grid than that of pref_step
        assert main(["laws", "show", law]) == 0
        assert "unstable mode" not in capsys.readouterr().out
    assert main([*start, str(tmp_path / "good"), "--law", "vsg-2"]) == 0
    assert "unstable mode" not in capsys.readouterr().out


def test_no_command_is_the_help(call):
    code, out, _ = call()
    assert code == 0 and "run a scenario and leave a run folder" in out


@pytest.mark.parametrize(
    ("event", "line"),
    [
        ({"typ": "law", "law": "vsg-2"}, "events.0.typ = 'law': unknown key; did you mean 'type'?"),
        ({"type": "lwa", "law": "vsg-2"}, "events.0.type = 'lwa': did you mean 'law'? must be one"),
        ({"type": "law", "law": 3}, "events.0.law: must be a valid string, not 3"),
    ],
)
def test_a_wrong_word_in_a_scenario_is_one_line_and_the_hint_comes_first(event, line, refused):
    assert line in refused("run", scenario(events=[{"t": 0.1, **event}]))
