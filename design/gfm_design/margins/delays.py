"""Delay margins: a scan from a stable value to the first unstable one, then its refinement.

The scan ends at the first unstable value, even if the loop is stable again at larger ones: it
could not get there without becoming unstable.

The scan counts unstable poles by the argument principle, from the frequency response of the loop
without more delay. Let C be the rows by which the late channels are read from the closed loop's
state and B the columns by which they act on it, and B_d(z) those with more delay: then

    G(z) = det(zI - A_d)/det(zI - A) = det(I + C (zI - A)^-1 (B - B_d(z))),

but for the poles of the delay lines, which are at z = 0. As A is stable, G turns around 0 once,
clockwise, for each unstable pole of A_d. Eigenvalues then judge the two ends of the interval that
the scan found, and refine it; should they not agree with the count, they scan themselves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from gfm_design.model.closed_loop import ClosedLoop, Responses, frequencies_near

_TOLERANCE = 1e-9  # relative accuracy
_BOUND = 1e9  # 1/s; no growth rate is larger, but that of no loop at all


def first_loss(sigma: Callable[[float], float], values: Sequence[float]) -> float | None:
    """Where stability is lost between two values, the first such; None if all are stable.

    Args:
        sigma: largest growth rate at a value; unstable from 0 on, inf if there is no loop.
        values: to scan, from the nearest to the furthest; the first one counts as stable.
    """

    def bounded(value: float) -> float:
        return float(np.clip(sigma(value), -_BOUND, _BOUND))

    for held, value in pairwise(values):
        if bounded(value) >= 0.0:
            if bounded(held) >= 0.0:
                return held
            near = _TOLERANCE * max(abs(value), abs(held))
            return float(brentq(bounded, held, value, xtol=near, rtol=_TOLERANCE))
    return None


Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

_LONGEST_S, _SAMPLES = 0.01, (50, 300)  # how far it is looked at: s, and at least, at most
_STEP, _RATIO = 0.25, 1.02  # samples; from one point of the scan to the next
_A_TURN = 8  # frequencies in a turn of the longest delay
_TURN = 0.8  # rad; a larger turn of G between two frequencies is looked at more closely
_ROUNDS = 30
_WHOLE = 1e-9  # samples; a fraction below this is rounding


@dataclass(frozen=True)
class DelayMargin:
    """seconds: what may be added, inf if more than ``longest``; frequency_hz: of the mode that is
    lost there, Hz."""

    seconds: float
    frequency_hz: float


def longest(T_s: float) -> float:
    """The largest added delay of the scan, s."""
    least, most = _SAMPLES
    return float(np.clip(_LONGEST_S, least * T_s, most * T_s))


def overall_delay(loop: ClosedLoop) -> DelayMargin:
    """Margin for more delay of all of u at once; 0 for an unstable loop."""
    return DelayMargins(loop).overall()


class DelayMargins:
    """Delay margins of a sampled loop; all of an unstable loop are 0.

    Raises:
        ValueError: the loop is continuous.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        if loop.T_s is None:
            raise ValueError("a delay margin is that of a sampled loop; sample it first")
        self.loop, self.T_s = loop, loop.T_s
        scan, end = [0.0], longest(self.T_s) / self.T_s
        while scan[-1] < end:  # in quarters of a sample, so that few fractions occur
            step = max(_STEP, scan[-1] * (_RATIO - 1.0) // _STEP * _STEP)
            scan.append(min(end, scan[-1] + step))
        self.scan = [samples * self.T_s for samples in scan]
        self._paths: dict[tuple[bool, bytes], Any] = {}
        self._first_seen: dict[bool, Response] = {}

    def overall(self) -> DelayMargin:
        """Margin for more delay of all of u at once."""
        return self._margin(True, list(range(len(self.loop.u_delay))))

    def at_u(self, channel: int) -> DelayMargin:
        """Margin for more delay of one command only."""
        return self._margin(True, [channel])

    def at_y(self, channel: int) -> DelayMargin:
        """Margin for more delay of one measurement only."""
        return self._margin(False, [channel])

    def _margin(self, at_u: bool, channels: list[int]) -> DelayMargin:
        if self._sigma >= 0.0:
            return DelayMargin(0.0, np.nan)
        late = np.zeros_like(self.loop.u_delay if at_u else self.loop.y_delay)
        late[channels] = 1.0

        def later(seconds: float) -> ClosedLoop:
            return self.loop.later(*((late * seconds, 0.0) if at_u else (0.0, late * seconds)))

        def sigma(seconds: float) -> float:
            return float(later(seconds).sigma())

        k = self._first_unstable(at_u, channels)
        near = self.scan[k - 1 : k + 1]
        agrees = sigma(near[0]) < 0.0 and all(sigma(lost) >= 0.0 for lost in near[1:])
        held = first_loss(sigma, near if agrees else self.scan)
        if held is None:
            return DelayMargin(np.inf, np.nan)
        return DelayMargin(held, later(held).modes()[0].frequency_hz)

    @cached_property
    def _sigma(self) -> float:
        return float(self.loop.sigma())

    def _first_unstable(self, at_u: bool, channels: list[int]) -> int:
        """Which value of the scan is the first with an unstable pole; their number if none is."""
        omega, scan = self._omega, self.scan[1:]
        if at_u not in self._first_seen:
            self._first_seen[at_u] = self._seen(at_u, omega)
        G = self._ratio(at_u, channels, omega, self._first_seen[at_u], scan)
        for _ in range(_ROUNDS):
            turns = np.angle(G[:, 1:] * G[:, :-1].conj())
            # from z = 1 to z = -1, half a turn for each pole
            unstable = np.rint(-turns.sum(axis=1) / np.pi) > 0
            count = int(np.argmax(unstable)) + 1 if unstable.any() else len(scan)
            coarse = (np.abs(turns[:count]) > _TURN).any(axis=0)
            if not coarse.any():
                break
            scan, G = scan[:count], G[:count]
            more = 0.5 * (omega[1:] + omega[:-1])[coarse]
            found = self._ratio(at_u, channels, more, self._seen(at_u, more), scan)
            order = np.argsort(omega := np.concatenate([omega, more]), kind="stable")
            omega, G = omega[order], np.concatenate([G, found], axis=1)[:, order]
        return count + (0 if unstable[:count].any() else 1)

    @cached_property
    def _omega(self) -> Matrix:
        """Frequencies across all modes, and close enough for the longest delay, rad/s."""
        top = np.pi / self.T_s
        poles = self.loop.poles()
        near = frequencies_near(poles[poles.imag >= 0.0])
        even = np.linspace(0.0, top, int(_A_TURN * self.scan[-1] / self.T_s / 2) + 2)
        return np.unique(np.concatenate([even, near[near < top]]))

    @cached_property
    def _responses(self) -> tuple[Responses, Responses]:
        """From u and to y, see ``_seen``."""
        A, p, c = self.loop.A, self.loop.held, self.loop.controller
        at = np.eye(len(A)), np.zeros((len(A), 1))
        to_u, from_y = np.hstack([c.D @ p.C, c.C]), np.vstack([p.B @ c.D, c.B])
        return Responses(A.T, to_u.T, *at), Responses(A, from_y, *at)

    def _seen(self, at_u: bool, omega: Matrix) -> Response:
        """How the states act on u, shape (K, n_u, n), or are acted on by y, shape (K, n, n_y)."""
        z = np.exp(1j * omega * self.T_s)
        to_u, from_y = self._responses
        return to_u(z).swapaxes(1, 2) if at_u else from_y(z)

    def _ratio(
        self, at_u: bool, channels: list[int], omega: Matrix, x: Response, scan: Sequence[float]
    ) -> Response:
        """G at omega for each delay of the scan, shape (len(scan), K); x is from ``_seen``."""
        back, p = np.exp(-1j * omega * self.T_s)[:, None, None], self.loop.held
        x, n = (x[:, channels] if at_u else x[:, :, channels]), len(p.A)
        delay = self.loop.u_delay if at_u else self.loop.y_delay
        rest = x[:, :, :n] @ p.B[:, channels] if at_u else p.C[channels] @ x[:, :n]
        rest, late = rest + np.eye(len(channels)), dict[bytes, Response]()
        G = np.empty((len(scan), len(omega)), complex)
        for row, seconds in zip(G, scan, strict=True):
            total = (delay + seconds) / self.T_s
            whole = np.floor(total + _WHOLE)
            part = np.maximum(total - whole, 0.0).round(9)
            if (key := part.tobytes()) not in late:
                if at_u:
                    now, then = (x[:, :, :n] @ by[:, channels] for by in self._acting(part))
                    late[key] = now + then * back
                else:
                    rows, through, ticks = (by[channels] for by in self._read(part))
                    late[key] = (rows @ x + through[:, channels]) * back**ticks
            shift = whole[channels] if at_u else whole[channels, None]
            M = rest - late[key] * back**shift
            row[:] = M[:, 0, 0] if len(channels) == 1 else np.linalg.det(M)
        return G

    def _acting(self, part: Matrix) -> tuple[Matrix, Matrix]:
        """What u does to the held states in its tick and in the next, each (n, n_u), if each acts
        these parts of a sample late."""
        if (key := (True, part.tobytes())) not in self._paths:
            p, q, kept, same, lines = self._other(True, part)
            now, then = np.zeros_like(p.B), np.zeros_like(p.B)
            now[kept] = q.B[same]
            for j, line in enumerate(lines):
                then[kept, j] = q.A[same, line].sum(axis=1)  # of one state or none
            self._paths[key] = now, then
        return self._paths[key]

    def _read(self, part: Matrix) -> tuple[Matrix, Matrix, Matrix]:
        """How y is read these parts of a sample late: from all states, (n_y, n), from y itself,
        (n_y, n_y), and after how many more ticks, (n_y, 1)."""
        if (key := (False, part.tobytes())) not in self._paths:
            p, q, kept, same, lines = self._other(False, part)
            c, by_u = self.loop.controller, np.zeros((len(p.C), p.B.shape[1]))
            rows, ticks = np.zeros((len(p.C), len(self.loop.A))), np.zeros((len(p.C), 1))
            rows[:, kept] = q.C[:, same]
            for i, line in enumerate(lines):
                if line.stop > line.start:  # between two ticks, for the second of them
                    rows[i, kept], by_u[i] = q.A[line.start, same], q.B[line.start]
                    ticks[i] = 1.0
            rows += by_u @ np.hstack([c.D @ p.C, c.C])
            self._paths[key] = rows, by_u @ c.D, ticks
        return self._paths[key]

    def _other(self, at_u: bool, part: Matrix) -> tuple[Any, ...]:
        """The held plants of the loop and of that with these delays, the states of each that are
        in both, and where the delay lines of the second are."""
        loop, n_u = self.loop, len(self.loop.u_delay)
        late = part * self.T_s - (loop.u_delay if at_u else loop.y_delay)
        other = loop.later(late, 0.0) if at_u else loop.later(0.0, late)
        kept, lines = list[NDArray[np.intp]](), list[slice]()
        for of in (loop, other):
            lines = of.lines[:n_u] if at_u else of.lines[n_u:]
            states = np.arange(len(of.held.A))
            kept.append(np.delete(states, np.concatenate([states[line] for line in lines])))
        return loop.held, other.held, *kept, lines
