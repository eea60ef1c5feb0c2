"""All margins of a loop: each loop on its own, all channels at once, delay, elements, the grid."""

from dataclasses import dataclass

import numpy as np

from gfm_design.margins.delays import DelayMargin, DelayMargins, longest
from gfm_design.margins.locus import (
    DiskMargin,
    GainPhase,
    Locus,
    disk_margin,
    gain_phase,
    locus_at_u,
    locus_at_y,
)
from gfm_design.margins.tolerance import GridStrength, Range, element_ranges, grid_strength
from gfm_design.model.closed_loop import U_CARRIED, Y_CARRIED, ClosedLoop
from gfm_design.model.linear import Mode
from gfm_plant.parameters import Element

_AT_REST = 1e-6  # 1/s; a mode that decays more slowly is an integrator, to rounding
_INSIDE, _OUTSIDE = 0.99, 1.01  # of a margin, in dB, degrees or seconds


class UnstableLoop(ArithmeticError):
    """The nominal loop is unstable, so it has no margins; ``mode`` grows fastest."""

    def __init__(self, mode: Mode) -> None:
        self.mode = mode
        kind = f"the mode at {mode.frequency_hz:.4g} Hz" if mode.frequency_hz else "a real mode"
        if mode.sigma > _AT_REST:
            text = f"unstable: {kind} grows with sigma = {mode.sigma:+.4g} 1/s"
        else:
            text = f"not asymptotically stable: {kind} neither grows nor decays"
        super().__init__(text)


@dataclass(frozen=True)
class ChannelMargins:
    """Margins of the loop through one of u or y, all others closed.

    ``confirmed``: closed with 0.99 of every margin the loop is stable, with 1.01 it is not.
    """

    name: str
    gain_phase: GainPhase
    delay: DelayMargin
    confirmed: bool


@dataclass(frozen=True)
class LoopMargins:
    """The margins of a loop at one operating point."""

    worst: Mode  #: the mode that is damped least, its damping ratio the smallest
    #: u, y: each channel that the loop uses
    u: tuple[ChannelMargins, ...]
    y: tuple[ChannelMargins, ...]
    #: disk_u, disk_y: all channels of u, of y at once
    disk_u: DiskMargin
    disk_y: DiskMargin
    delay: DelayMargin  #: additional delay of all of u; the scan ended at ``longest``, s
    longest: float


@dataclass(frozen=True)
class Margins:
    """The margins of ``loop``, and the ranges of the circuit's elements and of the grid."""

    loop: LoopMargins
    elements: dict[Element, Range | None]
    grid: GridStrength


def margins(loop: ClosedLoop) -> Margins:
    """All margins of a sampled loop made of a plant and a law; takes some seconds.

    Raises:
        UnstableLoop: there are none.
        NoEquilibrium: plant and law have no operating point.
    """
    return Margins(loop_margins(loop), element_ranges(loop), grid_strength(loop))


def loop_margins(loop: ClosedLoop) -> LoopMargins:
    """The margins of one sampled loop.

    Raises:
        UnstableLoop: there are none.
    """
    if loop.T_s is None:
        raise ValueError("the margins are those of a sampled loop; sample it first")
    modes = loop.modes()
    if modes[0].sigma > -_AT_REST:
        raise UnstableLoop(modes[0])
    at_u, at_y, delays = locus_at_u(loop), locus_at_y(loop), DelayMargins(loop)
    return LoopMargins(
        min(modes, key=lambda mode: mode.ratio),
        _channels(delays, at_u, True),
        _channels(delays, at_y, False),
        disk_margin(at_u),
        disk_margin(at_y),
        delays.overall(),
        longest(loop.T_s),
    )


def _channels(delays: DelayMargins, locus: Locus, at_u: bool) -> tuple[ChannelMargins, ...]:
    names = U_CARRIED if at_u else Y_CARRIED
    omega, H = locus.sampled()
    found = []
    for k, channel in enumerate(locus.channels):
        classical = gain_phase(locus, omega, H, k)
        delay = (delays.at_u if at_u else delays.at_y)(channel)
        confirmed = _confirmed(delays.loop, channel, at_u, classical)
        found.append(ChannelMargins(names[channel], classical, delay, confirmed))
    return tuple(found)


def _confirmed(loop: ClosedLoop, channel: int, at_u: bool, m: GainPhase) -> bool:
    """Check the eigenvalues of the loop closed slightly inside and outside of every margin."""

    def held(factor: complex) -> bool:
        by = np.ones(len(loop.u_delay if at_u else loop.y_delay), complex)
        by[channel] = factor
        return bool((loop.scaled(u=by) if at_u else loop.scaled(y=by)).sigma() < 0.0)

    good = True
    for gain in (m.gain_low, m.gain_high):
        if 0.0 < gain < np.inf:
            good &= held(gain**_INSIDE) and not held(gain**_OUTSIDE)
    if m.phase_deg < np.inf:
        # at the negative frequency the same mode rotates in the other direction: try both
        turns = [
            [held(np.exp(sign * share * 1j * np.radians(m.phase_deg))) for sign in (1, -1)]
            for share in (_INSIDE, _OUTSIDE)
        ]
        good &= all(turns[0]) and not all(turns[1])
    return bool(good)
