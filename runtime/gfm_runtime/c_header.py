"""The kernel's records as C structs, for firmware that holds the same bytes.

``python -m gfm_runtime.c_header [float64|float32]`` prints the header. It checks itself: the size
of each struct and the place of each field are asserted when it is compiled, so an ABI that lays
structs out otherwise stops with an error instead of reading the wrong bytes.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from gfm_runtime.error_maps import ERROR_MAPS, R_MIN, V_MIN
from gfm_runtime.inner import KINDS, NEGLIGIBLE, PRIORITIES
from gfm_runtime.kernel import N_MAX, law_dtype, state_dtype
from gfm_runtime.signals import NU, NU_INNER, NY, NY_INNER

_C_TYPES = {"i8": "int64_t", "u8": "uint64_t", "f8": "double", "f4": "float"}


def c_struct(dtype: np.dtype[Any], name: str) -> str:
    """C11 text of a struct with the layout of a record.

    Args:
        dtype: a record of 64-bit integers and floats or arrays of them, in this machine's order.
        name: the type's name in C.

    Raises:
        ValueError: a field of another kind; it is named.
    """
    if dtype.fields is None:
        raise ValueError(f"{name}: {dtype} is not a record")
    members, checks = [], [f'_Static_assert(sizeof({name}) == {dtype.itemsize}, "{name}");']
    for field, (kind, offset, *_) in dtype.fields.items():
        c_type = _C_TYPES.get(kind.base.str[1:]) if kind.base.isnative else None
        if c_type is None:
            raise ValueError(f"{name}.{field}: {kind.base} has no C type here")
        members.append(f"    {c_type} {field}{''.join(f'[{n}]' for n in kind.shape)};")
        place = f"{name}.{field}"
        checks.append(f'_Static_assert(offsetof({name}, {field}) == {offset}, "{place}");')
    return "\n".join(["typedef struct {", *members, f"}} {name};", *checks, ""])


def _numbered(prefix: str, names: Mapping[str, int]) -> list[str]:
    return [f"#define {prefix}_{k.upper().replace('-', '_')} {v}" for k, v in names.items()]


def c_header(real: DTypeLike = np.float64) -> str:
    """The whole header: ``real``, the constants, ``law_t`` and ``state_t``; float64 or float32."""
    f = np.dtype(real)
    if f not in (np.float64, np.float32):
        raise ValueError(f"real = {f}: must be float64 or float32")
    return "\n".join(
        [
            f"/* Records of gfm_runtime.kernel in {f}; made by python -m gfm_runtime.c_header. */",
            "#ifndef GFM_LAW_H",
            "#define GFM_LAW_H",
            "",
            "#include <stddef.h>",
            "#include <stdint.h>",
            "",
            f"#define N_MAX {N_MAX}",
            f"#define NY {NY}",
            f"#define NU {NU}",
            f"#define NY_INNER {NY_INNER}",
            f"#define NU_INNER {NU_INNER}",
            f"#define V_MIN {V_MIN!r}",
            f"#define R_MIN {R_MIN.hex()}",
            f"#define NEGLIGIBLE {NEGLIGIBLE.hex()}",
            *_numbered("ERROR", ERROR_MAPS),
            *_numbered("INNER", KINDS),
            *_numbered("PRIORITY", PRIORITIES),
            "",
            f"typedef {_C_TYPES[f.str[1:]]} real;",
            "",
            c_struct(law_dtype(f), "law_t"),
            c_struct(state_dtype(f), "state_t"),
            "#endif",
            "",
        ]
    )


if __name__ == "__main__":
    print(c_header(*sys.argv[1:2]), end="")
