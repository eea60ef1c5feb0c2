"""C sources of the benchmark, compiled at run time if there is a compiler."""

import os
import shlex
import subprocess
from collections.abc import Sequence
from pathlib import Path

FLAGS = "-O3"
# A fused multiply-add rounds once, the kernel twice. Compilers for x86-64 do not fuse with -O3
# alone; compilers for other processors do.
_ALWAYS = ("-std=c11", "-ffp-contract=off", "-fPIC", "-shared", "-Wall", "-Werror")


class NoCompiler(Exception):
    """There is no C compiler, or it fails; the message is one line for the report."""


def compile_c(
    source: Path, folder: Path, name: str, flags: str = FLAGS, more: Sequence[Path] = ()
) -> Path:
    """Compile sources into ``folder``/``name``.so by $CC or cc; headers may be there too. Raises
    NoCompiler: there is none, or it fails."""
    compiler, library = os.environ.get("CC", "cc"), folder / f"{name}.so"
    command = [compiler, *shlex.split(flags), *_ALWAYS, f"-I{folder}"]
    command += [str(source), *map(str, more), "-o", str(library), "-lm"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        words = f"no C compiler: {compiler} is not there; install one or set CC"
        raise NoCompiler(words) from None
    if done.returncode:
        first = next(iter(done.stderr.splitlines()), "")
        raise NoCompiler(f"the C compiler refused {source.name}: {first}")
    return library
