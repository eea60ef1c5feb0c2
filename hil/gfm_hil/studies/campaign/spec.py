"""Dotted paths into a scenario as plain data, e.g. ``events.0.P_ref``."""

from __future__ import annotations

import hashlib
import json
import pickle
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any

from pydantic import Field

from gfm_hil.core.schema import StrictSchema
from gfm_hil.scenario import Scenario
from gfm_hil.studies.campaign.draw import Distribution, draw


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


class Axes(StrictSchema):
    """What the figure is drawn over: drawn paths, or sums of them ("a + b")."""

    x: str | None = Field(
        None,
        description="drawn path of the horizontal axis, or a sum a + b; the first drawn if none",
    )
    y: str | None = Field(
        None,
        description="drawn path of the vertical axis, or a sum a + b; the second drawn if none",
    )


class CampaignFile(StrictSchema):
    """The whole file."""

    title: str = Field(description="of tables and the figure")
    description: str = Field("", description="for people")
    scenario: str = Field(description="scenario file, or the name of a shipped one")
    laws: list[str] = Field(min_length=1, description="each runs on the same draws")
    runs: int = Field(gt=0, le=10**7, description="number of draws")
    seed: int = Field(0, ge=0, lt=2**63, description="of all draws")
    figure: Axes = Field(Axes(), description="what the figure is drawn over")
    set: dict[str, Any] = Field({}, description="dotted path = value, the same in every run")
    draw: list[Distribution] = Field(min_length=1, description="what is drawn in every run")


@dataclass(frozen=True)
class Campaign:
    """A checked campaign, ready to be sent to workers."""

    name: str  # stem of the file
    text: str  # the file itself
    file: CampaignFile  # what it says
    base: dict[str, Any]  # the scenario with ``set`` put in, as plain data
    laws: dict[str, str]  # name in the file to what ``load_law`` takes

    @cached_property
    def _packed(self) -> bytes:
        """``base`` in a form of which a copy is made quickly."""
        return pickle.dumps(self.base)

    def digest(self) -> str:
        """Hash over all that decides a record: draws, scenario, contents of laws, version."""
        decides = self.file.model_dump(include={"seed", "set", "draw", "laws"})
        scenarios = [
            Scenario.model_validate({**self.base, "law": law}).digest()
            for law in self.laws.values()
        ]
        limit = self.base["expect_ripple"]  # which the digests of scenarios leave out
        text = json.dumps([decides, limit, scenarios, version("gfmhil")], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def content(self, run: int, law: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Scenario of a run as plain data, and the values drawn for it by their paths."""
        seed, values = draw(self.file.seed, run, self.file.draw)
        content = pickle.loads(self._packed)
        content["law"], content["seed"] = self.laws[law], seed
        for d, value in zip(self.file.draw, values, strict=True):
            for path in d.paths():
                put(content, path, value)
        return content, {d.path: v for d, v in zip(self.file.draw, values, strict=True)}

    def scenario(self, run: int, law: str) -> tuple[Scenario, dict[str, Any]]:
        """The scenario of a run, and the values drawn for it by their paths."""
        content, drawn = self.content(run, law)
        return Scenario.model_validate(content), drawn
