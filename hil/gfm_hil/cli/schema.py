"""gfmhil schema: what a scenario, law, inner stage, campaign or test file may hold, as JSON
Schema."""

import argparse
import json
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from gfm_hil.core.files import write_or_print
from gfm_hil.scenario import Scenario
from gfm_hil.studies.campaign.spec import CampaignFile
from gfm_hil.studies.conformity.criteria.base import UnderTest
from gfm_hil.studies.conformity.sets import Test
from gfm_runtime.inner import Inner
from gfm_runtime.lawfile import LawFile

MODELS: dict[str, TypeAdapter[Any]] = {
    "scenario": TypeAdapter(Scenario),
    "law": TypeAdapter(LawFile),
    "inner": TypeAdapter(Inner),
    "campaign": TypeAdapter(CampaignFile),
    "conformity": TypeAdapter(Test),
    "converter": TypeAdapter(UnderTest),
}


_NAMES = {
    "inner": "inner stage",
    "conformity": "conformity test",
    "converter": "converter under test",
}


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Prints the JSON Schema (draft 2020-12) of a kind of file. It describes every "
        "key; what keys must be like together, only gfmhil itself checks."
    )
    command.add_argument("kind", choices=list(MODELS), help="kind of file")
    command.add_argument("-o", "--out", type=Path, metavar="FILE", help="write it to a file")


def call(options: argparse.Namespace) -> int:
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **MODELS[options.kind].json_schema(),
        "title": f"gfmhil {_NAMES.get(options.kind, options.kind)} file",
    }
    write_or_print(options.out, json.dumps(schema, indent=2, ensure_ascii=False) + "\n")
    return 0
