"""What the tests showed of one law or several, and the files that say so."""

from __future__ import annotations

import json
import re
from collections import Counter
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
from gfm_hil.results.page import render
from gfm_hil.results.report import finite
from gfm_hil.results.table import shown
from gfm_hil.studies.conformity.criteria.base import KNOWN, UnderTest
from gfm_hil.studies.conformity.execute import PartResult, slug
from gfm_hil.studies.conformity.sets import Case
from gfm_hil.studies.conformity.verdict import (
    CANNOT,
    CONSISTENT,
    FAIL,
    INFORMATIVE,
    LIMITED,
    PASS,
    SIGNS,
    Outcome,
    Verdict,
    worst,
)

#: attributes of a suite of JUnit that count verdicts, and, without the s, elements that tell them
_COUNTED: dict[Outcome, str] = {
    FAIL: "failures", CANNOT: "errors",
    **dict.fromkeys((LIMITED, CONSISTENT, INFORMATIVE), "skipped"),
}  # fmt: skip
#: characters that XML cannot hold, not even escaped
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


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
        """Whether no clause of any test fails or cannot be judged under any law, and some pass."""
        return self.verdict in (PASS, LIMITED, CONSISTENT)

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
        """One line for each part that fails or cannot be judged, with law, test and why."""
        return [
            f"{f.law}, {'/'.join(x for x in (f.test, f.part) if x)}: {f.verdict}: {f.words}"
            for key in self.matrix
            for f in self.of(*key)
            if f.verdict in (FAIL, CANNOT)
        ]

    def plain(self) -> dict[str, Any]:
        """The content of results.json."""
        about = {"title", "source", "f_n"}
        content = {
            "version": version("gfmhil"),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "inner": self.inner,
            "under_test": self.under.model_dump(mode="json", exclude_unset=True),
            "passed": self.passed,
            "tests": {case.id: case.test.model_dump(include=about) for case in self.cases},
            "laws": {
                law: {
                    case.id: {
                        "verdict": self.matrix[law, case.id],
                        "parts": [part.plain() for part in self.of(law, case.id)],
                    }
                    for case in self.cases
                }
                for law in self.laws
            },
        }
        return finite(content)

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
            write_text(folder / "report.html", self._page(None))
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}") from None

    def _junit(self) -> str:
        """One suite a law and test, one case a clause; what cannot be judged is an error, what is
        neither a pass nor a failure is skipped."""
        top = ElementTree.Element("testsuites", name="gfmhil conform")
        for law, test in self.matrix:
            parts = self.of(law, test)
            told = [
                (f, f"{v.clause} [{v.kind} from {v.start:g} s]", v.verdict, v.text)
                for f in parts
                for v in f.verdicts
            ]
            told += [(f, f.part, f.verdict, f.reason) for f in parts if not f.verdicts]
            outcomes = [verdict for *_, verdict, _ in told]
            tags = Counter(_COUNTED.get(verdict) for verdict in outcomes)
            count = {tag: str(tags[tag]) for tag in dict.fromkeys(_COUNTED.values())}
            attributes = {"name": f"{law}: {test}", "tests": str(len(told)), **count}
            suite = ElementTree.SubElement(top, "testsuite", attributes)
            for f, name, verdict, text in told:
                place = ".".join(x for x in (law, f.test, f.part) if x)
                entry = ElementTree.SubElement(suite, "testcase", classname=place, name=name)
                if verdict in _COUNTED:
                    kind = {} if verdict == FAIL else {"type": verdict}
                    tag = _COUNTED[verdict].removesuffix("s")
                    ElementTree.SubElement(entry, tag, {"message": text, **kind})
        ElementTree.indent(top)
        text = ElementTree.tostring(top, encoding="unicode", xml_declaration=True)
        return _NOT_XML.sub("\ufffd", text) + "\n"

    def _page(self, law: str | None) -> str:
        """A page about a law, or about all of them."""
        template = "conformity_matrix.html" if law is None else "conformity.html"
        title = "Conformity of laws" if law is None else f"{law}: conformity"
        return render(
            template, title=title, found=self, law=law, slug=slug, known=KNOWN, signs=SIGNS,
            row=_row, version=version("gfmhil"), date=datetime.now(UTC).date(),
        )  # fmt: skip

    def __repr__(self) -> str:
        count = list(self.matrix.values())
        told = ", ".join(f"{count.count(v)} {v}" for v in SIGNS if v in count)
        return "\n".join([f"<Conformity of {', '.join(self.laws)}: {told}", *self.failures, ">"])


def _row(v: Verdict) -> list[str]:
    """What a page says of a clause, after its verdict."""
    measured = "–" if v.value is None else f"{shown(v.value)} {v.unit}".rstrip()
    window = f"{v.start:g} … {v.stop:g}" if v.stop > v.start else "–"
    source = f"{v.source}; {KNOWN[v.known]}" if v.known else "–"
    return [v.clause, printed(v.signal) or "–", window, measured, v.limit, v.text, source]
