"""Inner stages in TOML: the ``[inner]`` table of a law file, or a file of its own.

The shipped ones are in ``gfm_runtime/inner_stages``. A number may be an expression over the
parameters of the law that has the table.
"""

from typing import Any

from pydantic import TypeAdapter

from gfm_runtime.inner import Inner, InnerStage
from gfm_runtime.shipped import NONE, Shipped

_ADAPTER: TypeAdapter[InnerStage] = TypeAdapter(Inner)
_SHIPPED = Shipped("inner stage", "inner_stages", Inner, _ADAPTER.validate_python)
NO_INNER, inner_names, named_inner = NONE, _SHIPPED.names, _SHIPPED.named


def acting(inner: InnerStage) -> dict[str, Any]:
    """The parameters of a stage by name, and those of its power limiter if it has one."""
    names = [name for name in type(inner).model_fields if name not in ("type", "power")]
    out = {name: getattr(inner, name) for name in names}
    if (power := inner.power) is not None:
        out |= {"P_max": power.P_max, "P_min": power.P_min, "k_P": power.k_p, "k_Pi": power.k_i}
    return out
