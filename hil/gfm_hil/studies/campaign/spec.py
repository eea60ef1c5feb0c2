"""A campaign as data: distributions, dotted paths into a scenario as plain data, e.g.
``events.0.P_ref``, and the scenario of a run: a function of (campaign seed, run number) alone.

Every parameter takes one uniform number, which its distribution turns into a value by its
quantile function. The numbers are the raw output of Philox, keyed by the run's own child of the
campaign's seed sequence, so that they depend neither on other runs nor on NumPy's version.
"""

from __future__ import annotations

import hashlib
import json
import math
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from statistics import NormalDist
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from gfm_hil.core.schema import StrictSchema
from gfm_hil.scenario import Scenario

_LEAST = 1e-9  # of a normal's probability that must lie within its bounds


class _DrawnValue(StrictSchema):
    path: str = Field(description="dotted path in the scenario, e.g. plant.factors.L_g")
    also: list[str] = Field([], description="further paths that get the same value")
    label: str | None = Field(None, description="of the figure's axis, the path if none")

    def paths(self) -> list[str]:
        """Every path that the value goes to."""
        return [self.path, *self.also]


class _Between(_DrawnValue):
    low: float = Field(description="least value")
    high: float = Field(description="greatest value")

    @model_validator(mode="after")
    def _not_empty(self) -> _Between:
        if not self.low < self.high:
            raise ValueError(f"low = {self.low:g}, high = {self.high:g}: low must be below high")
        return self

    def ends(self) -> list[Any]:
        """The extreme values."""
        return [self.low, self.high]

    def _within(self, value: float) -> float:
        return min(max(value, self.low), self.high)  # rounding must not leave the range


class Uniform(_Between):
    """Every value in [low, high] alike."""

    type: Literal["uniform"] = Field(description="kind of distribution")

    def quantile(self, u: float) -> float:
        """The value below which a share u, 0 <= u < 1, of all draws lies."""
        return self._within(self.low * (1 - u) + self.high * u)


class LogUniform(_Between):
    """Every decade of [low, high] alike; for factors, inductances and the like."""

    type: Literal["loguniform"] = Field(description="kind of distribution")

    @model_validator(mode="after")
    def _positive(self) -> LogUniform:
        if self.low <= 0:
            raise ValueError(f"low = {self.low:g}: must be > 0 for a logarithm")
        return self

    def quantile(self, u: float) -> float:
        """As ``Uniform.quantile``."""
        return self._within(math.exp(math.log(self.low) * (1 - u) + math.log(self.high) * u))


class Normal(_Between):
    """Normal with mean and sigma, cut off at low and high."""

    type: Literal["normal"] = Field(description="kind of distribution")
    mean: float = Field(description="of the distribution before it is cut at low and high")
    sigma: float = Field(gt=0, description="its standard deviation")

    @model_validator(mode="after")
    def _reaches(self) -> Normal:
        a, b = self._shares()
        if not b - a > _LEAST:
            raise ValueError(
                f"low = {self.low:g}, high = {self.high:g}: holds next to nothing of mean = "
                f"{self.mean:g}, sigma = {self.sigma:g}"
            )
        return self

    def _shares(self) -> tuple[float, float]:
        bell = NormalDist(self.mean, self.sigma)
        return bell.cdf(self.low), bell.cdf(self.high)

    def quantile(self, u: float) -> float:
        """As ``Uniform.quantile``."""
        a, b = self._shares()
        share = min(max(a * (1 - u) + b * u, 1e-300), 1 - 2**-53)  # 0 and 1 lie at infinity
        return self._within(NormalDist(self.mean, self.sigma).inv_cdf(share))


class Choice(_DrawnValue):
    """One of some values, all alike; they may be numbers, words or true and false."""

    type: Literal["choice"] = Field(description="kind of distribution")
    values: list[bool | int | float | str] = Field(
        min_length=1, description="numbers, words or true and false, all equally likely"
    )

    def ends(self) -> list[Any]:
        """All values."""
        return list(self.values)

    def quantile(self, u: float) -> Any:
        """The value at share u, 0 <= u < 1, in the order of the file."""
        return self.values[int(u * len(self.values))]


Distribution = Annotated[Uniform | LogUniform | Normal | Choice, Field(discriminator="type")]


def draw(seed: int, run: int, distributions: Sequence[Distribution]) -> tuple[int, list[Any]]:
    """The seed of a run's noise, 1 <= seed < 2**63, and one value a distribution."""
    raw = np.random.Philox(np.random.SeedSequence(seed, spawn_key=(run,))).random_raw(
        1 + len(distributions)
    )
    noise = (int(raw[0]) >> 1) or 1  # 0 would leave the scenario's own seed
    return noise, [
        d.quantile((int(r) >> 11) * 2.0**-53) for d, r in zip(distributions, raw[1:], strict=True)
    ]


def put(content: dict[str, Any], path: str, value: Any) -> None:
    """Put a value at a path; its last key may be new, as in ``plant.factors.L_g``. Raises KeyError:
    the path leads nowhere; the message says what there is instead."""
    place: Any = content
    keys = path.split(".")
    for depth, key in enumerate(keys, 1):
        is_last, above = depth == len(keys), ".".join(keys[: depth - 1])
        at: Any = key
        if isinstance(place, dict):
            there = key in place or (is_last and depth > 1)
            holds = f"holds {', '.join(place) or 'nothing'}"
        elif isinstance(place, list):
            there = key in map(str, range(len(place)))
            at = int(key) if there else 0
            holds = f"holds {len(place)} entries, counted from 0"
        else:
            there, holds = False, f"is {place!r} and holds nothing"
        if not there:
            where = repr(above) if above else "the scenario"
            raise KeyError(f"path {path!r}: {where} {holds}")
        if is_last:
            place[at] = value
        else:
            place = place[at]


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
    converter: str | None = Field(
        None, description="of a network: the one that gets the laws and whose events are kept"
    )
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

    def under(self, content: dict[str, Any], law: str) -> dict[str, Any]:
        """A scenario as plain data under a law of the campaign; of a network its converter is."""
        if self.file.converter is None:
            return {**content, "law": self.laws[law]}
        network = content["network"]
        members = network["converters"]
        own = {**members[self.file.converter], "law": self.laws[law]}
        converters = {**members, self.file.converter: own}
        return {**content, "network": {**network, "converters": converters}}

    def digest(self) -> str:
        """Hash over all that decides a record: draws, scenario, contents of laws, version."""
        decides = self.file.model_dump(include={"seed", "set", "draw", "laws"})
        scenarios = [
            Scenario.model_validate(self.under(self.base, law)).digest() for law in self.laws
        ]
        limit = self.base["expect_ripple"]  # which the digests of scenarios leave out
        text = json.dumps([decides, limit, scenarios, version("gfmhil")], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def drawn(self, run: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Scenario of a run as plain data, under no law of the campaign yet, and the values drawn
        for it by their paths."""
        seed, values = draw(self.file.seed, run, self.file.draw)
        content = pickle.loads(self._packed) | {"seed": seed}
        for d, value in zip(self.file.draw, values, strict=True):
            for path in d.paths():
                put(content, path, value)
        return content, {d.path: v for d, v in zip(self.file.draw, values, strict=True)}

    def scenario(self, run: int, law: str) -> tuple[Scenario, dict[str, Any]]:
        """The scenario of a run, and the values drawn for it by their paths."""
        content, drawn = self.drawn(run)
        return Scenario.model_validate(self.under(content, law)), drawn
