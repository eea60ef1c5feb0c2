"""The controls of a synchronous machine, one a file, and their registries.

A new control is a file here and a line there.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Union

from pydantic import BeforeValidator, Field

from gfm_plant.components.controls.control import (
    Control,
    Exciter,
    Governor,
    Shaft,
    Stabiliser,
    Terminals,
)
from gfm_plant.components.controls.esst3a import Esst3a
from gfm_plant.components.controls.esst4b import Esst4b
from gfm_plant.components.controls.exdc2 import Exdc2
from gfm_plant.components.controls.exst1 import Exst1
from gfm_plant.components.controls.gast import Gast
from gfm_plant.components.controls.ggov1 import Ggov1
from gfm_plant.components.controls.hygov import Hygov
from gfm_plant.components.controls.ieeeg1 import Ieeeg1
from gfm_plant.components.controls.ieeet1 import Ieeet1
from gfm_plant.components.controls.pss1a import Pss1a
from gfm_plant.components.controls.sexs import Sexs
from gfm_plant.components.controls.st2cut import St2cut
from gfm_plant.components.controls.tgov1 import Tgov1
from gfm_runtime.compiled import inlined_as

EXCITERS: tuple[type[Exciter], ...] = (Sexs, Ieeet1, Exdc2, Exst1, Esst3a, Esst4b)
GOVERNORS: tuple[type[Governor], ...] = (Tgov1, Ieeeg1, Hygov, Gast, Ggov1)
STABILISERS: tuple[type[Stabiliser], ...] = (Pss1a, St2cut)


def _one_of(kinds: Sequence[type[Control]]) -> Any:
    """The type of a table whose key ``type`` names one of the kinds; the first if it is left
    out."""
    if len(kinds) == 1:
        return kinds[0]

    def named(table: Any) -> Any:
        return {"type": kinds[0].kind(), **table} if isinstance(table, dict) else table

    union: Any = Union[tuple(kinds)]  # noqa: UP007
    return Annotated[union, Field(discriminator="type"), BeforeValidator(named)]


AnyExciter: Any = _one_of(EXCITERS)
AnyGovernor: Any = _one_of(GOVERNORS)
AnyStabiliser: Any = _one_of(STABILISERS)


def _chosen(role: str, kinds: Sequence[type[Control]]) -> Any:
    """A compiled function (kind, p, x, at, seen, asked, out) that calls the ``rates`` of a kind, of
    which the first is 1; of 0 the output is what is asked for."""

    def none(kind: int, p: Any, x: Any, at: int, seen: Any, asked: float, out: Any) -> float:
        return asked

    chain = inlined_as(role, none)
    for k, one in reversed([*enumerate(kinds, 1)]):
        chain = _link(role, one.rates, k, chain)
    return chain


def _link(role: str, call: Callable[..., float], k: int, others: Callable[..., float]) -> Any:
    def link(kind: int, p: Any, x: Any, at: int, seen: Any, asked: float, out: Any) -> float:
        if kind == k:
            return call(p, x, at, seen, asked, out)
        return others(kind, p, x, at, seen, asked, out)

    return inlined_as(f"{role}_{k}", link)


excite, govern = _chosen("excite", EXCITERS), _chosen("govern", GOVERNORS)
stabilise = _chosen("stabilise", STABILISERS)


def _most(kinds: Sequence[type[Control]], seen: Any) -> int:
    return max(len(kind().rest(1.0, seen)[0]) for kind in kinds)


_EACH = (*EXCITERS, *GOVERNORS, *STABILISERS)
#: numbers and states of one of each role, at most
MOST_NUMBERS = max(len(kind().numbers()) for kind in _EACH)
OF_EXCITER = _most(EXCITERS, Terminals(1.0, 1.0, 1.0 + 0j, 0j))
OF_GOVERNOR, OF_STABILISER = _most(GOVERNORS, Shaft(0.0, 1.0)), _most(STABILISERS, 0.0)
