"""An FMU for co-simulation, FMI 2.0 or 3.0, as a controller; FMPy loads it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError, need
from gfm_hil.models.model import ModelError, run_name, ticks_a_step
from gfm_hil.models.ports import PortMap, wire
from gfm_runtime.signals import command_rows

_NUMBERS = ("Real", "Float64")


class FmuModel:
    """An FMU with a library for this machine.

    Args:
        path: of the .fmu.
        ports, T_s, inner: as for ``open_model``.

    Raises:
        UserError: FMPy is missing, it cannot read the file, or the ports do not fit.
    """

    real = "float64"

    def __init__(self, path: Path, ports: PortMap, T_s: float, inner: bool) -> None:
        need("fmpy", "FMPy", f"controller fmu:{path.name}", "fmu")
        import fmpy
        from fmpy.fmi1 import FMICallException

        self._failed: Any = FMICallException
        where, self._said = path.name, ""
        self._resources = contextlib.ExitStack()
        try:
            folder = self._resources.enter_context(scratch.temporary("gfmhil-fmu-"))
            unpacked = fmpy.extract(str(path), str(folder))
            of = fmpy.read_model_description(unpacked)
        except Exception as problem:  # FMPy has no class of its own for it
            raise UserError(f"{path}: is no FMU that FMPy reads: {problem}") from None
        if of.coSimulation is None or of.fmiVersion.startswith("1."):
            raise UserError(f"{path}: must be an FMU for co-simulation of FMI 2.0 or 3.0")
        self.name = run_name("fmu", of.modelName)
        self._two = of.fmiVersion.startswith("2.")
        variables = {v.name: v for v in of.modelVariables}
        inputs = [v for v in variables.values() if v.causality == "input"]
        outputs = [v for v in variables.values() if v.causality == "output"]
        self._names = [v.name for v in outputs]
        self._wiring = wire(where, ports, [v.name for v in inputs], self._names, inner)
        self._in, self._out = _by_type(inputs), _by_type(outputs)
        self._fixed: list[tuple[Any, float]] = []
        for name, value in ports.parameters.items():
            if name not in variables or variables[name].causality != "parameter":
                raise UserError(f"{where}: parameters.{name}: is no parameter of the FMU")
            self._fixed.append((variables[name], value))
        #: of an FMU of ours: where the outputs begin
        self._begins = [variables.get(f"start.{s.name}") for s in command_rows(inner)]
        self._every = ticks_a_step(where, ports.step_s or T_s, T_s)
        self._T_s, self._ticks = T_s, 0
        try:
            self._it = fmpy.instantiate_fmu(unpacked, of, "CoSimulation", logger=self._log)
        except Exception as problem:
            raise UserError(f"{path}: cannot be instantiated: {problem}") from None
        self._fresh = True

    def _log(self, *said: Any) -> None:
        text = said[-1]
        self._said = text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)

    def start(self, u: NDArray[np.float64]) -> None:
        """See ``Model``."""
        self._ticks = 0
        try:
            if not self._fresh:
                self._it.reset()
            self._fresh = False
            for v, value in [*zip(self._begins, u, strict=True), *self._fixed]:
                if v is not None:
                    self._set(v.type, [v.valueReference], [value])
            if self._two:
                self._it.setupExperiment(startTime=0.0)
            self._it.enterInitializationMode()
            self._it.exitInitializationMode()
        except self._failed as problem:
            raise ModelError(self._why(problem)) from None

    def tick(
        self, ref: NDArray[np.float64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> None:
        """See ``Model``."""
        if self._ticks % self._every == 0:
            values = self._wiring.inputs(ref, y)
            outputs = np.zeros(len(self._names))
            try:
                for kind, places, references in self._in:
                    self._set(kind, references, values[places])
                self._it.doStep(self._ticks * self._T_s, self._every * self._T_s)
                for kind, places, references in self._out:
                    outputs[places] = getattr(self._it, f"get{kind}")(references)
            except self._failed as problem:
                raise ModelError(self._why(problem)) from None
            blocks = self._wiring.blocks
            if blocks >= 0 and outputs[blocks] != 0:
                raise ModelError(
                    f"{self.name}: blocks the bridge: {self._names[blocks]} = {outputs[blocks]:g}"
                )
            self._wiring.take(outputs, u)
        self._ticks += 1

    def close(self) -> None:
        """See ``Model``."""
        with contextlib.suppress(self._failed):
            self._it.terminate()
            self._it.freeInstance()
        self._resources.close()

    def _set(self, kind: str, references: list[int], values: Any) -> None:
        plain = [float(v) if kind in _NUMBERS else int(v) for v in values]
        getattr(self._it, f"set{kind}")(references, plain)

    def _why(self, problem: Exception) -> str:
        return f"{self.name}: {problem}{f' ({self._said})' if self._said else ''}"


def _by_type(variables: list[Any]) -> list[tuple[str, list[int], list[int]]]:
    """Of each type, the places of its variables in the list and their value references."""
    found: dict[str, tuple[list[int], list[int]]] = {}
    for k, v in enumerate(variables):
        places, references = found.setdefault(v.type, ([], []))
        places.append(k)
        references.append(v.valueReference)
    return [(kind, *both) for kind, both in found.items()]
