"""Changes the gains of a running law: prepared off the loop, swapped in one tick."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from numpy.typing import NDArray

from gfm_runtime import law_file, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.errors import LawError
from gfm_runtime.kernel import pack_law
from gfm_runtime.lawfile import tied
from gfm_runtime.tustin import DiscreteLaw, discretise

Gains = tuple[tuple[str, float], ...]
Retuned = tuple[DiscreteLaw, NDArray[Any]]


@lru_cache(maxsize=64)
def retuned(name: str, gains: Gains, T_s: float, omega_b: float, inner: str | None) -> Retuned:
    """A law with some gains changed, discretised, and packed for the kernel.

    A gain that the law file ties to a changed one follows it unless it is given too. The newest
    results are cached: the command server's check prepares what the loop then uses. ``omega_b`` is
    that of the converter, rad/s, for an inner stage.

    Raises:
        ValueError: a scheduled law, a name that its file does not have, or no such law.
    """
    try:
        file = law_file(name)
        if file.schedule is not None:
            raise LawError(f"law {name}", "is scheduled: its gains change by themselves")
        (law,) = load_law(name, inner, **tied(file, dict(gains))).laws
        discrete = discretise(law, T_s)
        return discrete, pack_law(discrete, omega_b=omega_b)
    except LawError as problem:
        raise ValueError(str(problem)) from None


def change_gains(controller: Controller, values: Mapping[str, float]) -> int:
    """Change gains of the law selected last, on top of earlier changes.

    Returns:
        The index of the law from now on.

    Raises:
        ValueError: as ``retuned``.
    """
    return controller.retune(*ready_gains(controller, values), {**controller.gains, **values})


def ready_gains(controller: Controller, values: Mapping[str, float]) -> Retuned:
    """What ``change_gains`` changes to.

    Raises:
        ValueError: as ``retuned``.
    """
    gains = {**controller.gains, **values}
    name = controller.asked
    inner = controller.sets[name].inner
    return retuned(name, tuple(sorted(gains.items())), controller.T_s, controller.omega_b, inner)
