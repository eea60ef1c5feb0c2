"""Figures of a run for a notebook, drawn with pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import Run
from gfm_hil.run.network_run import NetworkRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# pyplot and figures take longer to import than a run takes, so each function imports them


def plot(run: Run, *names: str) -> list[Axes]:
    """Draw signals over time, one a panel; without names the six panels of the report.

    Raises:
        UserError: a signal that was not recorded.
    """
    from matplotlib import pyplot

    from gfm_hil.results import figures

    if not names:
        figure = pyplot.figure(figsize=figures.SIZE, layout="constrained")
        return figures.draw_signals(figure, run.scenario, run.columns, run.summary)
    signals = run.signals
    curves = [(signals["t"], signals[name], name) for name in names]
    figure, axes = pyplot.subplots(
        len(names), 1, sharex=True, squeeze=False, layout="constrained",
        figsize=(8.6, 2.2 * len(names)),
    )  # fmt: skip
    for a, (t, x, name) in zip(axes[:, 0], curves, strict=True):
        figures.draw_panel(a, name, [(t, x, figures.COLOURS[0], name)])
    axes[-1, 0].set_xlabel("t [s]")
    return list(axes[:, 0])


def plot_waveforms(run: Run, start: float | None = None, stop: float | None = None) -> list[Axes]:
    """Draw the three phases of the voltages and currents, as the report does.

    Args:
        start, stop: from when to when, s; the window of the report if not given.

    Raises:
        UserError: only one of them is given, nothing was recorded between them, or the
            recording lacks what this needs.
    """
    from matplotlib import pyplot

    from gfm_hil.results import figures

    if (start is None) != (stop is None):
        raise UserError(f"start = {start}, stop = {stop}: give both or neither")
    window = None if start is None or stop is None else (start, stop)
    figure = pyplot.figure(figsize=figures.SIZE_WAVES, layout="constrained")
    axes = figures.draw_waveforms(figure, run.scenario, run.columns, run.summary, window)
    if not axes:
        pyplot.close(figure)
        end = run.summary["duration_s"]
        raise UserError(f"start = {start}, stop = {stop}: the recording ends at {end:g} s")
    return axes


def plot_network(run: NetworkRun) -> list[Axes]:
    """p, frequency, q and v_dc of all converters in one figure."""
    from matplotlib import pyplot

    from gfm_hil.results import figures

    figure = pyplot.figure(figsize=figures.SIZE_LAWS, layout="constrained")
    return figures.draw_laws(figure, run.scenario, run.columns, run.events)


def plot_laws(runs: Mapping[str, Run]) -> list[Axes]:
    """p, frequency, q and v_dc of several laws in one figure."""
    from matplotlib import pyplot

    from gfm_hil.results import figures

    first = next(iter(runs.values()))
    events = max((one.summary["events"] for one in runs.values()), key=len)
    columns = {law: one.columns for law, one in runs.items()}
    figure = pyplot.figure(figsize=figures.SIZE_LAWS, layout="constrained")
    return figures.draw_laws(figure, first.scenario, columns, events)
