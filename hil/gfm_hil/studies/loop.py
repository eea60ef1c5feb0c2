"""A closed loop that draws itself: Bode, Nyquist, step, poles and the output impedance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.closed_loop import frequencies_near as _near
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import Scenario
from gfm_runtime import DiscreteLaw, law_titles, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.signals import U_NAMES, Y_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Vector = NDArray[np.float64]

_LOWEST_HZ, _TOP_HZ = 0.02, 5e3  # of a figure; a sampled loop ends at its Nyquist frequency
_POINTS = 1000
_LEAST_DB = -100.0  # the hold has zeros at the Nyquist frequency
_NYQUIST = 3.0  # half a side of the figure: beyond it L is not near -1
_GREY = "#888888"
_GROWS = 1e-6  # 1/s; rounding may move a mode that rests, as the angle of an island, by less


class Loop(ClosedLoop):
    """A law around a plant, linearised at its operating point; see ``Law.closed_loop``.

    All numbers are those of ``gfm_design.model.closed_loop.ClosedLoop``: ``modes()``,
    ``margins()``, ``gamma()``, ``poles()``, ``step_response()``, ``frequency_response()``,
    ``loop_gain()`` and ``output_impedance()``. The methods here draw them with matplotlib.
    """

    def bode(self, *at: str) -> list[Axes]:
        """Draw gain [dB] and phase [degrees] of L over Hz, see ``loop_gain``.

        Args:
            at: channels of u or y at which one loop is cut; each command that acts if none is
                given.

        Raises:
            UserError: the loop does not use such a channel.
        """
        gain, phase = _figure(2)
        hz = self._hz()
        for k, name in enumerate(at or self._acting()):
            L = self._gain(name, 2 * np.pi * hz)
            _curve(gain, hz, 20 * np.log10(np.abs(L)), k, name)
            _curve(phase, hz, _degrees(L), k, name)
        gain.axhline(0.0, color=_GREY, lw=0.8)
        gain.set_ylim(bottom=max(gain.get_ylim()[0], _LEAST_DB))
        phase.axhline(-180.0, color=_GREY, lw=0.8)
        return _finish([gain, phase], f"{self.title}: L, one loop cut", "|L| [dB]", "∠L [°]")

    def nyquist(self, *at: str) -> Axes:
        """Draw L in the complex plane near -1, over positive frequencies; arguments as ``bode``.

        Raises:
            UserError: the loop does not use such a channel.
        """
        from matplotlib import pyplot

        from gfm_hil.results.figures import COLOURS, dress

        _, axes = pyplot.subplots(figsize=(5.6, 5.6), layout="constrained")
        for k, name in enumerate(at or self._acting()):
            L = self._gain(name, 2 * np.pi * self._hz())
            axes.plot(L.real, L.imag, color=COLOURS[k % len(COLOURS)], lw=1.2, label=name)
        turn = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
        axes.plot(turn.real, turn.imag, color=_GREY, lw=0.7, ls=(0, (4, 3)))
        axes.plot(-1.0, 0.0, "+", color="k", ms=10, label="−1")
        axes.set(xlim=(-_NYQUIST, _NYQUIST), ylim=(-_NYQUIST, _NYQUIST), aspect="equal")
        axes.set(xlabel="Re L", ylabel="Im L")
        dress(axes, f"{self.title}: L, one loop cut")
        axes.legend(fontsize=8, frameon=False, loc="upper right")
        return axes

    def step(self, of: str = "P_ref", seconds: float = 1.0) -> list[Axes]:
        """Draw y = (v_dc, p, omega_u, q, V) [p.u.] after a unit step, see ``step_response``.

        Args:
            of: one of the references, ``grid.omega_g`` or ``grid.V_g``.
            seconds: how long, s.

        Raises:
            UserError: no such input.
        """
        from gfm_hil.results.figures import COLOURS

        try:
            t, y = self.step_response(of, seconds)
        except ValueError as problem:
            raise UserError(f"step: {problem}") from None
        return draw_step(t, [(y, COLOURS[0], "")], f"{self.title}: after a unit step of {of}")

    def pole_map(self) -> Axes:
        """Draw the poles: sigma [1/s] and frequency [Hz], over symmetric logarithms."""
        from matplotlib import pyplot

        from gfm_hil.results.figures import COLOURS, dress

        poles = self.poles()
        _, axes = pyplot.subplots(figsize=(6.6, 4.6), layout="constrained")
        for here, colour, marker in (
            (poles.real < 0.0, COLOURS[0], "o"),
            (poles.real >= 0.0, COLOURS[1], "X"),
        ):
            some = poles[here]
            axes.plot(some.real, some.imag / (2 * np.pi), marker, color=colour, ms=5)
        axes.axvline(0.0, color="k", lw=0.8)
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set(xlabel="σ [1/s]", ylabel="frequency [Hz]")
        dress(axes, f"{self.title}: poles, stable where σ < 0")
        return axes

    def impedance(self) -> list[Axes]:
        """Draw gain [p.u. of Z_b] and phase [degrees] of ``output_impedance`` over Hz.

        Raises:
            ValueError: the loop was made of matrices.
        """
        size, phase = _figure(2)
        hz = self._hz()
        Z = self.output_impedance(2 * np.pi * hz)
        for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
            name = f"Z_{'dq'[i]}{'dq'[j]}"
            _curve(size, hz, np.abs(Z[:, i, j]), k, name)
            _curve(phase, hz, _degrees(Z[:, i, j]), k, name)
        size.set_yscale("log")
        title = f"{self.title}: output impedance at the capacitor, dq"
        return _finish([size, phase], title, "|Z| [p.u.]", "∠Z [°]")

    @property
    def title(self) -> str:
        """The name of the law; of a converter of a network its own name too."""
        if self.around is not None:
            return self.around.name
        return self.origin.law.law.name if self.origin else "loop"

    def _acting(self) -> list[str]:
        return [U_NAMES[j] for j in self.commands]

    def _gain(self, at: str, omega: ArrayLike) -> NDArray[np.complex128]:
        try:
            return self.loop_gain(at, omega)
        except ValueError as problem:
            raise UserError(str(problem)) from None

    def _hz(self) -> Vector:
        """The frequencies of a figure, closer together where the loop resonates."""
        top = _TOP_HZ if self.T_s is None else 0.5 / self.T_s
        near = _near(self.poles()) / (2 * np.pi)
        base = np.geomspace(_LOWEST_HZ, 0.999 * top, _POINTS)
        return np.unique(np.concatenate([base, near[(near > _LOWEST_HZ) & (near < base[-1])]]))


def initial_law(scenario: Scenario) -> tuple[DiscreteLaw, str]:
    """The law of one converter at its start, of a scheduled law the stage in force; its label."""
    references = scenario.references.vector()
    controller = Controller([load_law(scenario.law, scenario.inner)], scenario.T_s, references)
    return controller.active_law, controller.active


def scenario_loop(scenario: Scenario, converter: str | None = None) -> tuple[Loop, str]:
    """The loop of the scenario's first law, and its label.

    Args:
        converter: of a network, which one; the folder of a converter knows it.

    Raises:
        NoEquilibrium, UserError: there is no operating point; or there is a network and no
            converter is named, or one that it does not have.
    """
    if scenario.network is None:
        law, label = initial_law(scenario)
        return Loop.of(law, scenario.plant, scenario.references.vector()), label
    from gfm_hil.studies.network_loop import network_loop

    name = converter or scenario.converter
    if name is None:
        raise UserError(
            f"network: this takes the loop of one converter; --converter names it, one of"
            f" {scenario.converters}"
        )
    loop = network_loop(scenario).converter(name)
    return loop, loop.title


def unstable_mode(scenario: Scenario) -> tuple[str, str] | None:
    """The law under which the linear loop of a scenario's start is unstable, and the mode that
    grows fastest there, in words.

    Of a network the law is empty. Of other scenarios those count that the run changes to as well.
    None if every loop is stable, or if there is none, for example for want of an operating point.
    """
    from gfm_hil.studies.network_loop import network_loop

    alone = scenario.network is None
    laws = scenario.model_copy(update={"ready_laws": []}).laws() if alone else [""]
    for law, title in law_titles(laws).items():
        under = scenario.model_copy(update={"law": law})
        try:
            loop = scenario_loop(under)[0] if alone else network_loop(scenario)
            worst = max(loop.modes(), key=lambda mode: mode.sigma)
        except (UserError, ValueError, ArithmeticError, ModuleNotFoundError):
            continue
        if worst.sigma > _GROWS:
            hz = f"{worst.frequency_hz:.4g} Hz" if worst.frequency_hz else "real"
            of = f" of {title}" if title else ""
            words = f"the linear loop{of} has an unstable mode: {hz}, {worst.sigma:+.3g} 1/s"
            return law, words + (_current_loop_too_fast(under) if alone else "")
    return None


def _current_loop_too_fast(scenario: Scenario) -> str:
    """What to change where the current loop of the law's inner stage is too fast for T_s, or "".

    The loop on L_f alone, i[k+1] = i[k] - g i[k-d] with g = k_c omega_b T_s / L_f, is stable for
    g below 2 sin(pi / (4 d + 2)) (Levin and May, Theor. Popul. Biol. 9, 1976).
    """
    (inner, *_) = (law.inner for law in load_law(scenario.law, scenario.inner).laws)
    if inner is None:
        return ""
    delay = scenario.plant.delay
    d = math.ceil(delay.samples + delay.fraction)
    turn = 2 * math.pi * nominal_frequency(scenario) * scenario.T_s
    most = 2 * math.sin(math.pi / (4 * d + 2)) * inner.L_f / turn
    if inner.k_c < most:
        return ""
    return (
        f"; at T_s = {1e3 * scenario.T_s:g} ms, u {d} ticks late, the current loop needs "
        f"k_c below {most:.3g} p.u. (it is {inner.k_c:g})"
    )


def _figure(rows: int) -> list[Axes]:
    from matplotlib import pyplot

    _, panels = pyplot.subplots(rows, 1, sharex=True, figsize=(7.6, 5.6), layout="constrained")
    return list(panels)


def _curve(axes: Axes, hz: Vector, values: Vector, k: int, label: str) -> None:
    from gfm_hil.results.figures import COLOURS

    axes.semilogx(hz, values, color=COLOURS[k % len(COLOURS)], lw=1.2, label=label)


def _degrees(L: NDArray[np.complex128]) -> Vector:
    """The phase without jumps, which begins within (-360, 0]."""
    phase = np.degrees(np.unwrap(np.angle(L)))
    return np.asarray(phase - 360.0 * np.ceil(phase[0] / 360.0))


def _finish(panels: Sequence[Axes], title: str, *labels: str) -> list[Axes]:
    from gfm_hil.results.figures import dress

    for axes, label in zip(panels, labels, strict=True):
        dress(axes)
        axes.set_ylabel(label, fontsize=9.5)
    panels[0].set_title(title, loc="left", fontsize=9.5, color="#222222")
    panels[-1].set_xlabel("frequency [Hz]", fontsize=9.5)
    panels[0].legend(fontsize=8, frameon=False, loc="best")
    return list(panels)


def draw_step(t: Any, curves: Sequence[tuple[Any, str, str]], title: str) -> list[Axes]:
    """Draw y = (v_dc, p, omega_u, q, V) [p.u.] over t [s], a panel each.

    Args:
        t: shape (K,).
        curves: y (K, 5), its colour and its name; a legend tells names that are not empty.
        title: of the figure.
    """
    from matplotlib import pyplot

    from gfm_hil.results.figures import draw_panel

    figure, panels = pyplot.subplots(
        len(Y_NAMES), 1, sharex=True, figsize=(8.6, 8.2), layout="constrained"
    )
    for k, (axes, signal) in enumerate(zip(panels, Y_NAMES, strict=True)):
        lines = [(t, y[:, k], colour, name or signal) for y, colour, name in curves]
        draw_panel(axes, f"{signal} [p.u.]", lines)
    panels[-1].set_xlabel("t [s]", fontsize=9)
    if any(name for _, _, name in curves):
        panels[0].legend(fontsize=8, frameon=False, loc="best", ncols=4)
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return list(panels)
