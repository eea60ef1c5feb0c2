"""Exported firmware to compile in tests, and the compilers."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from gfm_runtime.firmware import export

from .laws import LAWS

T_S = 1e-4


def exported(folder: Path, real: str, style: Any, *names: str) -> Path:
    """A folder with laws, all by default."""
    laws = {name: LAWS[name] for name in names} or LAWS
    for name, text in export(laws, T_S, real, style).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def cc(folder: Path, *arguments: str, compiler: str = "gcc") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [compiler, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
