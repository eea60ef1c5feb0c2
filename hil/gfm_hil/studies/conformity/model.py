"""A conformity test as data: its source, the run, and what is asked clause by clause.

A test is one TOML file. Its runs are scenarios in the scenario's own language, without a law; a
test may have several parts, each of which changes some of the scenario and is a run of its own.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from gfm_hil.core.schema import StrictSchema
from gfm_hil.studies.conformity.criteria import Criterion
from gfm_hil.studies.conformity.criteria.nfp import Nfp

Known = Literal["read", "summary", "memory", "own"]

#: how the source of a test is known, for people
KNOWN: dict[str, str] = {
    "read": "read",
    "summary": "from a summary; check the original",
    "memory": "from memory; check the original",
    "own": "our own choice",
}


class Publication(StrictSchema):
    """Where a test comes from."""

    document: str = Field(min_length=1, description="name of the document")
    clause: str = Field(min_length=1, description="section, table or test in it")
    revision: str = Field(min_length=1, description="revision or year")
    known: Known = Field(description="how its content is known to us")

    def words(self) -> str:
        """Document, clause and revision in one line."""
        return f"{self.document}, {self.clause}, {self.revision}"


class TestPart(StrictSchema):
    """One run of a test that has several."""

    __test__ = False  # none of pytest's

    name: str = Field(pattern=r"^[A-Za-z0-9.+-]+$", description="letters, digits, . + -")
    title: str = Field("", description="for people")
    scenario: dict[str, Any] = Field(
        {}, description="keys of the scenario that this part changes; a list is replaced"
    )
    criteria: list[Criterion] = Field([], description="besides those of the test")
    cannot: str | None = Field(
        None, description="why the bench cannot run this part; its clauses cannot be judged"
    )

    @model_validator(mode="after")
    def _asks_what_it_can(self) -> TestPart:
        if self.cannot is not None and (self.scenario or self.criteria):
            raise ValueError("cannot: such a part has neither scenario nor criteria")
        return self


class Test(StrictSchema):
    """The whole file."""

    __test__ = False  # none of pytest's

    title: str = Field(min_length=1, description="of tables and figures")
    description: str = Field("", description="what is done, and what of it is our choice")
    source: Publication = Field(description="where the test comes from")
    f_n: float = Field(ge=1, le=1000, description="nominal frequency, Hz; the converter follows it")
    ratings: dict[str, Annotated[float, Field(ge=1e-3, le=1e3)]] = Field(
        {}, description="in a network: rating of a converter over that under test"
    )
    judged: str | None = Field(
        None, description="in a network: the converter whose signals are judged"
    )
    scenario: dict[str, Any] = Field(
        description="the run: keys of a scenario file but for title, law, inner and link"
    )
    criteria: list[Criterion] = Field([], description="what is asked of every part")
    parts: list[TestPart] = Field([], description="runs of the test; one if none")

    def runs(self) -> list[TestPart]:
        """The parts, or the only run as a part without a name."""
        return self.parts or [TestPart.model_construct(name="", title="", cannot=None)]

    @model_validator(mode="after")
    def _fits_together(self) -> Test:
        names = [part.name for part in self.parts]
        if len(set(names)) < len(names):
            raise ValueError(f"parts: names {names}: each once")
        for part in self.runs():
            asked = [*self.criteria, *part.criteria]
            if any(isinstance(c, Nfp) for c in asked) and len(asked) > 1:
                raise ValueError(f"parts {part.name!r}: nfp: must be its only criterion")
            if part.cannot is None and not asked:
                raise ValueError(f"parts {part.name!r}: no criterion; give some to it or the test")
        own = sorted({"title", "law", "inner", "link", "mode"} & {*self.scenario})
        if own:
            raise ValueError(f"scenario.{own[0]}: is not the test's to set")
        return self
