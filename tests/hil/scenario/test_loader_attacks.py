"""Attacks on the loaders: every file yields a value, or one line per mistake."""

import os
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from gfm_hil.cli import main
from gfm_hil.scenario import load_scenario, toml_text
from gfm_runtime.toml_file import MAX_BYTES

from ...support.files import text_of

ROOT = Path(__file__).resolve().parents[3]
LAWS = ROOT / "runtime" / "gfm_runtime" / "laws"
CONVERTER = ROOT / "plant_emulator" / "gfm_plant" / "converters" / "paper.toml"
BASE = 'title = "x"\nduration = 0.05\nlink = { type = "inproc" }\n'
CAMPAIGN = text_of("campaign_of_two_runs.toml")


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
    "a key without a value": (b"x = ", "not TOML"),
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


@pytest.mark.processes
def test_a_folder_named_like_an_option_serves_as_any_other(here):
    Path("two.toml").write_text('title = "x"\nduration = 0.02\n')
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
