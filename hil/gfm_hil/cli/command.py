"""gfmhil command: set-points, laws and grid events for a run that is going on."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_runtime.errors import meant
from gfm_runtime.signals import REF_NAMES


def add(command: argparse.ArgumentParser) -> None:
    command.description = "Without a command it prints the newest tick as JSON."
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument(
        "references", nargs="*", metavar="NAME=VALUE", help=f"one of {', '.join(REF_NAMES)}, p.u."
    )
    command.add_argument("--ramp", type=float, metavar="S", help="spread them over a time, s")
    command.add_argument("--law", help="change to this law, one that the scenario names")
    command.add_argument(
        "--gain", action="append", default=[], metavar="NAME=VALUE",
        help="another gain of the active law, bumpless; may be repeated",
    )  # fmt: skip
    command.add_argument(
        "--reset", action="store_true", help="bring a run that waits after a trip back to its start"
    )
    command.add_argument("--event", metavar="JSON", help="an event as in a scenario, without t")
    command.add_argument("--stop", action="store_true", help="end the run")


def call(options: argparse.Namespace) -> int:
    events = _events(options)
    operator = Operator(options.folder, through="command")
    try:
        for event in events:
            done = operator.command(event)
            print(f"{done['label']} at tick {done['tick']}")
        if options.stop:
            operator.stop()
        if not events and not options.stop:
            print(json.dumps(operator.snapshot(), indent=2))
    finally:
        operator.close()
    return 0


def _events(options: argparse.Namespace) -> list[dict[str, Any]]:
    """What is asked for, in the order: reset, references, law, gains, event. Raises UserError: not
    NAME=VALUE, or not JSON."""
    events: list[dict[str, Any]] = []
    if options.reset:
        events.append({"type": "reset"})
    values = _values(options.references, f"one of {REF_NAMES}", REF_NAMES)
    if values:
        ramp = {} if options.ramp is None else {"ramp_s": options.ramp}
        events.append({"type": "reference", **values, **ramp})
    elif options.ramp is not None:
        raise UserError(f"--ramp {options.ramp:g}: there is no reference to spread")
    if options.law is not None:
        events.append({"type": "law", "law": options.law})
    if options.gain:
        events.append({"type": "gains", "values": _values(options.gain, "a gain of the law")})
    if options.event is not None:
        try:
            event = json.loads(options.event)
        except (ValueError, RecursionError) as problem:
            raise UserError(f"--event: not JSON: {problem}") from None
        if not isinstance(event, dict):
            raise UserError(f"--event {options.event}: must be an object")
        events.append(event)
    return events


def _values(texts: list[str], what: str, known: Sequence[str] | None = None) -> dict[str, float]:
    """Numbers by name from NAME=VALUE. Raises UserError: it is not that, or the name is not
    known."""
    values: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        if known is not None and name not in known:
            raise UserError(f"{text!r}: must be NAME=VALUE, NAME {what}{meant(name, known)}")
        try:
            values[name] = float(value)
        except ValueError:
            raise UserError(f"{text!r}: must be NAME=VALUE, NAME {what}") from None
    return values
