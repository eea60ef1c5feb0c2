"""A test of one converter laid over the network of a user.

The node of ``network.grid`` is the point of connection, behind which are the line and the grid of
the test. So the network is the plant under test: its converters all get the references of the test,
and its short-circuit ratio is over all their ratings. Each level of the ratio that the test has is
a line in parallel with those of the lower levels, since ratios of one X/R add up, and a step of the
ratio opens or closes lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario, check_scenario, load_scenario
from gfm_hil.scenario.loading import find_scenario
from gfm_hil.studies.conformity.sets import Case, TestPart, content_of, converter_at
from gfm_plant import Plant, load_converter
from gfm_plant.options import Grid
from gfm_runtime.errors import meant

_GRID = "grid of the test"  # its node
#: of a user's scenario that a test does not take
_DROPPED = (
    "title", "description", "events", "compare", "expect", "expect_reason", "expect_after",
    "after_trip", "waveforms", "snapshot", "start_from", "ready_laws", "duration", "converter",
)  # fmt: skip


@dataclass(frozen=True)
class NetworkUnderTest:
    """A network of converters, of which one is judged."""

    path: Path  # of its scenario
    scenario: Scenario  # in process
    judged: str

    @classmethod
    def load(cls, given: str | Path, judged: str | None) -> NetworkUnderTest:
        """The network of a scenario, a path or a shipped name; its first converter is judged if
        none is named. Raises UserError: one line a mistake; it has no grid for a test."""
        path, scenario = find_scenario(str(given)), load_scenario(given, in_process=True)
        known = scenario.converters
        if scenario.network is None:
            raise UserError(f"--network {given}: has no network; --converter is for one alone")
        if scenario.network.grid is None:
            raise UserError(f"--network {given}: has no network.grid, whose node is the point of "
                            "connection, behind which the tests have their grid")  # fmt: skip
        if judged is not None and judged not in known:
            raise UserError(f"--judged {judged}: must be one of {known}{meant(judged, known)}")
        return cls(path, scenario, judged or known[0])

    @property
    def own(self) -> Scenario:
        """The scenario as the judged converter sees it."""
        return self.scenario.each[self.judged]

    @property
    def plant(self) -> Plant:
        """That of the judged converter, without a grid."""
        given = self.own.plant.model_dump(mode="json", exclude_unset=True, exclude={"grid"})
        return Plant.model_validate(given)

    def words(self) -> str:
        """Which converter of which network, for reports."""
        others = [name for name in self.scenario.converters if name != self.judged]
        return f"{self.judged} of {self.path.name}, beside {', '.join(others) or 'no other'}"

    def scenario_of(
        self, case: Case, part: TestPart, law: str, inner: str | None, converters: Path
    ) -> Scenario:
        """The scenario of a part, with a law and inner stage of the judged converter; the folder is
        for files of converters at another frequency. Raises UserError: why it cannot be laid over a
        network."""
        test = content_of(case, part, {})
        self._check(case, part, test)
        content = self.scenario.model_dump(mode="json", exclude_none=True)
        content = {key: value for key, value in content.items() if key not in _DROPPED}
        network = content["network"]
        for name, member in network["converters"].items():
            references = self.scenario.each[name].references.model_dump()
            member["references"] = references | test.get("references", {})
            plant = member.setdefault("plant", dict(content["plant"], grid={}))
            converter = self.scenario.each[name].plant.converter
            plant["converter"] = converter_at(converter, case.test.f_n, 1.0, converters)
        plant = content["plant"]
        plant["converter"] = converter_at(plant["converter"], case.test.f_n, 1.0, converters)
        grid = test["plant"].get("grid", {})
        plant["grid"] |= {k: v for k, v in grid.items() if k not in ("scr", "x_over_r")}
        member = network["converters"][self.judged]
        member["law"] = law
        if inner is not None:
            member["inner"] = inner
        kept = ("title", "duration", "T_s", "seed")
        content |= {key: test[key] for key in kept if key in test}
        content["events"] = [*self._events(test, network)]
        return check_scenario(content, f"{case.path} over {self.path}")

    def _check(self, case: Case, part: TestPart, test: Mapping[str, Any]) -> None:
        """See that a part is of one converter behind a line. Raises UserError: it is not."""
        if "network" in test:
            raise UserError(f"{case.id} has a network of its own, which goes over no other")
        own = [key for key in test["plant"] if key != "grid"]
        if own:
            raise UserError(f"{case.id} sets plant.{own[0]}, which is the network's own")
        for criterion in case.test.clauses(part):
            if criterion.alone:
                raise UserError(f"{case.id}: {criterion.kind}: {criterion.alone}")

    def _share(self) -> float:
        """The rating of all converters over that of the first, whose bases the network has."""
        ratings = [
            load_converter(self.scenario.each[name].plant.converter).S_n
            for name in self.scenario.converters
        ]
        return sum(ratings) / ratings[0]

    def _events(self, test: Mapping[str, Any], network: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """The events of a test, after its lines have come into a network. Raises UserError: one is
        for a converter alone."""
        node, share = network["grid"], self._share()
        grid, events = test["plant"].get("grid", {}), test.get("events", [])
        now, levels = grid.get("scr"), list[float]()
        if now is not None:
            steps = [event for event in events if event["type"] == "grid-impedance"]
            if any(event.get("x_over_r") != grid["x_over_r"] for event in steps):
                raise UserError("grid-impedance: over a network only scr may change, and not X/R")
            levels = sorted({now, *(event["scr"] for event in steps)})
            _add_lines(network, levels, now, grid["x_over_r"], share)
        for event in events:
            moved = dict(event)
            if event["type"] == "grid-impedance":
                if now is None:
                    raise UserError("grid-impedance: the test has no plant.grid.scr to begin with")
                closed = event["scr"] > now
                between = sorted((now, event["scr"]))
                time = {key: event[key] for key in ("t", "tick") if key in event}
                for level in (x for x in levels if between[0] < x <= between[1]):
                    yield time | {"type": "breaker", "name": _line(level), "closed": closed}
                now = event["scr"]
                continue
            if event["type"] == "fault":
                moved |= {key: event[key] / share for key in ("R", "R_0", "X_0") if key in event}
                if moved.pop("position", 0.0) != 0.0 or "line" in event:
                    raise UserError("fault: over a network only one at the point of connection")
                moved["node"] = node
            elif event["type"] == "grid-breaker":
                raise UserError("grid-breaker: the test's local load goes not over a network")
            elif "converter" not in event and event["type"] in ("reference", "law", "gains"):
                moved["converter"] = self.judged
            yield moved


def _line(scr: float) -> str:
    """The name of the line that brings the short-circuit ratio to a level."""
    return f"SCR-{scr:g}"


def _add_lines(
    network: dict[str, Any], levels: list[float], now: float, x_over_r: float, share: float
) -> None:
    """Put lines between the point of connection and the grid, one for each level of the
    short-circuit ratio; those up to the first ratio are closed."""
    lines, below, node = network.setdefault("lines", {}), 0.0, network["grid"]
    for scr in levels:
        line = Grid(scr=(scr - below) * share, x_over_r=x_over_r).line()
        assert line is not None
        if _line(scr) in lines:
            raise UserError(
                f"network.lines: {_line(scr)!r} is the name of a line of the test's own"
            )
        lines[_line(scr)] = {
            "start": node, "end": _GRID, "L": line["L_g"], "R": line["R_g"], "closed": scr <= now,
        }  # fmt: skip
        below = scr
    network["grid"] = _GRID
