"""The inner stage in C: what the templates ``stage.c`` and ``stage_settle.c`` ask for.

They are ``gfm_runtime.inner`` line by line, so the bits are the kernel's. In an unrolled law the
constants are numbers and the choices are made; in the generic step both are the law record's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gfm_runtime.firmware.c_text import Choices, chosen, filled, literal, template
from gfm_runtime.inner import INNER_CONSTANTS, KINDS, NONE, PRIORITIES, STATOR
from gfm_runtime.signals import group

#: variables of the stage in an instance, in its order: name (as in ``state_dtype``), size, remark
VARIABLES = (
    ("i_ref", 2, "reference current, limited"),
    ("v_f", 2, "low-pass filtered v"),
    ("i_f", 2, "low-pass filtered i"),
    ("x_c", 2, "integral of the current loop"),
    ("x_v", 2, "integral of the voltage loop, or current of the virtual stator"),
    ("away", 2, "voltage that a change of law left; decays"),
    ("e", 2, "the bridge's voltage"),
    ("pll", 2, "unit phasor that follows v"),
    ("omega_pll", 1, "frequency of the PLL"),
    ("x_high", 1, "integrals of the power limiter"),
    ("x_low", 1, ""),
)
#: numbers among them
SIZE = sum(size for _, size, _ in VARIABLES)
#: constants that are the same in all laws, and no members of a law's record in C
SHARED = ("one",)
CONSTANTS = tuple(name for name in INNER_CONSTANTS if name not in SHARED)
#: templates: a tick, and what settles the stage
STAGE_PARTS = ("stage.c", "stage_settle.c")
#: no law of the folder has a stage
WITHOUT: Choices = {"stages": False, "pll": False, "fixed": False}
#: of the generic step
AT_RUN_TIME: Choices = {
    "stages": True,
    "fixed": False,
    "stage": f"law->inner != {NONE}",
    "stator": f"law->inner == {STATOR}",
    "voltage": f"law->inner != {STATOR}",
    "threshold": True,
    "power": True,
    "pll": "law->k_pll > 0",
    "integral": "law->T_k_ci > 0",
    "angle": f"law->priority == {PRIORITIES['angle']}",
    "keep_d": f"law->priority == {PRIORITIES['d']}",
    "keep_q": f"law->priority == {PRIORITIES['q']}",
}


def choices_of(record: np.void) -> Choices:
    """The choices of one law, for its unrolled step.

    What is left out changes no bit: the limiter of a power that the signal table refuses, an
    integral with the gain 0, a threshold with the impedance 0.
    """
    kind, priority = int(record["inner"]), int(record["priority"])
    p = next(s for s in group("y") if s.name == "p")
    return {
        "stages": True,
        "fixed": False,
        "stage": kind != NONE,
        "stator": kind == STATOR,
        "voltage": kind not in (NONE, STATOR),
        "threshold": bool(record["k_thr"] > 0),
        "power": bool(kind != NONE and (record["P_max"] < p.high or record["P_min"] > p.low)),
        "pll": bool(record["k_pll"] > 0),
        "integral": bool(record["T_k_ci"] > 0),
        "angle": priority == PRIORITIES["angle"],
        "keep_d": priority == PRIORITIES["d"],
        "keep_q": priority == PRIORITIES["q"],
    }


def numbers_of(record: np.void) -> dict[str, str]:
    """The keys of one law as literals, for its unrolled step."""
    real = record["u_0"].dtype
    keys = {name: literal(record[name], real) for name in (*CONSTANTS, "decay")}
    return keys | {f"{end}_omega": literal(record[end][1], real) for end in ("low", "high")}


def stage_text(part: str, choices: Choices, keys: Mapping[str, str]) -> str:
    """One of ``STAGE_PARTS`` in C; without the keys of ``numbers_of``, for the generic step."""
    generic = {name: f"law->{name}" for name in (*CONSTANTS, "decay")}
    generic |= {"low_omega": "law->low[1]", "high_omega": "law->high[1]"}
    return filled(chosen(template(part), choices), {**generic, **keys})


def variables_text(prefix: str) -> str:
    """The members of the stage's struct."""
    return "\n".join(
        f"    {prefix}_real {name}{f'[{size}]' * (size > 1)};{f' /* {remark} */' * bool(remark)}"
        for name, size, remark in VARIABLES
    )


def kinds_text() -> str:
    """The codes of a record's ``inner`` and ``priority``, for a comment."""
    return "; ".join(
        ", ".join(f"{code} {name}" for name, code in codes.items()) for codes in (KINDS, PRIORITIES)
    )


def check_stage(record: np.void) -> str:
    """Why C cannot hold a record's stage, or nothing."""
    wrong: dict[str, Any] = {
        "inner": int(record["inner"]) not in KINDS.values(),
        "priority": int(record["priority"]) not in PRIORITIES.values(),
        "one": record["one"] != 1,
        "k_c": not record["k_c"] > 0,
    }
    return next((f"{name} = {record[name]} is not possible" for name in wrong if wrong[name]), "")
