"""Attacks on the loaders: every file yields a value, or one line per mistake."""

import contextlib
import copy
import os
import tomllib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gfm_design.norms.performance import read_weights
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.engine.setup import make_bench
from gfm_hil.scenario import SCENARIO_FOLDERS, load_scenario, scenario_toml, toml_text
from gfm_hil.studies.campaign.loading import load_campaign
from gfm_plant import NoEquilibrium
from gfm_runtime import LawError, discretise, load_law
from gfm_runtime.toml_file import MAX_BYTES

ROOT = Path(__file__).resolve().parents[3]
LAWS = ROOT / "runtime" / "gfm_runtime" / "laws"
CONVERTER = ROOT / "plant_emulator" / "gfm_plant" / "converters" / "paper.toml"
BASE = 'title = "x"\nduration = 0.05\nlink = { type = "inproc" }\n'
CAMPAIGN = """\
title = "x"
scenario = "pref_step"
laws = ["mimo-gfm"]
runs = 2
[figure]
x = "plant.factors.L_g"
[set]
duration = 1.5
[[draw]]
path = "plant.factors.L_g"
type = "uniform"
low = 0.9
high = 1.1
label = "L"
also = ["plant.factors.R_g"]
[[draw]]
path = "plant.delay.samples"
type = "choice"
values = [0, 1]
[[draw]]
path = "plant.factors.C_f"
type = "normal"
mean = 1.0
sigma = 0.1
low = 0.9
high = 1.1
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with things that are not files; no warning on stderr besides the one line."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.toml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # from another test
        yield tmp_path


def commands(file: str) -> dict[str, list[str]]:
    """The commands that read a file of each kind; a scenario reads the laws and converters."""
    Path("of_law.toml").write_text(BASE + f'law = "{file}"\n')
    Path("of_converter.toml").write_text(BASE + f'[plant]\nconverter = "{file}"\n')
    return {
        "scenario": ["run", file],
        "campaign": ["campaign", file],
        "law": ["laws", "show", file],
        "law of a scenario": ["run", "of_law.toml"],
        "converter": ["run", "of_converter.toml"],
        "weights": ["design", "gamma", "--law", "vsg-2", "--weights", file],
    }


KINDS = ("scenario", "campaign", "law", "law of a scenario", "converter", "weights")
CONTENTS: dict[str, tuple[bytes, str]] = {
    "3,000 arrays in each other": (b"x = " + b"[" * 3000 + b"]" * 3000, "nested more than 32"),
    "3,000 tables in each other": (b"[" + b".".join([b"a"] * 3000) + b"]", "nested more than 32"),
    "3,000 tables in line": (b"x = " + b"{a=" * 3000 + b"1" + b"}" * 3000, "nested more than 32"),
    "an integer of 5,000 digits": (b"x = " + b"9" * 5000, "not TOML"),
    "a key twice": (b"x = 1\nx = 2\n", "not TOML"),
    "Latin-1": (b'# fine\nx = "\xe9"\n', "line 2 is not UTF-8"),
    "UTF-16": ("x = 1\n".encode("utf-16"), "line 1 is not UTF-8"),
    "a control character": (b"x = 1\x00\n", "not TOML"),
    "5 MB": (b"# comment\n" * 500_000, "larger than 4 MiB"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.attack(
    "9.1",
    "files nested 3,000 deep, too large, or in no UTF-8, as scenario, law, converter, campaign "
    "and weights",
    "a traceback of RecursionError, ValueError or OverflowError",
)
def test_contents_that_are_no_usable_toml(kind, refused, attack_now):
    assert len(CONTENTS["5 MB"][0]) > MAX_BYTES
    for data, part in CONTENTS.values():
        Path("bad.toml").write_bytes(data)
        line = refused(*commands("bad.toml")[kind])
        assert part in line and len(line) < 300
    attack_now(f"{len(CONTENTS)} files of each kind, one line each, exit code 2")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.attack(
    "9.2",
    "a folder, a named pipe, /dev/zero or a name of 300 characters in place of a file",
    "a traceback, or the command never ended",
)
def test_what_is_no_file(kind, refused, attack_now):
    for name in ("folder.toml", "pipe.toml", "zero.toml", "a" * 300 + ".toml"):
        line = refused(*commands(name)[kind])
        assert "is not a regular file" in line or "File name too long" in line
    attack_now("4 of each kind, one line each, exit code 2")


def numbers(kind: str, path: str, value: str) -> list[str]:
    """The command that reads a valid file in which one number was replaced."""
    text = {"converter": CONVERTER.read_text(), "campaign": CAMPAIGN}.get(kind, BASE)
    content = tomllib.loads(text)
    *parents, last = path.split(".")
    table = content
    for name in parents:
        table = table.setdefault(name, {}) if not name.isdigit() else table[int(name)]
    table[last] = tomllib.loads(f"x = {value}")["x"]
    Path("numbers.toml").write_text(toml_text(content))
    return commands("numbers.toml")[kind]


NUMBERS = [
    ("converter", "V_n", "1e300"),
    ("converter", "V_n", "1e-300"),
    ("converter", "S_n", "5e-324"),
    ("converter", "omega_n", "1e300"),
    ("converter", "C_dc", "nan"),
    ("scenario", "duration", "9" * 30),
    ("scenario", "seed", "9" * 30),
    ("scenario", "seed", "9" * 400),
    ("scenario", "late_policy.hold", "9" * 30),
    ("scenario", "plant.factors.L_g", "1e300"),
    ("scenario", "plant.dc_source.k_p", "inf"),
    ("campaign", "runs", "9" * 30),
    ("campaign", "runs", "-1"),
    ("campaign", "set.duration", "9" * 30),
]


@pytest.mark.parametrize(("kind", "path", "value"), NUMBERS)
@pytest.mark.attack(
    "9.3",
    "V_n = 1e300, integers of 30 and 400 digits, NaN and infinities in files",
    "a traceback of OverflowError or ZeroDivisionError",
)
def test_numbers_that_no_field_can_have(kind, path, value, refused, attack_now):
    line = refused(*numbers(kind, path, value))
    assert path.split(".")[-1] in line
    assert len(line) < 400
    attack_now(f"{len(NUMBERS)} fields, each named in one line, exit code 2")


WRITERS = {
    "run": ["run", "of_nothing.toml"],
    "compare": ["compare", "of_nothing.toml", "--laws", "vsg-2"],
    "campaign": ["campaign", "campaign.toml"],
    "keys": ["keys"],
    "dbc": ["dbc"],
    "export": ["export", "a_run", "--format", "csv"],
}


@pytest.mark.parametrize("command", WRITERS)
@pytest.mark.attack(
    "9.4",
    "--out=--, a name of 300 characters, a name below a file, for every command that writes",
    "a traceback of TypeError or OSError",
)
def test_places_that_cannot_be_written(command, here, run, refused, attack_now):
    Path("of_nothing.toml").write_text(BASE)
    Path("campaign.toml").write_text(CAMPAIGN)
    run().folder.rename("a_run")
    before = sorted(here.iterdir())
    for name in ("--", "a" * 300, "of_nothing.toml/x"):
        refused(*WRITERS[command], f"--out={name}")
    assert sorted(here.iterdir()) == before
    attack_now(f"{len(WRITERS)} commands, one line each, exit code 2, nothing written")


def test_a_folder_named_like_an_option_serves_as_any_other(here):
    Path("two.toml").write_text('title = "x"\nduration = 0.02\n')  # sides as processes
    assert main(["run", "two.toml", "--out=./--", "--quiet", "--no-figures"]) == 0
    assert (here / "--" / "summary.json").is_file()


@pytest.mark.parametrize("tick", ["9" * 30, "9" * 400])
def test_an_event_far_beyond_the_end(tick, refused):
    event = f'[[events]]\ntick = {tick}\ntype = "law"\nlaw = "vsg-2"\n'
    Path("late.toml").write_text(BASE + event)
    assert "events.0" in refused("run", "late.toml")


def test_more_events_than_a_run_takes(refused):
    event = "{ tick = 1, type = 'reference', P_ref = 0.6 },"
    Path("many.toml").write_text(BASE + f"events = [{event * 10_001}]\n")
    assert "events" in refused("run", "many.toml")


@pytest.mark.parametrize(
    "text", [b"\xef\xbb\xbf" + BASE.encode(), BASE.encode().replace(b"\n", b"\r\n")]
)
def test_what_an_editor_for_windows_writes_is_read(text):
    Path("windows.toml").write_bytes(text)
    assert load_scenario("windows.toml").duration == 0.05


def test_thousands_of_mistakes_are_not_thousands_of_lines(capsys):
    Path("many.toml").write_text(BASE + f"events = [{'1,' * 5000}]\n")
    law = (LAWS / "dvoc.toml").read_text() + "\n[psi]\n11 = [" + "1," * 5000 + "]\n"
    Path("law.toml").write_text(law)
    for command in (["run", "many.toml"], ["laws", "show", "law.toml"]):
        assert main(command) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 21 and lines[-1].endswith("and 4980 more mistakes")


@pytest.mark.parametrize("kind", KINDS)
def test_a_key_cannot_write_to_the_terminal(kind, refused):
    texts = {"campaign": CAMPAIGN, "scenario": BASE, "converter": CONVERTER.read_text()}
    text = texts.get(kind, (LAWS / "vsg-2.toml").read_text())
    Path("key.toml").write_text('"a\\nb\\u001b[31m" = 1\n' + text)
    assert "a\\nb\\x1b" in refused(*commands("key.toml")[kind])


# ------------------------------------------------------------------------- anything, anywhere

WEIRD = st.one_of(
    st.sampled_from([0, -1, 2**31, 2**63 - 1, 2**63, 10**29, 10**400, -(10**400)]),
    st.sampled_from([0.0, -0.0, -1.0, 1e300, -1e300, 1e-300, 5e-324, 1e12, 1e-12]),
    st.sampled_from([float("nan"), float("inf"), -float("inf")]),
    st.sampled_from(["", " ", "a" * 300, "a\0b", "a\nb", "é", "/dev/zero", "pipe.toml", "P_ref"]),
    st.sampled_from([True, False, [], {}, [[]], [[1.0]], {"a": 1}, [1] * 100, ["x"], "@date"]),
    st.floats(),
    st.integers(-3, 10**6),
)
_SLOW = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value in nested tables and arrays."""
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    elif isinstance(content, list):
        items = enumerate(content)
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def spoilt(content: dict[str, Any]) -> st.SearchStrategy[str]:
    """The TOML of a file in which one to three values were replaced or removed."""
    changes = st.lists(
        st.tuples(st.sampled_from(list(places(content))), st.one_of(st.just(None), WEIRD)),
        min_size=1, max_size=3,
    )  # fmt: skip

    def apply(chosen: list[tuple[tuple[Any, ...], Any]]) -> str:
        changed = copy.deepcopy(content)
        for path, value in chosen:
            at: Any = changed
            with contextlib.suppress(KeyError, IndexError, TypeError):  # changed before
                for key in path[:-1]:
                    at = at[key]
                last = str(path[-1]) if isinstance(at, dict) else path[-1]
                if value is None:
                    del at[last]
                else:
                    at[last] = copy.deepcopy(value)  # else a list could contain itself
        return toml_text(changed).replace('"@date"', "1979-05-27")

    return changes.map(apply)


def full(name: str) -> dict[str, Any]:
    """A shipped scenario with every key, in process, with at least one event."""
    content = tomllib.loads(scenario_toml(load_scenario(name)))
    content["plant"]["factors"] = {"L_g": 1.0, "R_f": 1.0}
    return content


def holds(load: Callable[[str], Any], text: str) -> None:
    """Check that a file is read, or refused with one line per mistake."""
    file = Path("spoilt.toml")
    file.write_text(text, encoding="utf-8")
    try:
        load(str(file))
    except (UserError, LawError, NoEquilibrium) as problem:
        for line in str(problem).split("\n"):
            assert line and line.isprintable() and len(line) < 3000


def ready(name: str) -> None:
    """Do what ``gfmhil run`` does before it writes anything."""
    make_bench(load_scenario(name, mode="lockstep", link__type="inproc"))


def law_ready(name: str) -> None:
    for stage in load_law(name).laws:
        discretise(stage, 1e-4)


@pytest.mark.parametrize("name", ["pref_step", "switchover", "weakening_grid"])
@given(data=st.data())
@settings(max_examples=60, suppress_health_check=_SLOW)
def test_any_scenario_is_read_or_refused_in_lines(name, data):
    holds(ready, data.draw(spoilt(full(name))))


@pytest.mark.parametrize("name", ["zmq", "can", "shm"])
@given(data=st.data())
@settings(max_examples=30, suppress_health_check=_SLOW)
def test_any_link_is_read_or_refused_in_lines(name, data):
    link = {"type": name, "endpoint": "tcp://127.0.0.1:5555", "peer_timeout_s": 1.0,
            "options": {"fd": True, "every": 1, "curve": "keys", "plain": True, "bitrate": 1000000},
            "impairment": {"pause_at": 3, "kill_at": 3, "seed": 3}}  # fmt: skip
    holds(load_scenario, data.draw(spoilt({"title": "x", "duration": 0.05, "link": link})))


@given(data=st.data())
@settings(max_examples=100, suppress_health_check=_SLOW)
def test_any_converter_is_read_or_refused_in_lines(data):
    Path("conv.toml").write_text(data.draw(spoilt(tomllib.loads(CONVERTER.read_text()))))
    holds(ready, BASE + '[plant]\nconverter = "conv.toml"\n')


@pytest.mark.parametrize("name", ["mimo-gfm", "droop-5", "mimo-gfm-scheduled", "dvoc"])
@given(data=st.data())
@settings(max_examples=60, suppress_health_check=_SLOW)
def test_any_law_is_read_or_refused_in_lines(name, data):
    holds(law_ready, data.draw(spoilt(tomllib.loads((LAWS / f"{name}.toml").read_text()))))


@given(data=st.data())
@settings(max_examples=60, suppress_health_check=_SLOW)
def test_any_campaign_is_read_or_refused_in_lines(data):
    holds(load_campaign, data.draw(spoilt(tomllib.loads(CAMPAIGN))))


@given(data=st.data())
@settings(max_examples=60)
def test_any_weights_are_read_or_refused(data):
    text = data.draw(spoilt({"W_11": {"num": [1.0, 4.0], "den": [1.0, 4e-4]}}))
    Path("weights.toml").write_text(text)
    try:
        read_weights(Path("weights.toml"))
    except ValueError as problem:
        assert str(problem).isprintable()


@given(lines=st.lists(st.integers(0, 60), max_size=4), noise=st.text(max_size=10))
@settings(max_examples=60, suppress_health_check=_SLOW)
def test_any_text_is_read_or_refused_in_lines(lines, noise):
    """Lines of a shipped file replaced by noise."""
    (folder,) = [f for f in SCENARIO_FOLDERS if f.is_dir()]
    text = (folder / "switchover.toml").read_text().splitlines()
    for k in lines:
        text[k % len(text)] = noise.encode("utf-8", "replace").decode()
    holds(load_scenario, "\n".join(text))
