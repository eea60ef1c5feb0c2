"""Law files: a law element by element in TOML, with every number named and its source stated.

The catalogue (``gfm_runtime/laws/*.toml``) and a user's own laws pass through the same loader
and the same checks. ``docs/law-files.md`` shows one line by line.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    ValidationError,
)
from pydantic_core import PydanticCustomError

from gfm_runtime import elements
from gfm_runtime.elements import Element
from gfm_runtime.error_maps import ERROR_MAPS, HYBRID_ANGLE
from gfm_runtime.errors import LawError
from gfm_runtime.expressions import evaluate
from gfm_runtime.law import Cell, HomeGrid, Law, Limits, Parameter, cell_name
from gfm_runtime.signals import U_NAMES
from gfm_runtime.toml_file import parse_toml, read_text


def _number(value: Any) -> float | str:
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):
            return float(value)
    raise PydanticCustomError("number", "must be a number or an expression over the parameters")


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, dict) else value


# a number or an expression over the law's parameters; one union would give two errors a mistake
Number = Annotated[float | str, PlainValidator(_number)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class ElementSpec(_Model):
    """One factor: its kind and its numbers (T, T_f in s)."""

    type: Literal["P", "I", "D", "PI", "PD", "IF", "O"]
    k: Number | None = None
    k_i: Number | None = None
    T: Number | None = None
    xi: Number | None = None
    T_f: Number | None = None


# the factors of one cell; a single one may stand without its list
Factors = Annotated[list[ElementSpec], BeforeValidator(_listed), Field(min_length=1, max_length=8)]


class ParameterSpec(_Model):
    """A named number; ``free`` bounds it for synthesis, ``tied`` makes it follow others there."""

    value: float
    unit: str
    source: str
    free: Range | None = None
    tied: str | None = None


class ErrorMapSpec(_Model):
    """The errors on which Phi(s) acts; R and X (p.u.) only for hybrid-angle."""

    type: str = "linear"
    R: Number | None = None
    X: Number | None = None


class SetPoints(_Model):
    """u_0: numbers (p.u.) or names of references."""

    i_u: Number = 0.0
    omega_u: Number = 1.0
    E_u: Number = "V_ref"


class LimitsSpec(_Model):
    """Clamps of u in p.u., times in s."""

    i_u: Range = Field(default_factory=lambda: [-5.0, 5.0])
    omega_u: Range = Field(default_factory=lambda: [0.9, 1.1])
    E_u: Range = Field(default_factory=lambda: [0.0, 1.5])
    T_t: float = 0.02
    T_off: float = 0.2


class GridSpec(_Model):
    """The grid the defaults are meant for, as factors on the converter's."""

    L_g: float = Field(1.0, gt=0)
    R_g: float = Field(1.0, ge=0)
    note: str = "the paper's grid"


class Stage(_Model):
    """One stage of a gain-scheduled law, in force up to the reactance X (p.u.)."""

    X: float = Field(gt=0)
    parameters: dict[str, float] = Field(default_factory=dict)


class Schedule(_Model):
    """Gains as a function of the estimated grid reactance."""

    stages: Annotated[list[Stage], Field(min_length=2, max_length=8)]
    hysteresis: float = Field(0.15, ge=0, lt=1)
    dwell_s: float = Field(0.5, ge=0)
    X_0: float = Field(gt=0)
    X_f: float = Field(0.0, ge=0)


class LawFile(_Model):
    """The whole file."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_.-]*$")
    title: str
    source: str
    error_map: ErrorMapSpec = ErrorMapSpec()
    u_0: SetPoints = SetPoints()
    parameters: dict[Name, ParameterSpec] = Field(default_factory=dict)
    phi: dict[str, Factors]
    psi: dict[str, Factors] = Field(default_factory=dict)
    limits: LimitsSpec = LimitsSpec()
    home_grid: GridSpec = GridSpec()
    schedule: Schedule | None = None


_SHOWN = 10
_NUMBERS = {
    "P": ({"k"}, {"k"}),
    "I": ({"T"}, {"k_i"}),
    "D": ({"T"}, {"T"}),
    "PI": ({"k", "T"}, {"k", "k_i"}),
    "PD": ({"k", "T"}, {"k", "T"}),
    "IF": ({"k", "T"}, {"k", "T"}),
    "O": ({"k", "T", "xi"}, {"k", "T", "xi"}),
}


def build_element(where: str, spec: ElementSpec, parameters: Mapping[str, float]) -> Element:
    """One factor with its numbers evaluated.

    Raises:
        LawError: naming the cell, the number and what is allowed.
    """
    given = {k: v for k, v in spec.model_dump(exclude={"type", "T_f"}).items() if v is not None}
    if set(given) not in _NUMBERS[spec.type]:
        forms = " or ".join(sorted({str(sorted(form)) for form in _NUMBERS[spec.type]}))
        raise LawError(where, f"{spec.type} takes {forms}, not {sorted(given)}")
    numbers = {k: evaluate(f"{where}.{k}", v, parameters) for k, v in given.items()}
    if "k_i" in numbers:  # k + k_i/s, the form the paper prints its gains in
        integral = _made(f"{where}.k_i", "P", k=numbers["k_i"]) * elements.I(1.0)
        element = _made(where, "P", k=numbers.get("k", 0.0)) + integral
    else:
        element = _made(where, spec.type, **numbers)
    if spec.T_f is not None:
        T_f = evaluate(f"{where}.T_f", spec.T_f, parameters)
        element = element * _made(f"{where}.T_f", "IF", k=1.0, T=T_f)
    return element


def _made(where: str, kind: str, **numbers: float) -> Element:
    try:
        made: Element = getattr(elements, kind)(**numbers)
    except LawError as problem:
        raise LawError(f"{where}, {kind}", problem.why) from None
    return made


def _cells(
    matrix: str, specs: Mapping[str, list[ElementSpec]], numbers: Mapping[str, float]
) -> dict[Cell, Element]:
    cells: dict[Cell, Element] = {}
    for key, spec in specs.items():
        if len(key) != 2 or key[0] not in "123" or key[1] not in "12345":
            raise LawError(f"{matrix}.{key}", "a cell is row 1..3 and column 1..5, e.g. 22")
        cell = (int(key[0]) - 1, int(key[1]) - 1)
        product = elements.P(1.0)
        for factor in spec:
            product = product * build_element(cell_name(matrix, cell), factor, numbers)
        cells[cell] = product
    return cells


def build_law(file: LawFile, changed: Mapping[str, float] | None = None) -> Law:
    """The law of a file, with other values for some of its parameters if given.

    Raises:
        LawError: an invalid element, parameter, set-point or limit, by its name.
    """
    numbers = {name: spec.value for name, spec in file.parameters.items()}
    for name, value in (changed or {}).items():
        if name not in numbers:
            raise LawError(f"parameter {name}", f"unknown to {file.name}; known: {sorted(numbers)}")
        numbers[name] = value
    code = file.error_map.type
    if code not in ERROR_MAPS:
        raise LawError("error_map.type", f"{code!r} is unknown; use one of {sorted(ERROR_MAPS)}")
    impedance = (file.error_map.R, file.error_map.X)
    needs = ERROR_MAPS[code] == HYBRID_ANGLE
    if needs != (None not in impedance) or (not needs and impedance != (None, None)):
        raise LawError("error_map", "R and X belong to hybrid-angle, which needs both")
    error_parameters = tuple(
        evaluate(f"error_map.{n}", v, numbers)
        for n, v in zip("RX", impedance, strict=True)
        if v is not None
    )
    if needs and not (error_parameters[0] >= 0.0 and error_parameters[1] > 0.0):
        raise LawError("error_map", f"R, X = {error_parameters} p.u. must be R >= 0 and X > 0")
    parameters = {
        name: Parameter(numbers[name], spec.unit, spec.source)
        for name, spec in file.parameters.items()
    }
    low, high = zip(*(getattr(file.limits, name) for name in U_NAMES), strict=True)
    return Law(
        name=file.name,
        title=file.title,
        source=file.source,
        phi=_cells("phi", file.phi, numbers),
        psi=_cells("psi", file.psi, numbers),
        u_0=(file.u_0.i_u, file.u_0.omega_u, file.u_0.E_u),
        error_map=code,
        error_parameters=error_parameters,
        limits=Limits(low, high, file.limits.T_t, file.limits.T_off),
        parameters=parameters,
        home_grid=HomeGrid(**file.home_grid.model_dump()),
    )


def parse_law(text: str, where: str = "law file") -> LawFile:
    """Parse the text of a law file.

    Raises:
        LawError: every mistake found, each with its path in the file.
    """
    try:
        return LawFile.model_validate(parse_toml(text))
    except ValidationError as problem:
        raise LawError(where, "; ".join(_lines(problem.errors()))) from None
    except ValueError as problem:
        raise LawError(where, str(problem)) from None


def read_law_file(path: str | Path) -> LawFile:
    """Read a law file; errors as ``parse_law``, and LawError for a file that cannot be read."""
    try:
        text = read_text(path)
    except ValueError as problem:
        raise LawError(f"law file {path}", str(problem)) from None
    return parse_law(text, f"law file {path}")


def _lines(errors: list[Any]) -> list[str]:
    """One part for each mistake, at most ``_SHOWN`` of them."""
    shown = [
        f"{'.'.join(map(str, e['loc']))}: {e['msg']} (got {e['input']!r:.200})"
        for e in errors[:_SHOWN]
    ]
    return shown + ([f"and {len(errors) - _SHOWN} more"] if len(errors) > _SHOWN else [])
