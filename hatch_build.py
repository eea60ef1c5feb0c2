"""Build hook: the wheel carries scenarios/ and deploy/ inside gfm_hil.

An editable install must not: its copies would go stale, and the folders are there to be read.
"""

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


class FoldersHook(BuildHookInterface):
    """Adds every scenario and every file for deployment to a standard wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version != "standard":
            return
        root = Path(self.root)
        for path in sorted(p for pattern in FILES for p in root.glob(pattern) if p.is_file()):
            inside = path.relative_to(root).as_posix()
            build_data["force_include"][str(path)] = f"gfm_hil/{inside}"
