"""An FMU for co-simulation, FMI 2.0 or 3.0, as a controller; FMPy loads it."""

import contextlib
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.controllers.external import (
    BenchContext,
    ControllerError,
    MappedController,
    State,
    run_name,
    ticks_a_step,
)
from gfm_hil.controllers.phases import Frame
from gfm_hil.controllers.ports import PortMap, Vector, wire
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError, need
from gfm_hil.core.files import Archive
from gfm_runtime.regular import open_regular
from gfm_runtime.signals import command_rows

_NUMBERS = ("Real", "Float64")
_MEMBERS = 10_000  # of an archive, at most
_UNPACKED, _DESCRIPTION = 1 << 29, 1 << 25  # bytes of all members, and of the one that FMPy parses


class FmuController(MappedController):
    """An FMU with a library for this machine. Raises UserError: FMPy is missing, it cannot read the
    file, or the ports do not fit.

    Args:
        path: of the .fmu.
        ports, context: as for ``open_controller``.
    """

    def __init__(self, path: Path, ports: PortMap, context: BenchContext) -> None:
        need("fmpy", "FMPy", f"controller fmu:{path.name}", "fmu")
        import fmpy
        from fmpy.fmi1 import FMICallException

        self._failed: Any = FMICallException
        where, self._said = path.name, ""
        self._resources = contextlib.ExitStack()
        try:
            _check_size(path)
            folder = self._resources.enter_context(scratch.temporary("gfmhil-fmu-"))
            unpacked = fmpy.extract(str(path), str(folder))
            of = fmpy.read_model_description(unpacked)
        except Exception as problem:  # FMPy has no class of its own for it
            self._resources.close()
            why = getattr(problem, "strerror", None) or problem
            raise UserError(f"{path}: is no FMU that FMPy reads: {why}") from None
        if of.coSimulation is None or of.fmiVersion.startswith("1."):
            raise UserError(f"{path}: must be an FMU for co-simulation of FMI 2.0 or 3.0")
        self.name = run_name("fmu", of.modelName)
        can = of.coSimulation
        self.gives_state = bool(can.canGetAndSetFMUstate and can.canSerializeFMUstate)
        self._two = of.fmiVersion.startswith("2.")
        variables = {v.name: v for v in of.modelVariables}
        inputs = [v for v in variables.values() if v.causality == "input"]
        outputs = [v for v in variables.values() if v.causality == "output"]
        self._names = [v.name for v in outputs]
        if ports.initial:
            raise UserError(
                f"{where}: initial in its map: an FMU's outputs begin as it says itself"
            )
        self._wiring = wire(
            where, ports, [v.name for v in inputs], self._names, context.signal_set, context.bases
        )
        self._in, self._out = _by_type(inputs), _by_type(outputs)
        self._fixed: list[tuple[Any, float]] = []
        for name, value in ports.parameters.items():
            if name not in variables or variables[name].causality != "parameter":
                raise UserError(f"{where}: parameters.{name}: is no parameter of the FMU")
            self._fixed.append((variables[name], value))
        #: of an FMU of ours: where the outputs begin
        self._begins = [variables.get(f"start.{s.name}") for s in command_rows(context.signal_set)]
        self._T_s = context.T_s
        self._every = ticks_a_step(where, ports.step_s or self._T_s, self._T_s)
        self._frame = Frame(context, self._every)
        try:
            self._it = fmpy.instantiate_fmu(unpacked, of, "CoSimulation", logger=self._log)
        except Exception as problem:
            raise UserError(f"{path}: cannot be instantiated: {problem}") from None
        self._fresh = True

    def _log(self, *said: Any) -> None:
        text = said[-1]
        self._said = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)

    def start(self, u: Vector) -> None:
        super().start(u)
        with self._calls():
            if not self._fresh:
                self._it.reset()
            self._fresh = False
            for v, value in [*zip(self._begins, u, strict=False), *self._fixed]:
                if v is not None:
                    self._set(v.type, [v.valueReference], [value])
            if self._two:
                self._it.setupExperiment(startTime=0.0)
            self._it.enterInitializationMode()
            self._it.exitInitializationMode()

    def _step(self, inputs: Vector) -> Vector:
        outputs = np.zeros(len(self._names))
        with self._calls():
            for kind, places, references in self._in:
                self._set(kind, references, inputs[places])
            self._it.doStep(self._time, self._every * self._T_s)
            for kind, places, references in self._out:
                outputs[places] = getattr(self._it, f"get{kind}")(references)
        return outputs

    def state(self) -> State:
        with self._calls():
            found = self._it.getFMUState()
            data = bytes(self._it.serializeFMUState(found))
            self._it.freeFMUState(found)
        return super().state() | {"FMUState": np.frombuffer(data, np.uint8)}

    def restore(self, kept: State) -> None:
        super().restore(kept)
        data = kept.get("FMUState")
        if data is None:
            raise UserError(f"{self.name}: the snapshot has nothing for its FMUState")
        with self._calls():
            found = self._it.deserializeFMUState(data.tobytes())
            self._it.setFMUState(found)
            self._it.freeFMUState(found)

    def close(self) -> None:
        with contextlib.suppress(self._failed):
            self._it.terminate()
            self._it.freeInstance()
        self._resources.close()

    def _set(self, kind: str, references: list[int], values: Any) -> None:
        plain = [float(v) if kind in _NUMBERS else int(v) for v in values]
        getattr(self._it, f"set{kind}")(references, plain)

    @contextlib.contextmanager
    def _calls(self) -> Iterator[None]:
        """Call the FMU. Raises ControllerError: a call failed; with what the FMU logged last."""
        try:
            yield
        except self._failed as problem:
            said = f" ({self._said})" if self._said else ""
            raise ControllerError(f"{self.name}: {problem}{said}") from None


def _check_size(path: Path) -> None:
    """See that a file is an archive that may be unpacked. Raises OSError: it is no regular file;
    BadZipFile: it is no archive, or has too many or too large members."""
    with open_regular(path) as file, zipfile.ZipFile(Archive(file, _MEMBERS)) as archive:
        size = sum(info.file_size for info in archive.infolist())
        if size > _UNPACKED:
            raise zipfile.BadZipFile(f"unpacked it has {size} bytes, more than {_UNPACKED}")
        described = archive.getinfo("modelDescription.xml").file_size
        if described > _DESCRIPTION:
            said = f"modelDescription.xml has {described} bytes, more than {_DESCRIPTION}"
            raise zipfile.BadZipFile(said)


def _by_type(variables: list[Any]) -> list[tuple[str, list[int], list[int]]]:
    """Of each type, the places of its variables in the list and their value references."""
    found: dict[str, tuple[list[int], list[int]]] = {}
    for k, v in enumerate(variables):
        places, references = found.setdefault(v.type, ([], []))
        places.append(k)
        references.append(v.valueReference)
    return [(kind, *both) for kind, both in found.items()]
