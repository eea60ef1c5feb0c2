"""gfmhil recover: complete the folder of a run that was cut off."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from gfm_hil.cli.common import print_network, print_summary
from gfm_hil.recording.run import converters_of
from gfm_hil.results.network_run import NetworkRun
from gfm_hil.results.run_folder import recover


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Complete the folder of a run that a kill, a power failure or a full disk cut off: "
        "signals, times, events, summary, figures and report of all that was recorded. "
        "The command leaves a folder that is complete as it is."
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("--json", action="store_true", help="print summary.json and nothing else")


def call(options: argparse.Namespace) -> int:
    """Complete the folder; returns the exit code."""
    folder: Path = options.folder
    run = NetworkRun.recover(folder) if converters_of(folder) else recover(folder)
    if options.json:
        print(json.dumps(run.summary, indent=2))
    elif isinstance(run, NetworkRun):
        print_network(run, folder)
    else:
        print_summary(run.summary, options.folder)
    return 0
