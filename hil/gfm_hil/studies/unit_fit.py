"""D, H and X_eff of a run or of a recording with intervals, by its power after a phase jump.

The swing equation of ``envelopes.fit_jump`` is fitted to means of p over a cycle, of before the
jump and of after it; the level at rest is fitted too. Means that the noise of sensors leaves are
correlated, as a meter filters it, and so a covariance of independent ones would be too small.
Here that of the estimate is (J'J)^-1 J' C J (J'J)^-1 with the covariance C of an autoregression of
what is left, whose order is that of the least AIC. The intervals are of the noise: what the swing
equation itself leaves shows as more after the jump than before it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz, toeplitz
from scipy.stats import t as student

from gfm_hil.core.errors import UserError
from gfm_hil.recording.foreign import ABOUT
from gfm_hil.recording.run import Run
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.scenario.events.phase_jump import PhaseJump
from gfm_hil.studies.envelopes import Unit, fit_swing, modes
from gfm_plant import make_plant

Vector = NDArray[np.float64]

_SKIP = 1.5  # cycles after the jump: the circuit's own transient
_LAGS = 5.0  # of a meter, after which its own transient is gone
_FAR = 30.0  # of the logarithm of an interval's end
_REST_S = 0.2  # before the jump of a measurement
_ORDERS = 5  # of the autoregression, less one


@dataclass(frozen=True)
class UnitFit:
    """D, H and X_eff, and how well they are known.

    WECC's models with this swing equation, by the names of their records: REGFM_A1 with mp, TPf and
    X_L = X_eff, and REGFM_B1 with X_L = X_eff, 1/mp + D1 = D and H + D2/(2 omega_D) + TPf D/2 = H.

    Attributes:
        D, H, X_eff: p.u./p.u., s, p.u.; noise may leave an X_eff below 0.
        interval: of 95 %, lower and upper end by name.
        noise, left: RMS of p before the jump, and of what the fit leaves after it, p.u. Where more
            is left than noise, the unit is no swing equation, and the intervals do not show that.
    """

    D: float
    H: float
    X_eff: float
    interval: dict[str, tuple[float, float]]
    noise: float
    left: float

    @property
    def mp(self) -> float:
        """The droop 1/D, p.u."""
        return 1.0 / self.D

    @property
    def TPf(self) -> float:
        """The lag of the droop's power measurement that is this inertia, 2 H/D, s."""
        return 2.0 * self.H / self.D


@dataclass(frozen=True)
class _JumpRecord:
    """The power around a phase jump, as means over a cycle."""

    radians: float  # of the jump
    omega_b: float  # rad/s
    X_grid: float  # of the line to the stiff grid, p.u.
    before: Vector  # p.u.
    after: Vector  # p.u.
    starts: Vector  # of ``after`` from the jump, s
    smooth: list[float]  # the lengths of the means that p has been through, s
    lag: float  # of the meter, s

    def left(self, X: float, zero: float, stiff: float) -> Vector:
        """What the power is above that of the swing equation, without its mean: the level at rest
        is not known."""
        swing = np.array([1.0, zero, stiff])
        seen = np.convolve(swing, [self.lag, 1.0]) if self.lag else swing
        poles, residues = modes([1.0, zero], seen)
        with np.errstate(over="ignore", invalid="ignore"):  # of a unit almost without inertia
            for seconds in self.smooth:
                residues = residues * np.expm1(poles * seconds) / (poles * seconds)
            answer = (residues * np.exp(np.outer(self.starts, poles))).sum(1).real
            rest = np.concatenate([self.before, self.after + self.radians / X * answer])
            return np.asarray(rest - rest.mean())


def fit_run(run: Run) -> UnitFit:
    """D, H and X_eff with intervals of 95 %, fitted to p after a phase jump of a stiff grid.

    The jump is the first event; what follows the second one does not count. X_eff is all that is
    between the unit's voltage and the grid but the line, over E V cos of the angle across it.

    Args:
        run: of the bench, or a recording as a run.

    Raises:
        UserError: the first event is no jump or the grid not stiff, the run is too short, or no
            swing equation fits.
    """
    seen = _around_jump(run)
    noise = float(np.std(seen.before))
    largest = float(np.abs(seen.after - seen.before.mean()).max())
    if not largest > 0:
        raise UserError("fit: the power does not change")
    most = math.hypot(0.1 * largest, 1.5 * noise)
    best = fit_swing(seen.left, abs(seen.radians) / largest, most)
    X, zero, stiff = (float(x) for x in np.exp(best.x))
    H = seen.omega_b / (2 * stiff * X)
    D, X_eff = 2 * H * zero, X - seen.X_grid
    wide = _half_widths(best.fun, best.jac)
    # D = omega_b zero/(stiff X), H = omega_b/(2 stiff X) and TPf = 1/zero: as logarithms, sums
    interval = {}
    for name, value, way in (
        ("D", D, (-1, 1, -1)),
        ("H", H, (-1, 0, -1)),
        ("mp", 1 / D, (1, -1, 1)),
        ("TPf", 1 / zero, (0, -1, 0)),
    ):
        factor = math.exp(min(_FAR, wide(*way)))
        interval[name] = value / factor, value * factor
    beside = X * wide(1, 0, 0)
    interval["X_eff"] = X_eff - beside, X_eff + beside
    if interval["X_eff"][1] <= 0:
        raise UserError(
            f"fit: X = {X:.4g} p.u. in all: must be above that of the line, {seen.X_grid:.4g} p.u."
        )
    left = float(np.sqrt(np.mean(best.fun[len(seen.before) :] ** 2)))
    return UnitFit(D, H, X_eff, interval, noise, left)


def measure_unit(start: Scenario, degrees: float = 0.5, seconds: float = 4.0) -> Unit:
    """D, H and X_eff of a converter, fitted to its power after a phase jump.

    Args:
        start: scenario, of which no event counts; its line is not part of X_eff, but
            its transformer is.
        degrees: of the jump; a small one, so that nothing limits and nothing bends.
        seconds: of the fit, after the jump.

    Raises:
        UserError: a mistake, a run that does not complete, or no swing equation fits.
    """
    if not (0 < abs(degrees) <= 30 and 0.5 <= seconds <= 60):
        raise UserError(
            f"degrees = {degrees:g}, seconds = {seconds:g}: must lie in [-30, 30] without 0, and "
            "in [0.5, 60]"
        )
    kept = {"inner", "T_s", "seed", "references", "plant", "law"}
    content = start.model_dump(mode="json", exclude_none=True, include=kept)
    jump = {"type": "grid-phase-jump", "t": _REST_S, "degrees": degrees}
    more = {"title": start.title, "duration": _REST_S + seconds, "events": [jump]}
    made = run_in_memory(load_scenario(content | more, in_process=True))
    if made.status not in ("completed", "oscillating"):
        reason = made.summary["reason"]
        raise UserError(f"the run after the jump ended as {made.status}: {reason}")
    fit = fit_run(made)
    return Unit(fit.D, fit.H, fit.X_eff)


def _around_jump(run: Run) -> _JumpRecord:
    """The power of a run around its phase jump; raises as ``fit_run``."""
    scenario, T_s = run.scenario, run.scenario.T_s
    events = scenario.sorted_events()
    if scenario.network is not None or scenario.plant.grid.finite is not None:
        raise UserError("fit: the grid must be stiff, of one converter")
    if not events or not isinstance(events[0], PhaseJump) or not events[0].degrees:
        raise UserError("fit: the first event must be a grid-phase-jump")
    first = events[0].at(T_s)
    par, lcl = make_plant(scenario.plant, T_s).par[0], scenario.plant.lcl
    omega_b, X_grid = float(par["omega_b"]), float(par["L_g"]) - (lcl.L if lcl else 0.0)
    read = run.summary.get(ABOUT, {})
    window, lag = (float(read.get(name, 0.0)) for name in ("window_s", "lag_s"))
    cycle = 2 * math.pi / omega_b
    width = round(max(cycle, read.get("dt_s", 0.0)) / T_s)
    skip = round((max(_SKIP * cycle, window, _LAGS * lag) + 0.5 * window) / T_s)
    last = min([run.ticks, *(e.at(T_s) for e in events[1:])])
    p = run.signals["p"]
    # a meter shows what comes half of its window early
    there = np.flatnonzero(np.isfinite(p[:last]))
    begin, end = there[[0, -1]] if len(there) else (0, -1)
    early = math.ceil(0.5 * window / T_s)
    before = _means(p[begin : max(begin, first - early)][::-1], width)[::-1]
    after = _means(p[first + skip : end + 1], width)
    for count, least, side in (len(before), 5, "before"), (len(after), 20, "after"):
        if count < least:
            raise UserError(
                f"fit: {count * width * T_s:.3g} s of p {side} the jump: must be "
                f"{least * width * T_s:.3g} s at least"
            )
    starts = (skip - 0.5) * T_s - 0.5 * window + width * T_s * np.arange(len(after))
    smooth = [width * T_s, *filter(None, [window])]
    radians = math.radians(events[0].degrees)
    return _JumpRecord(radians, omega_b, X_grid, before, after, starts, smooth, lag)


def _half_widths(rest: Vector, J: Vector) -> Callable[..., float]:
    """Half of the interval of a sum of the parameters with these factors."""
    free = len(rest) - J.shape[1] - 1
    inverse = np.linalg.pinv(J.T @ J)
    C = toeplitz(_autocovariance(rest * math.sqrt(len(rest) / free)))
    covariance = inverse @ J.T @ C @ J @ inverse
    sure = float(student.ppf(0.975, free))

    def wide(*way: int) -> float:
        return sure * math.sqrt(max(0.0, float(np.array(way) @ covariance @ np.array(way))))

    return wide


def _means(x: Vector, width: int) -> Vector:
    """The means of one stretch of ``width`` samples after another."""
    count = len(x) // width
    return np.asarray(x[: count * width].reshape(count, width).mean(1))


def _autocovariance(rest: Vector) -> Vector:
    """That of the autoregression of least AIC, shape as ``rest``."""
    n = len(rest)
    r = np.array([rest[: n - k] @ rest[k:] / n for k in range(_ORDERS)])
    if not r[0] > 0:
        return np.zeros(n)
    models = [np.zeros(0), *(solve_toeplitz(r[:k], r[1 : k + 1]) for k in range(1, _ORDERS))]
    left = [float(r[0] - a @ r[1 : len(a) + 1]) for a in models]
    a = models[int(np.argmin([n * math.log(max(e, 1e-300)) + 2 * k for k, e in enumerate(left)]))]
    out = np.zeros(n)
    out[: len(a) + 1] = r[: len(a) + 1]
    for k in range(len(a) + 1, n if len(a) else 0):
        out[k] = a @ out[k - 1 : k - 1 - len(a) : -1]
    return out
