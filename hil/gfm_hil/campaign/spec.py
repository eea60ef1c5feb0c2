"""What a campaign is: its file as pydantic models, and the scenario of each of its runs."""

from __future__ import annotations

import copy
import hashlib
import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from pydantic import Field

from gfm_hil.campaign.draw import Distribution, Model, draw
from gfm_hil.campaign.paths import put
from gfm_hil.scenario import Scenario


class Axes(Model):
    """What the figure is drawn over: drawn paths, or sums of them ("a + b")."""

    x: str | None = None
    y: str | None = None


class CampaignFile(Model):
    """The whole file."""

    title: str
    description: str = ""
    scenario: str = Field(description="scenario file, or the name of a shipped one")
    laws: list[str] = Field(min_length=1, description="each runs on the same draws")
    runs: int = Field(gt=0, le=10**7, description="number of draws")
    seed: int = Field(0, ge=0, lt=2**63)
    ripple_max: float = Field(
        0.2, gt=0, description="p.u.; peak to peak of p over the last 0.2 s of a stable run"
    )
    figure: Axes = Axes()
    set: dict[str, Any] = Field({}, description="dotted path = value, the same in every run")
    draw: list[Distribution] = Field(min_length=1)


@dataclass(frozen=True)
class Campaign:
    """A checked campaign, ready to be sent to workers.

    Attributes:
        name: stem of the file.
        text: the file itself.
        file: what it says.
        base: the scenario with ``set`` put in, as plain data.
        laws: name in the file to what ``load_law`` takes.
    """

    name: str
    text: str
    file: CampaignFile
    base: dict[str, Any]
    laws: dict[str, str]

    def digest(self) -> str:
        """Hash over all that decides a record: draws, scenario, contents of laws, version."""
        decides = self.file.model_dump(include={"seed", "set", "draw", "laws"})
        scenarios = [
            Scenario.model_validate({**self.base, "law": law}).digest()
            for law in self.laws.values()
        ]
        text = json.dumps([decides, scenarios, version("gfmhil")], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def content(self, run: int, law: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Scenario of a run as plain data, and the values drawn for it by their paths."""
        seed, values = draw(self.file.seed, run, self.file.draw)
        content = copy.deepcopy(self.base)
        content["law"], content["seed"] = self.laws[law], seed
        for d, value in zip(self.file.draw, values, strict=True):
            for path in d.paths():
                put(content, path, value)
        return content, {d.path: v for d, v in zip(self.file.draw, values, strict=True)}

    def scenario(self, run: int, law: str) -> tuple[Scenario, dict[str, Any]]:
        """The scenario of a run, and the values drawn for it by their paths."""
        content, drawn = self.content(run, law)
        return Scenario.model_validate(content), drawn
