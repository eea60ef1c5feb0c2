"""What the tests showed of one law or several, and the files that say so."""

import json
import math
import platform
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from gfm_hil.core.errors import naming
from gfm_hil.core.files import write_text
from gfm_hil.realtime.environment import environment
from gfm_hil.recording.columns import symbol_of
from gfm_hil.results.curves import PackedCurves
from gfm_hil.results.page import plot_script, render
from gfm_hil.results.report import finite
from gfm_hil.results.table import shown
from gfm_hil.studies.conformity.criteria.base import KNOWN, UnderTest
from gfm_hil.studies.conformity.execute import PartResult, slug
from gfm_hil.studies.conformity.sets import Case, shipped_sets
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
        hashes: SHA-256 by file: the laws' own, those of the stage and of the converter under test,
            and the tests'.
        digests: by law, the digest of all that its file, the file's bases and the inner stage say,
            which the two sides of a link compare as well.
        droops: by law, the droop that its clauses ask for, p.u./p.u.; inf: none.
        recordings: by what was recorded in place of a run of a law, how it was read.
        network: which converter of which network is judged, in words; empty of one alone.
    """

    laws: list[str]
    inner: str | None
    under: UnderTest
    cases: list[Case]
    parts: list[PartResult]
    folder: Path | None = None
    hashes: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)
    droops: dict[str, float | None] = field(default_factory=dict)
    recordings: dict[str, str] = field(default_factory=dict)
    network: str = ""

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
            "network": self.network,
            "under_test": self.under.model_dump(mode="json", exclude_unset=True),
            "passed": self.passed,
            "machine": self.machine,
            "hashes": self.hashes,
            "digests": self.digests,
            "recordings": self.recordings,
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

    @cached_property
    def machine(self) -> str:
        """The name of the machine, its processor, kernel, and the versions of what computes."""
        badge = environment()
        packages = ", ".join(f"{name} {badge[name]}" for name in ("python", "numpy", "numba"))
        return f"{platform.node()}, {badge['cpu']}, Linux {badge['kernel']}, {packages}"

    def counts(self, law: str) -> dict[str, Counter[str]]:
        """How many clauses of a law have each verdict, by how the limit is known; a clause that
        is judged at several times counts as often."""
        found: dict[str, Counter[str]] = {}
        for case in self.cases:
            for part in self.of(law, case.id):
                for v in part.verdicts:
                    found.setdefault(v.known, Counter()).update([v.verdict])
        return found

    def saturated(self, law: str) -> int:
        """How many clauses of a law are judged while a limiter of its stage acts."""
        each = [part for case in self.cases for part in self.of(law, case.id)]
        return sum(bool(v.saturated) for part in each for v in part.verdicts)

    def verdict_of(self, law: str) -> Outcome:
        """The worst of all tests under a law."""
        return worst([self.matrix[law, case.id] for case in self.cases])

    def about(self, law: str | None) -> list[tuple[str, str]]:
        """What a first page says of a law, or of all, and of the tests, line by line."""
        under = self.under
        own = [] if law is None else [("law", law), ("digest", self.digests.get(law, "–"))]
        droop = self.droops.get(law or "", under.droop)
        words = "" if droop is None else "none" if droop == math.inf else f"{100 * droop:.3g} %"
        if law in self.recordings:
            own = [("recording", law), ("read as", self.recordings[law])]
            (case,), (shown,) = self.cases, self.parts  # a recording is of one part of one test
            if others := [p.name for p in case.test.runs() if p.name != shown.part]:
                own.append(("part", f"{shown.part}; not judged: {', '.join(others)}"))
        else:
            own.append(("inner stage", "the law's own" if self.inner is None else self.inner))
        if under.droop is None and law not in self.recordings:
            words = ", ".join(filter(None, [words, "that of the law itself"]))
        return [
            *own,
            *([("network", self.network)] if self.network else []),
            ("converter under test", f"{under.plant.converter}, {under.instruments}"),
            ("declared", f"droop {words}; power {under.P_min:g} to {under.P_max:g} p.u."),
            ("gfmhil", version("gfmhil")),
            *([("not run", left)] if (left := self._left_out()) else []),
            ("machine", self.machine),
            ("date", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
        ]

    def _left_out(self) -> str:
        """The other tests of the shipped sets of which some were run."""
        ran = {case.path for case in self.cases}
        left = (
            f"{name}/{path.stem}" for name, folder in shipped_sets().items()
            if any(path.parent == folder for path in ran)
            for path in sorted(folder.glob("*.toml")) if path not in ran
        )  # fmt: skip
        return ", ".join(left)

    def write(self, folder: Path, notice: Callable[[str], None] = lambda text: None) -> None:
        """Write report.html, report.pdf, results.json and junit.xml, and with several laws a report
        for each and matrix.png. Without the package that makes PDF, ``notice`` is told how to get
        it.

        Raises:
            UserError: the folder cannot be written.
        """
        from gfm_hil.studies.conformity.document import write_document

        with naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
            write_text(folder / "results.json", json.dumps(self.plain(), indent=1) + "\n")
            write_text(folder / "junit.xml", self._junit())
            alone = len(self.laws) == 1
            for law in self.laws:
                path = folder / ("report" if alone else f"report-{slug(law)}")
                write_text(path.with_name(f"{path.name}.html"), self._page(law))
                try:
                    write_document(path.with_name(f"{path.name}.pdf"), self, law)
                except ModuleNotFoundError:
                    if law == self.laws[0]:
                        notice("no PDF was written; it needs: pip install 'gfmhil[pdf]'")
            if not alone:
                from gfm_hil.studies.conformity.figure import draw_matrix

                tests = [case.id for case in self.cases]
                draw_matrix(folder / "matrix.png", self.laws, tests, self.matrix)
                write_text(folder / "report.html", self._page(None))

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
        curves = PackedCurves()
        return render(
            template, title=title, found=self, law=law, slug=slug, known=KNOWN, signs=SIGNS,
            row=row, heads=HEADS, saturation=saturation, curves=curves, script=plot_script(),
            tally=None if law is None else tally(self, law),
            explained=None if law is None else explain_counts(self, law),
        )  # fmt: skip

    def __repr__(self) -> str:
        count = list(self.matrix.values())
        told = ", ".join(f"{count.count(v)} {v}" for v in SIGNS if v in count)
        return "\n".join([f"<Conformity of {', '.join(self.laws)}: {told}", *self.failures, ">"])


#: of the verdicts that are neither pass nor fail, for who signs
_MEANINGS: dict[str, str] = {
    CANNOT: "Cannot judge: there is no run, it ended before the window did, or a recording lacks "
    "the signal; this is no pass.",
    LIMITED: "Limited: the declared droop asks for more than the declared power, so that the "
    "clause judges the limit of power and not the droop.",
    CONSISTENT: "Consistent with itself: the limit is made of what was measured on this converter, "
    "as its owner declares nothing; this is no pass.",
    INFORMATIVE: "Informative: measured but judged by no limit; it counts for nothing.",
}
#: of the table of a part, after number and verdict
HEADS = ("clause", "signal", "window", "measured", "limit", "in words", "source", "known")


def row(v: Verdict) -> list[str]:
    """What a report says of a clause, under ``HEADS``."""
    measured = "–" if v.value is None else f"{shown(v.value)} {v.unit}".rstrip()
    window = f"{v.start:g} … {v.stop:g} s" if v.stop > v.start else "–"
    signal = symbol_of(v.signal) or "–"
    known = KNOWN.get(v.known, "–")
    return [v.clause, signal, window, measured, v.limit or "–", v.text, v.source or "–", known]


def saturation(v: Verdict) -> str:
    """The limiters that act in the window of a clause, and in which part of it; empty if none."""
    return ", ".join(
        f"{name} {100 * part:.0f} %" if part >= 0.01 else f"{name} under 1 %"
        for name, part in v.saturated.items()
    )


def explain_counts(found: Conformity, law: str) -> str:
    """What the table of counts of the first page means."""
    counts = Counter[str]()
    for of in found.counts(law).values():
        counts.update(of)
    terms = " ".join(text for verdict, text in _MEANINGS.items() if counts[verdict])
    about = (
        "These verdicts are about what was recorded, by the bases and units of its map."
        if law in found.recordings
        else "These verdicts are about this model, not about a product."
    )
    return (
        f"Clauses, each as often as it is judged. {found.saturated(law)} of them are judged while "
        "a limiter of the controller acts: the tables mark them with the limiter and the part of "
        f"the window in which it does. {terms} The verdict of a test, and of the law, is the first "
        "of fail, cannot judge, limited, consistent with itself and pass that one of its clauses "
        f"has. {about} Check each limit against the source before you rely on it."
    )


def tally(found: Conformity, law: str) -> list[list[str]]:
    """The table of counts of the first page: a head, a row for each way to know a source, a sum."""
    counts = found.counts(law)
    verdicts = [*dict.fromkeys([*SIGNS, *(v for of in counts.values() for v in of)])]
    ways = [known for known in KNOWN if known in counts]
    rows = [[KNOWN[known], *(str(counts[known][v]) for v in verdicts)] for known in ways]
    every = Counter[str]()
    for of in counts.values():
        every.update(of)
    return [["limit is known", *verdicts], *rows, ["all", *(str(every[v]) for v in verdicts)]]
