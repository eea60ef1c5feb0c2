"""What a command cannot do is one line and exit code 2, and nothing is printed, written or started.

A row is a command and a part of that line, or all of it if it begins with ``gfmhil: ``.
"""

import shlex
from pathlib import Path

import pytest

from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario, toml_text

from ...support.files import text_of

SHORT = {"title": "short [run]", "duration": 0.3, "link": {"type": "inproc"}}
TWO = {
    "title": "two", "duration": 0.5, "law": "droop-3", "link": {"type": "zmq"},
    "network": {
        "converters": {"A": {"node": "bus", "law": "vsg-2"}, "B": {"node": "bus"}},
        "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.1}},
    },
}  # fmt: skip
WRONG = text_of("wrong_use.txt")
#: these compile the start of several converters
WRONG_OF_NETWORKS = text_of("wrong_use_of_networks.txt")


def rows(text: str) -> list[str]:
    return [line for line in text.splitlines() if line and not line.startswith("#")]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with what the commands name."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "short.toml").write_text(toml_text(SHORT))
    (folder / "two.toml").write_text(toml_text(TWO))
    law = 'name="a"\ntitle=""\nsource=""\nphi.22={type="P", k=0, typ=1}'
    (folder / "bad.toml").write_text(law)
    (folder / "wrong.toml").write_text(toml_text({**SHORT, "duration": "3"}))
    plant = {"factors": {"L_f": -1.0}}
    (folder / "wrong-plant.toml").write_text(toml_text({**SHORT, "plant": plant}))
    (folder / "own.so").touch()
    for name in ("over/summary.json", "broken/scenario.toml"):
        (folder / name).parent.mkdir()
        (folder / name).write_text("= 1")
    run_scenario(check_scenario({**SHORT, "duration": 0.01}, "short"), folder / "run")
    return folder


@pytest.mark.parametrize(
    "row", rows(WRONG) + [pytest.param(r, marks=pytest.mark.full) for r in rows(WRONG_OF_NETWORKS)]
)
def test_a_command_that_cannot_be_is_one_line(row, place, refused, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setattr("os.nice", lambda by: by)  # it would last for all of pytest
    before = sorted(place.rglob("*"))
    command, _, said = row.partition(" | ")
    line = refused(*shlex.split(command))
    assert line == f"{said}\n" if said.startswith("gfmhil: ") else said in line
    assert sorted(place.rglob("*")) == before
