"""Compiles the C source of a real-code model of IEEE and CIGRE for Linux, as it is."""

import re
import shutil
from collections.abc import Sequence
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import replacing
from gfm_runtime.firmware.check import run_tool

_WINDOWS = Path(__file__).parent / "windows"
_MAIN = re.compile(r"^\s*(int|void)\s+main\s*\(", re.MULTILINE)


def compile_model(sources: Sequence[Path], include: Sequence[Path], library: Path) -> list[Path]:
    """Compile C files, and those of folders that have no ``main``, to a shared library; returns the
    files that were compiled.

    What they take from ``windows.h`` is that of ``controllers/windows``. Raises UserError: there is
    no such folder, source or compiler. Raises LawError: the compiler fails; with its first error.

    Args:
        sources: files and folders.
        include: folders of further headers.
        library: what is written.
    """
    for folder in include:
        if not folder.is_dir():
            raise UserError(f"{folder}: is no folder of headers")
    used: list[Path] = []
    for source in sources:
        every = sorted(source.glob("*.c")) if source.is_dir() else []
        found = [x for x in every if not _MAIN.search(x.read_text("utf-8", "replace"))]
        found += [source] if source.is_file() else []
        if not found:
            raise UserError(f"{source}: must be a C file, or a folder with C files without main")
        used += found
    if shutil.which("gcc") is None:
        raise UserError("gcc is not there; apt-get install gcc")
    folders = [f"-I{x.absolute()}" for x in (_WINDOWS, *include)]
    with replacing(library) as part:
        options = ["-O2", "-w", "-shared", "-fPIC", "-Wl,-z,defs", "-include", "windows.h"]
        files = [str(x.absolute()) for x in used]
        command = ["gcc", *options, *folders, "-o", str(part.absolute()), *files, "-lm"]
        run_tool(command, used[0].parent)
    return used
