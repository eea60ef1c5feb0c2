"""Build hook: the wheel carries scenarios/ as gfm_hil/scenarios.

An editable install must not: its copy would go stale, and the folder itself is there to be read.
"""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ScenariosHook(BuildHookInterface):
    """Adds every scenario file to a standard wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version != "standard":
            return
        for path in sorted((Path(self.root) / "scenarios").rglob("*.toml")):
            inside = path.relative_to(self.root).as_posix()
            build_data["force_include"][str(path)] = f"gfm_hil/{inside}"
