"""Machine code that a wheel carries, so that its first run compiles nothing.

``.ci/wheel`` compiles what runs call for a family of processors (``TARGETS``), and ``pack`` makes
one file of it, which the wheel has beside this module. ``WheelCode`` is that file in a process: it
gives nothing where the file is damaged, or was made from other sources, for another Python, numba
or llvmlite, or needs instructions that the processor has not. Then numba compiles, and ``unfit``
says why.

A function is kept as machine code alone. Where numba compiles a caller, it compiles the function
too (``DeferredDispatcher``).

The file: the SHA-256 of all that follows, the length of the header as 4 bytes, the header (JSON),
and the functions, each pickled and compressed.
"""

import hashlib
import json
import pickle
import platform
import struct
import sys
import zlib
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
from numba.core import config
from numba.core.serialize import dumps

FILE = Path(__file__).with_name("wheel_code.bin")

#: by machine: a processor as LLVM names it, and the features that it takes for granted
TARGETS = {
    "x86_64": (
        "x86-64-v3",
        [
            *("avx", "avx2", "bmi", "bmi2", "cmov", "cx16", "cx8", "f16c", "fma", "fxsr", "lzcnt"),
            *("mmx", "movbe", "popcnt", "sahf", "sse", "sse2", "sse3", "sse4.1", "sse4.2", "ssse3"),
            *("xsave", "pclmul"),  # pclmul: for the CRC of frames; each such processor has it
        ],
    ),
    "aarch64": ("generic", ["fp-armv8", "neon"]),
}
_DIGEST = hashlib.sha256().digest_size
_LENGTH = struct.Struct("<I")


class WheelCode:
    """What the wheel carries, for a process.

    Args:
        sources: digest of all sources that may be compiled into a function, as they are here.
        file: as ``pack`` writes it; there is none in a clone.
    """

    def __init__(self, sources: str, file: Path = FILE) -> None:
        self._sources, self._file = sources, file
        self._entries: dict[str, list[int]] = {}
        self._body = memoryview(b"")

    @cached_property
    def unfit(self) -> str:
        """The reason not to use the file; empty if it is used, or there is none."""
        try:
            held = memoryview(self._file.read_bytes())
        except FileNotFoundError:
            return ""
        body = held[_DIGEST:]
        if len(body) < _LENGTH.size or hashlib.sha256(body).digest() != bytes(held[:_DIGEST]):
            return f"{self._file} is damaged"
        begin = _LENGTH.size + _LENGTH.unpack_from(body)[0]
        header = json.loads(bytes(body[_LENGTH.size : begin]))
        for name, here in {**_surroundings(), "sources": self._sources}.items():
            if (made := header[name]) != here:
                return (
                    "the sources have changed since"
                    if name == "sources"
                    else f"it is for {name} {made}, and here is {here}"
                )
        if (other := vars(config)["CPU_NAME"]) is not None:
            return f"NUMBA_CPU_NAME asks for {other}"
        has = llvm.get_host_cpu_features()
        if lacks := [feature for feature in header["features"] if not has.get(feature, False)]:
            return f"this processor lacks {', '.join(lacks)}"
        self._entries, self._body = header["entries"], body[begin:]
        return ""

    def load(self, name: str) -> Any:
        """What numba's cache would keep of the function of this name, or None."""
        if self.unfit or name not in self._entries:
            return None
        begin, end = self._entries[name]
        return pickle.loads(zlib.decompress(self._body[begin:end]))


def name_of(folder: str, base: str, source: bytes, key: tuple[Any, Any, Any]) -> str:
    """The name of a function for types of arguments: of the last folder of its source and that
    file's digest, of numba's name for its cache, and of numba's key, without what that says of the
    processor."""
    signature, _, code = key
    return hashlib.sha256(repr((folder, base, source, signature, code)).encode()).hexdigest()


def pack(cache: Path, file: Path, sources: str) -> int:
    """Write all machine code of a cache, made for the target, to a file.

    Args:
        cache: the NUMBA_CACHE_DIR of processes that had the target in ``environment``.
        sources: as for ``WheelCode``.

    Returns:
        How many functions those are.
    """
    processor, features = TARGETS[platform.machine()]
    entries, body = {}, bytearray()
    for index in sorted(cache.rglob("*.nbi")):
        with index.open("rb") as stream:
            pickle.load(stream)  # numba's version
            (source, digest), overloads = pickle.loads(stream.read())
        if digest.hex() != sources:
            continue  # older than the sources
        for key, data in overloads.items():
            made_of, result = pickle.loads((index.parent / data).read_bytes())
            if made_of is not None or key[1][1] != processor:
                continue  # no machine code, or another processor's
            (library, kind, (code, module)), *rest = result
            kept = None, ((library, kind, (code, _names(module))), *rest)
            begin = len(body)
            body += zlib.compress(dumps(kept), 9)
            name = name_of(index.parent.name.rsplit("_", 1)[0], index.stem, source, key)
            entries[name] = [begin, len(body)]
    header = {**_surroundings(), "sources": sources, "features": features, "entries": entries}
    text = json.dumps(header).encode()
    whole = _LENGTH.pack(len(text)) + text + body
    file.write_bytes(hashlib.sha256(whole).digest() + whole)
    return len(entries)


def _names(module: bytes) -> bytes:
    """A module that defines functions of the same names; numba looks there whether it has one."""
    functions = llvm.parse_bitcode(module).functions
    text = "".join(
        f'define void @"{f.name}"() {{ ret void }}\n' for f in functions if not f.is_declaration
    )
    return bytes(llvm.parse_assembly(text).as_bitcode())


def environment() -> dict[str, str]:
    """What makes numba compile for the target of this machine."""
    processor, features = TARGETS[platform.machine()]
    return {
        "NUMBA_CPU_NAME": processor,
        "NUMBA_CPU_FEATURES": ",".join(f"+{feature}" for feature in features),
    }


def _surroundings() -> dict[str, str]:
    """What machine code depends on, but for sources and processor."""
    python = f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}"
    versions = {name: version(name) for name in ("numba", "llvmlite")}
    return {"machine": platform.machine(), "Python": python, **versions}
