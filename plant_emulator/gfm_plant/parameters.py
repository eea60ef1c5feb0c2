"""Converter parameters: read from a TOML file in SI units, handed on in per unit."""

import errno
import stat
import tomllib
from collections.abc import Mapping
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from gfm_plant.bases import Bases

_MOST_BYTES = 1 << 20
LEAST, MOST = 1e-12, 1e12
"""Limits of any quantity, in SI units or p.u.; beyond them products overflow before the checks."""


def _not_tiny(value: float) -> float:
    if value < LEAST:
        raise ValueError(f"{value:g}: must be at least {LEAST:g}")
    return value


Positive = Annotated[float, Field(gt=0, le=MOST), AfterValidator(_not_tiny)]
NonNegative = Annotated[float, Field(ge=0, le=MOST)]

Element = Literal["L_f", "R_f", "C_f", "L_g", "R_g", "C_dc"]

ELEMENTS: dict[Element, str] = {
    "L_f": "L",
    "R_f": "R",
    "C_f": "C",
    "L_g": "L",
    "R_g": "R",
    "C_dc": "C_dc",
}
"""The circuit elements and the quantity whose base each is expressed in."""


class Options(BaseModel):
    """Base of all options: unknown keys, wrong types and NaN are errors; instances are frozen."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class ConverterParameters(Options):
    """Nominal elements of one converter and its line, in SI units (`converters/*.toml`)."""

    source: str = Field(description="where the numbers come from")
    S_n: Positive = Field(description="nominal power, VA")
    V_n: Positive = Field(description="nominal line-to-line RMS voltage, V")
    omega_n: Positive = Field(description="nominal angular frequency, rad/s")
    V_dcref: Positive = Field(description="DC voltage reference, V")
    L_f: Positive = Field(description="filter inductor, H")
    R_f: NonNegative = Field(description="filter resistor, ohm")
    C_f: Positive = Field(description="filter capacitor, F")
    L_g: Positive = Field(description="line inductor, H")
    R_g: NonNegative = Field(description="line resistor, ohm")
    C_dc: Positive = Field(description="DC capacitor, F")

    @property
    def bases(self) -> Bases:
        """The per-unit bases that these nominal values define."""
        return Bases(self.S_n, self.V_n, self.omega_n, self.V_dcref)

    def pu(self, factors: Mapping[Element, float] | None = None) -> dict[Element, float]:
        """Return the elements in p.u. of the nominal bases.

        Args:
            factors: Real over nominal value of any element; 1 where not given. The bases stay
                nominal, since the controller and its references know only those.

        Raises:
            ValueError: As ``check_factors``.
        """
        factors = factors or {}
        check_factors(factors)
        bases = self.bases
        return {
            name: bases.to_pu(getattr(self, name) * factors.get(name, 1.0), quantity)
            for name, quantity in ELEMENTS.items()
        }


def check_factors(factors: Mapping[Element, float]) -> None:
    """Raise ValueError if a factor names no element, makes L or C <= 0 or R < 0, or is absurd."""
    for name, factor in factors.items():
        if name not in ELEMENTS:
            raise ValueError(f"factors.{name}: must be one of {', '.join(ELEMENTS)}")
        if not (factor > 0 or (factor == 0 and ELEMENTS[name] == "R")):
            raise ValueError(f"factors.{name} = {factor}: must be > 0 (>= 0 for a resistor)")
        if factor and not LEAST <= factor <= MOST:
            raise ValueError(f"factors.{name} = {factor}: must lie in [{LEAST:g}, {MOST:g}]")


def load_converter(name_or_path: str | Path) -> ConverterParameters:
    """Load a converter by the name of a shipped file ("paper") or the path of a .toml file.

    Raises:
        ValueError: If no such converter is shipped, or the file breaks a rule
            (pydantic's ValidationError, which names every field, value and rule at once).
        OSError: If the path cannot be read.
    """
    if isinstance(name_or_path, str) and not name_or_path.endswith(".toml"):
        shipped = _shipped()
        if name_or_path not in shipped:
            raise ValueError(
                f"converter = {name_or_path!r}: must be one of {', '.join(shipped)},"
                " or the path of a .toml file"
            )
        return _parsed(shipped[name_or_path])
    path = Path(name_or_path)
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):  # a pipe or a device may have no end
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    if found.st_size > _MOST_BYTES:
        raise OSError(errno.EFBIG, f"is larger than {_MOST_BYTES} bytes", str(path))
    return _parsed(path.read_text(encoding="utf-8"))


@cache
def _shipped() -> dict[str, str]:
    """The shipped files by the names of their converters."""
    files = sorted((resources.files("gfm_plant") / "converters").iterdir(), key=lambda f: f.name)
    return {f.name.removesuffix(".toml"): f.read_text(encoding="utf-8") for f in files}


@lru_cache(maxsize=16)
def _parsed(text: str) -> ConverterParameters:
    try:
        return ConverterParameters.model_validate(tomllib.loads(text))
    except RecursionError:
        raise ValueError("not usable: tables and arrays are nested too deep") from None
