"""Dotted paths into a scenario as plain data, e.g. ``events.0.P_ref``."""

from __future__ import annotations

from typing import Any


def put(content: dict[str, Any], path: str, value: Any) -> None:
    """Put a value at a path; its last key may be new, as in ``plant.factors.L_g``.

    Raises:
        KeyError: the path leads nowhere; the message says what there is instead.
    """
    place: Any = content
    *parents, last = path.split(".")
    for depth, key in enumerate(parents):
        place = _step(place, key, path, ".".join(parents[:depth]))
    if isinstance(place, list):
        _step(place, last, path, ".".join(parents))
        place[int(last)] = value
    elif isinstance(place, dict) and (last in place or parents):
        place[last] = value
    else:
        raise KeyError(_words(place, path, ".".join(parents)))


def _step(place: Any, key: str, path: str, above: str) -> Any:
    if isinstance(place, dict) and key in place:
        return place[key]
    if isinstance(place, list) and key in map(str, range(len(place))):
        return place[int(key)]
    raise KeyError(_words(place, path, above))


def _words(place: Any, path: str, above: str) -> str:
    where = f"{above!r}" if above else "the scenario"
    if isinstance(place, dict):
        return f"path {path!r}: {where} holds {', '.join(place) or 'nothing'}"
    if isinstance(place, list):
        return f"path {path!r}: {where} holds {len(place)} entries, counted from 0"
    return f"path {path!r}: {where} is {place!r} and holds nothing"
