"""Sets of conformity tests as data: what a test file says, finding and checking them, and the
scenarios of their parts.

A test is one TOML file: its source, the run, and what is asked clause by clause. Its runs are
scenarios in the scenario's own language, without a law; a test may have several parts, each of
which changes some of the scenario and is a run of its own.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.schema import StrictSchema, read_model, validate
from gfm_hil.scenario import SCENARIO_FOLDERS, Scenario, check_scenario, toml_text
from gfm_hil.studies.conformity.criteria import Criterion
from gfm_hil.studies.conformity.criteria.base import KNOWN, Clause, Publication, UnderTest
from gfm_hil.studies.conformity.criteria.plot import Plot
from gfm_plant import ConverterParameters, load_converter
from gfm_runtime.errors import allowed, printable

ALL = "all"
#: what a test may set of a converter's plant: its grid, and in a network its line to the bus
_OF_A_TEST = ("grid", "factors.L_g", "factors.R_g")
_FOLDER, _UNDER_TEST = "conformity", "converter.toml"
_LIMIT = ("test", "clause", "criterion", "limit", "source", "known")  # of an entry of the list


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
        description="the run: keys of a scenario file except title, law, inner, link and mode"
    )
    replaces: list[str] = Field(
        [],
        description="keys of the plant, such as lcl, that the clause of the source demands other "
        "than the converter under test has them",
    )
    criteria: list[Criterion] = Field([], description="what is asked of every part")
    parts: list[TestPart] = Field([], description="runs of the test; one if none")

    def runs(self) -> list[TestPart]:
        """The parts, or the only run as a part without a name."""
        return self.parts or [TestPart.model_construct(name="", title="", cannot=None)]

    def clauses(self, part: TestPart) -> list[Clause]:
        """All that is asked of a part, each with its source."""
        return [c.of(self.source) for c in (*self.criteria, *part.criteria)]

    @model_validator(mode="after")
    def _fits_together(self) -> Test:
        names = [part.name for part in self.parts]
        if len(set(names)) < len(names):
            raise ValueError(f"parts: names {names}: each once")
        for part in self.runs():
            asked = self.clauses(part)
            plot = next((c.kind for c in asked if isinstance(c, Plot)), None)
            if plot is not None and len(asked) > 1:
                raise ValueError(f"parts {part.name!r}: {plot}: must be its only criterion")
            if part.cannot is None and not asked:
                raise ValueError(f"parts {part.name!r}: no criterion; give some to it or the test")
        own = sorted({"title", "law", "inner", "link", "mode"} & {*self.scenario})
        if own:
            raise ValueError(f"scenario.{own[0]}: is not the test's to set")
        return self


@dataclass(frozen=True)
class Case:
    """A test with where it is from."""

    id: str  # set and name, e.g. ``miso/3-phase-jump``
    path: Path  # of its file
    test: Test


def shipped_sets() -> dict[str, Path]:
    """Folders of the shipped sets by name."""
    found: dict[str, Path] = {}
    for root in SCENARIO_FOLDERS:
        folder = root / _FOLDER
        for path in sorted(folder.iterdir()) if folder.is_dir() else []:
            if path.is_dir():
                found[path.name] = path
    return found


def load_cases(names: Sequence[str]) -> list[Case]:
    """The tests of sets, in order, each once. Names are those of shipped sets, ``all`` of them,
    shipped tests such as ``miso/2-rocof``, folders of test files, or test files. Raises UserError:
    one line per mistake."""
    shipped, found = shipped_sets(), dict[Path, Case]()
    for name in names:
        for chosen in shipped if name == ALL else [name]:
            for path in _files(chosen, shipped):
                found.setdefault(path, _load_case(path))
    return list(found.values())


def _files(name: str, shipped: Mapping[str, Path]) -> list[Path]:
    folder = shipped.get(name, Path(name))
    chosen, _, test = name.partition("/")
    if chosen in shipped and test:
        one = shipped[chosen] / f"{test.removesuffix('.toml')}.toml"
        folder = one if one.is_file() else folder
    if folder.is_file():
        return [folder]
    files = sorted(folder.glob("*.toml")) if folder.is_dir() else []
    if not files:
        known = [ALL, *shipped]
        raise UserError(
            printable(
                f"--against {name}: "
                + allowed(name, known, more=", a test such as miso/2-rocof, or a path of tests")
            )
        )
    return files


def _load_case(path: Path) -> Case:
    test = read_model(path, Test)
    case = Case(f"{path.resolve().parent.name}/{path.stem}", path, test)
    for part in test.runs():
        if part.cannot is None:
            content = content_of(case, part, {})
            validate(path, Scenario, content, "scenario.")
            wrong = _mistakes(test, part, content)
            if wrong:
                raise UserError("\n".join(printable(f"{path}: {line}") for line in wrong))
    return case


def _mistakes(test: Test, part: TestPart, content: Mapping[str, Any]) -> list[str]:
    """What does not fit together in a part, one line each."""
    found = []
    members = [*(content.get("network") or {}).get("converters", {})]
    for key, names in (("ratings", [*test.ratings]), ("judged", [test.judged or ""])):
        found += [
            f"{key}: {name!r}: must be one of {members}"
            for name in names
            if name and name not in members
        ]
    for where, plant in _plants(content):
        found += [
            f"{where}.{key}: belongs to the converter under test; a test sets "
            f"{', '.join(_OF_A_TEST)} of a plant, or what it names in replaces"
            for key in _keys(plant)
            if key not in (*_OF_A_TEST, *test.replaces)
            and key.partition(".")[0] not in test.replaces
        ]
    duration = content["duration"]
    for c in test.clauses(part):
        window = getattr(c, "window", None) or (0.0, 0.0)
        for at in c.at or []:
            if not 0 < at + window[1] <= duration or at >= duration:
                found.append(
                    f"criteria: {c.kind}: at = {at:g}, window to {window[1]:g}: must lie in the "
                    f"run, which ends at {duration:g} s"
                )
    return found


def _plants(content: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Each table of a plant that a part has, and where."""
    members = (content.get("network") or {}).get("converters", {})
    each = [(f"scenario.network.converters.{name}.plant", one) for name, one in members.items()]
    return [("scenario.plant", content["plant"]), *((w, one.get("plant", {})) for w, one in each)]


def _keys(plant: Mapping[str, Any]) -> list[str]:
    """The keys of a plant; those of its factors one by one, and its place in a network aside."""
    factors = [f"factors.{name}" for name in plant.get("factors", {})]
    return [*(key for key in plant if key not in ("factors", "node")), *factors]


def all_limits(cases: Sequence[Case]) -> list[dict[str, str]]:
    """One entry a limit of tests, each once a test: what it asks, where that is from and how it is
    known."""
    found = dict[tuple[str, ...], None]()
    for case in cases:
        for part in case.test.runs():
            for c in case.test.clauses(part):
                assert c.source is not None and c.known is not None
                found[case.id, c.clause, c.kind, c.limits() or "–", c.source.words(), c.known] = (
                    None
                )
    return [dict(zip(_LIMIT, row, strict=True)) for row in found]


def count_limits(limits: Sequence[Mapping[str, str]]) -> str:
    """How many limits there are, and how many are known in which way, in one line."""
    ways = Counter(row["known"] for row in limits)
    told = ", ".join(f"{ways[known]} {known}" for known in KNOWN if known in ways)
    return f"{len(limits)} limits: {told}."


def under_test_file(given: str | Path | None) -> Path:
    """The file of the converter under test; the shipped one if None."""
    if given is not None:
        return Path(given)
    shipped = [root / _FOLDER / _UNDER_TEST for root in SCENARIO_FOLDERS]
    return next(path for path in shipped if path.is_file())


def load_under_test(given: str | Path | None) -> UnderTest:
    """The converter under test, of a file; the shipped one if None. Raises UserError: one line per
    mistake."""
    path = under_test_file(given)
    under = read_model(path, UnderTest)
    beside = path.parent / under.plant.converter
    if under.plant.converter.endswith(".toml") and beside.is_file():
        plant = under.plant.model_copy(update={"converter": str(beside.resolve())})
        under = under.model_copy(update={"plant": plant})
    try:
        load_converter(under.plant.converter)
    except (OSError, ValueError) as problem:
        raise UserError(f"{path}: plant.converter = {under.plant.converter!r}: {problem}") from None
    return under


def scenario_of(
    case: Case, part: TestPart, under: UnderTest, law: str, inner: str | None, converters: Path
) -> Scenario:
    """The scenario of a part, checked, under a law and inner stage of every converter; the folder
    is for the files of converters of another frequency or rating. Raises UserError: it cannot be
    run; one line a mistake."""
    test = case.test
    plant = under.plant.model_dump(mode="json", exclude_unset=True)
    content = content_of(case, part, plant)
    given = str(plant.get("converter", under.plant.converter))
    content["plant"]["converter"] = converter_at(given, test.f_n, 1.0, converters)
    members = content.get("network", {}).get("converters", {})
    for name, member in members.items():
        own = _merge({k: v for k, v in content["plant"].items() if k != "grid"},
                      member.get("plant", {}))  # fmt: skip
        own["converter"] = converter_at(given, test.f_n, test.ratings.get(name, 1.0), converters)
        member["plant"] = own
    content |= {"law": law} | ({} if inner is None else {"inner": inner})
    return check_scenario(content, str(case.path))


def content_of(case: Case, part: TestPart, plant: dict[str, Any]) -> dict[str, Any]:
    """The scenario of a part as plain data, without a law."""
    base = _merge({"plant": plant, "link": {"type": "inproc"}}, case.test.scenario)
    content = _merge(base, part.scenario)
    words = part.title or part.name
    content["title"] = f"{case.test.title}: {words}" if words else case.test.title
    return content


def _merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Tables merged key by key; anything else is replaced. Both stay as they are."""
    made = {k: _merge(v, {}) if isinstance(v, dict) else v for k, v in base.items()}
    for key, value in over.items():
        before = made.get(key)
        if isinstance(value, dict):
            made[key] = _merge(before if isinstance(before, dict) else {}, value)
        else:
            made[key] = value
    return made


def converter_at(given: str, f_n: float, rating: float, folder: Path) -> str:
    """A converter at a nominal frequency and rating: itself, or a file in the folder."""
    nominal = load_converter(given)
    f_own = nominal.omega_n / (2 * math.pi)
    if math.isclose(f_own, f_n, rel_tol=1e-9) and rating == 1.0:
        return given
    made = to_base(nominal, f_n, rating)
    share = "" if rating == 1.0 else f"-{rating:g}"
    path = folder / f"{Path(given).stem}-{f_n:g}hz{share}.toml"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_text(path, toml_text(made.model_dump()))
    return str(path.absolute())


def to_base(nominal: ConverterParameters, f_n: float, rating: float) -> ConverterParameters:
    """The same converter for another nominal frequency, Hz, and another rating over its own: its
    elements have the same per-unit values, and its DC link stores as much for its rating."""
    slower = nominal.omega_n / (2 * math.pi * f_n)
    factors = {
        "L_f": slower / rating, "L_g": slower / rating, "R_f": 1 / rating, "R_g": 1 / rating,
        "C_f": slower * rating, "C_dc": rating,
    }  # fmt: skip
    elements = {name: getattr(nominal, name) * factor for name, factor in factors.items()}
    return nominal.model_copy(
        update={
            **elements,
            "S_n": nominal.S_n * rating,
            "omega_n": 2 * math.pi * f_n,
            "source": f"{nominal.source}; at {f_n:g} Hz and {rating:g} of the rating, with the "
            "same elements per unit",
        }
    )
