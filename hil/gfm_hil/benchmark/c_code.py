"""C sources of the benchmark, compiled at run time if there is a compiler."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
from pathlib import Path

SOURCES = Path(__file__).parent
FLAGS = "-O3"
# A fused multiply-add rounds once, the kernel twice. Compilers for x86-64 do not fuse with -O3
# alone; compilers for other processors do.
_ALWAYS = ("-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Werror")


class NoCompiler(Exception):
    """There is no C compiler, or it fails; the message is one line for the report."""


def compiler() -> str:
    """The C compiler: $CC or cc.

    Raises:
        NoCompiler: there is none.
    """
    name = os.environ.get("CC", "cc")
    if shutil.which(name) is None:
        raise NoCompiler(f"no C compiler: {name} is not there; install one or set CC")
    return name


def compile_c(source: str, folder: Path, name: str, flags: str = FLAGS) -> Path:
    """Compile a source of this package into ``folder``/``name``.so; headers may be there too.

    Raises:
        NoCompiler: there is none, or it fails.
    """
    library = folder / f"{name}.so"
    command = [compiler(), *shlex.split(flags), *_ALWAYS, f"-I{folder}", str(SOURCES / source)]
    done = subprocess.run(
        [*command, "-o", str(library), "-lm"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        first = next(iter(done.stderr.splitlines()), "")
        raise NoCompiler(f"the C compiler refused {source}: {first}")
    return library


def load_c(library: Path) -> ctypes.CDLL:
    """The compiled functions; calls release the interpreter's lock."""
    return ctypes.CDLL(str(library))


def version_line() -> str:
    """First line of the compiler's version output.

    Raises:
        NoCompiler: there is none.
    """
    done = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0]
