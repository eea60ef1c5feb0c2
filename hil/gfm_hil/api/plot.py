"""Figures of linear loops with matplotlib, for a notebook: ``gfmhil.plot.bode(loop)``.

A loop is that of ``Law.closed_loop``, a ``ClosedLoop``; of a network ``gfmhil.design.network_loop``
gives a ``NetworkLoop``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import U_CARRIED, ClosedLoop, frequencies_near
from gfm_design.model.linear import Mode
from gfm_design.model.network import NetworkLoop
from gfm_hil.api.transients import SCR
from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import symbol_of
from gfm_hil.results.figures import (
    COLOURS,
    GREY,
    complex_plane,
    draw_panel,
    dress,
    dress_alone,
    headline,
    pyplot_panels,
    symbol,
)
from gfm_hil.results.look import figure_of, legend, look, own_colour, rc, with_look
from gfm_hil.results.look import save as save
from gfm_hil.studies.certificate import CertifiedLaws
from gfm_hil.studies.clearing import OF_ANGLE, ClearingTime
from gfm_hil.studies.linear_loop import title_of
from gfm_hil.studies.margin_figures import draw_sigma
from gfm_runtime.signals import Y_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from gfm_hil.api.sweeps import GainSweep, StabilityMap
    from gfm_hil.api.transients import TransientMap
    from gfm_hil.scenario import Scenario
    from gfm_hil.studies.attraction import Attraction
    from gfm_hil.studies.bus_scan import BusScan
    from gfm_hil.studies.forming_share import FormingShare

Vector = NDArray[np.float64]

_LOWEST_HZ, _TOP_HZ = 0.02, 5e3  # of a figure; a sampled loop ends at its Nyquist frequency
_POINTS = 1000
_TWO = 7.6, 5.6  # inches, of gain and phase
_STRIP = 0.6  # of a diagram, above it
_LEAST_DB = -100.0  # the hold has zeros at the Nyquist frequency
_SHOWN = 12  # modes of the figure of participations
_LEAST = 0.005  # a part below this in every mode is left out


@with_look
def bode(loop: ClosedLoop, *at: str) -> list[Axes]:
    """Draw gain [dB] and phase [degrees] of L over Hz, see ``ClosedLoop.loop_gain``, with the
    least margins of each loop, if all together are stable: of the phase where the gain crosses
    0 dB, of the gain where the phase crosses an odd multiple of 180 degrees.

    Args:
        at: channels of u or y at which one loop is cut; each command that acts if none is given.

    Raises:
        UserError: the loop does not use such a channel.
    """
    gain, phase = pyplot_panels(2, _TWO, below=1)
    margins = []
    for k, (name, hz, L) in enumerate(_gains(loop, at)):
        dB, degrees = 20 * np.log10(np.abs(L)), _degrees(L)
        _curve(gain, hz, dB, k, symbol_of(name))
        _curve(phase, hz, degrees, k, "_")
        margins.append((hz, dB, degrees))
    stable = loop.sigma() < 0.0
    for k, found in enumerate(margins):
        if stable:
            _mark_margins(gain, phase, *found, k)
    if phase.get_legend_handles_labels()[1]:
        legend(phase, loc="best")
    gain.axhline(0.0, color=GREY, lw=0.8)
    gain.set_ylim(bottom=max(gain.get_ylim()[0], _LEAST_DB))
    phase.axhline(-180.0, color=GREY, lw=0.8)
    _tick_degrees(phase)
    cut = "one loop cut" if stable else "one loop cut; the closed loop is unstable"
    return _finish([gain, phase], f"{_title(loop)}: L, {cut}", "|L| [dB]", "∠L [°]")


def _title(loop: ClosedLoop) -> str:
    """The law, and the scenario if it is known."""
    return f"{title_of(loop)}, {loop.where}" if loop.where else title_of(loop)


def _tick_degrees(axes: Axes) -> None:
    """Ticks at multiples of 45°, where these are too many of 90° or more."""
    from matplotlib.ticker import MultipleLocator

    low, high = axes.get_ylim()
    most = 9 if not look().paper else 6
    step = next(s for s in (45, 90, 180, 360, 720, 1e6) if (high - low) / s <= most)
    axes.yaxis.set_major_locator(MultipleLocator(step))


def _mark_margins(gain: Axes, phase: Axes, hz: Vector, dB: Vector, degrees: Vector, k: int) -> None:
    """Mark the least margins of a loop: of the phase in the panel of the phase, of the gain in that
    of the gain."""
    log, turn = np.log(hz), 360.0
    first, last = math.floor(degrees.min() / turn), math.ceil(degrees.max() / turn)
    odd = [_crossings(log, degrees - turn * n + 180.0) for n in range(first, last + 1)]
    style: Any = {"color": own_colour(COLOURS[k % len(COLOURS)]), "ms": 4.0, "ls": "none"}
    for axes, at, values, sign, unit in (
        (phase, _crossings(log, dB), degrees, "φ_m", "°"),
        (gain, np.concatenate(odd), dB, "g_m", " dB"),
    ):
        there = np.interp(at, log, values)
        margins = (there + turn) % turn - 180.0 if axes is phase else -there
        if not len(at):
            continue
        least = int(np.argmin(np.abs(margins)))
        f = float(np.exp(at[least]))
        said = f"{sign} {margins[least]:.3g}{unit} at {f:.3g} Hz"
        axes.plot(f, there[least], "o", label=said, **style)


def _crossings(x: Vector, y: Vector) -> Vector:
    """Where y, linear between its points, crosses zero."""
    at = np.flatnonzero((y[:-1] < 0.0) != (y[1:] < 0.0))
    share = y[at] / (y[at] - y[at + 1])
    return np.asarray(x[at] + share * (x[at + 1] - x[at]))


@with_look
def nyquist(loop: ClosedLoop, *at: str) -> Axes:
    """Draw L in the complex plane near -1, over positive frequencies; arguments and errors as
    ``bode``."""
    loci = {symbol_of(name): L for name, _, L in _gains(loop, at)}
    return complex_plane(f"{_title(loop)}: L, one loop cut", loci, (0.0, 1.0, None), "L")


@with_look
def step(loop: ClosedLoop | NetworkLoop, of: str | None = None, seconds: float = 1.0) -> list[Axes]:
    """Draw y = (v_dc, p, omega_u, q, V) [p.u.] after a unit step, of a network those of all
    converters; see ``step_response``.

    Args:
        of: one of the loop's ``inputs``: ``P_ref`` if None, of a network ``A.P_ref`` of its first
            converter A.
        seconds: how long, s.

    Raises:
        UserError: no such input.
    """
    of = of or stepped_by_default(loop)
    title = f"after a unit step of {of}"
    curves: list[tuple[Vector, str, str]]
    try:
        if isinstance(loop, NetworkLoop):
            colours = _colours(loop)
            t, each = loop.step_response(of, seconds)
            curves = [(each[one], colours[one], one) for one in loop.names]
        else:
            title = f"{_title(loop)}: {title}"
            t, y = loop.step_response(of, seconds)
            curves = [(y, COLOURS[0], "")]
    except ValueError as problem:
        raise UserError(f"step: {problem}") from None
    panels = pyplot_panels(len(Y_NAMES), (8.6, 8.2))
    for k, (axes, signal) in enumerate(zip(panels, Y_NAMES, strict=True)):
        lines = [(t, x[:, k], colour, name or signal) for x, colour, name in curves]
        draw_panel(axes, symbol(signal), lines, label=symbol(signal))
    panels[-1].set_xlabel("t [s]", fontsize=rc("axes.labelsize", 9))
    if len(curves) > 1:
        legend(panels[0], loc="best", ncols=4)
    headline(figure_of(panels), title)
    return panels


def stepped_by_default(loop: ClosedLoop | NetworkLoop) -> str:
    """The active power reference, of a network that of its first converter."""
    return f"{loop.names[0]}.P_ref" if isinstance(loop, NetworkLoop) else "P_ref"


@with_look
def pole_map(loop: ClosedLoop | NetworkLoop) -> Axes:
    """Draw the poles: sigma [1/s] and frequency [Hz], over symmetric logarithms; of a network each
    in the colour of the part that takes part in it most."""
    (axes,) = pyplot_panels(1, (6.6, 4.6))
    if isinstance(loop, NetworkLoop):
        _mark_parts(axes, loop)
        title = "poles, stable where σ < 0; colour: the part with the largest participation"
    else:
        poles = loop.poles()
        _mark_poles(axes, poles[poles.real < 0.0], "o", COLOURS[0])
        _mark_poles(axes, poles[poles.real >= 0.0], "X", COLOURS[1])
        title = f"{_title(loop)}: poles, stable where σ < 0"
    _dress_poles(axes, title)
    if isinstance(loop, NetworkLoop):
        legend(axes, loc="best")
    return axes


@with_look
def root_locus(sweep: GainSweep) -> Axes:
    """Draw the poles of ``gfmhil.design.sweep``: sigma [1/s] and frequency [Hz], over symmetric
    logarithms, in the colour of the parameter's value; those of the law's own value as crosses."""
    (axes,) = pyplot_panels(1, (6.6, 4.6))
    values = np.repeat(sweep.values, [len(p) for p in sweep.poles])
    poles = np.concatenate(sweep.poles)
    scale = "log" if values.min() > 0.0 else "linear"
    cloud = axes.scatter(poles.real, poles.imag / (2 * np.pi), 9, values, norm=scale)
    figure_of([axes]).colorbar(cloud, ax=axes, label=sweep.gain)
    if sweep.values[0] <= sweep.own <= sweep.values[-1]:
        k = int(np.argmin(np.abs(sweep.values - sweep.own)))
        near, label = sweep.poles[k], _of_law(sweep.gain, sweep.own)
        if not math.isclose(sweep.values[k], sweep.own, rel_tol=1e-3):
            label = f"{sweep.gain} = {sweep.values[k]:.4g}, nearest to the law's {sweep.own:.4g}"
        crosses = axes.plot(near.real, near.imag / (2 * np.pi), "kx", ms=5, label=label)
        _explain(axes, crosses)
    _dress_poles(axes, f"{_of(sweep)}: poles over {sweep.gain}, stable where σ < 0")
    return axes


def _mark_poles(
    axes: Axes, poles: NDArray[np.complex128], marker: str, colour: str, label: str | None = None
) -> None:
    axes.plot(poles.real, poles.imag / (2 * np.pi), marker, color=colour, ms=5, label=label)


def _dress_poles(axes: Axes, title: str) -> None:
    """What a panel of poles has: symmetric logarithms, and a line where sigma is 0."""
    axes.axvline(0.0, color="k", lw=0.8)
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.autoscale_view()  # of these scales
    axes.set(xlabel="σ [1/s]", ylabel="frequency [Hz]")
    dress_alone(axes, title)


def _of_law(gain: str, own: float) -> str:
    return f"{gain} = {own:.4g} (the law's)"


def _of(found: GainSweep | StabilityMap) -> str:
    """The law, and the scenario if it is known."""
    return f"{found.law}, {found.title}" if found.title else found.law


def _explain(axes: Axes, lines: list[Line2D]) -> None:
    """A legend below the axes, where it covers nothing; within those of somebody's figure."""
    if look().ax:
        legend(axes, handles=lines, loc="upper left", frameon=None)
    else:
        legend(figure_of([axes]), handles=lines, loc="outside lower center", ncols=2)


@with_look
def stability_map(stability: StabilityMap) -> Axes:
    """Draw ``gfmhil.design.stability_map``: sigma [1/s] over the parameter and the short-circuit
    ratio, its zero as a line, the law's own value dashed."""
    (axes,) = pyplot_panels(1, (6.6, 4.6))
    explained = draw_sigma(axes, stability.values, stability.scr, stability.sigma)
    label = _of_law(stability.gain, stability.own)
    own = axes.axvline(stability.own, color="k", lw=0.9, ls=(0, (4, 3)), label=label)
    axes.set_xlim(stability.values[0], stability.values[-1])
    axes.set_xscale("log" if stability.values[0] > 0.0 else "linear")
    axes.set_yscale("log")
    axes.set(xlabel=stability.gain, ylabel="short-circuit ratio")
    if not look().paper:  # which has captions
        axes.set_title(f"{_of(stability)}: stable where σ < 0", loc="left", fontsize=10)
    if stability.values[0] <= stability.own <= stability.values[-1]:
        explained.insert(0, own)
    if explained:
        _explain(axes, explained)
    return axes


@with_look
def certificate(found: CertifiedLaws) -> Axes:
    """Draw the margin of ``gfmhil.certify`` over Hz; where it is not positive, it is shaded.

    Raises:
        ValueError: a single converter is unstable already, so there is no certificate.
    """
    if found.certificate is None:
        raise ValueError(f"no certificate: {found.unstable}")
    (axes,) = pyplot_panels(1, (6.6, 3.2))
    hz, margin = found.certificate.hz, found.certificate.margin
    axes.stairs(margin, hz, color=COLOURS[0], lw=rc("lines.linewidth", 1.2))
    for k, (low, high) in enumerate(found.certificate.void):
        axes.axvspan(low, high, color=COLOURS[1], alpha=0.25, lw=0, label=None if k else "void")
    axes.axhline(0.0, color="k", lw=0.6)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=1e-3)
    axes.set(xlabel="frequency in the dq frame [Hz]", ylabel="margin", xlim=(hz[0], hz[-1]))
    if found.certificate.void:
        legend(axes)
    grids = found.grids
    dress_alone(axes, f"{', '.join(found.laws)}: strength {grids.weakest:g} to {grids.stiffest:g}")
    return axes


#: how a clearing time is marked, by what a longer fault does
_ENDS = {"o": "equilibrium not reached", "x": "is tripped", "^": "bears longer ones"}


@with_look
def clearing_times(times: Sequence[ClearingTime], scr: Sequence[float]) -> Axes:
    """Draw results of ``gfmhil.clearing_time`` over the short-circuit ratios of their grids, s: a
    cross where a longer fault ends by the protection, an arrow where the longest tried is borne."""
    order = np.argsort(scr)
    return _clearing_curve([times[k] for k in order], np.asarray(scr)[order], SCR)


@with_look
def clearing_map(found: TransientMap[ClearingTime]) -> list[Axes]:
    """Draw ``gfmhil.clearing_map``: what is borne, s, over one quantity as a curve; over two as
    cells, the first to the right and the second upwards; with a panel for each value of a third.
    The marks are those of ``clearing_times``."""
    if len(found.over) == 1:
        ((name, x),) = found.over.items()
        return [_clearing_curve(found.found, np.array(x), name)]
    seconds = found.values("seconds")
    panels = _cells(found, seconds, "clearing time [s]", float(seconds.max()) or 1.0)
    kinds = np.array([_end(one) for one in found.found])
    places = np.array([*itertools.product(*found.over.values())])
    layers = [*found.over.values()][2] if len(found.over) > 2 else (None,)
    for axes, layer in zip(panels, layers, strict=True):
        here = True if layer is None else places[:, 2] == layer
        for mark, meaning in _ENDS.items():
            x, y = places[np.isin(kinds, mark) & here, :2].T
            axes.plot(x, y, mark, color="w", mec="k", mew=0.7, ms=5, label=meaning)
    handles, labels = panels[0].get_legend_handles_labels()
    legend(figure_of(panels), handles=handles, labels=labels, loc="outside lower center", ncols=3)
    return panels


@with_look
def attraction_map(found: TransientMap[Attraction]) -> list[Axes]:
    """Draw ``gfmhil.attraction_map``, degrees: over one quantity the jumps from which the converter
    comes back; over two and three the smallest from which it does not, as ``clearing_map``."""
    low, high = found.values("low"), found.values("high")
    if len(found.over) > 1:
        return _cells(found, np.minimum(-low, high), "comes back from jumps below [deg]", 180.0)
    (axes,) = pyplot_panels(1, (6.6, 3.6))
    ((name, x),) = found.over.items()
    axes.fill_between(x, low, high, color=COLOURS[0], alpha=0.25, lw=0, label="comes back")
    for edge in (low, high):
        axes.plot(x, edge, "o-", color=COLOURS[0], lw=rc("lines.linewidth", 1.2), ms=4)
    axes.set(xlabel=_QUANTITY.get(name, name), ylabel="jump of the grid's angle [deg]")
    axes.set(ylim=(-185.0, 185.0), yticks=range(-180, 181, 60))
    legend(axes)
    dress_alone(axes, f"{found.law}: {found.title}")
    return [axes]


def _cells(found: TransientMap[Any], values: NDArray[Any], label: str, most: float) -> list[Axes]:
    """A map over two quantities, or a panel for each value of a third, with its colours."""
    names, (x, y, *third) = [*found.over], [np.array(values) for values in found.over.values()]
    layers = [f"{names[2]} = {z:g}" for z in third[0]] if third else [""]
    panels = pyplot_panels(len(layers), (6.6, 1.0 + 3.0 * len(layers)))
    values = values.reshape(len(x), len(y), len(layers))
    for k, (axes, layer) in enumerate(zip(panels, layers, strict=True)):
        mesh = axes.pcolormesh(x, y, values[:, :, k].T, shading="nearest", vmin=0.0, vmax=most)
        axes.set(ylabel=_QUANTITY.get(names[1], names[1]))
        dress_alone(axes, ", ".join(filter(None, (f"{found.law}: {found.title}", layer))))
    panels[-1].set(xlabel=_QUANTITY.get(names[0], names[0]))
    figure_of(panels).colorbar(mesh, ax=panels, label=label)
    return panels


_QUANTITY = {SCR: "short-circuit ratio"}


def _end(time: ClearingTime) -> str:
    return "^" if not time.loss else "o" if time.loss in OF_ANGLE else "x"


def _clearing_curve(times: Sequence[ClearingTime], x: Vector, quantity: str) -> Axes:
    """Clearing times over a quantity that ascends, with marks."""
    (axes,) = pyplot_panels(1, (6.6, 3.6))
    y, kinds = np.array([one.seconds for one in times]), np.array([_end(one) for one in times])
    axes.plot(x, y, color=COLOURS[0], lw=rc("lines.linewidth", 1.2))
    for mark, name in _ENDS.items():
        some = kinds == mark
        if some.any():
            axes.plot(x[some], y[some], mark, color=COLOURS[0], ms=5, label=name)
    label = _QUANTITY.get(quantity, quantity)
    axes.set(xlabel=label, ylabel="clearing time [s]", ylim=(0.0, None))
    legend(axes)
    dress_alone(axes, f"{times[0].law}: {times[0].title}")
    return axes


def _mark_parts(axes: Axes, loop: NetworkLoop) -> None:
    modes = loop.modes()
    for part, colour in _colours(loop).items():
        those = [m for m in modes if next(iter(m.participation)) == part]
        upper = np.array([complex(m.sigma, 2 * np.pi * m.frequency_hz) for m in those])
        poles = np.concatenate([upper, upper.conj()])
        label: str | None = part
        for marker, some in (("o", poles[poles.real < 0.0]), ("X", poles[poles.real >= 0.0])):
            if len(some):
                _mark_poles(axes, some, marker, colour, label)
                label = None


@with_look
def impedance(loop: ClosedLoop) -> list[Axes]:
    """Draw gain [p.u. of Z_b] and phase [degrees] of ``ClosedLoop.output_impedance`` over Hz.

    Raises:
        ValueError: the loop was made of matrices.
    """
    size, phase = pyplot_panels(2, _TWO)
    hz = _hz(loop)
    Z = loop.output_impedance(2 * np.pi * hz)
    for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        name = f"Z_{'dq'[i]}{'dq'[j]}"
        _curve(size, hz, np.abs(Z[:, i, j]), k, name)
        _curve(phase, hz, _degrees(Z[:, i, j]), k, name)
    size.set_yscale("log")
    title = f"{_title(loop)}: output impedance at the capacitor, dq"
    _tick_degrees(phase)
    return _finish([size, phase], title, "|Z| [p.u.]", "∠Z [°]")


@with_look
def participations(loop: NetworkLoop, most: int = _SHOWN) -> Axes:
    """Draw who takes part in the modes, the slowest to decay first: a bar for each, with the
    participations of ``modes()``.

    Args:
        most: how many modes, at least 1.
    """
    modes = loop.modes()[:most]
    (axes,) = pyplot_panels(1, (7.6, 1.2 + 0.3 * len(modes)))
    left = np.zeros(len(modes))
    for part, colour in _colours(loop).items():
        share = np.array([mode.participation[part] for mode in modes])
        if share.max() >= _LEAST:
            axes.barh(range(len(modes)), share, left=left, color=colour, label=part)
        left += share
    labels = [_label(mode) for mode in modes]
    axes.set_yticks(range(len(modes)), labels, family="monospace", fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(0.0, 1.0), xlabel="participation")
    dress(axes)
    legend(axes, loc="lower left", bbox_to_anchor=(0, 1), ncols=6)
    return axes


@with_look
def mode_shape(loop: NetworkLoop, scenario: Scenario, number: int = 1) -> Axes:
    """Draw who swings against whom in a mode, on the single-line diagram: the angle, and so the
    speed, of each converter and machine as an arrow, of the largest one.

    Args:
        scenario: of the loop.
        number: of the mode, from 1 on, the slowest to decay first.

    Raises:
        UserError: there is no such mode, or others have the same pole.
    """
    from matplotlib import pyplot

    from gfm_hil.results.diagram import fill_diagram

    modes = loop.modes()
    if not 1 <= number <= len(modes):
        raise UserError(f"mode {number}: must be one of 1 to {len(modes)}")
    mode = modes[number - 1]
    if not mode.shape:
        raise UserError(f"mode {number}: others have the same pole, so it has no shape of its own")
    figure = pyplot.figure()
    axes = fill_diagram(figure, scenario, phasors=mode.shape)
    (low, high), (width, height) = axes.get_ylim(), figure.get_size_inches()
    axes.set_ylim(low, high + _STRIP)  # the title stands above the diagram
    figure.set_size_inches(width, height * (1.0 + _STRIP / (high - low)))
    axes.text(0.99, 1.0 - 0.2 * _STRIP / (high + _STRIP - low),
              f"mode {number}: {_label(mode).strip()}", transform=axes.transAxes,
              ha="right", va="top", fontsize=9)  # fmt: skip
    return axes


@with_look
def bus_scan(scan: BusScan) -> list[Axes]:
    """Draw size [p.u.] and angle [degrees] of ``gfmhil.design.bus_scan`` over Hz."""
    size, phase = pyplot_panels(2, _TWO)
    _curve(size, scan.hz, np.abs(scan.Z), 0, "Z")
    _curve(phase, scan.hz, np.degrees(np.angle(scan.Z)), 0, "_")
    size.set_yscale("log")
    _tick_degrees(phase)
    title = f"{scan.title}: bus {scan.bus}, positive sequence"
    return _finish([size, phase], title, "|Z| [p.u.]", "∠Z [°]")


@with_look
def forming_shares(each: Sequence[FormingShare], title: str = "") -> Axes:
    """Draw the largest sigma [1/s] of ``gfmhil.design.forming_shares`` over the share of the rating
    that forms the grid; a cross where it is not stable, and where there is no steady state a line.
    """
    (axes,) = pyplot_panels(1, (6.6, 3.6))
    there = [one for one in each if one.mode is not None]
    x, sigma = (np.array([getattr(one, name) for one in there]) for name in ("share", "sigma"))
    axes.plot(100 * x, sigma, color=COLOURS[0], lw=rc("lines.linewidth", 1.2))
    for marker, some in (("o", sigma < 0.0), ("X", sigma >= 0.0)):
        axes.plot(100 * x[some], sigma[some], marker, color=COLOURS[0], ms=5)
    for one in there:
        axes.annotate(one.follows, (100 * one.share, one.sigma), (4, 4), fontsize=8,
                      textcoords="offset points")  # fmt: skip
    for one in each:
        if one.mode is None:
            axes.axvline(100 * one.share, color=GREY, lw=0.8, ls=":")
            axes.text(100 * one.share, 0.02, f"{one.follows}: no linear loop ", rotation=90,
                      ha="right", transform=axes.get_xaxis_transform(), fontsize=8)  # fmt: skip
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set(
        xlabel="rating that forms the grid [%]; a name follows from there on", ylabel="σ [1/s]"
    )
    axes.set(xlim=(103.0, -3.0))
    dress_alone(axes, f"{title}: mode with the largest σ")
    return axes


def _label(mode: Mode) -> str:
    """sigma and frequency of a mode, as wide for all."""
    sigma = f"{mode.sigma:.3g}".replace("-", "−")
    return f"{sigma:>7} 1/s {mode.frequency_hz:6.4g} Hz"


def _colours(loop: NetworkLoop) -> dict[str, str]:
    return {part: COLOURS[k % len(COLOURS)] for k, part in enumerate(loop.network.parts)}


def _gains(
    loop: ClosedLoop, at: Sequence[str]
) -> Iterable[tuple[str, Vector, NDArray[np.complex128]]]:
    """L at some channels, each with its name and the frequencies, Hz."""
    hz = _hz(loop)
    for name in at or [U_CARRIED[j] for j in loop.commands]:
        try:
            yield name, hz, loop.loop_gain(name, 2 * np.pi * hz)
        except ValueError as problem:
            raise UserError(str(problem)) from None


def _hz(loop: ClosedLoop) -> Vector:
    """The frequencies of a figure, closer together where the loop resonates."""
    top = _TOP_HZ if loop.T_s is None else 0.5 / loop.T_s
    across = np.tan(np.linspace(-1.5, 1.5, 60))  # a resonance is a circle in the complex plane
    near = frequencies_near(loop.poles(), across) / (2 * np.pi)
    base = np.geomspace(_LOWEST_HZ, 0.999 * top, _POINTS)
    return np.unique(np.concatenate([base, near[(near > _LOWEST_HZ) & (near < base[-1])]]))


def _curve(axes: Axes, hz: Vector, values: Vector, k: int, label: str) -> None:
    own, width = own_colour(COLOURS[k % len(COLOURS)]), rc("lines.linewidth", 1.2)
    axes.semilogx(hz, values, color=own, lw=width, label=label)


def _degrees(L: NDArray[np.complex128]) -> Vector:
    """The phase without jumps, which begins within (-360, 0]."""
    phase = np.degrees(np.unwrap(np.angle(L)))
    return np.asarray(phase - 360.0 * np.ceil(phase[0] / 360.0))


def _finish(panels: list[Axes], title: str, *labels: str) -> list[Axes]:
    for axes, label in zip(panels, labels, strict=True):
        dress(axes)
        axes.set_ylabel(label, fontsize=rc("axes.labelsize", 9.5))
    if not look().paper:  # which has captions
        size = rc("axes.titlesize", 9.5)
        panels[0].set_title(title, loc="left", fontsize=size, color="#222222", wrap=True)
    panels[-1].set_xlabel("frequency [Hz]", fontsize=rc("axes.labelsize", 9.5))
    if look().paper and not look().ax:  # its labels may be wider than the panels
        both = [one.get_legend_handles_labels() for one in panels]
        for one in filter(None, (axes.get_legend() for axes in panels)):
            one.remove()
        handles, names = ([x for pair in part for x in pair] for part in zip(*both, strict=True))
        where: dict[str, Any] = {"loc": "outside lower left", "ncols": 2, "columnspacing": 1.0}
        legend(figure_of(panels), handles=handles, labels=names, **where)
    else:
        legend(panels[0], loc="best")
    return panels
