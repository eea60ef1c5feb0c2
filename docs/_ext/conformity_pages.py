"""The page on conformity: the shipped tests and their sources, and the keys of a test file."""

from __future__ import annotations

from _ext.scenario_pages import table

from gfm_hil.core.terminal import markdown
from gfm_hil.studies.conformity import sets
from gfm_hil.studies.conformity.criteria import BY_KIND
from gfm_hil.studies.conformity.criteria.base import KNOWN, Clause, Publication, UnderTest


def tests() -> str:
    """One row a test: what it asks, where that is from, and how the source is known."""
    rows = []
    for case in sets.load_cases(["all"]):
        test, runs = case.test, len(case.test.runs())
        asked = [c for part in test.runs() for c in test.clauses(part)]
        clauses = ", ".join(dict.fromkeys(c.clause for c in asked)) or "cannot be run yet"
        source = f"{test.source.words()}; {KNOWN[test.source.known]}"
        rows.append((f"`{case.id}`", test.title, str(runs), f"{test.f_n:g}", clauses, source))
    heads = ("test", "what happens", "runs", "Hz", "asked", "source")
    return markdown(heads, [[cell.replace("|", "\\|") for cell in row] for row in rows])


def limits() -> str:
    """One row a limit: what it is, where it is from, and how it is known; and how many are known
    in which way."""
    rows = sets.all_limits(sets.load_cases(["all"]))
    cells = [[str(x).replace("|", "\\|") for x in row.values()] for row in rows]
    return f"{sets.count_limits(rows)}\n\n{markdown([*rows[0]], cells)}"


def keys() -> str:
    """The tables of a test file and of a converter under test."""
    tables = (
        ("top level", sets.Test),
        ("[source]", Publication),
        ("[[parts]]", sets.TestPart),
        ("the file of the converter under test", UnderTest),
    )
    return "\n".join(
        f"**{f'`{title}`' if title[0] == '[' else title}**\n\n{table(of)}\n" for title, of in tables
    )


def criteria() -> str:
    """One table a kind of criterion; ``clause`` and ``at`` are common to all."""
    common = (*Clause.model_fields, "window")
    text = []
    for name, kind in BY_KIND.items():
        words = " ".join((kind.__doc__ or "").split())
        own = [key for key in kind.model_fields if key not in common]
        text.append(f"**`{name}`** — {words}\n")
        text.append(table(kind, common) + "\n" if own else "")
    return "\n".join(text)
