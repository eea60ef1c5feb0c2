"""One run of a campaign by itself, with everything that a run folder holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from gfm_hil.campaign.spec import Campaign
from gfm_hil.campaign.worker import Record, record
from gfm_hil.errors import UserError
from gfm_hil.runner import run_scenario


def run_alone(campaign: Campaign, run: int, law: str, folder: Path) -> Record:
    """Write the run folder of one run, and its record beside as ``record.json``.

    A run without a steady state has nothing but the record.

    Raises:
        UserError: the folder is in use.
    """
    scenario, drawn = campaign.scenario(run, law)
    scenario = scenario.model_copy(update={"title": f"{campaign.file.title}: run {run}"})
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty; choose another --out")
    try:
        whole = run_scenario(scenario, folder)
        summary, p = whole.summary, whole.signals["true_p"]
    except UserError as problem:
        summary = {"status": "no-steady-state", "reason": str(problem), "events": []}
        p = np.empty(0)
    kept = record(run, law, scenario, drawn, summary, p)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "record.json").write_text(json.dumps(kept, indent=2) + "\n", "utf-8")
    return kept
