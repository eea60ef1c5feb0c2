"""The figure of a failed assertion: the signal with its limits, and other signals."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gfm_hil.recording.columns import unit_of
from gfm_hil.results.figures import COLOURS, draw_panel
from gfm_hil.run.checks import Violation

_BLUE, _RED, _GREEN, *_ = COLOURS
_CONTEXT = ("p", "f_hz", "V", "i", "v_dc")  # the first four that are not the signal itself
_FOLLOWS = {"p": "ref_P_ref", "q": "ref_Q_ref", "V": "ref_V_ref", "v_dc": "ref_V_dcref"}


def draw(
    path: Path, text: str, signal: str, signals: Mapping[str, NDArray[Any]],
    steps: Sequence[tuple[float, str]], finding: Violation | None,
    around: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Draw one failure: its text as title, the checked signal with its band and worst point, if the
    check is about a curve, steps as times in s with a short text, and four other signals. The large
    panel shows the time ``around`` [s], all by default."""
    figure = Figure(figsize=(9.5, 7.0), layout="constrained")
    rows = figure.subplot_mosaic(
        [["main", "main"], ["a", "b"], ["c", "d"]], height_ratios=[2.2, 1, 1]
    )
    main = rows["main"]
    first, last = around or (signals["t"][0], signals["t"][-1])
    shown = (signals["t"] >= first) & (signals["t"] <= last)
    _curve(main, signal, {name: signals[name][shown] for name in {*signals, signal}})
    if finding is not None:
        _band(main, finding, signals[signal])
        worst = int(np.searchsorted(signals["t"], finding.at - 1e-9))
        main.plot(
            finding.at, signals[signal][worst], "o", ms=8, mfc="none", mec=_RED, mew=1.8,
            label="worst" if np.isfinite([*finding.low, *finding.high]).any() else "largest swing",
        )  # fmt: skip
    seen = [(t, label) for t, label in steps if first <= t <= last]
    for k, (t, label) in enumerate(seen):
        right = t > first + 0.8 * (last - first)
        main.annotate(
            label, (t, 1.0), (-3 if right else 3, 4 + 10 * (k % 3)),
            xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8,
            color="#444444", ha="right" if right else "left",
        )  # fmt: skip
    main.legend(fontsize=8, frameon=False, loc="best")
    beside = [name for name in _CONTEXT if name != signal]
    for place, name in zip("abcd", beside, strict=False):
        _curve(rows[place], name, signals)
    for axes in rows.values():
        for t, _ in seen if axes is main else steps:
            axes.axvline(t, color="#888888", lw=0.8, ls=(0, (4, 3)), zorder=0)
    for place in "cd":
        rows[place].set_xlabel("t [s]", fontsize=9)
    figure.suptitle("\n".join(textwrap.wrap(text, 125)), fontsize=9.5, x=0.01, ha="left")
    figure.savefig(path, dpi=110)


def _curve(axes: Axes, name: str, signals: Mapping[str, NDArray[Any]]) -> None:
    curves = [(signals["t"], signals[name], _BLUE, name)]
    follows = _FOLLOWS.get(name, "")
    if follows in signals:
        curves.append((signals["t"], signals[follows], "#888888", follows.removeprefix("ref_")))
    draw_panel(axes, f"{name} [{unit_of(name) or '1'}]", curves)


def _band(axes: Axes, finding: Violation, x: NDArray[Any]) -> None:
    """Draw the band in green; a one-sided limit is shaded up to the range of the curve."""
    low, high = finding.low, finding.high
    if not (np.isfinite(low).any() or np.isfinite(high).any()):
        return
    bottom, top = axes.get_ylim()
    lower = np.where(np.isnan(low) & ~np.isnan(high), bottom, low)
    upper = np.where(np.isnan(high) & ~np.isnan(low), top, high)
    axes.fill_between(finding.t, lower, upper, color=_GREEN, alpha=0.18, lw=0, label="allowed")
    for limit in (low, high):
        axes.plot(finding.t, limit, color=_GREEN, lw=0.9)
