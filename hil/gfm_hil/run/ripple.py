"""Whether a run that lasted still oscillates at its end.

The ripple of a signal is the peak-to-peak value of its strongest sinusoid, so that noise, which is
spread over all frequencies, counts for little. It is judged over the last second, or, if less time
has passed since the last disturbance, over the second half of that time: what a disturbance set
going has had as long to die away before. A ripple that has halved since the stretch before, of the
same length, is dying away, and one that the last half of the stretch does not show was a step.

What repeats in every cycle of the grid is a harmonic and no oscillation. An unbalance of the grid,
or an unbalanced fault, that is still there explains the even multiples of the grid's frequency. A
switched bridge explains the multiples of three times that: its three legs do the same a third of a
cycle apart, so the currents have the orders 3 k + 1 forwards and 3 k - 1 backwards, which p and the
magnitudes show at 3 k. ``gfmhil waveforms`` shows how large they are.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import Columns
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.run.cycles import detrend, fast_length, hann
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.fault import Fault
from gfm_hil.scenario.events.grid_unbalance import GridUnbalance
from gfm_hil.scenario.events.note import Note

_SIGNALS = {"p": "p", "V": "V", "omega_u": "omega_u", "i": "|i|"}
_SPAN = 1.0  # s at the end that are judged, at most
_LEAST = 0.1  # s, at least: five cycles
_SLOWEST = 2.0  # periods in a span: a slower swing looks like a trend
_NEAR = 2.5  # lines of the spectrum on each side over which a sinusoid spreads
_ROUNDING = 1e-9  # p.u.; the plant is solved to it
_NOISE = 50.0  # of a sensor's standard deviation; the rig's ripple is up to 36 times that
_EQUAL = GridUnbalance(type="grid-unbalance", tick=0).label()


class Ripple(NamedTuple):
    """What still moves at the end of a run."""

    pu: dict[str, float]  # peak to peak of the strongest sinusoid by signal, p.u.
    hz: dict[str, float]  # its frequency by signal, Hz
    span_s: float  # the stretch at the end that was judged, s
    limit: float  # above which a signal oscillates, p.u.
    oscillates: str  # a signal beyond the limit that is not dying away; "" without one

    def words(self) -> str:
        """Signal, value, frequency, limit and stretch."""
        name = self.oscillates
        return (
            f"still oscillating: {_SIGNALS[name]} by {self.pu[name]:.3g} p.u. peak to peak at "
            f"about {self.hz[name]:.3g} Hz > {self.limit:g} p.u. in the last {self.span_s:.3g} s"
        )


def remaining_ripple(
    scenario: Scenario, signals: Columns, log: Sequence[dict[str, Any]], done: int
) -> Ripple | None:
    """The ripple at the end of a run; None if the run was at rest for less than 0.2 s.

    Args:
        scenario: of the run; its ``expect_ripple`` is the limit, unless the noise of its sensors
            explains more.
        signals: columns with true_p, true_V, true_omega_u, true_i and true_omega_g, p.u.
        log: every line of the run's log.
        done: ticks recorded.
    """
    T_s = scenario.T_s
    rest = (done - _last_disturbance(scenario, log, done)) * T_s
    span = min(_SPAN, 0.5 * rest)
    n = round(span / T_s)
    if span < _LEAST - 0.5 * T_s or n < 20:
        return None
    explained = _harmonics(scenario, signals, log, done)
    limit = max(
        scenario.expect_ripple, _NOISE * max(scenario.plant.sensors.noise_std.values(), default=0.0)
    )
    columns = {name: signals[f"true_{name}"] for name in _SIGNALS}
    last = np.array([column[done - n : done] for column in columns.values()])
    sizes, lines = _sinusoids(last, T_s, explained)
    sizes[sizes < _ROUNDING] = 0.0
    size = dict(zip(columns, sizes.tolist(), strict=True))
    hertz = dict(zip(columns, lines.tolist(), strict=True))
    worst = ""
    for name, column in columns.items():
        if size[name] <= max(limit, size.get(worst, 0.0)):
            continue
        if np.ptp(detrend(column[done - n // 2 : done])) < 0.5 * size[name]:
            continue
        if done >= 2 * n:
            before, _ = _sinusoids(column[done - 2 * n : done - n][None], T_s, explained)
            if size[name] <= 0.5 * before[0]:
                continue
        worst = name
    return Ripple(size, hertz, n * T_s, limit, worst)


def _last_disturbance(scenario: Scenario, log: Sequence[dict[str, Any]], done: int) -> int:
    """The tick at which the last event of a run, planned or an operator's, was over; a run without
    events is judged as a whole, for it begins at rest."""
    happened = [e["tick"] for e in log if "label" in e or e["event"] == "recovered"]
    acts = [e for e in scenario.events if not isinstance(e, Note)]
    over = [e.at(scenario.T_s) + round(e.lasts() / scenario.T_s) for e in acts]
    return max([*happened, *over], default=-done)


def _harmonics(
    scenario: Scenario, signals: Columns, log: Sequence[dict[str, Any]], done: int
) -> NDArray[np.float64]:
    """Frequencies, Hz, that an unbalance in force and a switched bridge explain."""
    f_g = float(signals["true_omega_g"][done - 1 : done][0]) * nominal_frequency(scenario)
    orders = [2, 4] if _is_unbalanced(scenario, log) else []
    if scenario.plant.bridge.kind != "average":
        orders += range(3, int(0.5 / (scenario.T_s * f_g)) + 1, 3)
    return f_g * np.array(orders)


def _is_unbalanced(scenario: Scenario, log: Sequence[dict[str, Any]]) -> bool:
    """Whether an unbalance of the grid, or an unbalanced fault, is still there at the end."""
    timed = [
        (e.type, e.at(scenario.T_s))
        for e in scenario.events
        if isinstance(e, GridUnbalance | Fault) and e.duration is not None
    ]
    last = [_last(log, "grid-unbalance"), _last(log, "fault", "fault-clear")]
    return any(
        e is not None
        and e["label"] != _EQUAL
        and not e["label"].startswith("fault")  # of three phases, or cleared
        and (e["event"], e["tick"]) not in timed
        for e in last
    )


def _last(log: Sequence[dict[str, Any]], *kinds: str) -> dict[str, Any] | None:
    """The last event of some kinds."""
    return next((e for e in reversed(log) if e["event"] in kinds), None)


def _sinusoids(
    x: NDArray[Any], T_s: float, explained: NDArray[np.float64]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Peak-to-peak values and frequencies [Hz], shape (signals,), of the strongest sinusoid in each
    row of x (signals, ticks), beside those of the ``explained`` frequencies."""
    n = x.shape[1]
    window = hann(n)
    # Lines lie half as far apart as the window has them: the strongest falls between two by 4 %.
    length = fast_length(2 * n)
    spectra = np.abs(np.fft.rfft(detrend(x) * window, length))
    lines = np.fft.rfftfreq(length, T_s)
    apart = 1.0 / (n * T_s)
    spectra[:, lines < _SLOWEST * apart] = 0.0
    for f in explained:
        spectra[:, np.abs(lines - f) < _NEAR * apart] = 0.0
    k = np.argmax(spectra, axis=1)
    return 4.0 * spectra[np.arange(len(x)), k] / window.sum(), lines[k]
