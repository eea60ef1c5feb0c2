"""A law as an FMU for co-simulation: the exported C code with the interface of FMI 2.0 or 3.0.

An FMU is a zip file: modelDescription.xml from the signal table, the sources with what builds them,
and binaries of this machine and, where mingw is installed, of Windows. With FMI-LS-XCP it also has
the A2L file of this machine's binary, and a first instance that lies where that file says.
"""

import io
import platform
import re
import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args
from xml.sax.saxutils import escape

from gfm_runtime.catalogue import LawSet
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import plain, render
from gfm_runtime.firmware.check import FLAGS, OPTIMISED
from gfm_runtime.firmware.dll import build_library
from gfm_runtime.firmware.elf import elf_a2l
from gfm_runtime.firmware.module import RESULT_TEXT, Module, keys_of
from gfm_runtime.firmware.schedule import one_module
from gfm_runtime.signals import TABLE_VERSION, Signal, command_rows, group, table_hash

Fmi = Literal["2", "3"]
FMI: tuple[Fmi, ...] = get_args(Fmi)

#: by FMI, what its names begin with and what they are in the one template of both
_NAMES = {
    "2": {"FMI": "2", "F": "fmi2", "INSTANCE": "Component", "REAL": "Real", "INTEGER": "Integer",
          "STATE": "FMUstate", "DESERIALIZE": "DeSerialize", "NAME": ", it->name", "COUNT": "",
          "TOO_FEW": "NULL"},
    "3": {"FMI": "3", "F": "fmi3", "INSTANCE": "Instance", "REAL": "Float64", "INTEGER": "Int32",
          "STATE": "FMUState", "DESERIALIZE": "Deserialize", "NAME": "", "COUNT": ", size_t n",
          "TOO_FEW": 'n < nvr ? "fewer values than value references" : NULL'},
}  # fmt: skip
_MINGW = "x86_64-w64-mingw32-gcc"
#: by FMI, folders of binaries
_HERE = {"2": {"x86_64": "linux64"}, "3": {}}
_WINDOWS = {"2": "win64", "3": "x86_64-windows"}
_LS_XCP = "extra/org.fmi-standard.fmi-ls-xcp"  # 1.0.0 of the layered standard
_DATE = (1980, 1, 1, 0, 0, 0)  # of all files, so that the same law gives the same bytes
_CAUSALITIES = {
    "input": {"causality": "input", "variability": "continuous"},
    "output": {"causality": "output", "variability": "discrete", "initial": "calculated"},
    "parameter": {"causality": "parameter", "variability": "fixed", "initial": "exact"},
    "gain": {"causality": "parameter", "variability": "tunable", "initial": "exact"},
}
_OF_FMI_3 = ("<Output valueReference", "<InitialUnknown valueReference")


def fmu(laws: LawSet, T_s: float, real: str, fmi: Fmi, omega_b: float, xcp: bool = False) -> bytes:
    """The FMU of a law, as the bytes of its file. Raises LawError: as ``make_modules``; there is no
    gcc or no FMPy (the package is named), or gcc fails.

    Args:
        laws: the law, with its inner stage if it has one; or a scheduled one.
        T_s: sampling time, s.
        real: float32 or float64 inside; inputs and outputs are always 64 bits.
        fmi: which FMI.
        omega_b: base frequency of the converter, rad/s, for an inner stage.
        xcp: with FMI-LS-XCP, the layered standard for measuring and calibrating by XCP; needs
            pyelftools.
    """
    m, own = one_module(laws, T_s, real, omega_b)
    code, description = _sources(m, own, T_s, fmi, xcp)
    held: dict[str, bytes] = {"modelDescription.xml": description}
    held |= {f"sources/{file}": text.encode() for file, text in code.items()}
    if fmi == "3":
        options = " ".join([*FLAGS, OPTIMISED])
        keys = {"P": m.prefix, "OPTIONS": options, "FILES": _files("SourceFile", code)}
        held["sources/buildDescription.xml"] = render("buildDescription.xml", keys).encode()
    held |= _binaries(m, code, fmi, xcp)
    if xcp:
        keys = keys_of(m)
        held[f"{_LS_XCP}/fmi-ls-manifest.xml"] = render("fmi-ls-manifest.xml", keys).encode()
        held["documentation/fmi-ls-xcp.txt"] = render("fmi-ls-xcp.txt", keys).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in held.items():
            archive.writestr(zipfile.ZipInfo(file, _DATE), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _sources(
    m: Module, own: Mapping[str, str], T_s: float, fmi: Fmi, xcp: bool
) -> tuple[dict[str, str], bytes]:
    """The law's ``own`` sources and the others by file name, and modelDescription.xml; the token
    follows from both."""
    u, two = command_rows(m.stages), fmi == "2"
    inside, gains = (*group("ref"), *m.inputs), _gains(m)
    keys = (
        keys_of(m)
        | _NAMES[fmi]
        | {
            "T_S": repr(float(T_s)),
            "U_START": ", ".join(repr(s.default) for s in u),
            "IN_START": ", ".join(repr(s.default) for s in inside),
            "E_IN_USE": ", &u[2]" * m.stages,
            "GAIN_LOW": ", ".join(repr(s.low) for s in gains),
            "GAIN_HIGH": ", ".join(repr(s.high) for s in gains),
            "NEW": "new_instance()" if xcp else "calloc(1, sizeof *it)",
            "FREE": "free_instance" if xcp else "free",
            "REFUSALS": "@REFUSALS@",
            "TOKEN": "@TOKEN@",
        }
    )
    keys["FIRST"] = render("first.c", keys, m.choices)
    choices = {"fmi2": two, "tuned": m.tuning is not None, "xcp": xcp}
    interface = render("fmi.c", keys, choices)
    code = {
        **own,
        f"fmi{fmi}.c": interface.replace("@REFUSALS@", _refusals(fmi, interface).rstrip()),
    }
    assert m.law is not None
    keys |= _variables(m, two) | {
        "TOKEN_NAME": "guid" if two else "instantiationToken",
        "MODEL": _quote(m.name),
        "ABOUT": _quote(f"{plain(m.law.title)}, {m.real}. Source: {plain(m.law.source)}"),
        "VERSION": _quote(f"signal table {TABLE_VERSION} ({table_hash()})"),
        "FILES": _files("File", code),
    }
    description = render("modelDescription.xml", keys, {"fmi2": two})
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, chr(10).join([*code.values(), description]))}}}"
    code[f"fmi{fmi}.c"] = code[f"fmi{fmi}.c"].replace("@TOKEN@", token)
    return code, description.replace("@TOKEN@", token).encode()


def _variables(m: Module, two: bool) -> dict[str, str]:
    """What modelDescription.xml says of the variables; the value reference of each is its place
    among all, from 1. No output follows an input within a tick; where one begins is a parameter."""
    inside = [("ref", s) for s in group("ref")]
    inside += [("y", s) for s in m.inputs]
    u = command_rows(m.stages)
    rows: list[tuple[str, str, str, Signal | None]] = [
        *((f"{v}.{s.name}", "input", f"{s.description}, of {s.base}", s) for v, s in inside),
        *((f"u.{s.name}", "output", f"{s.description}, of {s.base}", s) for s in m.outputs),
        ("reason", "output", RESULT_TEXT, None),  # of a tick, an integer
        *((f"start.{s.name}", "parameter", f"where u.{s.name} begins, of {s.base}", s) for s in u),
        *((f"gain.{s.name}", "gain", s.description, s) for s in _gains(m)),
    ]
    lines, units = list[str](), {s.unit for *_, s in rows if s}
    for reference, (name, causality, about, s) in enumerate(rows, 1):
        base = {"name": name, "valueReference": str(reference)}
        base |= _CAUSALITIES[causality] | {"description": plain(about)}
        number = {"min": repr(s.low), "max": repr(s.high)} if s else {}
        number |= {"unit": s.unit} if s and s.unit else {}
        number |= {"start": repr(s.default)} if s and causality != "output" else {}
        kind = ("Real" if two else "Float64") if s else ("Integer" if two else "Int32")
        lines += (
            [f"    <ScalarVariable{_attributes(base)}>", f"      <{kind}{_attributes(number)} />",
             "    </ScalarVariable>"]
            if two
            else [f"    <{kind}{_attributes(base | number)} />"]
        )  # fmt: skip
    first = len(inside) + 1
    last = first + len(m.outputs)
    tags = ("  <Unknown index", "  <Unknown index") if two else _OF_FMI_3
    begins = [
        str(k - first + last + 1) if k < first + len(u) else "" for k in range(first, last + 1)
    ]
    return {
        "UNITS": "\n".join(f"    <Unit name={_quote(x)} />" for x in sorted(filter(None, units))),
        "VARIABLES": "\n".join(lines),
        "OUTPUTS": "\n".join(
            f'    {tags[0]}="{k}" dependencies="" />' for k in range(first, last + 1)
        ),
        "INITIAL": "\n".join(
            f'    {tags[1]}="{k}" dependencies="{at}" />' for k, at in enumerate(begins, first)
        ),
    }


def _gains(m: Module) -> list[Signal]:
    """The gains of a law that can be tuned, as rows of the signal table are."""
    if m.tuning is None:
        return []
    of, ranges = m.tuning.file.parameters, m.tuning.ranges
    return [
        Signal("ref", name, "", of[name].unit, "", 1.0, *ranges[name], value,
               of[name].source or "gain of the law")
        for name, value in m.tuning.gains.items()
    ]  # fmt: skip


def _quote(text: str) -> str:
    return '"' + escape(text, {'"': "&quot;"}) + '"'


def _attributes(named: Mapping[str, str]) -> str:
    return "".join(f" {name}={_quote(value)}" for name, value in named.items())


def _files(tag: str, code: Mapping[str, str]) -> str:
    return "\n".join(f'      <{tag} name="{file}" />' for file in code if file.endswith(".c"))


def _headers() -> Path:
    """The folder of the C headers of FMI 2.0 and 3.0 that FMPy carries. Raises LawError: FMPy is
    not installed."""
    spec = find_spec("fmpy")  # does not import it
    if spec is None or not spec.submodule_search_locations:
        raise LawError("an FMU", "takes the C headers of FMPy: pip install 'gfmhil[fmu]'")
    return Path(spec.submodule_search_locations[0], "c-code")


def _refusals(fmi: Fmi, interface: str) -> str:
    """The functions of the standard that the interface has not, as C that says so."""
    declared = _headers().joinpath(f"fmi{fmi}FunctionTypes.h").read_text(encoding="utf-8")
    defined = set(re.findall(r"\b(fmi\d\w+)\(", interface))
    out = []
    for kind, name, text in re.findall(
        r"typedef\s+(fmi\dStatus|fmi3Instance)\s+(fmi\d\w+)TYPE\s*\((.*?)\);", declared, re.DOTALL
    ):
        if name in defined:
            continue
        arguments = " ".join(text.split())
        first, *others = re.findall(r"(\w+)(?:\[\])?\s*(?:,|$)", arguments)
        answer = f'unsupported({first}, "{name}")'
        if kind == "fmi3Instance":  # of another kind than co-simulation
            answer, others = "NULL", [first, *others]
        lines = [*(f"(void){other};" for other in others), f"return {answer};"]
        body = "\n".join(f"    {line}" for line in lines)
        out.append(f"{kind} {name}({arguments})\n{{\n{body}\n}}\n")
    return "\n".join(out)


def _binaries(m: Module, code: Mapping[str, str], fmi: Fmi, xcp: bool) -> dict[str, bytes]:
    """The libraries by their place in the FMU, and the A2L file of this machine's. Raises LawError:
    there is no gcc, or a compiler fails."""
    machine, flags = platform.machine(), [f"-I{_headers()}"]
    here = _HERE[fmi].get(machine, f"{machine}-linux")
    made: dict[str, tuple[str, ...]] = {f"{here}/{m.prefix}.so": ("", "-fPIC")}
    if shutil.which(_MINGW) is not None:
        place = f"{_WINDOWS[fmi]}/{m.prefix}.dll"
        made[place] = (_MINGW, "-static-libgcc", "-Wl,--no-insert-timestamp")
    out = {}
    with tempfile.TemporaryDirectory(prefix="gfmhil-fmu-") as work:
        for file, text in code.items():
            Path(work, file).write_text(text, encoding="utf-8")
        for place, (compiler, *own) in made.items():
            build_library(Path(work), m.name, code, "made", [*own, *flags], compiler)
            library = next(Path(work).glob("made*"))
            out[f"binaries/{place}"] = library.read_bytes()
            library.unlink()
        if xcp:  # of the same code with what only a debugger reads
            build_library(Path(work), m.name, code, f"{m.prefix}.so", ["-fPIC", "-g", *flags])
            text, *_ = elf_a2l(Path(work, f"{m.prefix}.so"))
            out[f"{_LS_XCP}/{here}/{m.prefix}.a2l"] = text.encode()
    return out
