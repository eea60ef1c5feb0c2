"""What several commands share: options, the progress bar, the closing table."""

import argparse
import json
import re
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TaskProgressColumn,
    TimeRemainingColumn,
)

from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt
from gfm_hil.core.terminal import terminal
from gfm_hil.engine.processes import Progress as TellProgress
from gfm_hil.recording.run import Run, controlled_by
from gfm_hil.results.report import as_expected, events_table, finite, has_stages, inner_stages
from gfm_hil.results.table import Table, shown
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.run.runner import Notice
from gfm_hil.scenario import Scenario, find_scenario, load_scenario
from gfm_hil.studies.workers import Watch
from gfm_runtime import law_file

EXIT_OTHERWISE, EXIT_INTERRUPTED = 3, 130
_ENDS = 3  # events shown from each end of a long run

#: what the command line calls the overrides of ``load_scenario``; argparse has each by its key
OPTIONS = {
    "mode": "--mode",
    "link__type": "--link",
    "link__endpoint": "--endpoint",
    "duration": "--duration",
    "seed": "--seed",
    "law": "--law",
    "inner": "--inner",
    "counts": "--counts",
    "waveforms": "--waveforms",
    "cores": "--cores",
    "snapshot": "--snapshot",
    "start_from": "--from",
}


def add_scenario_options(command: argparse.ArgumentParser) -> None:
    """Options that override what a scenario says."""
    command.add_argument("scenario", help="scenario file, or the name of a shipped one")
    command.add_argument("--mode", choices=["lockstep", "realtime"], help="override mode")
    command.add_argument(
        "--link", dest="link__type", metavar="LINK",
        help="override link.type: zmq, shm, serial, can or inproc",
    )  # fmt: skip
    command.add_argument(
        "--endpoint", action="append", default=[],
        help="override link.endpoint, e.g. tcp://127.0.0.1:5555; of a network's plant repeat it for"
        " each converter, as NAME=ENDPOINT",
    )  # fmt: skip
    command.add_argument(
        "--option", action="append", default=[], metavar="KEY=VALUE", type=link_option,
        help="override a key of link.options, e.g. curve=keys; may be repeated",
    )  # fmt: skip
    command.add_argument("--duration", type=float, metavar="S", help="override duration, s")
    add_inner(command)
    add_counts(command)
    command.add_argument("--seed", type=int, help="override seed of the sensors' noise")
    add_settings(command)


def add_settings(command: argparse.ArgumentParser) -> None:
    """The option that overrides any key of a scenario."""
    command.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", type=_setting,
        help="override any key of the scenario, e.g. plant.grid.V_g=0.95; may be repeated",
    )  # fmt: skip


def settings(options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, str]]:
    """What --set changes, and what the user calls it, both as for ``load_scenario``."""
    keys = {name.replace(".", "__"): (name, value) for name, value in options.settings}
    return {key: value for key, (_, value) in keys.items()}, {
        key: f"--set {name}" for key, (name, _) in keys.items()
    }


def add_inner(command: argparse.ArgumentParser) -> None:
    """The option that gives every law an inner stage."""
    said = (
        "inner stage: a shipped name (gfmhil laws), a file, or none; by default each law's own,"
        " which grid-following laws keep in place of a grid-forming one"
    )
    command.add_argument("--inner", metavar="NAME", help=said)


def add_counts(command: argparse.ArgumentParser) -> None:
    """The option that has every law measure and modulate."""
    said = "measurement and modulation of every law: a shipped name (rig), a file, or none"
    command.add_argument("--counts", metavar="NAME", help=said)


def add_map(command: argparse.ArgumentParser, option: str, **more: Any) -> None:
    """The option that goes with a model, which ``option`` gives."""
    command.add_argument(
        "--map", type=Path, metavar="FILE",
        help=f"of {option}: which signals its ports are, as TOML, where names differ from ours",
        **more,
    )  # fmt: skip


def by_converter(option: str, given: Sequence[str], parts: Sequence[str]) -> dict[str, str]:
    """What an option that may come again gives each converter of a network, as NAME=VALUE; without
    a network its one value, by "". Raises UserError: a value for no converter, or a second one."""
    found: dict[str, str] = {}
    for text in given:
        name, equals, value = text.partition("=") if parts else ("", "=", text)
        if not equals or name not in (parts or [""]):
            raise UserError(f"{option} {text}: must be NAME=VALUE with NAME one of {parts}")
        if name in found:
            raise UserError(f"{option} {text}: a second one" + f" of {name}" * bool(name))
        found[name] = value
    return found


def link_option(text: str) -> tuple[str, Any]:
    """KEY=VALUE with the value as in TOML, or as text where it is none."""
    key, value = _setting(text)
    if not key.isidentifier():
        raise argparse.ArgumentTypeError(f"{text!r}: must be KEY=VALUE")
    return key, value


def _setting(text: str) -> tuple[str, Any]:
    """``link_option`` of a key that may have dots."""
    key, equals, value = text.partition("=")
    if not (re.fullmatch(r"[A-Za-z_][\w-]*(\.[\w-]+)*", key) and equals):
        raise argparse.ArgumentTypeError(f"{text!r}: must be KEY=VALUE")
    try:
        return key, tomllib.loads(f"x = {value}")["x"]
    except tomllib.TOMLDecodeError:
        return key, value


def two_numbers(form: str) -> Callable[[str], tuple[float, float]]:
    """The type of an option that is two numbers of this form, such as ``LOW:HIGH, e.g. 1:20``."""

    def read(text: str) -> tuple[float, float]:
        try:
            first, second = map(float, text.split(":"))
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r}: must be {form}") from None
        return first, second

    return read


def window(text: str) -> list[float]:
    """FROM:TO in s, as [from, to]."""
    return [*two_numbers("FROM:TO, two numbers in s")(text)]


def numbers(text: str) -> list[float]:
    """Numbers between commas."""
    try:
        return [float(one) for one in text.split(",")]
    except ValueError:
        why = f"{text!r}: must be numbers separated by commas, e.g. 1.5,3"
        raise argparse.ArgumentTypeError(why) from None


def endpoints(options: argparse.Namespace) -> dict[str, str]:
    """The endpoints that --endpoint names, by converter, "" for one without a name. Raises
    UserError: one is given twice."""
    found: dict[str, str] = {}
    for text in options.endpoint:
        named = re.fullmatch(r"([A-Za-z_][A-Za-z0-9_-]*)=(.+)", text)
        name, endpoint = named.groups() if named else ("", text)
        if name in found:
            raise UserError(f"--endpoint {text}: given twice{name and f' for {name}'}")
        found[name] = endpoint
    return found


def resolve(options: argparse.Namespace, named: bool = False, in_process: bool = False) -> Scenario:
    """The scenario with its overrides. Raises UserError: as ``load_scenario``.

    Args:
        named: the command takes an endpoint for each converter, see ``endpoints``; the option
            --converter says which one it controls. That of other commands says which one gets
            the law and the inner stage.
    """
    gets = {} if named or "converter" not in options else {"converter": "--converter"}
    ends = endpoints(options)
    for name in ends:
        if name and not named:
            raise UserError(
                f"--endpoint {name}={ends[name]}: for gfmhil plant; here a scenario names it, as"
                f" network.converters.{name}.link.endpoint"
            )
    own = {key: getattr(options, key, None) for key in OPTIONS}
    own |= {f"link__options__{key}": value for key, value in options.option}
    if not named or options.converter is None:
        own["link__endpoint"] = ends.get("")
    changed, names = settings(options)
    scenario = load_scenario(
        options.scenario,
        {
            **OPTIONS,
            **gets,
            **{f"link__options__{key}": f"--option {key}" for key, _ in options.option},
            **names,
        },
        in_process,
        options.converter if gets else None,
        **own | changed,
    )
    if options.inner is not None:
        members = [*scenario.each.values()] or [scenario]
        laws = dict.fromkeys(law for one in members for law in one.laws())
        for law in laws:
            if (file := law_file(law)).behind(options.inner) is file:
                why = f"{law} needs its own stage, and keeps it"
                print(f"gfmhil: --inner {options.inner}: {why}", file=sys.stderr)
    return scenario


def short_name(scenario: str) -> str:
    """What a run is named after: the scenario's file, or the folder of one that a command wrote
    under the name that all such files have."""
    file = find_scenario(scenario)
    return file.resolve().parent.name if file.stem in ("network", "scenario") else file.stem


def new_folder(out: str | None, stem: str) -> Path:
    """Where a run goes: --out, or runs/<stem>-<time> that is not there yet."""
    if out is not None:
        return Path(out)
    base = Path("runs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder, k = base, 1
    while folder.exists():
        k += 1
        folder = base.with_name(f"{base.name}-{k}")
    return folder


def progress(*columns: str | ProgressColumn, quiet: bool = False) -> Progress:
    """A bar on stderr that a pipe or a file does not get; a text is the format of a column."""
    console = terminal(stderr=True, quiet=quiet, highlight=False)
    off = not console.is_terminal
    return Progress(*columns, console=console, disable=off, transient=True, refresh_per_second=4)


def above(bar: Progress) -> Notice:
    """What prints a line above a progress bar."""

    def notice(text: str) -> None:
        bar.console.print(escape(text), style="dim", highlight=False, soft_wrap=True)

    return notice


@contextmanager
def watching(label: str, quiet: bool = False, stoppable: bool = False) -> Iterator[Watch]:
    """A bar on stderr that watches a study; Ctrl-C then ends a ``stoppable`` one in good order."""
    columns = BarColumn(), TaskProgressColumn(), "{task.fields[words]}", TimeRemainingColumn()
    interrupt = Interrupt()
    with ExitStack() as stack:
        if stoppable:
            stack.enter_context(interrupt)
        bar = stack.enter_context(progress("{task.description}", *columns, quiet=quiet))
        task = bar.add_task(escape(label), total=None, words="starting …")

        def tell(done: int, of: int, words: str) -> None:
            bar.update(task, completed=done, total=of, words=escape(words))

        yield Watch(tell, above(bar), lambda: interrupt.came)


def add_study_options(command: argparse.ArgumentParser, printed: str, stem: str) -> None:
    """--out, --json and --quiet: ``printed`` is what --json prints, ``stem`` begins the name of the
    folder if none is given."""
    said = f"folder; runs/{stem}-<time> by default"
    command.add_argument("-o", "--out", metavar="DIR", help=said)
    command.add_argument("--json", action="store_true", help=f"print {printed}, nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def add_workers(command: argparse.ArgumentParser, default: str) -> None:
    """--workers, of which there are by default as many as the words say, and --dask, for
    ``workers_of``."""
    where = command.add_mutually_exclusive_group()
    words = f"processes; {default} by default"
    where.add_argument("--workers", type=int, metavar="N", help=words)
    where.add_argument(
        "--dask", metavar="ADDRESS", help="run on a Dask cluster, e.g. tcp://host:8786"
    )


def workers_of(options: argparse.Namespace, default: int) -> int | str:
    """How many processes a command is to use, or the address of a cluster."""
    if options.dask is not None:
        address: str = options.dask
        return address
    return default if options.workers is None else int(options.workers)


def print_parts(parts: Iterable[str | Table]) -> None:
    """Print lines, which have rich's markup, and tables."""
    console = terminal(highlight=False)
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, str))


def print_result(options: argparse.Namespace, content: Any, parts: Iterable[str | Table]) -> None:
    """Print what a command computed: ``content`` as JSON if --json is given, else ``parts``, and
    the file of ``add_figure``'s option if it is given."""
    if options.json:
        print(json.dumps(finite(content), indent=2), flush=True)
        return
    print_parts(parts)
    if figure := getattr(options, "figure", None):
        print_parts([escape(f"figure: {figure}")])


@contextmanager
def progress_bar(scenario: Scenario, quiet: bool) -> Iterator[tuple[TellProgress, Notice]]:
    """A bar with simulated time and misses on stderr; yields (progress, notice)."""
    with watching(scenario.title, quiet) as watch:

        def tell(ticks: int, misses: int) -> None:
            late = f", {misses} misses" if misses else ""
            words = f"{ticks * scenario.T_s:.2f} s simulated{late}"
            watch.progress(ticks, scenario.ticks, words)

        yield tell, watch.notice


def _summary_in_words(
    summary: dict[str, Any], folder: Path, why: str = ""
) -> Iterator[str | Table]:
    """The short table that ends a run; ``why`` is a sentence more on its end."""
    colour = "red" if summary["unmet"] else "green"
    reason = f" — {escape(summary['reason'])}" if summary["reason"] else ""
    expected = ", as expected" if as_expected(summary) else ""
    yield f"[bold {colour}]{summary['status']}[/]{expected}{reason}"
    for part in summary["unmet"]:
        yield f"[red]not as expected:[/] {escape(part)}"
    if why:
        yield escape(why)
    stage = f" · inner stage {inner_stages(summary)}" if has_stages(summary) else ""
    yield escape(controlled_by(summary) + stage)
    yield (
        f"{summary['link']}, {summary['mode']} · {summary['duration_s']:g} s in "
        f"{summary['wall_s']:.2f} s · {summary['ticks']} ticks, {shown(summary['misses'])} misses"
    )
    if "latency" in summary:
        yield escape(summary["latency"])
    if summary["round_trip_us"]:
        text = ", ".join(f"{k} {v:g}" for k, v in summary["round_trip_us"].items())
        yield escape(f"round trip [µs]: {text}")
    if "instructions" in summary:
        text = ", ".join(f"{k} {v}" for k, v in summary["instructions"].items())
        yield f"instructions of a step: {text}"
    events = summary["events"]
    short = events if len(events) <= 2 * _ENDS else [*events[:_ENDS], *events[-_ENDS:]]
    yield from events_table(short).fitting(terminal())
    if left_out := len(events) - len(short):
        yield (
            f"{left_out} events between {short[_ENDS - 1]['t']:g} s and {short[_ENDS]['t']:g} s "
            "are not shown; summary.json has all of them"
        )
    yield escape(f"run folder: {folder}")


def run_in_words(run: Run | NetworkRun, folder: Path, why: bool = False) -> Iterator[str | Table]:
    """What ends a run; with ``why`` also what made it unstable, see ``why_it_ended``."""
    each = run.values() if isinstance(run, NetworkRun) else [run]
    lasted, reason = all(one.status == "completed" for one in each), ""
    if isinstance(run, Run) and "unstable_mode" in run.summary:
        reason = run.summary["unstable_mode"]
    elif (why or isinstance(run, NetworkRun)) and not lasted:
        from gfm_hil.studies.linear_loop import why_it_ended  # a second of imports

        reason = why_it_ended(run)
    if isinstance(run, Run):
        yield from _summary_in_words(run.summary, folder, reason)
        return
    for name, one in run.items():
        yield f"\n{name}"
        yield from _summary_in_words(one.summary, folder / name)
    if reason:
        yield escape(f"\n{reason}")


def exit_code(run: Run | NetworkRun) -> int:
    """0 as expected, 130 interrupted, 3 otherwise; of a network the worst one of its runs."""
    if isinstance(run, NetworkRun):
        return max(exit_code(one) for one in run.values())
    if not run.summary["unmet"]:
        return 0
    return EXIT_INTERRUPTED if run.status == "interrupted" else EXIT_OTHERWISE


def add_open(command: argparse.ArgumentParser) -> None:
    """The option that opens the report."""
    command.add_argument("--open", action="store_true", help="open the report in a browser")


def show_page(options: argparse.Namespace, page: Path) -> None:
    """Name the report that a command has left, if there is one, as its last line, and open it if
    ``add_open``'s option is given."""
    if not page.is_file():
        return
    if not getattr(options, "json", False):
        terminal().print(escape(f"report: {page}"), highlight=False, soft_wrap=True)
    if options.open:
        import webbrowser

        if not webbrowser.open(page.resolve().as_uri()):
            print(f"gfmhil: --open: there is no browser; open {page}", file=sys.stderr)


def split_laws(text: str) -> list[str]:
    """Names from a comma-separated list. Raises UserError: an empty one."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise UserError(f"--laws {text!r}: names separated by commas, none empty")
    return names
