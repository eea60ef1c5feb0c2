"""A law as a real-code model for EMT programs: the DLL interface of IEEE and CIGRE (CIGRE TB 958).

The model is the exported C code with one more source, ``model.c``. The simulation program owns all
states, and may copy them between two calls; so there may be several instances.
"""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gfm_runtime.catalogue import LawSet
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import Choices, identifier, plain, render
from gfm_runtime.firmware.check import FLAGS, OPTIMISED, TARGETS, run_tool
from gfm_runtime.firmware.module import RESULT_TEXT, keys_of
from gfm_runtime.firmware.schedule import one_module
from gfm_runtime.firmware.tuning import GainChanges
from gfm_runtime.signals import TABLE_VERSION, Signal, command_rows, group, table_hash

_INTERFACE = "IEEE_Cigre_DLLInterface.h"


def dll_sources(laws: LawSet, T_s: float, real: str, omega_b: float) -> dict[str, str]:
    """The headers and sources of a model by file name. Raises LawError: as ``make_modules``.

    Args:
        laws: the law, with its inner stage if it has one; or a scheduled one.
        T_s: sampling time, s.
        real: float32 or float64 inside; inputs and outputs are always real64.
        omega_b: base frequency of the converter, rad/s, for an inner stage.
    """
    m, code = one_module(laws, T_s, real, omega_b)
    assert m.law is not None
    schedule = laws.schedule is not None
    u = command_rows(m.stages)
    # what is kept in words as a whole: integers are among what changes
    choices: Choices = {**m.choices, "whole": schedule or m.tuning is not None}
    single = m.real == np.float32
    keys = keys_of(m) | {
        "NAME": _string(m.name),
        "VERSION": _string(f"signal table {TABLE_VERSION} ({table_hash()})"),
        "TITLE": _string(m.law.title),
        "SOURCE": _string(m.law.source),
        "T_S": repr(float(T_s)),
        "FIRST_INT": "limited" if m.stages else "reason",
        "REAL64": "IEEE_Cigre_DLLInterface_DataType_real64_T",
        "INPUTS": _ports((*group("ref"), *m.inputs)),
        "OUTPUTS": _ports(m.outputs),
        "REASON": _string(RESULT_TEXT),
        "STATES": "FloatStates" if single else "DoubleStates",
        "FLOATS": "REALS" if single and not choices["whole"] else "0",
        "DOUBLES": "0" if single or choices["whole"] else "REALS",
        "PARAMETERS": _parameters(m.tuning) if m.tuning else "",
        "GAINS": ", &gains" * bool(m.tuning),
        "GAINS_IN": f", const {m.prefix}_gains_t *gains" * bool(m.tuning),
        "GAINS_OUT": f", {m.prefix}_gains_t *gains" * bool(m.tuning),
        "U_START": ", ".join(repr(s.default) + "f" * single for s in u),
        "E_IN_USE": ", &u[2]" * m.stages,
    }
    keys["FIRST"] = render("first.c", keys, choices)
    return {
        **code,
        _INTERFACE: render(_INTERFACE, keys),
        "model.c": render("model.c", keys, choices),
    }


def build_dll(folder: Path, name: str, files: Iterable[str]) -> Path:
    """Compile by gcc the files of ``dll_sources`` in a folder; the shared library's path. Raises
    LawError: as ``build_library``."""
    library = folder / f"gfm_{identifier(name)}.so"
    build_library(folder, name, files, library.name, ["-fPIC"])
    return library


def build_library(
    folder: Path, law: str, files: Iterable[str], out: str, flags: Iterable[str], compiler: str = ""
) -> None:
    """Compile the C files in a folder to a shared library, by gcc if no compiler is named. Raises
    LawError: there is no gcc (the apt package is named), or the compiler fails."""
    host = TARGETS["host"]
    if shutil.which(host.compiler) is None:
        why = f"{host.compiler} is not there; apt-get install {host.packages}"
        raise LawError(f"law {law!r}", why)
    own = [file for file in files if file.endswith(".c")]
    command = [compiler or host.compiler, *FLAGS, OPTIMISED, *flags, "-shared"]
    run_tool([*command, "-fvisibility=hidden", *own, "-o", out, *host.link], folder)


def _string(text: str) -> str:
    return json.dumps(plain(text))


def _parameters(tuning: GainChanges) -> str:
    """The gains, which may change at any time."""
    return "\n".join(
        f"    {{{_string(name)}, {_string('Gains')}, {_string(of.source)}, {_string(of.unit)}, "
        "IEEE_Cigre_DLLInterface_DataType_real64_T, 0, "
        f"{{.Real64_Val = {value!r}}}, {{.Real64_Val = {low!r}}}, {{.Real64_Val = {high!r}}}}},"
        for (name, value), (low, high), of in (
            (gain, tuning.ranges[gain[0]], tuning.file.parameters[gain[0]])
            for gain in tuning.gains.items()
        )
    )


def _ports(signals: Iterable[Signal]) -> str:
    return "\n".join(
        f"    {{{_string(s.name)}, {_string(f'{s.description}, of {s.base}')}, {_string(s.unit)}, "
        "IEEE_Cigre_DLLInterface_DataType_real64_T, 1},"
        for s in signals
    )
