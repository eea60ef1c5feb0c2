"""A law as an FMU for co-simulation: the exported C code with the interface of FMI 2.0 or 3.0.

An FMU is a zip file: modelDescription.xml from the signal table, the sources with what builds them,
and binaries of this machine and, where mingw is installed, of Windows.
"""

from __future__ import annotations

import io
import platform
import re
import shutil
import tempfile
import uuid
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, get_args
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from gfm_runtime.catalogue import LawSet
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import chosen, filled, plain, template
from gfm_runtime.firmware.check import FLAGS, OPTIMISED, TARGETS, called
from gfm_runtime.firmware.module import MADE, RESULTS, Module, keys_of
from gfm_runtime.firmware.schedule import one_module
from gfm_runtime.signals import TABLE_VERSION, Signal, carried_rows, command_rows, group, table_hash

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
_DATE = (1980, 1, 1, 0, 0, 0)  # of all files, so that the same law gives the same bytes
_LOGS = ("logStatusWarning", "logStatusError")


@dataclass(frozen=True)
class _Variable:
    """A variable of the FMU; its value reference is its place among all, from 1."""

    name: str
    causality: str
    description: str
    signal: Signal | None  # None for the result of a tick, an integer

    @property
    def attributes(self) -> dict[str, str]:
        """What FMI 2.0 and 3.0 have in common."""
        kept = {
            "input": {"variability": "continuous"},
            "output": {"variability": "discrete", "initial": "calculated"},
            "parameter": {"variability": "fixed", "initial": "exact"},
        }
        text = {"description": plain(self.description)}
        return {"causality": self.causality, **kept[self.causality], **text}

    @property
    def number(self) -> dict[str, str]:
        """Unit and range, and where it starts."""
        if (s := self.signal) is None:
            return {}
        start = {} if self.causality == "output" else {"start": repr(s.default)}
        return {"unit": s.unit, "min": repr(s.low), "max": repr(s.high), **start}


def fmu(laws: LawSet, T_s: float, real: str, fmi: Fmi, omega_b: float) -> bytes:
    """The FMU of a law, as the bytes of its file.

    Args:
        laws: the law, with its inner stage if it has one; or a scheduled one.
        T_s: sampling time, s.
        real: float32 or float64 inside; inputs and outputs are always 64 bits.
        fmi: which FMI.
        omega_b: base frequency of the converter, rad/s, for an inner stage.

    Raises:
        LawError: as ``make_modules``; there is no gcc or no FMPy (the package is named), or gcc
            fails.
    """
    m, own = one_module(laws, T_s, real, omega_b)
    code, description = _sources(m, own, T_s, fmi)
    held: dict[str, bytes] = {"modelDescription.xml": description}
    held |= {f"sources/{file}": text.encode() for file, text in code.items()}
    if fmi == "3":
        held["sources/buildDescription.xml"] = _build_description(m, code)
    held |= _binaries(m, code, fmi)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in held.items():
            archive.writestr(zipfile.ZipInfo(file, _DATE), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _sources(
    m: Module, own: Mapping[str, str], T_s: float, fmi: Fmi
) -> tuple[dict[str, str], bytes]:
    """The law's ``own`` sources and the others by file name, and modelDescription.xml; the token
    follows from both."""
    u = command_rows(m.stages)
    inside = (*group("ref"), *carried_rows("y", m.stages))
    keys = (
        keys_of(m)
        | _NAMES[fmi]
        | {
            "MADE": MADE,
            "LAW_NAME": plain(m.name),
            "T_S": repr(float(T_s)),
            "U_LOW": ", ".join(repr(s.low) for s in u),
            "U_HIGH": ", ".join(repr(s.high) for s in u),
            "U_START": ", ".join(repr(s.default) for s in u),
            "IN_START": ", ".join(repr(s.default) for s in inside),
            "E_IN_USE": ", &s->u[2]" * m.stages,
            "REFUSALS": "@REFUSALS@",
            "TOKEN": "@TOKEN@",
        }
    )
    interface = filled(chosen(template("fmi.c"), {"fmi2": fmi == "2"}), keys)
    code = {
        **own,
        f"fmi{fmi}.c": interface.replace("@REFUSALS@", _refusals(fmi, interface).rstrip()),
    }
    description = _description(m, T_s, fmi, code)
    said = "\n".join([*code.values(), description.decode()])
    token = f"{{{uuid.uuid5(uuid.NAMESPACE_URL, said)}}}"
    code[f"fmi{fmi}.c"] = code[f"fmi{fmi}.c"].replace("@TOKEN@", token)
    return code, description.replace(b"@TOKEN@", token.encode())


def _headers() -> Path:
    """The folder of the C headers of FMI 2.0 and 3.0 that FMPy carries.

    Raises:
        LawError: FMPy is not installed.
    """
    spec = find_spec("fmpy")  # does not import it
    if spec is None or not spec.submodule_search_locations:
        raise LawError("an FMU", "takes the C headers of FMPy: pip install 'gfmhil[fmu]'")
    return Path(spec.submodule_search_locations[0], "c-code")


def _refusals(fmi: Fmi, interface: str) -> str:
    """The functions of the standard that the interface has not, as C that says so."""
    declared = _headers().joinpath(f"fmi{fmi}FunctionTypes.h").read_text(encoding="utf-8")
    written = set(re.findall(r"\b(fmi\d\w+)\(", interface))
    out = []
    for kind, name, text in re.findall(
        r"typedef\s+(fmi\dStatus|fmi3Instance)\s+(fmi\d\w+)TYPE\s*\((.*?)\);", declared, re.DOTALL
    ):
        if name in written:
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


def _variables(m: Module) -> list[_Variable]:
    """All variables but the time, in the order of their value references."""
    inside = [("ref", s) for s in group("ref")]
    inside += [("y", s) for s in carried_rows("y", m.stages)]
    u = command_rows(m.stages)
    result = "0, or why the bridge must be blocked: "
    result += "; ".join(f"{code} {text}" for code, text in RESULTS.values() if code)
    return [
        *(
            _Variable(f"{vector}.{s.name}", "input", f"{s.description}, of {s.base}", s)
            for vector, s in inside
        ),
        *(_Variable(f"u.{s.name}", "output", f"{s.description}, of {s.base}", s) for s in u),
        _Variable("reason", "output", result, None),
        *(
            _Variable(f"start.{s.name}", "parameter", f"where u.{s.name} begins, of {s.base}", s)
            for s in u
        ),
    ]


def _description(m: Module, T_s: float, fmi: Fmi, code: Mapping[str, str]) -> bytes:
    """modelDescription.xml."""
    assert m.law is not None
    two, step = fmi == "2", repr(float(T_s))
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{fmi}.0",
            "modelName": m.name,
            "guid" if two else "instantiationToken": "@TOKEN@",
            "description": f"{plain(m.law.title)}, {m.real}. Source: {plain(m.law.source)}",
            "version": f"signal table {TABLE_VERSION} ({table_hash()})",
            "generationTool": "gfmhil firmware fmu",
            "variableNamingConvention": "structured",
        },
    )
    state = "FMUstate" if two else "FMUState"
    does = SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": m.prefix,
            "canHandleVariableCommunicationStepSize": "true",
            f"canGetAndSet{state}": "true",
            f"canSerialize{state}": "true",
        },
    )
    if two:
        does.set("canNotUseMemoryManagementFunctions", "true")
        listed = SubElement(does, "SourceFiles")
        for file in code:
            if file.endswith(".c"):
                SubElement(listed, "File", name=file)
    else:
        does.set("fixedInternalStepSize", step)
    variables, number = _variables(m), "Real" if two else "Float64"
    units = {v.signal.unit for v in variables if v.signal is not None}
    units_of = SubElement(root, "UnitDefinitions")
    for unit in sorted(units | (set() if two else {"s"})):
        defined = SubElement(units_of, "Unit", name=unit)
        if unit == "s":
            SubElement(defined, "BaseUnit", s="1")
    logs = SubElement(root, "LogCategories")
    for log in _LOGS:
        SubElement(logs, "Category", name=log)
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="1.0", stepSize=step)
    held = SubElement(root, "ModelVariables")
    if not two:
        time = {"causality": "independent", "variability": "continuous", "unit": "s"}
        SubElement(held, number, {"name": "time", "valueReference": "0", **time})
    for reference, v in enumerate(variables, 1):
        base = {"name": v.name, "valueReference": str(reference), **v.attributes}
        kind = number if v.signal is not None else "Integer" if two else "Int32"
        if two:
            SubElement(SubElement(held, "ScalarVariable", base), kind, v.number)
        else:
            SubElement(held, kind, {**base, **v.number})
    _structure(root, variables, two)
    indent(root)
    return bytes(tostring(root, "utf-8", xml_declaration=True)) + b"\n"


def _structure(root: Element, variables: list[_Variable], two: bool) -> None:
    """No output follows an input within a tick; where an output begins is a parameter."""
    structure = SubElement(root, "ModelStructure")
    places = {v.name: str(k) for k, v in enumerate(variables, 1)}
    key = "index" if two else "valueReference"
    outputs = [v for v in variables if v.causality == "output"]
    listed = SubElement(structure, "Outputs") if two else structure
    for v in outputs:
        at = {key: places[v.name], "dependencies": ""}
        SubElement(listed, "Unknown" if two else "Output", at)
    listed = SubElement(structure, "InitialUnknowns") if two else structure
    for v in outputs:
        begins = places.get(v.name.replace("u.", "start.", 1), "") if v.signal else ""
        at = {key: places[v.name], "dependencies": begins}
        SubElement(listed, "Unknown" if two else "InitialUnknown", at)


def _build_description(m: Module, code: Mapping[str, str]) -> bytes:
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    how = SubElement(root, "BuildConfiguration", modelIdentifier=m.prefix)
    options = " ".join([*FLAGS, OPTIMISED])
    listed = SubElement(
        how, "SourceFileSet", language="C99", compiler="gcc", compilerOptions=options
    )
    for file in code:
        if file.endswith(".c"):
            SubElement(listed, "SourceFile", name=file)
    SubElement(how, "Library", name="m", external="true")
    indent(root)
    return bytes(tostring(root, "utf-8", xml_declaration=True)) + b"\n"


def _binaries(m: Module, code: Mapping[str, str], fmi: Fmi) -> dict[str, bytes]:
    """The libraries by their place in the FMU.

    Raises:
        LawError: there is no gcc, or a compiler fails.
    """
    host, machine = TARGETS["host"], platform.machine()
    if shutil.which(host.compiler) is None:
        raise LawError(
            f"law {m.name!r}", f"{host.compiler} is not there; apt-get install {host.packages}"
        )
    here = _HERE[fmi].get(machine, f"{machine}-linux")
    made = {f"{here}/{m.prefix}.so": [host.compiler, "-fPIC"]}
    if shutil.which(_MINGW) is not None:
        made[f"{_WINDOWS[fmi]}/{m.prefix}.dll"] = [
            _MINGW, "-static-libgcc", "-Wl,--no-insert-timestamp",
        ]  # fmt: skip
    out = {}
    with tempfile.TemporaryDirectory(prefix="gfmhil-fmu-") as work:
        for file, text in code.items():
            Path(work, file).write_text(text, encoding="utf-8")
        own = [file for file in code if file.endswith(".c")]
        for place, (compiler, *flags) in made.items():
            called(
                [compiler, *FLAGS, OPTIMISED, *flags, "-shared", "-fvisibility=hidden",
                 f"-I{_headers()}", *own, "-o", "made", *host.link],
                Path(work),
            )  # fmt: skip
            library = next(Path(work).glob("made*"))
            out[f"binaries/{place}"] = library.read_bytes()
            library.unlink()
    return out
