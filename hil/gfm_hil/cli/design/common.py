"""What the design commands share: gains on the command line, channels as JSON and as a table."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from gfm_design.performance import Channel
from gfm_hil.errors import UserError
from gfm_hil.report import cell


def add_law_options(command: argparse.ArgumentParser) -> None:
    """The law, its gains, and JSON."""
    command.add_argument("--law", required=True, help="catalogue name or law file")
    command.add_argument("--gains", help="k=v,…: other values (tune: other starts)")
    command.add_argument("--json", action="store_true", help="as JSON")


def read_gains(text: str | None) -> dict[str, float]:
    """``k_22=5,k_34=1`` as a dict.

    Raises:
        UserError: an entry that is not NAME=NUMBER.
    """
    found = {}
    for entry in text.split(",") if text else []:
        name, _, value = entry.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            raise UserError(f"--gains {entry!r}: must be NAME=NUMBER, e.g. k_22=5.98") from None
    return found


def channels_as_json(channels: Sequence[Channel]) -> dict[str, Any]:
    """gamma and its channels as plain data."""
    rows = [{"i": c.i, "j": c.j, "norm": c.norm, "omega_rad_s": c.omega} for c in channels]
    return {"gamma": max(c.norm for c in channels), "channels": rows}


def print_channels(name: str, channels: Sequence[Channel]) -> None:
    """gamma and its channels as a table."""
    table = Table("channel", "‖W T‖∞", "at \\[rad/s]", box=None, pad_edge=False, title=None)
    for c in channels:
        table.add_row(f"W_{c.i}{c.j} T_{c.i}{c.j}", f"{c.norm:.6g}", cell(c.omega))
    console = Console(highlight=False)
    console.print(f"[bold]{name}[/]: γ = {max(c.norm for c in channels):.6g}")
    console.print(table)
