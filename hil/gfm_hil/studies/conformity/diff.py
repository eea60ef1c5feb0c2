"""What changed between two reports of the same tests: verdicts, measured values, what came or went.

A clause is found again by law, test, part, its words and its kind, and where a part asks the same
several times, by its turn. If each report has one law, these two are compared whatever they are
called, so that a changed law may have another name or path.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.files import read_file
from gfm_hil.results.page import render
from gfm_hil.results.table import shown
from gfm_hil.studies.conformity.verdict import FAIL, PASS, SIGNS, Outcome
from gfm_runtime.errors import printable

Change = Literal["worse", "better", "gone", "new", "moved"]

SHARE = 0.05
_MOST = 64 << 20  # bytes of results.json: hundreds of laws
_SMALL = 1e-3  # in the unit of a value: what moves by less has not moved
_RANK = {**dict.fromkeys(SIGNS, 1), PASS: 0, FAIL: 2}
_ORDER: tuple[Change, ...] = ("worse", "gone", "moved", "better", "new")


class _Read(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True)


class ClauseResult(_Read):
    """What results.json says of a clause; a part without clauses is one without words."""

    clause: str  # clause, kind: its words and its criterion
    kind: str
    verdict: Outcome
    value: float | None  # measured, in ``unit``, or None
    unit: str  # of the value
    text: str  # one sentence


class _Part(_Read):
    part: str
    verdict: Outcome
    reason: str
    clauses: list[ClauseResult]


class _Test(_Read):
    verdict: Outcome
    parts: list[_Part]


class Results(_Read):
    """What results.json holds, as far as it is compared."""

    version: str  # of gfmhil
    inner: str | None  # stage of every law, or None
    under_test: dict[str, Any]  # the converter under test
    laws: dict[str, dict[str, _Test]]  # tests by law and id


@dataclass(frozen=True)
class ChangedClause:
    """A clause that is not what it was."""

    # worse or better: of its verdict; moved: its value; new, gone: in one report only
    change: Change
    law: str  # law, test, part: where it is
    test: str
    part: str
    old: ClauseResult | None  # old, new: what the reports say; None where it is missing
    new: ClauseResult | None
    counts: bool  # whether the new report is worse for it

    @property
    def clause(self) -> ClauseResult:
        """What is there now, or was."""
        found = self.new or self.old
        assert found is not None
        return found

    @property
    def value(self) -> str:
        """The measured values, ``old → new``."""
        each = [x and x.value is not None and f"{shown(x.value)} {x.unit}".rstrip()
                for x in (self.old, self.new)]  # fmt: skip
        return " → ".join(dict.fromkeys(x or "–" for x in each))

    @property
    def verdict(self) -> str:
        """The verdicts, ``old → new``."""
        return " → ".join(dict.fromkeys(x.verdict if x else "–" for x in (self.old, self.new)))


@dataclass(frozen=True)
class ReportDiff:
    """Two reports beside each other."""

    rows: list[ChangedClause]  # what changed, the worst first
    notes: list[str]  # what differs in how the reports were made, one sentence each
    same: int  # how many clauses are what they were
    share: float  # by which part of the larger a value had to move

    @property
    def worse(self) -> bool:
        """Whether a verdict got worse, or a clause that passed is gone."""
        return any(row.counts for row in self.rows)

    @property
    def words(self) -> str:
        """How many clauses changed in which way."""
        count = Counter(row.change for row in self.rows)
        told = [f"{count[change]} {change}" for change in _ORDER if change in count]
        return ", ".join([*told, f"{self.same} as before"])

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {"worse": self.worse, **TypeAdapter(ReportDiff).dump_python(self)}

    def page(self, old: str, new: str) -> str:
        """As an HTML page; the arguments are the reports' names."""
        return render(
            "conformity_diff.html", title="Conformity: what changed", old=old, new=new, diff=self
        )


def read_results(path: str | Path) -> Results:
    """A report's results.json, or that in a report's folder. Raises UserError: it cannot be read,
    or is no results.json."""
    file = Path(path)
    file = file / "results.json" if file.is_dir() else file
    try:
        return Results.model_validate_json(read_file(file, _MOST))
    except OSError as problem:
        raise UserError(f"{file}: {problem.strerror}") from None
    except ValidationError as problem:
        told = lines(problem, Results)[0]
        raise UserError(
            printable(f"{file}: is no results.json of gfmhil conform: {told}")
        ) from None


def compare_results(old: Results, new: Results, share: float = SHARE) -> ReportDiff:
    """Lay two reports beside each other. A value has moved if it changed by more than the share of
    the larger of both, and by more than 1e-3 in its unit. Raises UserError: the share is not in
    [0, 1)."""
    if not 0.0 <= share < 1.0:
        raise UserError(f"share = {share:g}: must lie in [0, 1)")
    tests_old, tests_new = _tests(old), _tests(new)
    if len(old.laws) == len(new.laws) == 1:
        (law,) = new.laws
        tests_old = {(law, test): found for (_, test), found in tests_old.items()}
    rows, same = [], 0
    for at in {**tests_old, **tests_new}:
        a, b = tests_old.get(at), tests_new.get(at)
        if a is None or b is None:  # a test that one report has not is one row
            there = a or b
            assert there is not None
            proven = any(c.verdict == PASS for part in there.parts for c in part.clauses)
            whole = _bare(there.verdict, "")
            if a is None:
                rows.append(ChangedClause("new", *at, "", None, whole, False))
            else:
                rows.append(ChangedClause("gone", *at, "", whole, None, proven))
            continue
        before, after = _clauses(a), _clauses(b)
        for key in {**before, **after}:
            one, other = before.get(key), after.get(key)
            found = _change(one, other, share)
            if found is None:
                same += 1
                continue
            counts = found == "worse" or (one is not None and other is None and one.verdict == PASS)
            rows.append(ChangedClause(found, *at, key[0], one, other, counts))
    rows.sort(key=lambda row: (not row.counts, _ORDER.index(row.change)))
    return ReportDiff(rows, list(_notes(old, new)), same, share)


def _tests(of: Results) -> dict[tuple[str, str], _Test]:
    return {(law, test): found for law, tests in of.laws.items() for test, found in tests.items()}


def _clauses(of: _Test) -> dict[tuple[str, str, str, int], ClauseResult]:
    """The clauses by part, words, kind and turn."""
    found = {}
    for part in of.parts:
        turn: Counter[tuple[str, str]] = Counter()
        for clause in part.clauses or [_bare(part.verdict, part.reason)]:
            what = clause.clause, clause.kind
            found[(part.part, *what, turn[what])] = clause
            turn[what] += 1
    return found


def _bare(verdict: Outcome, text: str) -> ClauseResult:
    return ClauseResult(clause="", kind="", verdict=verdict, value=None, unit="", text=text)


def _change(old: ClauseResult | None, new: ClauseResult | None, share: float) -> Change | None:
    if old is None or new is None:
        return "new" if old is None else "gone"
    if _RANK[old.verdict] != _RANK[new.verdict]:
        return "worse" if _RANK[new.verdict] > _RANK[old.verdict] else "better"
    if old.value is None or new.value is None:
        return None if old.value is new.value else "moved"
    moved = abs(new.value - old.value)
    return "moved" if moved > max(share * max(abs(old.value), abs(new.value)), _SMALL) else None


def _notes(old: Results, new: Results) -> Iterator[str]:
    if old.version != new.version:
        yield f"gfmhil was {old.version} and is {new.version}."
    if old.inner != new.inner:
        was, now = (x or "each law's own" for x in (old.inner, new.inner))
        yield f"The inner stage was {was} and is {now}."
    if old.under_test != new.under_test:
        yield "The converter under test is another one."
    if len(old.laws) == len(new.laws) == 1 and [*old.laws] != [*new.laws]:
        yield f"The law was {next(iter(old.laws))} and is {next(iter(new.laws))}."
