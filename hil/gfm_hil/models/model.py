"""What a model is to the controller's process, and how one is opened by its kind."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.models.ports import PortMap
from gfm_plant import Bases

if TYPE_CHECKING:
    from gfm_hil.models.pil import PilModel

PIL = "pil:"
KINDS = ("dll", "fmu", "c")
_FILES = "dll:FILE, fmu:FILE or c:FILE"
FORMS = "dll:FILE, fmu:FILE, c:FILE or pil:TARGET"
_LONGEST = 64  # of a name, see gfm_hil.engine.handshake


@dataclass(frozen=True)
class Rig:
    """What a model is connected to.

    Attributes:
        T_s: sampling time of the run, s.
        inner: whether the run has an inner stage, so that y and u have its signals.
        bases: of the converter.
        delay: from the sampling of y to the moment when u acts, in ticks.
    """

    T_s: float = 1e-4
    inner: bool = False
    bases: Bases = field(default_factory=Bases)
    delay: float = 0.0


class ModelError(Exception):
    """A model fails while it runs; the message names it and says what it said."""


class Model(Protocol):
    """A controller that is not ours.

    Attributes:
        name: what the run calls it: 1 to 64 printable ASCII characters.
        real: float64 or float32, for the laws that the controller's process has beside it.
    """

    name: str
    real: str

    def start(self, u: NDArray[np.float64]) -> None:
        """Make it ready for tick 0, its outputs beginning at u, p.u., shape (3,) or (4,).

        Raises:
            ModelError: it refuses.
        """

    def tick(
        self, ref: NDArray[np.float64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> None:
        """One tick: u[k] from the references (5,) and the measurements, p.u.

        Raises:
            ModelError: it fails, or blocks the bridge.
        """

    def close(self) -> None:
        """End it, and remove what it left."""


def open_model(text: str, ports: PortMap, rig: Rig) -> Model | PilModel:
    """The model that ``text`` names.

    Args:
        text: ``dll:FILE``, ``fmu:FILE``, ``c:FILE`` for a library that has the interface of
            ``gfmhil_controller.h``, or ``pil:TARGET`` for the run's own laws.
        ports: which signal each of its ports is.
        rig: what it is connected to.

    Raises:
        UserError: there is no such file, it is no such model, or its ports do not fit.
    """
    if text.startswith(PIL):
        from gfm_hil.models.pil import PilModel

        if ports != PortMap():
            raise UserError(f"controller {text}: has our signals, and takes no map")
        return PilModel(text.removeprefix(PIL))
    kind, path = model_file(text, FORMS)
    if kind == "dll":
        from gfm_hil.models.dll import DllModel

        return DllModel(path, ports, rig.T_s, rig.inner)
    if kind == "c":
        from gfm_hil.models.library import LibraryModel

        return LibraryModel(path, ports, rig)
    from gfm_hil.models.fmu import FmuModel

    return FmuModel(path, ports, rig.T_s, rig.inner)


def model_file(text: str, forms: str = _FILES) -> tuple[str, Path]:
    """The kind and the file of the model ``KIND:FILE``; ``forms`` is what the message allows.

    Raises:
        UserError: there is no such kind or file.
    """
    kind, colon, file = text.partition(":")
    if not colon or kind not in KINDS or not file:
        raise UserError(f"controller {text!r}: must be {forms}")
    _refuse_source(text)
    path = Path(file).absolute()
    if not path.is_file():
        raise UserError(f"{file}: there is no such file")
    return kind, path


def _refuse_source(text: str) -> None:
    file = Path(text.partition(":")[2])
    if text.startswith(("c:", "dll:")) and file.suffix in (".c", ".h", ".cc", ".cpp"):
        raise UserError(
            f"controller {text}: is a source, not a library; compile it by cc -O2 -shared -fPIC "
            f'-I"$(gfmhil firmware include)" {file} -o {file.with_suffix(".so")} -lm, and name '
            f"{file.with_suffix('.so')}"
        )


def check_currents(text: str, inner: bool) -> None:
    """Check that a run, with an inner stage or without, carries what a library in C measures.

    Raises:
        UserError: ``text`` is ``c:FILE``, and the run has no inner stage.
    """
    _refuse_source(text)
    if text.startswith("c:") and not inner:
        raise UserError(
            f"controller {text}: measures currents, which only a run with an inner stage carries: "
            "choose --inner virtual-stator"
        )


def precision(text: str) -> str:
    """The precision, float64 or float32, of the laws beside the model that ``text`` names.

    Raises:
        UserError: it is a target that is not there.
    """
    if not text.startswith(PIL):
        return "float64"
    from gfm_hil.models.pil import PilModel

    return PilModel(text.removeprefix(PIL)).real


def run_name(kind: str, model: str) -> str:
    """What a run calls a model, from what the model calls itself."""
    plain = "".join(c if " " <= c <= "~" else "?" for c in f"{kind} {model}")
    return plain[:_LONGEST].strip()


def ticks_a_step(where: str, step_s: float, T_s: float) -> int:
    """How many ticks of T_s [s] pass between two steps of a model.

    Raises:
        UserError: its step is not a whole number of ticks.
    """
    ticks = round(step_s / T_s) if step_s > 0 else 0
    if ticks < 1 or abs(step_s - ticks * T_s) > 1e-6 * T_s:
        raise UserError(
            f"{where}: its step of {step_s:g} s must be a multiple of the run's T_s = {T_s:g} s"
        )
    return ticks
