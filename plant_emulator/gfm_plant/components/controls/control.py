"""What a control of a synchronous machine declares: an exciter with its regulator, a governor with
its turbine, or a stabiliser."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import model_validator

from gfm_plant.parameters import Options


def parabola(E_1: float, S_1: float, E_2: float, S_2: float) -> tuple[float, float]:
    """The numbers a and b of a saturation: S(E) E = b (E - a)^2 above a and 0 below it, through
    S(E_1) = S_1 and S(E_2) = S_2; without S_2 there is none."""
    if S_2 == 0.0:
        return 0.0, 0.0
    first, second = math.sqrt(S_1 * E_1), math.sqrt(S_2 * E_2)
    rise = (second - first) / (E_2 - E_1)
    return E_2 - second / rise, rise**2


class Terminals(NamedTuple):
    """What an exciter sees of its machine, p.u.

    The phasors are those of the rotor's frame, i out of the machine. v leaves out what the stator
    adds while currents and fluxes move, as the models of phasors do, for which exciters that use
    it are defined.
    """

    V: float  #: size of the terminals' voltage
    I_fd: float  #: current of the field, X_ad I_fd: E_fd where nothing moves
    v: complex
    i: complex


class Shaft(NamedTuple):
    """What a governor sees of its machine, p.u."""

    w: float  #: deviation of the speed
    P_e: float  #: power that the terminals bring


class Control(Options):
    """Base of all controls; the options of one are its standard parameters, in p.u. of the
    machine's rating and s.

    Its ``rates`` is a compiled function (p, x, at, seen, asked, out) -> output. What a stabiliser
    sees is a number, an exciter ``Terminals`` and a governor ``Shaft``. p are its ``numbers``, its
    states are x from ``at`` on, and their d/dt, 1/s, go to the same places of out.
    A time constant of 0 that it allows leaves its block out, whose states then do not move.
    """

    #: its states in their order: name, unit, meaning
    states: ClassVar[Sequence[tuple[str, str, str]]]
    rates: ClassVar[Callable[..., float]]
    #: options between which something stays, named by these with min and max behind them
    ranges: ClassVar[Sequence[str]] = ()
    #: leads that need a lag, with it: their names
    leads: ClassVar[Sequence[tuple[str, str]]] = ()
    #: options that ``rates`` takes first, in their order, and those that are time constants
    order: ClassVar[Sequence[str]]
    times: ClassVar[Sequence[str]]
    #: by the place of a state, options between which it stays, named as in ``ranges``
    stops: ClassVar[Mapping[int, str]] = {}

    @model_validator(mode="after")
    def _is_proper(self) -> Self:
        for name in (*self.ranges, *self.stops.values()):
            least, most = getattr(self, f"{name}min"), getattr(self, f"{name}max")
            if not least < most:
                raise ValueError(f"{name}min = {least:g}: must be less than {name}max, {most:g}")
        for lead, lag in self.leads:
            if getattr(self, lag) == 0.0 and getattr(self, lead) > 0.0:
                raise ValueError(
                    f"{lag} = 0: must be above 0 with {lead} = {getattr(self, lead):g}"
                )
        return self

    @classmethod
    def kind(cls) -> str:
        """The name of what it is, its key ``type``."""
        return str(cls.model_fields["type"].default)

    def numbers(self) -> Sequence[float]:
        """What ``rates`` takes as p."""
        return [float(getattr(self, name)) for name in self.order]

    def lags(self) -> Mapping[str, float]:
        """Its time constants by their names, s, but for those that leave a block out."""
        return {name: T for name in self.times if (T := getattr(self, name)) > 0.0}

    def limits(self) -> Mapping[int, tuple[float, float]]:
        """Between which values a state stays, by its place: a limit without wind-up."""
        return {
            place: (getattr(self, f"{name}min"), getattr(self, f"{name}max"))
            for place, name in self.stops.items()
        }

    def limits_at(self, seen: Any) -> Mapping[int, tuple[float, float]]:
        """The limits at what it sees at a rest, those that follow it included."""
        return self.limits()

    def rest(self, output: float, seen: Any) -> tuple[Sequence[float], float]:
        """Its states, and what it is asked for, where nothing moves."""
        raise NotImplementedError


class Exciter(Control):
    """A voltage regulator with its exciter: sees ``Terminals``, is asked for a voltage, gives E_fd.
    Its first state is the size of the terminals' voltage as measured, with the lag T_R."""

    T_R: float


class Governor(Control):
    """A governor with its turbine: sees ``Shaft``, is asked for a power, gives the torque of the
    turbine."""

    #: options of which a larger one lets it bring more at rest, if not those of its stops
    opens: ClassVar[Sequence[str]] = ()

    def per_speed(self) -> float:
        """How much more torque it gives at rest by a lower speed, p.u./p.u."""
        raise NotImplementedError


class Stabiliser(Control):
    """A power system stabiliser: sees the deviation of the speed, gives what is added to the
    set-point of the voltage."""
