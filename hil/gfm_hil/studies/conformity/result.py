"""What the tests showed of one law or several, and the files that say so."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.recording.columns import printed
from gfm_hil.results.report import STYLE, cell, figure, finite
from gfm_hil.studies.conformity.execute import PartResult, slug
from gfm_hil.studies.conformity.model import KNOWN
from gfm_hil.studies.conformity.sets import Case
from gfm_hil.studies.conformity.under_test import UnderTest
from gfm_hil.studies.conformity.verdict import (
    CANNOT,
    FAIL,
    INFORMATIVE,
    PASS,
    SIGNS,
    Outcome,
    Verdict,
    worst,
)

#: characters that XML cannot hold, not even escaped
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_STYLE = """
.pass{background:#00734f} .fail{background:#b34500} .cannot{background:#777}
.informative{background:#36648b}
td .status{padding:0 .4rem;white-space:nowrap}
.scroll.text :is(th,td):not(:first-child){text-align:left;white-space:normal}
.scroll .matrix :is(td,th){padding:.1rem;text-align:center;border:0} .matrix a{color:inherit;
text-decoration:none} .matrix .status{padding:0;width:1.5rem}
.scroll .matrix th:first-child{position:sticky;left:0;background:var(--paper);text-align:left;
white-space:normal;min-width:9rem;padding-right:.6rem}
.matrix th.tall{writing-mode:vertical-rl;transform:rotate(180deg);text-align:left!important}
@media (max-width:45rem){.text :is(table,tbody,tr,td){display:block} .text th{display:none}
.text tr{padding:.4rem 0;border-bottom:1px solid var(--line)} .text td{padding:0;border:0}
.text td:not(:has(.status))::before{content:attr(data-head) ": ";opacity:.6}}
"""


@dataclass(frozen=True, repr=False)
class Conformity:
    """What the tests showed.

    Attributes:
        laws: names, in order; with a model its name is the last one.
        inner: stage of every law; None: each law's own.
        under: the converter under test.
        cases: the tests, in order.
        parts: one a law and part that ran, in any order.
        folder: with the report; None without one.
    """

    laws: list[str]
    inner: str | None
    under: UnderTest
    cases: list[Case]
    parts: list[PartResult]
    folder: Path | None = None

    @property
    def passed(self) -> bool:
        """Whether every clause of every test passes under every law, the informative ones left
        out."""
        return self.verdict == PASS

    @property
    def verdict(self) -> Outcome:
        """The worst of all tests under all laws."""
        return worst([*self.matrix.values()])

    @cached_property
    def matrix(self) -> dict[tuple[str, str], Outcome]:
        """The verdict by law and test, the worst of its parts."""
        return {
            (law, case.id): worst([found.verdict for found in self.of(law, case.id)])
            for law in self.laws
            for case in self.cases
        }

    def of(self, law: str, test: str) -> list[PartResult]:
        """The parts of a test under a law, in the order of its file."""
        case = next(case for case in self.cases if case.id == test)
        order = [part.name for part in case.test.runs()]
        mine = [f for f in self.parts if f.law == law and f.test == test]
        return sorted(mine, key=lambda f: order.index(f.part))

    @property
    def failures(self) -> list[str]:
        """One line for each part that does not pass, with law, test, verdict and why."""
        return [
            f"{f.law}, {'/'.join(x for x in (f.test, f.part) if x)}: {f.verdict}: {f.words}"
            for law in self.laws
            for case in self.cases
            for f in self.of(law, case.id)
            if f.verdict not in (PASS, INFORMATIVE)
        ]

    def plain(self) -> dict[str, Any]:
        """The content of results.json."""
        tests = {
            case.id: {
                "title": case.test.title,
                "source": case.test.source.model_dump(),
                "f_n": case.test.f_n,
            }
            for case in self.cases
        }
        laws: dict[str, Any] = {}
        for law in self.laws:
            laws[law] = {
                case.id: {
                    "verdict": self.matrix[law, case.id],
                    "parts": [
                        {
                            "part": f.part,
                            "verdict": f.verdict,
                            "status": f.status,
                            "reason": f.reason,
                            "cause": f.cause and {"clause": f.cause.clause, "text": f.cause.text},
                            "clauses": [v.plain() for v in f.verdicts],
                        }
                        for f in self.of(law, case.id)
                    ],
                }
                for case in self.cases
            }
        return finite(
            {
                "version": version("gfmhil"),
                "date": datetime.now(UTC).isoformat(timespec="seconds"),
                "inner": self.inner,
                "under_test": self.under.model_dump(mode="json", exclude_unset=True),
                "passed": self.passed,
                "tests": tests,
                "laws": laws,
            }
        )

    def write(self, folder: Path) -> None:
        """Write report.html, results.json and junit.xml, and with several laws a report for each
        and matrix.png.

        Raises:
            UserError: the folder cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_text(folder / "results.json", json.dumps(self.plain(), indent=1) + "\n")
            write_text(folder / "junit.xml", self._junit())
            if len(self.laws) == 1:
                write_text(folder / "report.html", self._page(self.laws[0]))
                return
            from gfm_hil.studies.conformity.figure import draw_matrix

            draw_matrix(folder / "matrix.png", self.laws, [c.id for c in self.cases], self.matrix)
            for law in self.laws:
                write_text(folder / f"report-{slug(law)}.html", self._page(law))
            write_text(folder / "report.html", self._overview())
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}") from None

    def _junit(self) -> str:
        """One suite a law and test, one case a clause; what cannot be judged is an error, what is
        informative is skipped."""
        top = ElementTree.Element("testsuites", name="gfmhil conform")
        for law in self.laws:
            for case in self.cases:
                parts = self.of(law, case.id)
                verdicts = [(f, v) for f in parts for v in f.verdicts]
                bare = [f for f in parts if not f.verdicts]
                outcomes = [v.verdict for _, v in verdicts] + [f.verdict for f in bare]
                suite = ElementTree.SubElement(
                    top, "testsuite", name=f"{law}: {case.id}", tests=str(len(outcomes)),
                    failures=str(outcomes.count("fail")),
                    errors=str(outcomes.count("cannot judge")),
                    skipped=str(outcomes.count("informative")),
                )  # fmt: skip
                for f, v in verdicts:
                    _case(suite, law, f, f"{v.clause} [{v.kind} from {v.start:g} s]", v.verdict,
                          v.text)  # fmt: skip
                for f in bare:
                    _case(suite, law, f, f.part, f.verdict, f.reason)
        ElementTree.indent(top)
        text = ElementTree.tostring(top, encoding="unicode", xml_declaration=True)
        return _NOT_XML.sub("\ufffd", text) + "\n"

    def _page(self, law: str) -> str:
        body = [self._head(f"{law}: conformity")]
        rows = [
            [status(self.matrix[law, c.id]), _link(c), html.escape(c.test.source.words())]
            for c in self.cases
        ]
        body.append(table(["verdict", "test", "source"], rows))
        body += [self._section(law, case) for case in self.cases]
        return document(f"{law}: conformity", "\n".join(body))

    def _overview(self) -> str:
        pages = {law: f"report-{slug(law)}.html" for law in self.laws}
        heads = "".join(
            f'<th class="tall"><a href="{page}">{html.escape(law)}</a></th>'
            for law, page in pages.items()
        )
        rows = ""
        for c in self.cases:
            cells = "".join(
                f'<td><a href="{page}#{slug(c.id)}">'
                f"{status(self.matrix[law, c.id], short=True)}</a></td>"
                for law, page in pages.items()
            )
            rows += (
                f'<tr><th title="{html.escape(c.test.title)}">{html.escape(c.id)}</th>{cells}</tr>'
            )
        matrix = f'<div class="scroll"><table class="matrix"><tr><th></th>{heads}</tr>{rows}'
        sources = table(
            ["test", "source", "known"],
            [
                [html.escape(c.id), html.escape(c.test.source.words()),
                 html.escape(KNOWN[c.test.source.known])]
                for c in self.cases
            ],
        )  # fmt: skip
        body = f"{self._head('Conformity of laws')}{matrix}</table></div><h2>Sources</h2>{sources}"
        return document("Conformity of laws", body)

    def _head(self, title: str) -> str:
        under = self.under
        stage = "each law's own" if self.inner is None else self.inner
        return (
            f"<h1>{html.escape(title)}</h1><p>Inner stage: {html.escape(stage)}. Converter: "
            f"{html.escape(under.plant.converter)}, declared droop {100 * under.droop:g} %, power "
            f"{under.P_min:g} to {under.P_max:g} p.u. gfmhil {version('gfmhil')}, "
            f"{datetime.now(UTC).date()}. These verdicts are about this model, not about a "
            "product; check each limit against the source before you rely on it.</p>"
        )

    def _section(self, law: str, case: Case) -> str:
        test = case.test
        text = [
            f'<h2 id="{slug(case.id)}">{status(self.matrix[law, case.id])} '
            f"{html.escape(f'{case.id}: {test.title}')}</h2>",
            f"<p>{html.escape(test.description)}</p>",
            f"<p>Source: {html.escape(test.source.words())}, {KNOWN[test.source.known]}.</p>",
        ]
        for f in self.of(law, case.id):
            if f.part:
                text.append(f"<h3>{status(f.verdict)} {html.escape(f.part)}</h3>")
            if f.verdicts:
                text.append(table(_HEADS, [_row(v) for v in f.verdicts]))
            else:
                text.append(f"<p>{html.escape(f.reason)}</p>")
            if f.figure is not None:
                text.append(figure(f"{f.test} {f.part}".rstrip(), f.figure.panels))
            if f.again:
                text.append(f"<p><code>{html.escape(f.again)}</code> repeats the run.</p>")
        return "\n".join(text)

    def __repr__(self) -> str:
        count = list(self.matrix.values())
        told = ", ".join(f"{count.count(v)} {v}" for v in SIGNS if v in count)
        return "\n".join([f"<Conformity of {', '.join(self.laws)}: {told}", *self.failures, ">"])


_HEADS = ("verdict", "clause", "signal", "window [s]", "measured", "limit", "what was found")


def _row(v: Verdict) -> list[str]:
    measured = "–" if v.value is None else f"{cell(v.value)} {v.unit}".rstrip()
    window = f"{v.start:g} … {v.stop:g}" if v.stop > v.start else "–"
    plain = (v.clause, printed(v.signal) or "–", window, measured, v.limit, v.text)
    return [status(v.verdict), *map(html.escape, plain)]


def status(verdict: str, short: bool = False) -> str:
    """A verdict in its colour, as a word or its sign."""
    look = verdict.split()[0]
    return f'<span class="status {look}">{SIGNS[verdict] if short else verdict}</span>'


def _link(case: Case) -> str:
    name = html.escape(f"{case.id}: {case.test.title}")
    return f'<a href="#{slug(case.id)}">{name}</a>'


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose cells are HTML already."""
    top = "".join(f"<th>{head}</th>" for head in heads)
    body = ""
    for row in rows:  # each cell with its head, for where there is no room for columns
        cells = (f'<td data-head="{h}">{c}</td>' for h, c in zip(heads, row, strict=True))
        body += f"<tr>{''.join(cells)}</tr>"
    return f'<div class="scroll text"><table><tr>{top}</tr>{body}</table></div>'


def document(title: str, body: str) -> str:
    """A whole page of HTML."""
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{STYLE}{_STYLE}</style>\n{body}</html>\n"
    )


def _case(suite: Any, law: str, f: PartResult, name: str, verdict: str, text: str) -> None:
    place = ".".join(x for x in (law, f.test, f.part) if x)
    entry = ElementTree.SubElement(suite, "testcase", classname=place, name=name)
    if verdict == FAIL:
        ElementTree.SubElement(entry, "failure", message=text)
    elif verdict == CANNOT:
        ElementTree.SubElement(entry, "error", message=text, type=CANNOT)
    elif verdict == INFORMATIVE:
        ElementTree.SubElement(entry, "skipped", message=text)
