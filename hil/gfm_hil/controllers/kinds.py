"""How a controller is opened by its kind."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from gfm_hil.controllers.dll import DllController
from gfm_hil.controllers.external import BenchContext, ExternalController, refuse_source
from gfm_hil.controllers.fmu import FmuController
from gfm_hil.controllers.library import LibraryController
from gfm_hil.controllers.ports import PortMap
from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt

if TYPE_CHECKING:
    from gfm_hil.controllers.pil import PilController

PIL = "pil:"
_KINDS: dict[str, Callable[[Path, PortMap, BenchContext], ExternalController]] = {
    "dll": DllController,
    "fmu": FmuController,
    "c": LibraryController,
}
_FILES = "dll:FILE, fmu:FILE or c:FILE"
FORMS = "dll:FILE, fmu:FILE, c:FILE or pil:TARGET"
_POLL_S = 0.05

T = TypeVar("T")


def open_controller(text: str, ports: PortMap, context: BenchContext) -> ExternalController:
    """The controller that ``text`` names. Raises UserError: there is no such file, its ports do not
    fit, or a signal came while its code kept us.

    Args:
        text: ``dll:FILE``, ``fmu:FILE``, ``c:FILE`` for a library that has the interface of
            ``gfmhil_controller.h``, or ``pil:TARGET`` for the run's own laws.
        ports: which signal each of its ports is.
        context: what it is connected to.
    """
    if text.startswith(PIL):
        if ports != PortMap():
            raise UserError(f"controller {text}: has our signals, and takes no map")
        return _pil(text)
    kind, path = controller_file(text, FORMS)
    where = "gfmhil_new" if kind == "c" else "being opened"
    return until_signal(f"{path.name}: {where}", lambda: _KINDS[kind](path, ports, context))


def until_signal(what: str, work: Callable[[], T]) -> T:
    """What ``work`` gives, in a thread of its own: foreign code that does not come back would keep
    signals from acting. Raises UserError: SIGINT, SIGTERM or SIGHUP came first; it says ``what``
    did not come back."""
    found: Future[T] = Future()

    def call() -> None:
        try:
            found.set_result(work())
        except BaseException as problem:  # the caller's thread raises it
            found.set_exception(problem)

    with Interrupt() as interrupt:
        threading.Thread(target=call, daemon=True).start()
        while not wait([found], _POLL_S).done:
            if interrupt.came:
                raise UserError(f"{what} does not come back")
    return found.result()


def controller_file(text: str, forms: str = _FILES) -> tuple[str, Path]:
    """The kind and the file of the controller ``KIND:FILE``; ``forms`` is what the message allows.
    Raises UserError: there is no such kind or file."""
    kind, colon, file = text.partition(":")
    if not colon or kind not in _KINDS or not file:
        raise UserError(f"controller {text!r}: must be {forms}")
    refuse_source(text)
    path = Path(file).absolute()
    if not path.is_file():
        raise UserError(f"{file}: there is no such file")
    return kind, path


def precision(text: str) -> str:
    """The precision, float64 or float32, of the laws beside the controller that ``text`` names.
    Raises UserError: it is a target that is not there."""
    return _pil(text).real if text.startswith(PIL) else "float64"


def _pil(text: str) -> PilController:
    # brings the compilers in, which few runs need
    from gfm_hil.controllers.pil import PilController

    return PilController(text.removeprefix(PIL))
