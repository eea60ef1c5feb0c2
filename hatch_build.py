"""Build hook: the wheel carries scenarios/ and deploy/ inside gfm_hil, and compiled code on demand.

GFMHIL_WHEEL_CODE names a file of compiled code, which .ci/wheel makes with the Python that builds.
The wheel is for that Python and machine then, and for every one without it.

An editable install must not: its copies would go stale, and the folders are there to be read.
"""

import os
import platform
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# Of deploy/ by name: keys may lie beside them. gfm_hil.cli.deploy has the same list.
FILES = (
    "scenarios/**/*.csv",
    "scenarios/**/LICENSE.txt",
    "scenarios/**/*.py",
    "scenarios/**/*.toml",
    "deploy/can/*",
    "deploy/container/Containerfile",
    "deploy/container/compose.yaml",
    "deploy/systemd/**/*",
    "deploy/tune-*",
)
SYSTEM = "manylinux_2_27"


class FoldersHook(BuildHookInterface):
    """Adds every scenario, every file for deployment, and compiled code to a standard wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version != "standard":
            return
        root = Path(self.root)
        for path in sorted(p for pattern in FILES for p in root.glob(pattern) if p.is_file()):
            inside = path.relative_to(root).as_posix()
            build_data["force_include"][str(path)] = f"gfm_hil/{inside}"
        if code := os.environ.get("GFMHIL_WHEEL_CODE"):
            build_data["force_include"][code] = "gfm_runtime/wheel_code.bin"
            python = f"cp{sys.version_info.major}{sys.version_info.minor}"
            # the wheels of llvmlite, which loads the code, ask for this glibc too
            build_data["tag"] = f"{python}-{python}-{SYSTEM}_{platform.machine()}"
            build_data["pure_python"] = False
