"""gfmhil bench: what the links, the clock, the kernel and the loop cost on this machine."""

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, TaskProgressColumn

from gfm_hil.bench.contenders import PEERS
from gfm_hil.bench.export import FORMATS
from gfm_hil.cli.common import add_map, link_option, new_folder, progress
from gfm_hil.controllers import FORMS
from gfm_hil.core.terminal import terminal
from gfm_hil.links import link_names
from gfm_hil.run.run_folder import check_free

_WIDTH = 100  # columns: a table cut short is no use in a file

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def _duration(text: str) -> float:
    """A time such as 12h, 90m or 30s, in s."""
    try:
        return float(text[:-1]) * _UNITS[text[-1:]]
    except (KeyError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r}: must be as 12h, 90m or 30s") from None


#: options of several kinds of benchmark, as argparse takes them
_OPTIONS: dict[str, dict[str, Any]] = {
    "--links": {"help": f"by commas (default: {','.join(link_names())}, with --to none)"},
    "--peers": {
        "help": f"what one would pick instead, by commas: {', '.join(PEERS)}; installed: those that"
        " are, or none (default: installed, with --to none)"
    },
    "--mode": {
        "default": "lockstep,realtime",
        "help": "lockstep: as fast as it goes; realtime: every 100 µs (default: %(default)s)",
    },
    "--load": {
        "default": "idle,busy",
        "help": "idle, or busy: with a CPU load on each processor (default: %(default)s)",
    },
    "--policy": {
        "choices": ["auto", "fifo", "other"],
        "default": "auto",
        "help": "SCHED_FIFO, or as any process; auto: fifo if it is permitted (%(default)s)",
    },
    "--payload": {
        "type": int,
        "default": 64,
        "help": "bytes there; 64: the bench's frames, 64 there and 48 back (default: %(default)s)",
    },
    "--to": {
        "metavar": "ENDPOINT",
        "help": "who answers elsewhere: the endpoint of gfmhil bench answer or of a controller of"
        f" docs/own-controller.md; or a controller here, {FORMS}",
    },
    "--as": {"metavar": "NAME", "dest": "as_name", "help": "its name in the tables"},
    "--option": {
        "action": "append",
        "default": [],
        "metavar": "KEY=VALUE",
        "type": link_option,
        "help": "a key of link.options, e.g. curve=keys; may be repeated",
    },
    "--ptp": {
        "type": float,
        "metavar": "US",
        "help": "CLOCK_TAI follows PTP within so many µs; both sides say so, for one-way delays",
    },
    "--payloads": {
        "default": "16,64,504",
        "help": "bytes of a message, by commas; links of ours carry 504 (default: %(default)s)",
    },
    "--rates": {"default": "1,5,10,20", "help": "kHz, by commas (default: %(default)s)"},
    "--wait": {
        "default": "both",
        "help": "how the sender waits, by commas: spin, sleep, or both in turn (%(default)s)",
    },
    "--missed": {
        "type": float,
        "default": 1.0,
        "help": "percent of the messages that may miss at the highest rate (default: %(default)s)",
    },
    "--for": {
        "dest": "for_s",
        "metavar": "TIME",
        "type": _duration,
        "help": "a night instead of rounds: so long, as 12h, 90m or 30s, in blocks that stay on"
        " disk; gfmhil bench page makes its page at any time",
    },
    "--block": {"type": float, "metavar": "S", "help": "of a night's block (default: 10)"},
    "--resume": {"action": "store_true", "help": "go on with the night in the folder of --out"},
    "--laws": {"help": "names, by commas (default: all that are stable there)"},
    "--cflags": {"default": "-O3", "help": "for the C compiler (default: %(default)s)"},
    "--seconds": {"type": float, "help": "of a round (default: %(default)s)"},
    "--rounds": {"type": int, "default": 5, "help": "of each, interleaved (default: %(default)s)"},
    "--out": {"help": "folder for bench.json and bench.html; runs/bench-… else"},
    "--json": {"action": "store_true", "help": "print bench.json and nothing else"},
    "--quiet": {"action": "store_true", "help": "no progress on stderr"},
}
#: kinds of benchmark: what they measure, and their options besides those of the output
_KINDS = {
    "latency": (
        "round trip of every link, of what one would pick instead, and of the limit in C",
        "--links --peers --to --as --option --ptp --mode --load --policy --payload --seconds"
        " --rounds --for --block --resume",
    ),
    "jitter": (
        "how late a loop that only paces begins its ticks",
        "--load --policy --seconds --rounds",
    ),
    "kernel": ("time of one step of every law, and of the same in C", "--laws --cflags --rounds"),
    "loop": (
        "closed loop: ticks a second in lockstep, misses in real time",
        "--links --mode --load --laws --seconds --rounds",
    ),
    "sweep": (
        "round trips by payload, rate, load, policy and wait; the highest rate, and the cost",
        "--links --peers --payloads --rates --load --policy --wait --missed --seconds --rounds",
    ),
    "all": ("all of it, in three minutes at most", "--links --peers"),
}
_SECONDS = {"latency": 0.2, "jitter": 0.3, "loop": 3.0, "sweep": 0.1}


def add(command: argparse.ArgumentParser) -> None:
    kinds = command.add_subparsers(dest="kind", required=True, metavar="WHAT")
    for name, (text, options) in _KINDS.items():
        kind = kinds.add_parser(name, help=text)
        for option in (*options.split(), "--out", "--json", "--quiet"):
            kind.add_argument(option, **_OPTIONS[option])
        if name == "latency":
            add_map(kind, "--to")
        kind.set_defaults(seconds=_SECONDS.get(name))
    _add_compare(kinds)
    _add_answer(kinds)
    _add_page(kinds)


def _add_page(kinds: Any) -> None:
    page = kinds.add_parser("page", help="make the page of a result, or of a night so far")
    export = kinds.add_parser("export", help="write a result for other tools")
    text = "; ".join(f"{name}: {what}" for name, (what, _) in FORMATS.items())
    export.add_argument("format", choices=FORMATS, help=text)
    for command, call in ((page, page_call), (export, export_call)):
        command.add_argument("result", type=Path, help="folder of a result or of a night")
        command.set_defaults(call=call)
    export.add_argument("-o", "--out", type=Path, required=True, help="the file to write")


def page_call(options: argparse.Namespace) -> int:
    """Make the page; returns the exit code."""
    from gfm_hil.bench.page import write_page
    from gfm_hil.bench.result import write_result

    content = _result(options.result)
    write_result(content, options.result / "bench.json")
    write_page(content, options.result / "bench.html")
    print(options.result / "bench.html")
    return 0


def export_call(options: argparse.Namespace) -> int:
    """Write the file; returns the exit code."""
    from gfm_hil.bench.export import export

    export(_result(options.result), options.format, options.out)
    print(options.out)
    return 0


def _result(folder: Path) -> dict[str, Any]:
    from gfm_hil.bench.night import holds_night, night_of
    from gfm_hil.bench.result import read_result

    return night_of(folder) if holds_night(folder) else read_result(folder)


def _add_answer(kinds: Any) -> None:
    text = "answer a bench on another machine, which names this endpoint by latency --to"
    command = kinds.add_parser("answer", help=text)
    command.add_argument(
        "endpoint", help="zmq, shm, serial or CAN, as of a run; or udp://host:port"
    )
    for option in ("--option", "--ptp", "--policy", "--quiet"):
        command.add_argument(option, **_OPTIONS[option])
    command.set_defaults(call=answer_call)


def answer_call(options: argparse.Namespace) -> int:
    """Answer until a signal comes; returns the exit code."""
    from gfm_hil.bench.options import policies
    from gfm_hil.bench.peer import answer

    def say(text: str) -> None:
        if not options.quiet:
            print(text, file=sys.stderr, flush=True)

    fifo = policies(options.policy)[0] == "fifo"
    answer(options.endpoint, dict(options.option), options.ptp or 0.0, fifo, say)
    return 0


def _add_compare(kinds: Any) -> None:
    command = kinds.add_parser(
        "compare",
        help="tell a real change from noise, between two results or two installations",
        description="Two results as they are, or with --interleave two installations, measured in "
        "turn on this machine now, which alone is safe against a machine that changes meanwhile.",
    )
    command.add_argument("a", metavar="A", help="bench.json or its folder; a gfmhil command")
    command.add_argument("b", metavar="B", help="the other one")
    command.add_argument(
        "--interleave", type=int, metavar="N", help="run the commands A and B so often, in turn"
    )
    command.add_argument(
        "--what", default="latency --mode lockstep --load idle",
        help="what they measure, with its options (default: %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "-o", "--out", help="folder for what was measured; runs/bench-compare-… else"
    )
    command.add_argument("--json", action="store_true", help="print JSON")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.set_defaults(call=compare_call)


def call(options: argparse.Namespace) -> int:
    from gfm_hil.bench.options import measurements
    from gfm_hil.bench.page import all_tables, write_page
    from gfm_hil.bench.result import new_result, write_result
    from gfm_hil.bench.tables import latency_verdicts

    options.folder = folder = new_folder(options.out, f"bench-{options.kind}")
    parts = measurements(options)
    if not getattr(options, "resume", False):
        check_free(folder, 0)
    with new_result(options.kind) as content, _bar(options.quiet) as show:
        for measure in parts:
            measure(content, show)
    write_result(content, folder / "bench.json")
    write_page(content, folder / "bench.html")
    if options.json:
        print(json.dumps(content, indent=1))
        return 0
    said = *latency_verdicts(content), *content["remarks"], *content["caveats"]
    _print([table for _, table in all_tables(content)], said)
    print(f"{content['seconds']:g} s · {folder / 'bench.html'}")
    return 0


def compare_call(options: argparse.Namespace) -> int:
    """Carry the comparison out; returns the exit code."""
    from gfm_hil.bench.compare import compare, comparison_table, interleave
    from gfm_hil.bench.result import read_result

    remarks = []
    if options.interleave is None:
        a, b = read_result(Path(options.a)), read_result(Path(options.b))
        remarks.append(
            "Measured one after the other: what changed on the machine between them is a real "
            "change too. Where both have limits in C, ratios to these are compared, which helps."
        )
    else:
        folder = new_folder(options.out, "bench-compare")
        check_free(folder, 0)
        with _bar(options.quiet) as show:
            a, b = interleave(options.a, options.b, options.interleave, options.what, folder, show)
    rows = compare(a, b, by_limit=options.interleave is None)
    if options.json:
        print(json.dumps({"results": rows, "remarks": remarks}, indent=1))
        return 0
    _print([comparison_table(rows)], remarks)
    return 0


def _print(tables: Iterable[Any], remarks: Iterable[str]) -> None:
    console = terminal()
    console.width = max(console.width, _WIDTH)
    for table in tables:
        console.print(table, end="\n\n")
    for remark in remarks:
        console.print(f"• {escape(remark)}", highlight=False)


@contextmanager
def _bar(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    with progress(BarColumn(), TaskProgressColumn(), "{task.description}", quiet=quiet) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda text, share: bar.update(task, description=escape(text), completed=share)
