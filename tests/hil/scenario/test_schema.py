"""JSON schemas: what ships is valid by them, what is misspelt is not, every key is described."""

import json
import tomllib
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.cli import main
from gfm_hil.scenario import SCENARIO_FOLDERS

EXAMPLES = Path(__file__).resolve().parents[3] / "docs" / "examples"
SCENARIOS = SCENARIO_FOLDERS[1]
LAWS = Path(str(files("gfm_runtime"))) / "laws"
SHIPPED = {
    "scenario": [*SCENARIOS.glob("*.toml"), EXAMPLES / "my-scenario.toml"],
    "law": [*LAWS.rglob("*.toml"), EXAMPLES / "my-law.toml", EXAMPLES / "droop-5-integral.toml"],
    "inner": [*LAWS.parent.glob("inner_stages/*.toml")],
    "campaign": [*SCENARIOS.glob("campaigns/*.toml")],
    "conformity": [*SCENARIOS.glob("conformity/*/*.toml")],
    "converter": [*SCENARIOS.glob("conformity/*.toml")],
}


@pytest.fixture(params=SHIPPED)
def kind(request) -> str:
    """Each kind of file."""
    return str(request.param)


@pytest.fixture
def schema(kind, capsys) -> dict[str, Any]:
    """What the command prints."""
    assert main(["schema", kind]) == 0
    return dict(json.loads(capsys.readouterr().out))


@pytest.fixture
def validator(schema) -> Any:
    """Checks files by that schema."""
    # here: its import takes a third of the time in which pytest collects all tests
    from jsonschema import Draft202012Validator

    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def test_every_shipped_file_is_valid(kind, validator):
    assert SHIPPED[kind]
    for file in SHIPPED[kind]:
        mistakes = [e.message for e in validator.iter_errors(tomllib.loads(file.read_text()))]
        assert not mistakes, file


def test_a_misspelt_key_and_a_wrong_type_are_not(kind, validator):
    good = tomllib.loads(sorted(SHIPPED[kind])[0].read_text())
    for wrong in ({"titel": "a"}, {"title": 3}):
        assert not validator.is_valid({**good, **wrong})


def properties(schema: Any) -> Iterator[tuple[str, Any]]:
    """Every property of a schema and of the definitions in it."""
    for part in (schema, *schema.get("$defs", {}).values()):
        for name, found in part.get("properties", {}).items():
            yield f"{part['title']}.{name}", found


def test_every_key_is_described(schema):
    assert [name for name, found in properties(schema) if not found.get("description")] == []


def test_it_is_written_to_a_file(kind, schema, tmp_path):
    file = tmp_path / "a.json"
    assert main(["schema", kind, "-o", str(file)]) == 0
    assert json.loads(file.read_text("utf-8")) == schema
