"""A real-code model of the interface of IEEE and CIGRE (CIGRE TB 958) as a controller.

The structures are those of the interface's header, version 2, with natural alignment. Ports may
have any width and any type of number; real-code models that leave out FirstCall, CheckParameters
or Terminate are loaded too.
"""

import ctypes as c
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.controllers.external import (
    BenchContext,
    ControllerError,
    MappedController,
    State,
    put_back,
    run_name,
    text_of,
    ticks_a_step,
)
from gfm_hil.controllers.phases import Frame
from gfm_hil.controllers.ports import PortMap, Vector, wire
from gfm_hil.core.errors import UserError

_EMT, _ERROR = 1, 2
#: DataType: numpy's type; 10 is text
_TYPES = {1: "i1", 2: "i1", 3: "u1", 4: "i2", 5: "u2", 6: "i4", 7: "u4", 8: "f4", 9: "f8"}
_TEXT = 10
_MOST = 10_000  # ports, parameters or states of a real-code model


class _Signal(c.Structure):
    _fields_ = (
        ("Name", c.c_char_p), ("Description", c.c_char_p), ("Unit", c.c_char_p),
        ("DataType", c.c_int), ("Width", c.c_int32),
    )  # fmt: skip


class _Value(c.Union):
    _fields_ = (("bytes", c.c_uint8 * 8), ("text", c.c_char_p))


class _Parameter(c.Structure):
    _fields_ = (
        ("Name", c.c_char_p), ("GroupName", c.c_char_p), ("Description", c.c_char_p),
        ("Unit", c.c_char_p), ("DataType", c.c_int), ("FixedValue", c.c_int),
        ("DefaultValue", _Value), ("MinValue", _Value), ("MaxValue", _Value),
    )  # fmt: skip


class _Info(c.Structure):
    _fields_ = (
        ("DLLInterfaceVersion", c.c_uint8 * 4),
        *((name, c.c_char_p) for name in (
            "ModelName", "ModelVersion", "ModelDescription", "GeneralInformation", "ModelCreated",
            "ModelCreator", "ModelLastModifiedDate", "ModelLastModifiedBy", "ModelModifiedComment",
            "ModelModifiedHistory")),
        ("FixedStepBaseSampleTime", c.c_double), ("EMT_RMS_Mode", c.c_uint8),
        ("NumInputPorts", c.c_int32), ("InputPortsInfo", c.POINTER(_Signal)),
        ("NumOutputPorts", c.c_int32), ("OutputPortsInfo", c.POINTER(_Signal)),
        ("NumParameters", c.c_int32), ("ParametersInfo", c.POINTER(_Parameter)),
        ("NumIntStates", c.c_int32), ("NumFloatStates", c.c_int32), ("NumDoubleStates", c.c_int32),
    )  # fmt: skip


class _Instance(c.Structure):
    _fields_ = (
        ("ExternalInputs", c.c_void_p), ("ExternalOutputs", c.c_void_p), ("Parameters", c.c_void_p),
        ("Time", c.c_double), ("SimTool_EMT_RMS_Mode", c.c_uint8),
        ("LastErrorMessage", c.c_char_p), ("LastGeneralMessage", c.c_char_p),
        ("IntStates", c.c_void_p), ("FloatStates", c.c_void_p), ("DoubleStates", c.c_void_p),
    )  # fmt: skip


class _Values:
    """Values in one block of memory, each of its own type, with natural alignment.

    Args:
        where: for errors.
        fields: name, DataType and width of each.
    """

    def __init__(self, where: str, fields: list[tuple[str, int, int]]) -> None:
        for name, kind, width in fields:
            if (kind not in _TYPES and kind != _TEXT) or not 1 <= width <= _MOST:
                raise UserError(f"{where}: {name} has DataType {kind} and Width {width}")
        places = [(f"f{k}", _TYPES.get(kind, "u8"), (w,)) for k, (_, kind, w) in enumerate(fields)]
        self._block = np.zeros(1, np.dtype(places, align=True))
        self.at = self._block.ctypes.data
        self.names: list[str] = []
        self._views: list[NDArray[Any]] = []
        for k, (name, _, width) in enumerate(fields):
            for j in range(width):
                self.names.append(name if width == 1 else f"{name}[{j}]")
                self._views.append(self._block[f"f{k}"][0, j : j + 1])

    def write(self, values: Vector) -> None:
        for view, value in zip(self._views, values, strict=True):
            if view.dtype != np.uint64:  # text is an address, which no number is
                view[0] = value

    def read(self) -> Vector:
        return np.array([view[0] for view in self._views], float)

    def view(self, name: str) -> NDArray[Any]:
        return self._views[self.names.index(name)]


class DllController(MappedController):
    """A controller in a shared library of Linux. Raises UserError: it cannot be loaded, has not the
    interface, or its ports do not fit.

    Args:
        path: of the library.
        ports, context: as for ``open_controller``.
    """

    def __init__(self, path: Path, ports: PortMap, context: BenchContext) -> None:
        where = path.name
        self._of, info = _open(path)
        self.name = run_name("dll", text_of(info.ModelName) or path.stem)
        self._in = _Values(where, _fields(info.InputPortsInfo, info.NumInputPorts))
        self._out = _Values(where, _fields(info.OutputPortsInfo, info.NumOutputPorts))
        self._names = self._out.names
        self._wiring = wire(
            where, ports, self._in.names, self._names, context.signal_set, context.bases
        )
        self._parameters = _parameters(where, info, ports)
        declared = info.FixedStepBaseSampleTime
        if ports.step_s and declared and abs(ports.step_s - declared) > 1e-6 * declared:
            raise UserError(
                f"{where}: step_s = {ports.step_s:g} in its map, but it declares"
                f" FixedStepBaseSampleTime = {declared:g} s; leave step_s out"
            )
        step_s, self._T_s = declared or ports.step_s or context.T_s, context.T_s
        self._every = ticks_a_step(where, step_s, context.T_s)
        self._frame = Frame(context, self._every)
        # one that declares none keeps it in variables of its own
        self.gives_state = info.NumIntStates + info.NumFloatStates + info.NumDoubleStates > 0
        self._states = (
            np.zeros(max(info.NumIntStates, 1), np.int32),
            np.zeros(max(info.NumFloatStates, 1), np.float32),
            np.zeros(max(info.NumDoubleStates, 1)),
        )
        self._now = _Instance(
            self._in.at, self._out.at, self._parameters.at, 0.0, _EMT, None, None,
            *(states.ctypes.data for states in self._states),
        )  # fmt: skip

    def state(self) -> State:
        """With the model's state in its arrays, where the interface wants all of it."""
        ports = {"inputs": self._in.read(), "outputs": self._out.read()}
        return super().state() | ports | {k: a.copy() for k, a in self._named_states()}

    def restore(self, kept: State) -> None:
        super().restore(kept)
        inputs, outputs = self._in.read(), self._out.read()
        put_back(self.name, kept, "inputs", inputs)
        put_back(self.name, kept, "outputs", outputs)
        self._in.write(inputs)
        self._out.write(outputs)
        if self._wiring.waits:  # it has not begun yet, and may do more there than set its states
            self._call("Model_Initialize")
            self._out.write(outputs)
        for name, states in self._named_states():
            put_back(self.name, kept, name, states)

    def _named_states(self) -> list[tuple[str, NDArray[Any]]]:
        return list(zip(("IntStates", "FloatStates", "DoubleStates"), self._states, strict=True))

    def start(self, u: Vector) -> None:
        super().start(u)
        for states in self._states:
            states[:] = 0
        for name in ("Model_FirstCall", "Model_CheckParameters"):
            if hasattr(self._of, name):
                self._call(name)
        if not self._wiring.waits:
            self._initialize(np.zeros(0))

    def _first(self, known: Vector) -> None:
        if self._wiring.waits:
            self._in.write(self._wiring.inputs(known))
            self._initialize(known)

    def _initialize(self, known: Vector) -> None:
        self._out.write(self._wiring.outputs(self._u, known))
        self._call("Model_Initialize")

    def _step(self, inputs: Vector) -> Vector:
        self._in.write(inputs)
        self._now.Time = self._time
        self._call("Model_Outputs")
        return self._out.read()

    def close(self) -> None:
        if hasattr(self._of, "Model_Terminate"):
            self._of.Model_Terminate(c.byref(self._now))

    def _call(self, name: str) -> None:
        self._now.LastErrorMessage = None
        if getattr(self._of, name)(c.byref(self._now)) == _ERROR:
            said = text_of(self._now.LastErrorMessage) or "it does not say why"
            raise ControllerError(f"{self.name}: {name} failed: {said}")


def _open(path: Path) -> tuple[c.CDLL, _Info]:
    """The library and what its model says of itself; raises as ``DllController``."""
    try:
        library = c.CDLL(str(path.absolute()))
    except OSError as problem:
        raise UserError(f"{path}: cannot be loaded: {problem}") from None
    for needed in ("Model_GetInfo", "Model_Initialize", "Model_Outputs"):
        if not hasattr(library, needed):
            other = "; it has gfmhil_version: use c:" if hasattr(library, "gfmhil_version") else ""
            raise UserError(f"{path}: has no function {needed}, so it is no real-code model{other}")
    library.Model_GetInfo.restype = c.POINTER(_Info)
    info: _Info = library.Model_GetInfo().contents
    if info.DLLInterfaceVersion[0] != 1:
        version = ".".join(map(str, info.DLLInterfaceVersion))
        raise UserError(f"{path}: its interface has version {version}; this bench knows 1.x")
    counts = (info.NumInputPorts, info.NumOutputPorts, info.NumParameters, info.NumIntStates,
              info.NumFloatStates, info.NumDoubleStates)  # fmt: skip
    if not all(0 <= count <= _MOST for count in counts):
        raise UserError(f"{path}: has {counts} ports, parameters and states")
    return library, info


def describe_model(path: Path) -> tuple[str, list[tuple[str, str, str, str]]]:
    """A model in a sentence, and its ports and parameters: name as in a map, width or default,
    unit, description. Raises UserError: as ``DllController``."""
    _, info = _open(path)
    rows = []
    for kind, ports, count in (
        ("inputs", info.InputPortsInfo, info.NumInputPorts),
        ("outputs", info.OutputPortsInfo, info.NumOutputPorts),
    ):
        for port in ports[:count]:
            width = str(port.Width) if port.Width > 1 else ""
            rows.append((f"{kind}.{text_of(port.Name)}", width, port))
    values = _parameters(path.name, info, PortMap())
    for row in info.ParametersInfo[: info.NumParameters]:
        is_text = row.DataType == _TEXT
        default = "text" if is_text else f"{values.view(text_of(row.Name))[0]:g}"
        rows.append((f"parameters.{text_of(row.Name)}", default, row))
    step = info.FixedStepBaseSampleTime
    every = f"every {step:g} s" if step else "at any step"
    states = info.NumIntStates + info.NumFloatStates + info.NumDoubleStates
    told = f"{text_of(info.ModelName)} {text_of(info.ModelVersion)}: runs {every}, {states} states"
    return told, [(n, w, text_of(x.Unit), text_of(x.Description)) for n, w, x in rows]


def _fields(ports: Any, count: int) -> list[tuple[str, int, int]]:
    return [(text_of(ports[k].Name), ports[k].DataType, ports[k].Width) for k in range(count)]


def _parameters(where: str, info: _Info, ports: PortMap) -> _Values:
    """The parameters at their defaults, or at the map's values."""
    rows = [info.ParametersInfo[k] for k in range(info.NumParameters)]
    values = _Values(where, [(text_of(row.Name), row.DataType, 1) for row in rows])
    for row in rows:
        view = values.view(text_of(row.Name))
        view[:] = np.frombuffer(bytes(row.DefaultValue.bytes), view.dtype, 1)
    for name, value in ports.parameters.items():
        if name not in values.names:
            there = ", ".join(values.names) or "none"
            raise UserError(f"{where}: parameters.{name} in its map: it has {there}")
        view = values.view(name)
        view[0] = value
    return values
