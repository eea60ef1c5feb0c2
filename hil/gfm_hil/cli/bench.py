"""gfmhil bench: what the links, the clock, the kernel and the loop cost on this machine."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

from gfm_hil.cli.common import new_folder
from gfm_hil.errors import UserError
from gfm_hil.links import link_names

_WIDTH = 100  # columns: a table cut short is no use in a file

Tell = Callable[[str, float], None]


def add(commands: Any) -> None:
    """Add the command to the parser."""
    command = commands.add_parser("bench", help="measure links, clock, kernel and loop here")
    kinds = command.add_subparsers(dest="kind", required=True, metavar="WHAT")
    latency = kinds.add_parser("latency", help="round trip of every link beside the limit in C")
    _add_links(latency)
    latency.add_argument(
        "--mode", default="lockstep,realtime",
        help="lockstep: one after the other; realtime: one every 100 µs (default: %(default)s)",
    )  # fmt: skip
    _add_load(latency)
    latency.add_argument(
        "--payload", type=int, default=84,
        help="bytes there; 84: the bench's frames, 84 there and 68 back (default: %(default)s)",
    )  # fmt: skip
    _add_rounds(latency, seconds=0.2)
    _add_output(latency)
    latency.set_defaults(call=call)


def _add_links(command: argparse.ArgumentParser) -> None:
    names = ",".join(link_names())
    command.add_argument("--links", default=names, help="by commas (default: %(default)s)")


def _add_load(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--load", default="idle,hogs",
        help="idle, or beside a busy process on each processor (default: %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "--policy", choices=["auto", "fifo", "other"], default="auto",
        help="SCHED_FIFO or as given; auto: fifo where the rights are there (%(default)s)",
    )  # fmt: skip


def _add_rounds(command: argparse.ArgumentParser, seconds: float) -> None:
    command.add_argument(
        "--seconds", type=float, default=seconds, help="of a round (default: %(default)s)"
    )
    command.add_argument(
        "--rounds", type=int, default=5, help="of each, interleaved (default: %(default)s)"
    )


def _add_output(command: argparse.ArgumentParser) -> None:
    command.add_argument("--out", help="folder for bench.json and bench.html; runs/bench-… else")
    command.add_argument("--json", action="store_true", help="print bench.json and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    """Carry a measuring command out; returns the exit code."""
    from gfm_hil.benchmark.result import Recorder, write_result
    from gfm_hil.benchmark.tables import tables

    steps = _steps(options)
    folder = new_folder(options.out, f"bench-{options.kind}")
    recorder = Recorder(options.kind)
    with _bar(options.quiet) as tell:
        for step in steps:
            step(recorder.content, tell)
    content = recorder.close()
    write_result(content, folder / "bench.json")
    if options.json:
        print(json.dumps(content, indent=1))
        return 0
    console = Console()
    console.width = max(console.width, _WIDTH)
    for table in tables(content):
        console.print(table)
        console.print()
    for remark in (*content["remarks"], *content["caveats"]):
        console.print(f"• {escape(remark)}", highlight=False)
    console.print(f"{content['seconds']:g} s · {folder / 'bench.json'}", highlight=False)
    return 0


def _steps(options: argparse.Namespace) -> list[Callable[[dict[str, Any], Tell], None]]:
    """What is to be measured, in order, every option checked."""
    return [_latency(options)]


def _latency(options: argparse.Namespace) -> Callable[[dict[str, Any], Tell], None]:
    from gfm_hil.benchmark.contenders import check_links
    from gfm_hil.benchmark.hogs import LOADS
    from gfm_hil.benchmark.latency import MODES, Plan, measure

    plan = Plan(
        links=check_links(split("--links", options.links)),
        modes=split("--mode", options.mode, MODES),
        loads=split("--load", options.load, LOADS),
        policy=policy(options.policy),
        payload=within("--payload", options.payload, 1, 504),
        seconds=within("--seconds", options.seconds, 0.01, 60),
        rounds=within("--rounds", options.rounds, 1, 1000),
    )

    def step(content: dict[str, Any], tell: Tell) -> None:
        rows, remarks = measure(plan, tell)
        content["results"] += rows
        content["remarks"] += remarks

    return step


def split(option: str, text: str, allowed: Sequence[Any] | None = None) -> list[Any]:
    """Names from a comma-separated list, each once.

    Raises:
        UserError: an empty one, or one that is not allowed.
    """
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if not name or (allowed is not None and name not in allowed):
            wanted = f"from {', '.join(allowed)}" if allowed is not None else "none empty"
            raise UserError(f"{option} {text!r}: names separated by commas, {wanted}")
    return names


def within(option: str, value: Any, low: Any, high: Any) -> Any:
    """The value, if it is in the range.

    Raises:
        UserError: it is not.
    """
    if not low <= value <= high:
        raise UserError(f"{option} {value}: must be {low} to {high}")
    return value


def policy(wanted: str) -> Any:
    """``fifo`` or ``other``.

    Raises:
        UserError: fifo is asked for without the rights.
    """
    from gfm_hil.environment import may_sched_fifo

    allowed = may_sched_fifo()
    if wanted == "fifo" and not allowed:
        raise UserError("--policy fifo: no right to SCHED_FIFO here; use other or auto")
    return wanted if wanted != "auto" else ("fifo" if allowed else "other")


@contextmanager
def _bar(quiet: bool) -> Iterator[Tell]:
    console = Console(stderr=True, quiet=quiet)
    with Progress(
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.description}"),
        console=console,
        disable=not console.is_terminal,
        transient=True,
        refresh_per_second=4,
    ) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, share: bar.update(task, description=escape(text), completed=share)
