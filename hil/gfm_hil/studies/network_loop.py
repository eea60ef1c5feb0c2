"""The linear loop of a scenario with several converters, which draws itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from gfm_design.model.linear import Mode
from gfm_design.model.network import NetworkLoop as _NetworkLoop
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario, load_scenario, plant_of
from gfm_hil.studies.loop import Loop, draw_step, initial_law
from gfm_plant import NoEquilibrium
from gfm_runtime import Law as BuiltLaw
from gfm_runtime import discretise

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 12  # modes of the figure of participations
_LEAST = 0.005  # of a participation that is drawn


class NetworkLoop(_NetworkLoop):
    """All converters of a network under their laws, linearised where all of them rest; see
    ``gfmhil.design.network_loop``.

    ``modes()`` gives the modes with the parts of the network that take part in each, ``poles()``
    and ``sigma()`` their poles, ``step_response()`` and ``frequency_response()`` the responses of
    all converters, and ``converter()`` the loop of one of them. The other methods draw with
    matplotlib.
    """

    view = Loop

    def converter(self, name: str) -> Loop:
        """The loop of one converter, while all others are closed under their laws: its margins, its
        gamma and its Bode diagram are those in this network.

        Raises:
            UserError: no such converter.
        """
        try:
            found = super().converter(name)
        except ValueError as problem:
            raise UserError(str(problem)) from None
        assert isinstance(found, Loop)
        return found

    def pole_map(self) -> Axes:
        """Draw the poles: sigma [1/s] and frequency [Hz], over symmetric logarithms, each in the
        colour of the part that takes part in it most."""
        from matplotlib import pyplot

        from gfm_hil.results.figures import dress

        _, axes = pyplot.subplots(figsize=(6.6, 4.6), layout="constrained")
        modes = self.modes()
        for part, colour in self._colours().items():
            those = [m for m in modes if next(iter(m.participation)) == part]
            label: str | None = part
            for marker, some in (
                ("o", [m for m in those if m.sigma < 0.0]),
                ("X", [m for m in those if m.sigma >= 0.0]),
            ):
                sigma, hz = ([getattr(m, name) for m in some] for name in ("sigma", "frequency_hz"))
                if some:
                    axes.plot(sigma * 2, [*hz, *(-f for f in hz)], marker, color=colour, ms=5,
                              label=label)  # fmt: skip
                    label = None
        axes.axvline(0.0, color="k", lw=0.8)
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set(xlabel="σ [1/s]", ylabel="frequency [Hz]")
        dress(axes, "poles, stable where σ < 0; colour: the part with the largest participation")
        axes.legend(fontsize=8, frameon=False, loc="best")
        return axes

    def participations(self, most: int = _SHOWN) -> Axes:
        """Draw who takes part in the modes, the slowest to decay first: a bar for each, with the
        participations of ``modes()``.

        Args:
            most: how many modes, at least 1.
        """
        from matplotlib import pyplot

        from gfm_hil.results.figures import dress

        modes = self.modes()[:most]
        figsize = 7.6, 1.2 + 0.3 * len(modes)
        _, axes = pyplot.subplots(figsize=figsize, layout="constrained")
        left = np.zeros(len(modes))
        for part, colour in self._colours().items():
            share = np.array([mode.participation[part] for mode in modes])
            if share.max() >= _LEAST:
                axes.barh(range(len(modes)), share, left=left, color=colour, label=part)
            left += share
        labels = [_label(mode) for mode in modes]
        axes.set_yticks(range(len(modes)), labels, family="monospace", fontsize=8)
        axes.invert_yaxis()
        axes.set(xlim=(0.0, 1.0), xlabel="participation")
        dress(axes)
        axes.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=6)
        return axes

    def step(self, of: str, seconds: float = 1.0) -> list[Axes]:
        """Draw y = (v_dc, p, omega_u, q, V) [p.u.] of all converters after a unit step.

        Args:
            of: one of ``inputs``, as A.P_ref.
            seconds: how long, s.

        Raises:
            UserError: no such input.
        """
        try:
            t, y = self.step_response(of, seconds)
        except ValueError as problem:
            raise UserError(f"step: {problem}") from None
        colours = self._colours()
        curves = [(y[one], colours[one], one) for one in self.names]
        return draw_step(t, curves, f"after a unit step of {of}")

    def _colours(self) -> dict[str, str]:
        from gfm_hil.results.figures import COLOURS

        parts = list(self.network.parts)
        return {part: COLOURS[k % len(COLOURS)] for k, part in enumerate(parts)}


def network_loop(
    on: str | Path | Scenario | dict[str, Any],
    laws: Mapping[str, BuiltLaw] = MappingProxyType({}),
    **changes: Any,
) -> NetworkLoop:
    """The linear loop of a scenario with a network, as it is when the run starts.

    Args:
        on: a scenario: its name, file or content, or a checked one.
        laws: by converter, other laws than the scenario's; they bring their own inner stage.
        changes: keys of the scenario with ``__`` for the dot, as for ``gfmhil.run``.

    Raises:
        UserError: one line a mistake; the scenario has no network; there is no operating point.
    """
    scenario = load_scenario(on, **changes)
    if scenario.network is None:
        raise UserError("network: the scenario has none; use Law.closed_loop")
    try:
        return _linearised(scenario, laws)
    except NoEquilibrium as problem:
        raise UserError(f"network: {problem}") from None


def loop_under(law: BuiltLaw, scenario: Scenario, converter: str | None) -> Loop:
    """The sampled loop of a checked scenario under another law, of one converter if there is a
    network.

    Raises:
        NoEquilibrium: there is no operating point.
    """
    if converter is not None:
        return _linearised(scenario, {converter: law}).converter(converter)
    return Loop.of(law, scenario.plant, scenario.references.vector(), T_s=scenario.T_s)


def _linearised(scenario: Scenario, laws: Mapping[str, BuiltLaw]) -> NetworkLoop:
    each = [scenario.of(name) for name in scenario.converters]
    built = [
        discretise(laws[name], scenario.T_s) if name in laws else initial_law(one)[0]
        for name, one in zip(scenario.converters, each, strict=True)
    ]
    references = [one.references.vector() for one in each]
    return NetworkLoop.of(plant_of(scenario), built, references)


def _label(mode: Mode) -> str:
    """sigma and frequency of a mode, as wide for all."""
    sigma = f"{mode.sigma:.3g}".replace("-", "−")
    return f"{sigma:>7} 1/s {mode.frequency_hz:6.4g} Hz"
