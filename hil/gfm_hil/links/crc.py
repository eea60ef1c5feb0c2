"""CRC-32 of a frame, compiled: that of zlib and Ethernet (reflected polynomial 0xEDB88320).

If the processor has a carry-less multiplication (PCLMULQDQ), 16 bytes are folded onto the next 16
until 16 are left (V. Gopal et al., "Fast CRC Computation for Generic Polynomials Using PCLMULQDQ
Instruction", Intel, 2009); tables process those 16, and all bytes on other processors.
"""

from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import config

from gfm_hil.realtime.atomics import load32, load64
from gfm_runtime.compiled import inlined, intrinsic

_AT_ONCE = 16  # bytes
_ONES = np.uint32(0xFFFFFFFF)
_HALF = np.uint64(32)

# factors that move the first and the second 8 bytes 16 bytes ahead: x^(128+32) and x^(128-32)
# modulo the polynomial, reflected
_FIRST, _SECOND = np.uint64(0x1_7519_97D0), np.uint64(0x0_CCAA_009E)


def _tables() -> np.ndarray:
    """Tables of the reflected polynomial: remainder of a byte followed by 0, 1, … zero bytes."""
    tables = np.zeros((_AT_ONCE, 256), np.uint32)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
        tables[0, byte] = crc
    for k in range(1, _AT_ONCE):
        before = tables[k - 1]
        tables[k] = (before >> np.uint32(8)) ^ tables[0][before & 0xFF]
    return tables


_T = _tables()


@intrinsic
def _fold(typingctx, low, high, next_low, next_high):
    """Fold two words onto the next two by carry-less multiplication, and add (XOR)."""
    word = types.uint64

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        i64 = ir.IntType(64)
        pair = ir.VectorType(i64, 2)

        def vector(low: Any, high: Any) -> Any:
            one = builder.insert_element(pair(ir.Undefined), low, ir.IntType(32)(0))
            return builder.insert_element(one, high, ir.IntType(32)(1))

        name, i8 = "llvm.x86.pclmulqdq", ir.IntType(8)
        known = builder.module.globals.get(name)
        multiply = known or ir.Function(
            builder.module, ir.FunctionType(pair, [pair, pair, i8]), name
        )
        here, there = vector(*arguments[:2]), vector(*arguments[2:])
        by = ir.Constant(pair, [int(_FIRST), int(_SECOND)])
        for which in (0x00, 0x11):  # low by low, high by high
            there = builder.xor(there, builder.call(multiply, [here, by, i8(which)]))
        words = [builder.extract_element(there, ir.IntType(32)(k)) for k in (0, 1)]
        return context.make_tuple(builder, signature.return_type, words)

    return types.UniTuple(word, 2)(word, word, word, word), make


@inlined
def _four(word, after):
    """Remainder of four bytes followed by ``after`` more bytes of the same step."""
    return (
        _T[after + 3, word & 0xFF]
        ^ _T[after + 2, (word >> np.uint32(8)) & 0xFF]
        ^ _T[after + 1, (word >> np.uint32(16)) & 0xFF]
        ^ _T[after, word >> np.uint32(24)]
    )


@inlined
def crc32_by_tables(message, count):
    """CRC-32 of the first ``count`` bytes, 16 at a time."""
    crc = _ONES
    at = message.ctypes.data
    k = 0
    while k + _AT_ONCE <= count:
        # first the terms that do not depend on the previous step's CRC
        later = _four(load32(at + k + 12), 0) ^ _four(load32(at + k + 8), 4)
        later ^= _four(load32(at + k + 4), 8)
        crc = later ^ _four(crc ^ load32(at + k), 12)
        k += _AT_ONCE
    while k + 4 <= count:
        crc = _four(crc ^ load32(at + k), 0)
        k += 4
    while k < count:
        crc = _T[0, (crc ^ message[k]) & 0xFF] ^ (crc >> np.uint32(8))
        k += 1
    return crc ^ _ONES


@inlined
def crc32_by_folding(message, count):
    """The same for 12, 28, 44, … bytes, the lengths of our frames; others go through the tables."""
    if count % _AT_ONCE != 12:
        return crc32_by_tables(message, count)
    at = message.ctypes.data
    # four leading zero bytes do not change the remainder and make the first block 16 bytes
    low, high = np.uint64(load32(at) ^ _ONES) << _HALF, load64(at + 4)
    k = 12
    while k < count:
        low, high = _fold(low, high, load64(at + k), load64(at + k + 8))
        k += _AT_ONCE
    crc = _four(np.uint32(low), 12) ^ _four(np.uint32(low >> _HALF), 8)
    return crc ^ _four(np.uint32(high), 4) ^ _four(np.uint32(high >> _HALF), 0) ^ _ONES


def _folds() -> bool:
    """Whether numba compiles for a processor with PCLMULQDQ; its cache is per processor too."""
    asked: str | None = vars(config)["CPU_FEATURES"]  # NUMBA_CPU_FEATURES; empty for a generic one
    if asked is not None:
        return "+pclmul" in asked.split(",")
    return bool(binding.get_host_cpu_features().get("pclmul"))


#: the variant for this processor
crc32: Any = crc32_by_folding if _folds() else crc32_by_tables
