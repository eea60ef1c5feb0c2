"""gfmhil conform: published tests of grid-forming converters, judged clause by clause."""

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_hil.api.studies import conform, judge_recording
from gfm_hil.cli import common
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.terminal import terminal
from gfm_hil.realtime.priority import processors
from gfm_hil.results.report import PAGE
from gfm_hil.results.table import Cell, Table
from gfm_hil.studies.conformity import sets, verdict
from gfm_hil.studies.conformity.diff import SHARE, compare_results, read_results
from gfm_hil.studies.conformity.execute import PartResult
from gfm_hil.studies.conformity.result import Conformity
from gfm_runtime import law_names

EXIT_FAILED = 1
_EXIT = {
    **dict.fromkeys((verdict.PASS, verdict.LIMITED, verdict.CONSISTENT), 0),
    verdict.FAIL: EXIT_FAILED,
    **dict.fromkeys((verdict.CANNOT, verdict.INFORMATIVE), 4),
}
_COLOURED = {verdict.PASS: "good", verdict.FAIL: "bad", verdict.CANNOT: "warn"}
_STYLES = {**dict.fromkeys(verdict.SIGNS, "dim"), **_COLOURED}


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Exit code 0: no clause fails, and all could be judged; 1: one fails; 2: wrong input; 4: "
        "none fails, but one cannot be judged. What is limited, consistent with itself or "
        "informative is no pass, and counts as no failure."
    )
    others = command.add_subparsers(metavar="{diff}", title="on reports")
    diff = others.add_parser("diff", help="what changed between two reports")
    diff.description = (
        "Exit code 0: nothing got worse; 1: a verdict did, or a clause that passed is gone; 2: "
        "wrong input."
    )
    diff.set_defaults(call=_diff)
    diff.add_argument(
        "old", type=Path, metavar="OLD", help="folder of a report, or its results.json"
    )
    diff.add_argument("new", type=Path, metavar="NEW", help="the same")
    diff.add_argument(
        "--share", type=float, default=SHARE, metavar="X",
        help=f"values that moved by more than this part of the larger are told; {SHARE:g}",
    )  # fmt: skip
    diff.add_argument("--html", type=Path, metavar="FILE", help="write a page too")
    diff.add_argument("--json", action="store_true", help="print all of it as JSON, nothing else")
    command.add_argument(
        "--law", action="extend", nargs="+", metavar="LAW",
        help="catalogue names or law files; all: the whole catalogue",
    )  # fmt: skip
    command.add_argument(
        "--controller", metavar="KIND:FILE",
        help="dll:FILE (IEEE/CIGRE), fmu:FILE or c:FILE: a controller to test, with or without "
        "laws beside it; it begins at the operating point of the first law; or pil:TARGET, the "
        "first law as firmware on a processor in QEMU",
    )  # fmt: skip
    command.add_argument(
        "--recording", type=Path, metavar="FILE",
        help="judge this recording, of one part of the test --against, in place of a run: CSV, "
        "COMTRADE (.cfg, .cff), Parquet, MF4 or MAT",
    )  # fmt: skip
    command.add_argument(
        "--part", metavar="NAME", help="with --recording: the part of the test, see --list parts"
    )
    common.add_map(command, "--controller, or the channels of --recording")
    common.add_inner(command)
    command.add_argument(
        "--against", action="extend", nargs="+", metavar="SET",
        help=f"{', '.join(sets.shipped_sets())}, or paths of your own; all: the shipped ones "
        "(default)",
    )  # fmt: skip
    command.add_argument(
        "--converter", metavar="FILE", help="the converter under test; the shipped one by default"
    )
    command.add_argument(
        "--network", metavar="SCENARIO",
        help="lay the tests over this network: network.grid is the point of connection, with line "
        "and grid of the test behind it; of --converter what its owner declares counts",
    )  # fmt: skip
    command.add_argument(
        "--judged", metavar="NAME",
        help="of the --network: the converter that gets the --law and is judged; its first one, "
        "with its own law, if not given",
    )  # fmt: skip
    common.add_workers(command, "all cores")
    command.add_argument("--no-figures", action="store_true", help="no figure of each run")
    command.add_argument(
        "--list", nargs="?", const="tests", choices=("tests", "parts", "limits"),
        help="list the tests, the parts of each, or all limits with source and how each is known; "
        "run nothing",
    )  # fmt: skip
    common.add_open(command)
    common.add_study_options(command, "results.json", "conform")


def call(options: argparse.Namespace) -> int:
    against = options.against or [sets.ALL]
    if options.list:
        cases = sets.load_cases(against)
        rows = {"tests": _tests, "parts": _parts, "limits": sets.all_limits}[options.list](cases)
        table = Table([*rows[0]], [[*row.values()] for row in rows], text=None)
        counts = [escape(sets.count_limits(rows))] if options.list == "limits" else []
        common.print_result(options, rows, [table, *counts])
        return 0
    if options.recording is not None:
        return _recording(options)
    if options.part is not None:
        raise UserError("--part: is of a --recording; name the test alone")
    if not options.law and options.controller is None and options.network is None:
        raise UserError("--law: missing; name a law, or all, or a --controller")
    laws = [n for law in options.law or [] for n in (law_names() if law == sets.ALL else [law])]
    folder, began = common.new_folder(options.out, "conform"), time.monotonic()
    with common.watching("conform", options.quiet, stoppable=True) as watch:
        found = conform(
            laws, against, folder, inner=options.inner, converter=options.converter,
            controller=options.controller, ports=options.map,
            network=options.network, judged=options.judged,
            workers=common.workers_of(options, processors()),
            figures=not options.no_figures, watch=watch,
        )  # fmt: skip
    return _tell(options, found, time.monotonic() - began, folder)


def _recording(options: argparse.Namespace) -> int:
    """Judge a recording; returns the exit code."""
    for name in ("law", "controller", "network", "judged"):
        if getattr(options, name):
            raise UserError(f"--{name}: goes not with --recording, which has no controller of ours")
    if options.map is None:
        raise UserError("--map: missing; it says what the channels of --recording are")
    if options.against is None or len(options.against) != 1:
        raise UserError(
            "--against: name the one test that was recorded, such as ercot/2-phase-jump"
        )
    folder, began = common.new_folder(options.out, "conform"), time.monotonic()
    with common.watching("conform", options.quiet) as watch:
        found = judge_recording(
            options.recording, options.map, options.against[0], options.part, folder,
            converter=options.converter, figures=not options.no_figures, watch=watch,
        )  # fmt: skip
    return _tell(options, found, time.monotonic() - began, folder)


def _diff(options: argparse.Namespace) -> int:
    """Two reports beside each other; returns the exit code."""
    found = compare_results(read_results(options.old), read_results(options.new), options.share)
    if options.html is not None:
        write_text(options.html, found.page(str(options.old), str(options.new)))
    heads = "", "law", "test", "part", "clause", "verdict", "measured"
    rows = [
        [
            Cell(row.change, "bad" if row.counts else ""), row.law, row.test, row.part,
            row.clause.clause, row.verdict, row.value,
        ]
        for row in found.rows
    ]  # fmt: skip
    tables = [Table(heads, rows, text=None)] if rows else []
    notes = map(escape, found.notes)
    common.print_result(options, found.plain(), [*notes, *tables, escape(found.words)])
    return EXIT_FAILED if found.worse else 0


def _tests(cases: Sequence[sets.Case]) -> list[dict[str, Any]]:
    return [
        {
            "test": case.id, "runs": len(case.test.runs()), "title": case.test.title,
            "source": case.test.source.words(),
        }
        for case in cases
    ]  # fmt: skip


def _parts(cases: Sequence[sets.Case]) -> list[dict[str, Any]]:
    return [
        {"test": case.id, "part": part.name, "title": part.title or case.test.title}
        for case in cases
        for part in case.test.runs()
    ]


def _why(part: PartResult) -> list[tuple[str, ...]]:
    """Clause and text of all that is wrong, each once; the reason alone if there was no run."""
    if part.status == "none":
        return [(part.reason,)]
    return [*dict.fromkeys((v.clause, v.text) for v in part.wrong)] or [(part.reason,)]


def _tell(options: argparse.Namespace, result: Conformity, wall_s: float, folder: Path) -> int:
    """What ends the command: a short table, the report; returns the exit code."""
    common.print_result(options, result.plain(), _in_words(result, wall_s))
    common.show_page(options, folder / PAGE)
    return _EXIT[result.verdict]


def _in_words(result: Conformity, wall_s: float) -> Iterator[str | Table]:
    yield from map(escape, result.recordings.values())
    rows: list[list[Any]] = []
    if len(result.laws) == 1:
        for case in result.cases:
            judged = result.matrix[result.laws[0], case.id]
            wrong = [
                ": ".join(filter(None, [f.part, *said]))
                for f in result.of(result.laws[0], case.id)
                if f.verdict == judged != verdict.PASS
                for said in _why(f)
            ]
            rows.append([case.id, Cell(judged, _STYLES[judged]), "\n".join(wrong)])
        yield Table(("test", "verdict", "why"), rows, text=None)
    else:
        signs = verdict.SIGNS
        cells = {at: Cell(f"{signs[v]} {v}", _STYLES[v]) for at, v in result.matrix.items()}
        rows = [[case.id, *(cells[law, case.id] for law in result.laws)] for case in result.cases]
        yield from Table(["test", *result.laws], rows, text=None).fitting(terminal())
    verdicts = list(result.matrix.values())
    told = ", ".join(f"{verdicts.count(v)} {v}" for v in verdict.SIGNS if v in verdicts)
    count = len(result.parts)
    runs = f"{count} {'run' if count == 1 else 'runs'} in {wall_s:.1f} s"
    yield f"{told}; {runs}"
    if result.network:
        yield escape(f"judged: {result.network}")
    elif not result.under.plant.model_fields_set - {"converter"}:
        under = result.under
        yield escape(f"converter under test: {under.plant.converter}, {under.instruments}")
