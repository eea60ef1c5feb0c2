"""Inner stages in TOML: the ``[inner]`` table of a law file, or a file of its own.

The shipped ones are in ``gfm_runtime/inner_stages``. A number may be an expression over the
parameters of the law that has the table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from gfm_runtime.errors import LawError, meant
from gfm_runtime.expressions import evaluate
from gfm_runtime.inner import PAPER_M, Inner
from gfm_runtime.mistakes import lines
from gfm_runtime.toml_file import Number, Table, parse_toml, read_text

NO_INNER = "none"


class PowerLimiter(Table):
    """Lowers omega_u while p is above P_max, and raises it while p is below P_min."""

    P_max: Number = Field(description="p.u.")
    P_min: Number = Field(description="p.u.")
    k_p: Number = Field(0.1, description="p.u. of omega_u per p.u. of power")
    k_i: Number = Field(5.0, description="1/s")


class _Stage(Table):
    m: Number = Field(PAPER_M, description="limit of abs(e) over v_dc, p.u.")
    freeze: bool = Field(
        True,
        description="while the current is limited, hold the states of the law's E_u row if they "
        "would move E_u further away from v_d",
    )
    power: PowerLimiter | None = Field(None, description="power limiter; none if not given")
    f_pll: Number = Field(
        0.0, description="bandwidth of the PLL that measures omega_g for column 3, Hz; 0: none"
    )


class _WithCurrentLoop(_Stage):
    I_max: Number = Field(1.2, description="limit of the current, p.u. of S_n/V_n")
    priority: Literal["circular", "d", "q", "angle"] = Field(
        "circular", description="what the limit keeps: the angle, i_d, i_q, or a set angle"
    )
    angle: Number = Field(0.0, description="of the limited current, degrees; priority angle only")
    k_c: Number = Field(0.15, description="current loop, p.u./p.u.")
    k_ci: Number = Field(0.0, description="current loop, 1/s")
    L_f: Number = Field(0.0174, description="the converter's filter inductor, p.u.")
    f_v: Number = Field(400.0, description="low-pass on v, Hz")


class VirtualStator(_WithCurrentLoop):
    """A reference current behind a virtual impedance, a limit, and a current loop."""

    type: Literal["virtual-stator"] = Field(description="kind of stage")
    R_v: Number = Field(0.1, description="virtual resistance, p.u.")
    X_v: Number = Field(0.3, description="virtual reactance, p.u.")


class _WithVoltageLoop(_WithCurrentLoop):
    R_v: Number = Field(0.1, description="virtual resistance, p.u.")
    X_v: Number = Field(0.3, description="virtual reactance, p.u.; without states")
    k_v: Number = Field(1.0, description="voltage loop, p.u./p.u.")
    k_vi: Number = Field(100.0, description="voltage loop, 1/s")
    k_ff: Number = Field(0.6, description="part of i_o that is fed forward")
    C_f: Number = Field(0.2268, description="the converter's filter capacitor, p.u.")


class Cascaded(_WithVoltageLoop):
    """A voltage loop, a limit, and a current loop."""

    type: Literal["cascaded"] = Field(description="kind of stage")


class ThresholdImpedance(_WithVoltageLoop):
    """The cascaded loops behind a virtual impedance that grows beyond a threshold of current."""

    type: Literal["threshold-impedance"] = Field(description="kind of stage")
    I_thr: Number = Field(1.0, description="threshold, p.u.")
    k_thr: Number = Field(0.67, description="impedance per current beyond the threshold, p.u.")
    sigma: Number = Field(2.0, description="X/R of that impedance")
    f_i: Number = Field(10.0, description="low-pass on i, Hz")


MODELS: dict[str, type[Table]] = {
    "virtual-stator": VirtualStator,
    "cascaded": Cascaded,
    "threshold-impedance": ThresholdImpedance,
}
InnerSpec = Annotated[VirtualStator | Cascaded | ThresholdImpedance, Field(discriminator="type")]
_ADAPTER: TypeAdapter[InnerSpec] = TypeAdapter(InnerSpec)


def build_inner(spec: InnerSpec, parameters: Mapping[str, float]) -> Inner:
    """The stage of a table, its expressions evaluated.

    Raises:
        LawError: every number that is not allowed, one line each.
    """
    given = spec.model_dump(exclude={"type", "power"})
    if spec.power is not None:
        power = spec.power.model_dump()
        given |= {"P_max": power["P_max"], "P_min": power["P_min"]}
        given |= {"k_P": power["k_p"], "k_Pi": power["k_i"]}
    words: dict[str, Any] = {k: given.pop(k) for k in ("priority", "freeze") if k in given}
    numbers: dict[str, Any] = {k: evaluate(f"inner.{k}", v, parameters) for k, v in given.items()}
    return Inner(spec.type, **words, **numbers)


def acting(inner: Inner) -> dict[str, Any]:
    """The parameters of a stage that act, by their names in ``Inner``: those of its kind, and of
    the power limiter if it has one."""
    names = [name for name in MODELS[inner.kind].model_fields if name not in ("type", "power")]
    if math.isfinite(inner.P_max) or math.isfinite(inner.P_min):
        names += ["P_max", "P_min", "k_P", "k_Pi"]
    return {name: getattr(inner, name) for name in names}


@cache
def inner_names() -> tuple[str, ...]:
    """The names of the shipped inner stages, and ``none``."""
    folder = files("gfm_runtime").joinpath("inner_stages")
    found = [p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")]
    return (NO_INNER, *sorted(found))


def named_inner(name: str) -> InnerSpec | None:
    """The inner stage of a shipped name, or of a path that ends in ``.toml``; None for ``none``.

    Raises:
        LawError: an unknown name, or every mistake of the file.
    """
    if name == NO_INNER:
        return None
    where = f"inner stage {name}"
    try:
        if name.endswith(".toml"):
            text = read_text(name)
        elif name in inner_names():
            folder = files("gfm_runtime").joinpath("inner_stages")
            text = folder.joinpath(f"{name}.toml").read_text(encoding="utf-8")
        else:
            known = list(inner_names())
            raise ValueError(f"unknown; use a .toml file or one of {known}{meant(name, known)}")
        content = parse_toml(text)
        return _ADAPTER.validate_python(content)
    except ValidationError as problem:
        raise LawError(where, *lines(problem, InnerSpec, content=content)) from None
    except ValueError as problem:
        raise LawError(where, str(problem)) from None
