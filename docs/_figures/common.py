"""What the figures and tables share: running, eigenvalues, writing."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode
from gfm_hil.core.terminal import markdown
from gfm_hil.results.figures import dress as dress
from gfm_hil.run.runner import run_in_memory as run  # noqa: F401
from gfm_hil.scenario import Scenario, check_scenario, find_scenario
from gfm_plant import Plant
from gfm_runtime import get_law

DOCS = Path(__file__).resolve().parents[1]
FIGURES, TABLES = DOCS / "_static" / "figures", DOCS / "tables"
LAWS = ("mimo-gfm", "vsg-2", "droop-5")
RIG: dict[str, Any] = {
    "delay": {"samples": 1},
    "sensors": {"bandwidth_hz": 300.0},
    "dc_source": {"mode": "regulated"},
}
GREY, INK = "#888888", "#222222"


def scenario(name: str, **changed: Any) -> Scenario:
    """A shipped scenario, in process, with keys changed (dotted path, __ for the dot)."""
    content = tomllib.loads(find_scenario(name).read_text(encoding="utf-8"))
    content |= {"mode": "lockstep", "link": {"type": "inproc"}}
    for path, value in changed.items():
        *parents, last = path.split("__")
        place = content
        for parent in parents:
            place = place.setdefault(parent, {})
        if value is None:
            place.pop(last, None)
        else:
            place[last] = value
    return check_scenario(content, name)


def modes(law: str, plant: dict[str, Any], ideal: bool = False, **gains: float) -> list[Mode]:
    """Modes of a law's loop, longest lasting first."""
    return ClosedLoop.of(get_law(law, **gains), Plant.model_validate(plant), ideal=ideal).modes()


def within(found: Sequence[Mode], low: float, high: float) -> Mode:
    """The longest lasting mode of a band, Hz."""
    return next(m for m in found if low < m.frequency_hz < high)


def number(value: float | None, digits: int = 3) -> str:
    """For a table."""
    if value is None:
        return "–"
    return f"{value:.{digits}f}".replace("-", "−")


def signed(value: float) -> str:
    """A growth rate; what grows is bold."""
    return f"**+{value:.2f}**" if value >= 0 else f"{value:.2f}".replace("-", "−")


def write_table(name: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A Markdown table for the page to include."""
    (TABLES / f"{name}.md").write_text(markdown(head, rows) + "\n", encoding="utf-8")


def box(
    axes: Axes, at: tuple[float, float], size: tuple[float, float], text: str, colour: str,
    faint: bool = False,
) -> None:  # fmt: skip
    """A rounded box with a text in its middle."""
    style = "round,pad=0,rounding_size=0.08"
    axes.add_patch(
        FancyBboxPatch(
            at, *size, boxstyle=style, fc="#fafafa" if faint else "white", ec=colour,
            lw=0.8 if faint else 1.2,
        )
    )  # fmt: skip
    x, y = at[0] + size[0] / 2, at[1] + size[1] / 2
    axes.text(x, y, text, ha="center", va="center", fontsize=8.5, color=INK)


def arrow(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str,
    both: bool = False,
) -> None:  # fmt: skip
    """An arrow with a head at its end, or at both."""
    style = {"arrowstyle": "<|-|>" if both else "-|>", "color": colour, "lw": 1.0}
    axes.annotate("", end, start, arrowprops={**style, "shrinkA": 0, "shrinkB": 0})
