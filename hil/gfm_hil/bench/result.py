"""The result of a benchmark as plain data, and its file.

It has ``results`` (rows of `latency`), ``jitter``, ``kernel`` and ``loop`` (those that were
requested), ``remarks``, ``environment``, ``caveats`` and ``seconds``.
"""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.realtime.environment import StealTime, caveats, environment

FORMAT = 1


@contextmanager
def new_result(kind: str) -> Iterator[dict[str, Any]]:
    """A result without measurements; it is complete when the context ends."""
    begin, steal = time.monotonic(), StealTime()
    badge = environment()
    content: dict[str, Any] = {"format": FORMAT, "bench": kind, "results": [], "remarks": []}
    content["environment"] = badge
    yield content
    badge["steal_pct"] = steal.percent()
    content["caveats"] = caveats(badge)
    content["seconds"] = round(time.monotonic() - begin, 1)


def write_result(content: dict[str, Any], path: Path) -> None:
    """Write a result as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1) + "\n")


def read_result(path: Path) -> dict[str, Any]:
    """Read a result from a file or a folder. Raises UserError: it is not a result."""
    file = path / "bench.json" if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as problem:
        raise UserError(f"{file}: cannot be read: {problem}") from None
    return check_result(content, str(file))


def rows_of(content: dict[str, Any], name: str) -> list[dict[str, Any]] | None:
    """The rows of a result that have this name in its file; None if they were not measured."""
    return (content | content.get("loop", {})).get(name)


def check_result(content: Any, source: str) -> dict[str, Any]:
    """The content, if it is a result. Raises UserError: it is not a result, or one of another
    version."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UserError(f"{source}: not a result of `gfmhil bench` of format {FORMAT}")
    return content
