"""Law files: a law element by element in TOML, with every number named and its source stated.

The catalogue (``gfm_runtime/laws/*.toml``) and a user's own laws pass through the same loader
and the same checks. ``docs/laws.md`` shows one line by line.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from gfm_runtime import elements
from gfm_runtime.counts import Counts, Measure, Modulate
from gfm_runtime.elements import Element
from gfm_runtime.error_maps import ERROR_MAPS, WITH_IMPEDANCE
from gfm_runtime.errors import LawError, Mistakes, allowed, meant
from gfm_runtime.expressions import evaluate, evaluated
from gfm_runtime.inner import Inner, InnerStage
from gfm_runtime.inner_file import named_inner
from gfm_runtime.law import BuiltLaw, Cell, HomeGrid, Limits, Parameter, cell_name
from gfm_runtime.mistakes import lines
from gfm_runtime.toml_file import Number, NumberOrName, TomlTable, parse_toml, read_text, read_toml


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


def _stage(value: Any) -> Any:
    return named_inner(value) if isinstance(value, str) else value


_MOST = 48  # order of a cell before its rows are put together: longer ones only cost time
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]


Polynomial = Annotated[list[Number], Field(min_length=1, max_length=13)]
Vector = Annotated[list[float], Field(max_length=12)]


class ElementSpec(TomlTable):
    """One factor: its type and its numbers (T, T_f in s)."""

    type: elements.Kind = Field(description="type of element")
    k: Number | None = Field(None, description="gain")
    k_i: Number | None = Field(None, description="integral gain, 1/s")
    T: Number | None = Field(None, description="time constant, s")
    xi: Number | None = Field(None, description="damping ratio of O")
    T_f: Number | None = Field(None, description="s; multiplies by 1/(T_f s + 1)")
    num: Polynomial | None = Field(
        None, description="of TF: numerator, coefficients in descending powers of s"
    )
    den: Polynomial | None = Field(None, description="of TF: denominator, likewise")
    A: Annotated[list[Vector], Field(max_length=12)] | None = Field(
        None, description="of SS: n rows of n numbers, 1/s"
    )
    B: Vector | None = Field(None, description="of SS: n numbers")
    C: Vector | None = Field(None, description="of SS: n numbers")
    D: float | None = Field(None, description="of SS: a number")
    terms: Annotated[list[Factors], Field(min_length=1, max_length=8)] | None = Field(
        None, description="of sum: elements, or lists of them for products"
    )


# the factors of one cell; a single one may stand without its list
Factors = Annotated[
    list[ElementSpec],
    BeforeValidator(_listed, json_schema_input_type=list[ElementSpec] | ElementSpec),
    Field(min_length=1, max_length=8),
]


class SeveralCells(TomlTable):
    """A state space over several cells, e.g. those of ``12x45``: rows 1 and 2, columns 4 and 5."""

    type: Literal["SS"] = Field(description="type of element")
    A: Annotated[list[Vector], Field(max_length=12)] = Field(description="n rows of n, 1/s")
    B: list[Vector] = Field(description="n rows, a number a column")
    C: list[Vector] = Field(description="a row of n numbers a row of cells")
    D: list[Vector] = Field(description="a row a row of cells, a number a column")

    def cells(self, key: str) -> dict[str, Any]:
        """The SS of each cell. Raises ValueError: rows and columns that are none, other shapes."""
        found = re.fullmatch("([123]+)x([12345]+)", key)
        if found is None or any(len({*part}) < len(part) for part in found.groups()):
            raise ValueError(f"{key}: must be rows x columns, each once, e.g. 12x45")
        rows, columns = found.groups()
        n, shape = len(self.A), (len(rows), len(columns))
        for name, height, width in (("B", n, shape[1]), ("C", shape[0], n), ("D", *shape)):
            if [len(row) for row in getattr(self, name)] != [width] * height:
                raise ValueError(f"{key}.{name}: must be {height} x {width}, as A is {n} x {n}")
        return {
            i + j: {"type": "SS", "A": self.A, "B": [row[b] for row in self.B],
                    "C": self.C[a], "D": self.D[a][b]}
            for a, i in enumerate(rows) for b, j in enumerate(columns)
        }  # fmt: skip


def _by_cells(value: Any) -> Any:
    """The tables phi and psi, with a state space over several cells as one a cell."""
    if not isinstance(value, dict):
        return value
    single = {key: spec for key, spec in value.items() if not re.fullmatch(r"\d+x\d+", key)}
    for key in value.keys() - single:
        try:
            cells = SeveralCells.model_validate(value[key]).cells(key)
        except ValidationError as problem:
            raise ValueError(f"{key}: {'; '.join(lines(problem, SeveralCells))}") from None
        if twice := single.keys() & cells:
            raise ValueError(f"{key}: has cell {min(twice)}, which stands beside it")
        single |= cells
    return single


Cells = Annotated[
    dict[str, Factors],
    BeforeValidator(_by_cells, json_schema_input_type=dict[str, Factors | SeveralCells]),
]


def _valued(value: Any) -> Any:
    bare = isinstance(value, int | float) and not isinstance(value, bool)
    return {"value": value} if bare else value


# a number alone may stand for the table
Named = Annotated[Parameter, BeforeValidator(_valued, json_schema_input_type=Parameter | float)]


class ErrorMap(TomlTable):
    """The errors on which Phi(s) acts; R and X (p.u.) of the line where the map needs them."""

    type: str = Field("linear", description=", ".join(ERROR_MAPS))
    R: Number | None = Field(None, description=f"line's, p.u.; {', '.join(WITH_IMPEDANCE)} only")
    X: Number | None = Field(None, description=f"line's, p.u.; {', '.join(WITH_IMPEDANCE)} only")


class SetPoints(TomlTable):
    """u_0: numbers (p.u.) or names of references."""

    i_u: NumberOrName = Field(0.0, description="p.u., or the name of a reference")
    omega_u: NumberOrName = Field(1.0, description="p.u., or the name of a reference")
    E_u: NumberOrName = Field("V_ref", description="p.u., or the name of a reference")


class SchedulePoint(TomlTable):
    """Gains of a schedule, in force up to the reactance X or the voltage V (p.u.)."""

    X: float | None = Field(
        None, gt=0, description="up to which reactance, p.u.; the last one has no end"
    )
    V: float | None = Field(
        None,
        gt=0,
        description="up to which voltage V, p.u., in place of X; the last one has no end",
    )
    parameters: dict[str, float] = Field(
        default_factory=dict, description="values that differ from [parameters]"
    )

    @property
    def end(self) -> float:
        """``X`` or ``V``, p.u."""
        return self.V or self.X or 0.0


class Schedule(TomlTable):
    """Gains as a function of the estimated grid reactance, or of the voltage V that is measured."""

    stages: Annotated[list[SchedulePoint], Field(min_length=2, max_length=8)] = Field(
        description="two to eight"
    )
    hysteresis: float = Field(0.15, ge=0, lt=1, description="relative, on every boundary")
    dwell_s: float = Field(
        0.5,
        ge=0,
        description="least time between two changes, s; V takes a lower stage at once, a higher "
        "one after this time above its end",
    )
    X_0: float | None = Field(None, gt=0, description="estimate to start from, p.u.; with X alone")
    X_f: float = Field(
        0.0,
        ge=0,
        description="reactance of the converter's own filter, taken off the estimate, p.u.",
    )

    @model_validator(mode="after")
    def _one_quantity(self) -> Self:
        by_V = self.stages[0].V is not None
        if any((one.V is not None) != by_V or (one.X is None) != by_V for one in self.stages):
            raise ValueError("stages: each needs X, or each needs V")
        if by_V == (self.X_0 is not None):
            raise ValueError("X_0: goes with stages of X, which need it")
        return self

    @property
    def by_V(self) -> bool:
        """Whether V chooses the stage; else the reactance."""
        return self.stages[0].V is not None

    @property
    def in_order(self) -> list[SchedulePoint]:
        """The stages by their ends, the least first."""
        return sorted(self.stages, key=lambda one: one.end)

    @property
    def ends(self) -> list[float]:
        """Up to which reactance or voltage each stage is in force, p.u., in ascending order."""
        return [one.end for one in self.in_order]

    @property
    def start(self) -> int:
        """The stage that is in force at the start, at ``X_0`` or at nominal voltage."""
        return bisect_left(self.ends[:-1], self.X_0 or 1.0)


def _base_or_whole(schema: dict[str, Any]) -> None:
    """A file with a base may leave out what the base has."""
    whole = {"required": schema.pop("required")}
    schema |= {"if": {"required": ["base"]}, "then": {"required": ["name"]}, "else": whole}


class LawFile(TomlTable):
    """The whole file; ``parse_law`` has put the content of its ``base`` into it."""

    @model_validator(mode="after")
    def _both_or_neither(self) -> LawFile:
        if (self.measure is None) != (self.modulate is None):
            lacks = "measure" if self.measure is None else "modulate"
            raise ValueError(f"{lacks}: missing; [measure] and [modulate] go together")
        return self

    @property
    def counts(self) -> Counts | None:
        """Both of them, if it has them."""
        if self.measure is None or self.modulate is None:
            return None
        return Counts(measure=self.measure, modulate=self.modulate)

    def behind(self, inner: str | None) -> LawFile:
        """The same with another inner stage: a shipped name, a file, ``none``, or None for its own.
        A law without the rows of omega_u and E_u keeps its own in place of one that needs them.
        Raises LawError: no such stage, or a mistake in its file."""
        if inner is None:
            return self
        stage, own, every = named_inner(inner), self.inner, InnerStage.rows
        needs = every if stage is None else stage.rows
        if own is not None and own.rows != every and needs == every:
            return self
        return self.model_copy(update={"inner": stage})

    model_config = ConfigDict(json_schema_extra=_base_or_whole)

    base: str | None = Field(
        None,
        description="a law of the catalogue, or a .toml file beside this one, that this file "
        "changes, key by key; a table with a type replaces the whole other one",
    )
    name: str = Field(
        pattern=r"^[a-z0-9][a-z0-9_.-]*$", description="lower case letters, digits, _, . and -"
    )
    title: str = Field(description="for people")
    source: str = Field(description="where the law and its numbers come from")
    error_map: ErrorMap = Field(ErrorMap(), description="what Φ acts on")
    u_0: SetPoints = Field(SetPoints(), description="set-points of u")
    parameters: dict[Name, Named] = Field(
        default_factory=dict, description="named numbers for the expressions"
    )
    phi: Cells = Field(
        description="elements by cell, ij = row and column of the matrix; 12x45: an SS of several"
    )
    psi: Cells = Field(
        default_factory=dict,
        description="the terms in braces of Table II, by cell: on the feedback only",
    )
    limits: Limits = Field(Limits(), description="clamps of u, anti-windup")
    home_grid: HomeGrid = Field(HomeGrid(), description="where the defaults are meant to be used")
    measure: Measure | None = Field(
        None, description="from counts of an A/D to y; goes with modulate"
    )
    modulate: Modulate | None = Field(
        None, description="from u to compare counts; goes with measure"
    )
    inner: Annotated[
        Inner | None, BeforeValidator(_stage, json_schema_input_type=Inner | str | None)
    ] = Field(
        None,
        description="the inner stage between the law and the bridge: a table, or the name of a "
        "shipped one or of a file; none if not given",
    )
    schedule: Schedule | None = Field(
        None, description="gains by the estimated grid reactance or by V; fixed gains if none"
    )


def element_of(
    where: str, specs: Sequence[ElementSpec], parameters: Mapping[str, Any]
) -> tuple[Element, Any]:
    """The product of the factors of a cell, its expressions evaluated, and whether it is usable.

    The parameters may be arrays of N numbers: the product holds N elements then, of which each is
    usable or not.

    Raises:
        LawError: naming ``where``: an expression or an element is wrong.
    """

    def valued(name: str, value: Any) -> Any:
        if isinstance(value, list):
            return tuple(valued(name, one) for one in value)
        return evaluate(f"{where}.{name}", value, parameters)

    product, good = elements.P(1.0), True
    for spec in specs:
        own = spec.model_dump(exclude={"type", "terms"}, exclude_none=True)
        if spec.type == "sum":
            if own or spec.terms is None:
                raise LawError(where, f"sum takes ['terms'] alone, not {sorted(own)}")
            factor, fine = elements.ZERO, True
            for term in spec.terms:
                one, usable = element_of(where, term, parameters)
                factor, fine = factor + one, fine & usable
        elif spec.terms is not None:
            raise LawError(where, f"terms belongs to sum, not to {spec.type}")
        else:
            numbers = {name: valued(name, value) for name, value in own.items()}
            factor = elements.make(where, spec.type, numbers)
            fine = elements.usable(numbers)
        product, good = product * factor, good & fine
        if product.order > _MOST:
            raise LawError(where, f"its order is above {_MOST}; a whole law has at most 12 states")
    return product, good


def _cells(
    matrix: str,
    specs: Mapping[str, list[ElementSpec]],
    numbers: Mapping[str, float],
    mistakes: Mistakes,
) -> dict[Cell, Element]:
    cells: dict[Cell, Element] = {}
    for key, spec in specs.items():
        with mistakes.noting():
            if len(key) != 2 or key[0] not in "123" or key[1] not in "12345":
                raise LawError(f"{matrix}.{key}", "a cell is row 1..3 and column 1..5, e.g. 22")
            cell = (int(key[0]) - 1, int(key[1]) - 1)
            cells[cell], _ = element_of(cell_name(matrix, cell), spec, numbers)
    return cells


def _error_map(file: LawFile, numbers: Mapping[str, float]) -> tuple[str, tuple[float, ...]]:
    """The name of the error map and its (R, X) in p.u., if it has any."""
    code = file.error_map.type
    if code not in ERROR_MAPS:
        known = f"use one of {sorted(ERROR_MAPS)}{meant(code, ERROR_MAPS)}"
        raise LawError("error_map.type", f"{code!r} is unknown; {known}")
    impedance = (file.error_map.R, file.error_map.X)
    needs = code in WITH_IMPEDANCE
    if needs != (None not in impedance) or (not needs and impedance != (None, None)):
        raise LawError("error_map", f"R and X belong to {WITH_IMPEDANCE}, which need both")
    values = tuple(
        evaluate(f"error_map.{n}", v, numbers)
        for n, v in zip("RX", impedance, strict=True)
        if v is not None
    )
    if needs and not (values[0] >= 0.0 and values[1] > 0.0):
        raise LawError("error_map", f"R, X = {values} p.u. must be R >= 0 and X > 0")
    return code, values


def build_law(file: LawFile, changed: Mapping[str, float] | None = None) -> BuiltLaw:
    """The law of a file, with other values for some of its parameters if given.

    Raises:
        LawError: every invalid element, parameter, set-point and limit, one line each.
    """
    numbers = {name: spec.value for name, spec in file.parameters.items()}
    for name, value in (changed or {}).items():
        if name not in numbers:
            known = allowed(name, sorted(numbers), "known:")
            raise LawError(f"parameter {name}", f"unknown to {file.name}; {known}")
        numbers[name] = value
    parameters = {
        name: one.model_copy(update={"value": numbers[name]})
        for name, one in file.parameters.items()
    }
    mistakes = Mistakes()
    code, error_parameters = "linear", tuple[float, ...]()
    with mistakes.noting():
        code, error_parameters = _error_map(file, numbers)
    phi, psi = (
        _cells(name, cells, numbers, mistakes)
        for name, cells in (("phi", file.phi), ("psi", file.psi))
    )
    inner = None
    with mistakes.noting():
        inner = None if file.inner is None else evaluated("inner", file.inner, numbers)
    law = None
    with mistakes.noting():  # from the valid parts: BuiltLaw finds further mistakes
        law = BuiltLaw(
            name=file.name,
            title=file.title,
            source=file.source,
            phi=phi,
            psi=psi,
            u_0=(file.u_0.i_u, file.u_0.omega_u, file.u_0.E_u),
            error_map=code,
            error_parameters=error_parameters,
            limits=file.limits,
            parameters=parameters,
            home_grid=file.home_grid,
            inner=inner,
            counts=file.counts,
        )
    mistakes.check()
    assert law is not None
    return law


def tied(file: LawFile, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` and all parameters that the file ties to others, e.g. k_35 = k_34 / D_q."""
    numbers = {n: p.value for n, p in file.parameters.items()} | dict(values)
    out = dict(values)
    for name, p in file.parameters.items():
        if p.tied is not None:
            out[name] = evaluate(f"parameters.{name}.tied", p.tied, numbers)
    return out


def shipped_law(name: str) -> str | None:
    """The text of a law that ships, whatever its group; None if no law has this name."""
    for group in ("", "tuned", "grid", "industry"):
        path = files("gfm_runtime").joinpath("laws", group, f"{name}.toml")
        if re.fullmatch("[a-z0-9-]{1,64}", name) and path.is_file():
            return path.read_text(encoding="utf-8")
    return None


def _with_base(content: dict[str, Any], folder: Path, seen: tuple[str, ...]) -> dict[str, Any]:
    """The content of a law file over that of its base, of the base's base, and so on.

    Raises:
        ValueError: one line: a base cannot be read, or the bases form a circle.
    """
    if "base" not in content:
        return content
    base = content["base"]
    if not isinstance(base, str):
        raise ValueError("base: must be a law's name or a .toml file, in quotes")
    if base in seen:
        raise ValueError(f"base: {' is based on '.join((*seen, base))}, a circle")
    if base.endswith(".toml"):
        try:
            below, folder = read_toml(folder / base), (folder / base).parent
        except ValueError as problem:
            raise ValueError(f"base: {base}: {problem}") from None
    elif (text := shipped_law(base)) is not None:
        below = parse_toml(text)
    else:
        raise ValueError(
            f"base: no law of the catalogue is named {base!r} (gfmhil laws lists them)"
        )
    below = _with_base(below, folder, (*seen, base))
    return _over(below, {key: value for key, value in content.items() if key != "base"})


def _over(below: dict[str, Any], content: dict[str, Any]) -> dict[str, Any]:
    """Merge tables key by key. A table with a ``type`` replaces the other one; a bare number
    replaces a parameter's value and clears its source."""
    merged = dict(below)
    for key, value in content.items():
        old = below.get(key)
        if isinstance(value, dict) and isinstance(old, dict) and "type" not in value:
            value = _over(old, value)
        elif isinstance(old, dict) and "value" in old:  # another number for a parameter
            value = {**old, "value": value, "source": ""}
        merged[key] = value
    return merged


def parse_law(text: str, where: str = "law file", folder: str | Path = ".") -> LawFile:
    """Parse the text of a law file.

    Args:
        text: TOML.
        where: what an error calls the file.
        folder: where a ``base`` that is a file lies.

    Raises:
        LawError: every mistake found, each with its path in the file.
    """
    content: Any = None
    try:
        content = _with_base(parse_toml(text), Path(folder), ())
        return LawFile.model_validate(content)
    except ValidationError as problem:
        raise LawError(where, *lines(problem, LawFile, content=content)) from None
    except ValueError as problem:
        raise LawError(where, str(problem)) from None


def read_law_file(path: str | Path) -> LawFile:
    """Read a law file; errors as ``parse_law``, and LawError for a file that cannot be read."""
    try:
        text = read_text(path)
    except ValueError as problem:
        raise LawError(f"law file {path}", str(problem)) from None
    return parse_law(text, f"law file {path}", Path(path).parent)
