"""Laws as FMUs, validated and stepped by FMPy: the kernel's bits, states, and what they refuse."""

import ctypes
import re
import shutil
import sys
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from fmpy.build import build_platform_binary
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from gfm_hil.cli import main
from gfm_runtime import law_file, load_law
from gfm_runtime.firmware import FMI
from gfm_runtime.signals import carried_rows, command_rows, group
from gfm_runtime.states import BAD_Y, RUNNING

from ..support.firmware import STRICT, T_S, accepted, bench, cc, from_pin_to_pin, turning_counts

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]

TICKS = 500
START = [0.5, 1.0, 1.0, 0.05]


class Unit:
    """An instance of an FMU, found by the names of its variables."""

    said: ClassVar[list[str]] = []  # of all: FMPy has one logger for FMI 2.0

    def __init__(self, folder: Path) -> None:
        self._of = fmpy.read_model_description(folder)
        self.two = self._of.fmiVersion == "2.0"
        self.it = fmpy.instantiate_fmu(folder, self._of, "CoSimulation", logger=self._log)
        self._at = {v.name: v.valueReference for v in self._of.modelVariables}
        self.inputs = self._all("input")
        self.outputs = [v for v in self._all("output") if v != self._at["reason"]]
        self.ticks = 0

    def _log(self, *said: Any) -> None:
        self.said.append(said[-1].decode())

    def _all(self, causality: str) -> list[int]:
        return [v.valueReference for v in self._of.modelVariables if v.causality == causality]

    def place(self, name: str) -> int:
        return int(self._at[name])

    def set(self, references: list[int], values: Any) -> None:
        (self.it.setReal if self.two else self.it.setFloat64)(references, list(values))

    def get(self, references: list[int]) -> list[float]:
        return list((self.it.getReal if self.two else self.it.getFloat64)(references))

    @property
    def reason(self) -> int:
        get = self.it.getInteger if self.two else self.it.getInt32
        return int(get([self._at["reason"]])[0])

    def start(self, u: Any) -> None:
        self.set([self._at[f"start.{s.name}"] for s in command_rows(len(u) > 3)], u)
        if self.two:
            self.it.setupExperiment(startTime=2.0)
            self.it.enterInitializationMode()
        else:
            self.it.enterInitializationMode(startTime=2.0)
        self.it.exitInitializationMode()

    def tick(self, ref: Any, y: Any, ticks: int = 1) -> list[float]:
        self.set(self.inputs, [*ref, *y])
        self.it.doStep(2.0 + self.ticks * T_S, ticks * T_S)
        self.ticks += ticks
        return self.get(self.outputs)

    def keep(self) -> Any:
        state = self.it.getFMUstate() if self.two else self.it.getFMUState()
        return (self.it.serializeFMUstate if self.two else self.it.serializeFMUState)(state)

    def restore(self, kept: Any) -> None:
        it = self.it
        read, put, free = (
            (it.deSerializeFMUstate, it.setFMUstate, it.freeFMUstate)
            if self.two
            else (it.deserializeFMUState, it.setFMUState, it.freeFMUState)
        )
        state = read(kept)
        put(state)
        free(state)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """By law, inner stage, precision and FMI: the unpacked FMU, which is ``.fmu`` beside it."""
    found: dict[Any, Path] = {}

    def build(law: str, inner: str, real: str, fmi: str) -> Path:
        key = (law, inner, real, fmi)
        if key not in found:
            folder = tmp_path_factory.mktemp("fmu") / "unpacked"
            file = folder.with_suffix(".fmu")
            command = ["firmware", "fmu", law, "--inner", inner, "--real", real, "--fmi", fmi]
            assert main([*command, "-o", str(file)]) == 0
            fmpy.extract(file, folder)
            found[key] = folder
        return found[key]

    return build


@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize(
    ("law", "inner", "real"),
    [("vsg-2", "cascaded", "float64"), ("vsg-2", "cascaded", "float32"),
     ("hybrid-angle", "none", "float64")],
)  # fmt: skip
def test_the_unit_has_the_kernels_bits(built, law, inner, real, fmi):
    """Two instances in turn; one of them goes back to tick 100 after 200 and gives the same."""
    folder = built(law, inner, real, fmi)
    assert validate_fmu(str(folder.with_suffix(".fmu"))) == []
    stages = inner != "none"
    u = np.array(START[: 3 + stages], real).astype(float)
    twins = []
    for seed in (1, 2):
        refs, ys = accepted(seed, TICKS, real, stages)
        unit = Unit(folder)
        unit.start(u)
        assert unit.get(unit.outputs) == u.tolist()
        twins.append((unit, bench(law, inner, real, refs[0], ys[0], u), refs, ys))
    expected, kept, seen = u.copy(), b"", []
    for k in range(TICKS):
        for unit, kernel, refs, ys in twins:
            kernel.ctl["ref"] = kernel.ctl["ref_target"] = refs[k]
            kernel.step(ys[k], expected)
            assert kernel.ctl["state"][0] == RUNNING
            found = unit.tick(refs[k], ys[k])
            assert (np.array(found).tobytes(), unit.reason) == (expected.tobytes(), 0), k
        seen.append(found)
        if k == 100:
            kept = unit.keep()
        if k == 200:
            now = unit.keep()
            unit.restore(kept)
            unit.ticks = 101
            assert [unit.tick(refs[j], ys[j]) for j in range(101, 201)] == seen[101:]
            assert unit.keep() == now
    assert np.ptp(np.array(seen), axis=0).min() > 0
    for unit, *_ in twins:
        unit.it.terminate()
        unit.it.freeInstance()


@pytest.mark.parametrize("fmi", FMI)
def test_a_unit_from_counts_to_counts_has_the_kernels_bits(tmp_path, fmi):
    file, ref = tmp_path / "law.fmu", [1, 0.5, 1, 0, 1]
    command = ["firmware", "fmu", "vsg-2", "--counts", "rig", "--real", "float64", "--fmi", fmi]
    assert main([*command, "-o", str(file)]) == 0
    assert validate_fmu(str(file)) == []
    unit, counts = Unit(fmpy.extract(str(file), str(tmp_path / "unpacked"))), turning_counts(TICKS)
    unit.start(START)
    law = load_law("vsg-2", None, "rig").laws[0]
    kernel = from_pin_to_pin(law, "float64", ref, counts, START)
    for row, expected in zip(counts, kernel, strict=True):
        assert unit.tick(ref, row) == expected


@pytest.mark.parametrize("fmi", FMI)
def test_the_a2l_file_is_where_fmi_ls_xcp_wants_it_and_has_the_addresses(tmp_path, fmi):
    """Section "Structure of the FMU Archive" and the tables of the manifest, version 1.0.0."""
    file, folder = tmp_path / "law.fmu", tmp_path / "unpacked"
    how = ["--inner", "cascaded", "--real", "float64", "--fmi", fmi, "--xcp"]
    assert main(["firmware", "fmu", "vsg-2", *how, "-o", str(file)]) == 0
    assert validate_fmu(str(file)) == []
    fmpy.extract(str(file), str(folder))
    extra = folder / "extra" / "org.fmi-standard.fmi-ls-xcp"
    (library,) = folder.glob("binaries/*linux*/*.so")
    a2l = extra / library.parent.name / f"{library.stem}.a2l"
    assert {*extra.rglob("*.*")} == {extra / "fmi-ls-manifest.xml", a2l}
    assert (folder / "documentation" / "fmi-ls-xcp.txt").is_file()

    root = ElementTree.parse(extra / "fmi-ls-manifest.xml").getroot()
    space = "{http://fmi-standard.org/fmi-ls-manifest}fmi-ls-"
    assert root.tag == "fmiLayeredStandardManifest"
    assert {*root.attrib} == {f"{space}{name}" for name in ("name", "version", "description")}
    assert root.get(f"{space}name") == "org.fmi-standard.fmi-ls-xcp"
    assert root.get(f"{space}version") == "1.0.0"
    (interface,) = root
    assert interface.tag == "Interface" and interface.get("definition") == a2l.name
    assert interface.get("supportsDirectMemoryAccess") == "true"
    assert interface.get("types") == "CoSimulation"

    text = a2l.read_text("ascii")
    assert "/include" not in text  # which the standard forbids
    unit, second = Unit(folder), Unit(folder)
    (row, *_) = [line for line in Path("/proc/self/maps").read_text().splitlines()
                 if line.endswith(str(library.resolve()))]  # fmt: skip
    base = int(row.partition("-")[0], 16)
    refs, ys = accepted(1, 20, "float64", True)
    for it in (unit, second):
        it.start(START)
    for ref, y in zip(refs, ys, strict=True):
        u = unit.tick(ref, y)
        second.tick(ref, y[::-1] * 0.5 + 0.5)
        place = r"MEASUREMENT first_instance\.now\.u\.\w+ .*?ECU_ADDRESS (0x\w+)"
        addresses = [int(x, 16) for x in re.findall(place, text, re.DOTALL)]
        assert [ctypes.c_double.from_address(base + x).value for x in addresses] == u
    unit.it.freeInstance()
    third = Unit(folder)  # takes its place
    third.start(START)
    assert [ctypes.c_double.from_address(base + x).value for x in addresses] == START


@pytest.mark.parametrize("fmi", FMI)
def test_what_the_unit_says_of_itself(built, fmi):
    folder = built("vsg-2", "cascaded", "float64", fmi)
    of = fmpy.read_model_description(folder)
    rows = {
        **{f"ref.{s.name}": s for s in group("ref")},
        **{f"y.{s.name}": s for s in carried_rows("y", True)},
        **{f"u.{s.name}": s for s in command_rows(True)},
        **{f"start.{s.name}": s for s in command_rows(True)},
    }
    found = {v.name: v for v in of.modelVariables}
    gains = law_file("vsg-2").parameters
    own = {f"gain.{name}": one for name, one in gains.items() if one.tied is None}
    others = own.keys() | {"reason"} | ({"time"} if fmi == "3" else set())
    assert found.keys() == rows.keys() | others
    for name, one in own.items():
        v = found[name]
        assert (v.variability, v.unit, float(v.start)) == ("tunable", one.unit, one.value)
        if one.free:
            assert (float(v.min), float(v.max)) == one.free
    for name, s in rows.items():
        v = found[name]
        assert (v.unit, float(v.min), float(v.max)) == (s.unit, s.low, s.high)
        assert v.start is None if name.startswith("u.") else float(v.start) == s.default
    assert float(of.defaultExperiment.stepSize) == T_S
    again = built("vsg-2", "cascaded", "float32", fmi)
    assert of.guid != fmpy.read_model_description(again).guid, "the token follows from the code"


@pytest.mark.parametrize("fmi", FMI)
def test_steps_that_are_no_whole_ticks_are_refused(built, fmi):
    refs, ys = accepted(3, 4, "float64", True)
    units = [Unit(built("vsg-2", "cascaded", "float64", fmi)) for _ in range(2)]
    one, many = units
    for step in (T_S, 0.0):
        with pytest.raises(FMICallException):
            one.it.doStep(2.0, step)  # before the initialisation
    for unit in units:
        unit.start(START)
    for wrong in (0.5 * T_S, 1.5 * T_S, 0.0, -T_S, float("nan")):
        before = one.keep()
        with pytest.raises(FMICallException):
            one.it.doStep(2.0, wrong)
        assert one.keep() == before
    assert "not a whole number of ticks of 0.0001 s" in one.said[-1]
    with pytest.raises(FMICallException):
        one.it.doStep(2.0 + T_S, T_S)
    assert "does not begin where the last one ended" in one.said[-1]
    for _ in range(3):
        found = one.tick(refs[0], ys[0])
    assert many.tick(refs[0], ys[0], ticks=3) == found


@pytest.mark.parametrize("fmi", FMI)
def test_parameters_states_and_a_reset(built, fmi):
    ref = [s.default for s in group("ref")]
    y = [1.0, 0.5, 1.0, 0.0, 1.0, 0.5, 0.0, 1.0, 0.0, 0.5, 0.0]
    unit = Unit(built("vsg-2", "cascaded", "float64", fmi))
    with pytest.raises(FMICallException):
        unit.set([unit._at["start.omega_u"]], [0.0])  # a frequency of 0 is no output
    with pytest.raises(FMICallException):
        unit.set([unit.outputs[0]], [0.0])
    unit.start(START)
    with pytest.raises(FMICallException):
        unit.set([unit._at["start.omega_u"]], [1.0])
    assert "before the end of the initialisation" in unit.said[-1]
    assert (unit.tick(ref, [0.0] * 11), unit.reason) == (START, BAD_Y), "waits"
    first = unit.tick(ref, y)
    assert unit.reason == 0
    assert (unit.tick(ref, [np.nan] * 11), unit.reason) == (first, BAD_Y), "keeps the last good u"
    assert "safe state" in unit.said[-1]
    assert (unit.tick(ref, y), unit.reason) == (first, BAD_Y), "stays there"
    other = Unit(built("vsg-2", "cascaded", "float32", fmi))
    with pytest.raises(FMICallException):
        unit.restore(other.keep())
    unit.it.reset()
    unit.ticks = 0
    unit.start(START)
    assert (unit.tick(ref, y), unit.reason) == (first, 0)
    with pytest.raises(FMICallException):
        unit.it.getBoolean([1])
    assert f"fmi{fmi}GetBoolean: this FMU has no such" in unit.said[-1]


@pytest.mark.parametrize("fmi", FMI)
def test_an_importer_builds_the_sources(built, fmi, tmp_path):
    """FMPy, with CMake and headers of its own, as the FMU's description of the build says."""
    folder = built("vsg-2", "cascaded", "float64", fmi)
    bare = tmp_path / "unpacked"
    shutil.copytree(folder, bare)
    shutil.rmtree(bare / "binaries")
    build_platform_binary(bare)
    refs, ys = accepted(4, 50, "float64", True)
    units = [Unit(at) for at in (folder, bare)]
    for unit in units:
        unit.start(START)
    for ref, y in zip(refs, ys, strict=True):
        first, second = (unit.tick(ref, y) for unit in units)
        assert first == second


@pytest.mark.parametrize("fmi", FMI)
def test_the_interface_is_whole_and_compiles_without_a_warning(built, fmi):
    folder = built("vsg-2", "cascaded", "float64", fmi)
    headers = Path(fmpy.__file__).parent / "c-code"
    for compiler in ("gcc", "clang"):
        arguments = ["-isystem", str(headers), "-fsyntax-only", f"fmi{fmi}.c"]
        done = cc(folder / "sources", *STRICT, *arguments, compiler=compiler)
        assert (done.returncode, done.stderr) == (0, "")
    library = next(folder.glob("binaries/*linux*/*.so"))
    said = cc(folder, "-D", "--defined-only", str(library), compiler="nm").stdout
    exported = {line.split()[-1] for line in said.splitlines()}
    assert all(name.startswith(f"fmi{fmi}") for name in exported)
    if fmi == "3":  # all functions must be there, see FMI 3.0, section 2.1.1
        declared = headers.joinpath("fmi3Functions.h").read_text(encoding="utf-8")
        wanted = [line.split()[1] for line in declared.splitlines() if "fmi3FullName(fmi3" in line]
        assert exported == set(wanted) and len(wanted) > 70


def test_a_scheduled_law_is_one_unit(built):
    """It begins with the first stage, whose bits it has; how it goes on is tested with the DLL."""
    refs, ys = accepted(5, 200, "float64", False)
    folder = built("mimo-gfm-scheduled", "none", "float64", "3")
    assert validate_fmu(str(folder.with_suffix(".fmu"))) == []
    unit, u = Unit(folder), np.array(START[:3])
    unit.start(u)
    kernel = bench("mimo-gfm-scheduled", "none", "float64", refs[0], ys[0], u)
    for ref, y in zip(refs, ys, strict=True):
        kernel.ctl["ref"] = kernel.ctl["ref_target"] = ref
        kernel.step(y, u)
        assert unit.tick(ref, y) == u.tolist()


def test_the_same_law_gives_the_same_file(built, tmp_path):
    first = built("vsg-2", "cascaded", "float64", "3").with_suffix(".fmu")
    command = ["firmware", "fmu", "vsg-2", "--inner", "cascaded", "--real", "float64"]
    assert main([*command, "-o", str(tmp_path / "again.fmu")]) == 0
    assert (tmp_path / "again.fmu").read_bytes() == first.read_bytes()


def test_what_the_command_refuses(tmp_path, refused, monkeypatch):
    command = ["firmware", "fmu", "vsg-1", "-o", str(tmp_path / "law.fmu")]
    with monkeypatch.context() as without:
        module = sys.modules["gfm_runtime.firmware.fmu"]
        without.setattr(module, "find_spec", lambda _: None)
        assert "pip install 'gfmhil[fmu]'" in refused(*command)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "apt-get install gcc libc6-dev" in refused(*command)
    assert not (tmp_path / "law.fmu").exists()
