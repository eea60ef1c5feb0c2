"""The dq admittance of a converter with its controller, measured on the bench by injection.

The grid's voltage carries small sines, once along itself (d: its length) and once across (q: its
frequency, hence its angle); a grid profile plays them, so that any controller can be measured, and
any link does. All tones of a decade sound together, each with a whole number of periods in the
window of that decade, after a time in which transients decay.

A run records the state of the circuit at each tick. Between two ticks the circuit is linear and
every voltage source is a phasor that turns steadily, so the Fourier coefficients of v(t) and i_o(t)
over the window are integrals over the continuous signals and not sums over samples: with
w' = A w + B s, a window from t_0 of length T has

    W(omega) = (j omega - A)^-1 (B S(omega) + (w(t_0) e^(-j omega t_0) - w(t_0 + T) e^(...)) / T).

Nothing aliases in them, although the samples have images of the injection and of the held commands
at multiples of the sampling frequency. That the recorded states follow this equation from tick to
tick is checked: where a limit of the bridge acts, they do not.

The voltage of a switched bridge is no phasor, and that of a law with compare counts is not in its
commands. There it follows from the states: the voltage which, held over the tick, takes i_f to what
the next tick has. Of it all but the ripple within the tick is in the sum. A run without tones is
taken away from the two with them, for what repeats in every cycle may lie on a tone. The tones have
to be well above a count of the timer, and the ripple keeps the ends of a window apart.
"""

from __future__ import annotations

import csv
import json
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.admittance import (
    GridStability,
    eigenloci,
    grid_stability,
    line_impedance,
    passivity,
)
from gfm_design.margins.certificate import Certificate, GridClass, certify
from gfm_design.model.dead_time import with_dead_time
from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import check_empty, write_text
from gfm_hil.recording.run import Run, controlled_by
from gfm_hil.run.runner import run_in_memory, run_scenario
from gfm_hil.scenario import INPROC, Scenario, load_scenario
from gfm_hil.studies.linear_loop import scenario_loop
from gfm_hil.studies.workers import SILENT, Watch
from gfm_plant import NoEquilibrium, make_plant
from gfm_plant.build import LINE
from gfm_plant.wiring import GRID_SOURCE
from gfm_runtime.signals import carried

Vector = NDArray[np.float64]
Response = NDArray[np.complex128]

POINTS, AMPLITUDE, SETTLE_S, WINDOW_S = 40, 1e-4, 2.0, 0.2
SWITCHED_AMPLITUDE = 1e-3  # of a bridge whose timer has 10,000 counts in a period
_PERIODS = 5  # of the slowest tone of a band in its window, at least
_LINES = 40  # of the profile in a period of the fastest tone of a band, at least
_MOST_LINES = 90_000  # of a file; a profile may have 100,000
_SETTLED = 3e-4  # by how much the two ends of a window may differ, over the largest deviation in it
_FOLLOWS = 1e-9  # p.u., between a recorded state and the one that the circuit's equations give
_ROOM = {"omega_g": 0.18, "V_g": 0.2}  # p.u.; how far the injection may lead
_SHRINK = 1e6  # transients shrink by this factor in the time to settle, by the linear model
_LONGEST_S = 60.0

_COMMANDS = carried("u", True)
#: columns of admittance.csv after f_hz
_CELLS = ("dd", "dq", "qd", "qq")


@dataclass(frozen=True, repr=False)
class FrequencyScan:
    """A measured admittance, the linear model's beside it, and what follows from them.

    Y is that of the converter at its terminal, the filter capacitor: the current into it is Y v, in
    the dq frame that turns steadily with the grid and lies on the converter's own frame at rest;
    p.u. of 1/Z_b. It is the inverse of ``ClosedLoop.output_impedance``.

    Attributes:
        name: of the law, or what a controller that is not ours calls itself.
        scenario: where it was measured.
        frequency: Hz in the dq frame, shape (K,).
        Y: measured, shape (K, 2, 2), rows: current, columns: voltage.
        model: that of the linear model, shape (K, 2, 2); None for a controller that is not ours.
        nfp: network frequency perturbation: change of the power that the converter gives over the
            change of the grid's frequency behind the line, p.u. over p.u., shape (K,).
        nfp_model: the same of the linear model, or None.
        rest: voltage and current at the filter capacitor without perturbation, d + jq, p.u.
        line: R and L of the grid of the measurement, p.u.
        omega: base and grid frequency, rad/s and p.u.
        amplitude: of each tone, p.u. and rad.
        settle_s: time before each window, s.
        settled: largest difference between the ends of a window, over the largest deviation in it.
    """

    name: str
    scenario: Scenario
    frequency: Vector
    Y: Response
    model: Response | None
    nfp: Response
    nfp_model: Response | None
    rest: tuple[complex, complex]
    line: tuple[float, float]
    omega: tuple[float, float]
    amplitude: float
    settle_s: float
    settled: float

    @cached_property
    def deviation(self) -> Vector | None:
        """Frobenius norm of Y minus the model over that of the model, shape (K,)."""
        if self.model is None:
            return None
        norm = np.linalg.norm(self.model, axis=(1, 2))
        return np.asarray(np.linalg.norm(self.Y - self.model, axis=(1, 2)) / norm)

    @property
    def passivity(self) -> Vector:
        """The least eigenvalue of Y + Y^H, p.u., shape (K,), negative where Y is not passive."""
        return passivity(self.Y)

    def stiffness(self, Y: Response) -> tuple[Response, Response]:
        """P/θ and Q/V at the point of connection, behind the converter's transformer if it has one:
        the change of the power that the converter gives over the change of the voltage's angle,
        p.u./rad, and of its reactive power over the voltage's magnitude, p.u.; shape (K,) each.

        Args:
            Y: at the filter capacitor, measured or of the model, shape (K, 2, 2).
        """
        lcl, (v_0, i_0) = self.scenario.plant.lcl, self.rest
        if lcl is not None:
            Y = np.asarray(np.linalg.inv(np.linalg.inv(Y) + self._impedance(lcl.R, lcl.L)))
            v_0 = v_0 - (lcl.R + 1j * self.omega[1] * lcl.L) * i_0
        v, i = (np.array([x.real, x.imag]) for x in (v_0, i_0))
        angle, size = np.array([-v[1], v[0]]), v / abs(v_0)  # of v, by its angle and by its length
        across = np.array([[0.0, 1.0], [-1.0, 0.0]])  # q = i (across v)
        return -Y @ angle @ v + i @ angle, -Y @ size @ across @ v + i @ across @ size

    def grid(self, scr: float, x_over_r: float) -> Response:
        """The dq impedance of a grid, shape (K, 2, 2), p.u.

        Args:
            scr: its short-circuit ratio at the filter capacitor.
            x_over_r: its X/R at nominal frequency.

        Raises:
            UserError: one of them is not > 0.
        """
        for name, value in (("scr", scr), ("x_over_r", x_over_r)):
            if not (math.isfinite(value) and value > 0):
                raise UserError(f"{name} = {value}: must be > 0")
        R = 1.0 / (scr * math.hypot(1.0, x_over_r))
        return self._impedance(R, x_over_r * R)

    def stability(self, scr: float, x_over_r: float) -> GridStability:
        """Whether the converter is stable on a grid, from the measured Y alone.

        Y belongs to the operating point of the measurement, which another grid would move.

        Args:
            scr, x_over_r: as for ``grid``.

        Raises:
            UserError: as ``grid``.
        """
        here = self._impedance(*self.line)
        return grid_stability(self.frequency, self.Y, self.grid(scr, x_over_r), here)

    def certificate(self, grids: GridClass) -> Certificate:
        """Whether every network of a class is stable with any number of such converters at this
        operating point, from the measured Y alone, between its frequencies.

        Raises:
            UserError: the grid of the measurement, on which the loop is stable, is not of the
                class.
        """
        R, L = self.line
        scr, x_over_r = 1.0 / math.hypot(R, L), L / R if R else math.inf
        low, high = grids.x_over_r
        if not (grids.weakest <= scr <= grids.stiffest and low <= x_over_r <= high):
            raise UserError(
                f"grids: that of the measurement (SCR {scr:.4g}, X/R {x_over_r:.4g}) must be one "
                "of the class"
            )
        return certify(grids, self.frequency, [self.Y])

    def eigenloci(self, scr: float, x_over_r: float) -> Response:
        """The eigenvalues of Z Y for a grid, shape (K, 2); arguments and errors as ``grid``."""
        return eigenloci(self.Y, self.grid(scr, x_over_r))

    def summary(self) -> dict[str, Any]:
        """What was measured, and how, as plain data."""
        p, dev = self.passivity, self.deviation
        out: dict[str, Any] = {
            "name": self.name,
            "scenario": self.scenario.title,
            "from_hz": float(self.frequency[0]),
            "to_hz": float(self.frequency[-1]),
            "points": len(self.frequency),
            "amplitude": self.amplitude,
            "settle_s": self.settle_s,
            "settled": self.settled,
            "line": {"R_g": self.line[0], "L_g": self.line[1]},
            "passive": bool((p >= 0.0).all()),
            "not_passive_hz": _stretches(self.frequency, p < 0.0),
            "least_eigenvalue": float(p.min()),
        }
        if dev is not None:
            k = int(np.argmax(dev))
            out |= {"largest_deviation": float(dev[k]), "at_hz": float(self.frequency[k])}
        return out

    def save(self, folder: str | Path, grids: Sequence[tuple[float, float]] = ()) -> Path:
        """Write admittance.csv, identification.json and the figures to a folder; returns it.

        Args:
            grids: (SCR, X/R) of the grids to judge.

        Raises:
            UserError: the folder holds something already, or cannot be written.
        """
        from gfm_hil.studies.scan_figures import save_figures

        folder = Path(folder)
        check_empty(folder)
        content = self.summary() | {"grids": [self._judge(*grid) for grid in grids]}
        with naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with (folder / "admittance.csv").open("w", encoding="utf-8", newline="") as file:
                csv.writer(file).writerows(self.rows())
            save_figures(self, folder, grids)
            write_text(folder / "identification.json", json.dumps(content, indent=2) + "\n")
        return folder

    def rows(self) -> Iterator[list[Any]]:
        """The head and the lines of admittance.csv."""
        columns = {"f_hz": self.frequency}
        for of, Y, nfp in (("", self.Y, self.nfp), ("model_", self.model, self.nfp_model)):
            if Y is not None and nfp is not None:
                each = zip((*(f"Y_{cell}" for cell in _CELLS), "nfp"), (*Y.reshape(-1, 4).T, nfp),
                           strict=True)  # fmt: skip
                for name, x in each:
                    columns |= {f"{of}{name}_re": x.real, f"{of}{name}_im": x.imag}
        columns["least_eigenvalue"] = self.passivity
        if self.deviation is not None:
            columns["deviation"] = self.deviation
        yield [*columns]
        yield from np.column_stack([*columns.values()]).tolist()

    def _judge(self, scr: float, x_over_r: float) -> dict[str, Any]:
        found = self.stability(scr, x_over_r)
        return {
            "scr": scr,
            "x_over_r": x_over_r,
            "stable": found.stable,
            "unstable_poles": found.unstable,
            "margin": found.margin,
            "margin_at_hz": found.at_hz,
            "reason": found.reason,
        }

    def _impedance(self, R: float, L: float) -> Response:
        return line_impedance(self.frequency, R, L, *self.omega)

    def __repr__(self) -> str:
        f, dev = self.frequency, self.deviation
        model = "" if dev is None else f", at most {100 * dev.max():.2g} % from the model"
        return f"<FrequencyScan {self.name}: {len(f)} points, {f[0]:g} to {f[-1]:g} Hz{model}>"


@dataclass(frozen=True)
class _Band:
    """The tones of a decade."""

    hz: Vector  # tones, multiples of the window's inverse
    every: int  # ticks from one line of the profile to the next
    window: int  # ticks, a multiple of ``every``
    start: int = 0  # its first tick: one band follows the other
    settle: int = 0  # ticks before its window, likewise a multiple

    @property
    def measured(self) -> slice:
        """The ticks of its window."""
        begin = self.start + self.settle
        return slice(begin, begin + self.window)


def measure_admittance(
    scenario: Scenario,
    *,
    start_hz: float = 1.0,
    stop_hz: float = 1000.0,
    points: int = POINTS,
    amplitude: float | None = None,
    settle_s: float | None = None,
    window_s: float = WINDOW_S,
    controller_command: Sequence[str] = (),
    watch: Watch = SILENT,
) -> FrequencyScan:
    """Measure the dq admittance of a converter on the bench.

    Args:
        scenario: of which plant, references, sampling time, law and inner stage count, but no
            event.
        start_hz, stop_hz, points: the frequencies, evenly apart on a logarithmic axis; each is
            moved to the nearest multiple of the inverse of its window.
        amplitude: of each tone, p.u. of the grid's voltage, and rad of its angle. If None it is
            1e-4, of a switched bridge 1e-3.
        settle_s: how long each band of tones sounds before its window, s. If None, it follows from
            the slowest mode of the linear model, or is 2 s where there is none, and is doubled, up
            to 60 s, while the two ends of a window differ; noise needs a given one. Those of a
            switched bridge always differ, so it is not doubled.
        window_s: least length of a window, s; a longer one averages noise out.
        controller_command: program and arguments of another controller, which runs over the
            scenario's link; it has no model.
        watch: told which injection runs.

    Raises:
        UserError: a value out of range, no operating point, a loop that is unstable, a run that
            does not complete, or a window whose ends still differ.
    """
    external = tuple(controller_command)
    _check(scenario, bool(external))
    name, Y_of, slowest = controlled_by({"controller": ""}), None, None
    if not external:
        name, Y_of, slowest = _model(scenario)
    bands = _bands(start_hz, stop_hz, points, scenario.T_s, window_s)
    switched = scenario.plant.bridge.kind != "average"
    if amplitude is None:
        amplitude = SWITCHED_AMPLITUDE if switched else AMPLITUDE
    given = switched or settle_s is not None
    if settle_s is None:
        settle_s = SETTLE_S
        if slowest is not None:
            settle_s = min(max(math.log(_SHRINK) / -slowest, 0.2), _LONGEST_S)
    while True:
        plan = _plan(bands, amplitude, settle_s, scenario)
        sides: list[_Spectra] = []
        for axis in "dq":
            seconds = plan[-1].measured.stop * scenario.T_s
            words = f"injection along {axis}: {seconds:.1f} s simulated"
            watch.progress(len(sides), 2, words)
            spectra, summary = _inject(scenario, plan, amplitude, axis, external)
            sides.append(spectra)
            name = controlled_by(summary) if external else name
        settled = max(side.ends for side in sides)
        if switched:
            without, _ = _inject(scenario, plan, 0.0, "d", external)
            sides = [side.less(without) for side in sides]
        if given or settled <= _SETTLED:
            break
        if 2.0 * settle_s > _LONGEST_S:
            raise UserError(
                f"after {settle_s:g} s the ends of a window still differ by {settled:.1e} of "
                f"the deviation, allowed is {_SETTLED:g}; the loop is too slow, or noise or "
                "rounding hides the tones: raise amplitude, and give settle_s"
            )
        settle_s *= 2.0
    hz = np.concatenate([band.hz for band in plan])
    return _make_scan(name, scenario, hz, amplitude, settle_s, settled, sides, Y_of)


def _check(scenario: Scenario, external: bool) -> None:
    if scenario.network is not None:
        raise UserError("network: a scan measures one converter on its line to the grid")
    if scenario.plant.grid.finite is not None:
        raise UserError("plant.grid.finite: such a grid sets its own frequency; leave it out")
    if external and scenario.link.type == INPROC:
        raise UserError(f"link.type = {INPROC!r}: another controller needs a link, e.g. zmq")


def _model(scenario: Scenario) -> tuple[str, Callable[[Vector], Response], float]:
    """The name of the law, its admittance by the linear model, and its slowest mode, 1/s; with
    the dead time of a two-level bridge."""
    dead_time = scenario.plant.bridge.dead_time_s
    try:
        loop, name = scenario_loop(scenario)
        if scenario.plant.bridge.kind == "two-level" and dead_time > 0.0:
            loop = with_dead_time(loop, dead_time)
            name += f", {1e6 * dead_time:g} µs of dead time"
    except NoEquilibrium as problem:
        raise UserError(str(problem)) from None
    worst = loop.modes()[0]
    if worst.sigma >= 0.0:
        raise UserError(
            f"{name}: cannot be scanned because it is unstable on this grid: a mode at "
            f"{worst.frequency_hz:.4g} Hz grows with {worst.sigma:.4g} 1/s"
        )

    def admittance(hz: Vector) -> Response:
        return np.asarray(np.linalg.inv(loop.output_impedance(2 * np.pi * hz)), complex)

    return name, admittance, worst.sigma


def _bands(
    start_hz: float, stop_hz: float, points: int, T_s: float, window_s: float
) -> list[_Band]:
    """The tones by decade. Raises UserError: a value that cannot be."""
    top = 0.45 / T_s
    if not 0.01 <= start_hz < stop_hz <= top:
        raise UserError(
            f"start_hz = {start_hz:g}, stop_hz = {stop_hz:g}: must be 0.01 <= start_hz < stop_hz "
            f"<= {top:g} Hz"
        )
    if not 2 <= points <= 1000:
        raise UserError(f"points = {points}: must lie in [2, 1000]")
    if not 0.0 <= window_s <= _LONGEST_S:
        raise UserError(f"window_s = {window_s}: must lie in [0, {_LONGEST_S:g}] s")
    wanted = np.geomspace(start_hz, stop_hz, points)
    decades = math.ceil(math.log10(stop_hz / start_hz) - 1e-9)
    decade = np.minimum(np.floor(np.log10(wanted / start_hz) + 1e-9), decades - 1)
    ratio = (stop_hz / start_hz) ** (1.0 / (points - 1))
    periods = max(_PERIODS, math.ceil(1.0 / (ratio - 1.0)))
    bands = []
    for k in np.unique(decade):
        hz = wanted[decade == k]
        every = max(1, math.floor(1.0 / (_LINES * hz[-1] * T_s)))
        seconds = max(periods / hz[0], window_s)
        window = math.ceil(seconds / (T_s * every) - 1e-9) * every
        step = 1.0 / (window * T_s)
        tones = step * np.unique(np.floor(hz / step + 0.5))
        bands.append(_Band(tones, every, window))
    return bands


def _plan(
    bands: Sequence[_Band], amplitude: float, settle_s: float, scenario: Scenario
) -> list[_Band]:
    """The bands one after the other. Raises UserError: settling or the injection cannot be so
    large."""
    if not (math.isfinite(settle_s) and settle_s >= 0.0):
        raise UserError(f"settle_s = {settle_s}: must be >= 0 s")
    if not (math.isfinite(amplitude) and amplitude > 0.0):
        raise UserError(f"amplitude = {amplitude}: must be > 0")
    plan, start = list[_Band](), 0
    for band in bands:
        settle = math.ceil(settle_s / scenario.T_s / band.every) * band.every
        plan.append(replace(band, start=start, settle=settle))
        start = plan[-1].measured.stop
    for axis, name in (("d", "V_g"), ("q", "omega_g")):
        largest = max(np.abs(_sines(band, amplitude, axis, scenario)).max() for band in plan)
        if largest > _ROOM[name]:
            raise UserError(
                f"amplitude = {amplitude:g}: would move {name} by {largest:.3g} p.u., allowed is "
                f"{_ROOM[name]:g} p.u.: at most {_below(amplitude * _ROOM[name] / largest):g}"
            )
    return plan


def _below(value: float) -> float:
    """The number of two digits that is not above ``value`` > 0."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.floor(value / digit) * digit


def _sines(band: _Band, amplitude: float, axis: str, scenario: Scenario) -> Vector:
    """The injection of a band at the lines of its profile: of V_g, or for q of omega_g, p.u.

    The phases are those of Schroeder, which keep the sum of the tones low (IEEE Trans. Inf. Theory
    16, 1970).
    """
    t = np.arange(0, band.settle + band.window + 1, band.every) * scenario.T_s
    n, out = len(band.hz), np.zeros(len(t))
    omega_b = float(make_plant(scenario.plant, scenario.T_s).net[0]["omega_b"])
    for j, hz in enumerate(band.hz):
        size = amplitude * (2 * np.pi * hz / omega_b if axis == "q" else 1.0)
        out += size * np.cos(2 * np.pi * hz * t - np.pi * j * (j + 1) / n)
    rise = 0.5 * band.settle * scenario.T_s  # smoothly, which excites slow modes least
    if rise > 0.0:
        out *= np.sin(0.5 * np.pi * np.minimum(t / rise, 1.0)) ** 2
    return out


def _inject(
    scenario: Scenario,
    plan: Sequence[_Band],
    amplitude: float,
    axis: str,
    external: tuple[str, ...],
) -> tuple[_Spectra, dict[str, Any]]:
    """The spectra of a run with the injection along one axis, and its summary. Raises UserError:
    the run did not complete."""
    grid, T_s = scenario.plant.grid, scenario.T_s
    events = []
    with tempfile.TemporaryDirectory(prefix="gfmhil-scan-") as place:
        for band in plan:
            wave = _sines(band, amplitude, axis, scenario)
            t = np.arange(len(wave)) * band.every * T_s
            omega_g = grid.omega_g + (wave if axis == "q" else 0.0 * wave)
            V_g = grid.V_g + (wave if axis == "d" else 0.0 * wave)
            lines = np.column_stack([t, omega_g, V_g])
            for first in range(0, len(lines) - 1, _MOST_LINES):
                part = lines[first : first + _MOST_LINES + 1].copy()
                part[:, 0] -= part[0, 0]
                tick = band.start + first * band.every
                file = Path(place) / f"{axis}-{tick}.csv"
                np.savetxt(file, part, "%.17g", ",", header="t,omega_g,V_g", comments="")
                events.append({"type": "grid-profile", "tick": tick, "file": str(file)})
        kept = {
            "law",
            "inner",
            "counts",
            "T_s",
            "seed",
            "references",
            "plant",
            "link",
            "late_policy",
        }
        content = scenario.model_dump(mode="json", exclude_none=True, include=kept)
        content |= {
            "title": f"{scenario.title}: injection along {axis}",
            "duration": (plan[-1].measured.stop + 1)
            * T_s,  # with the state at the end of the last window
            "mode": "lockstep",
            "expect_ripple": 1000.0,  # the injection is one
            "events": events,
        }
        made = load_scenario(content, in_process=not external)
        if external:
            run = run_scenario(made, Path(place) / "run", controller_command=external)
        else:
            run = run_in_memory(made)
        if run.status != "completed":
            raise UserError(
                f"the run with the injection along {axis} ended as {run.status}: "
                f"{run.summary['reason']}; a smaller amplitude, or another grid, may help"
            )
        return _Spectra.of(run, plan), run.summary  # read while the folder is there


@dataclass(frozen=True)
class _Spectra:
    """Fourier coefficients of one run in the dq frame, at the plan's tones; p.u."""

    # v, i_o, v_g: shape (K, 2): voltage of the capacitor, current to the grid, grid's voltage
    v: Response
    i_o: Response
    v_g: Response
    rest: tuple[complex, complex, complex]  # means of v, i_o and v_g as complex numbers d + jq
    ends: float  # largest difference between the ends of a window over the largest deviation in it

    @classmethod
    def of(cls, run: Run, plan: Sequence[_Band]) -> _Spectra:
        """Those of a run. Raises UserError: the circuit's states do not follow the commands: a
        limit acts."""
        path = _Path.of(run)
        parts, ends = [], 0.0
        for band in plan:
            window = band.measured
            path.check(window)
            parts.append(path.coefficients(window, band.hz))
            apart = np.abs(path.w[window.stop] - path.w[window.start])
            swing = np.abs(path.w[window] - path.w[window].mean(axis=0)).max(axis=0)
            ends = max(ends, float((apart / swing).max()))
        turn = np.exp(-1j * path.angle(window))
        rest = [complex(x[window].mean() * turn) for x in (path.w[:, 1], path.w[:, 2], path.v_g)]
        v, i_o, v_g = np.concatenate(parts, axis=1)
        return cls(v, i_o, v_g, (rest[0], rest[1], rest[2]), ends)

    def less(self, other: _Spectra) -> _Spectra:
        """These without the coefficients of another run."""
        v, i_o, v_g = (getattr(self, x) - getattr(other, x) for x in ("v", "i_o", "v_g"))
        return replace(self, v=v, i_o=i_o, v_g=v_g)


@dataclass(frozen=True)
class _Path:
    """A run as a path of the circuit: its states at the ticks and its sources in between.

    All space vectors are in the frame that turns steadily with the grid. A source is a phasor at
    the beginning of each stretch of a period, and the speed at which it turns, rad/s."""

    T_s: float  # s
    w: Response  # (i_f, v, i_o) at each tick, shape (N, 3)
    v_g: Response  # grid's voltage at each tick, shape (N,)
    delta: Vector  # angle of the converter's frame, shape (N,), rad
    # of a period: its begin and length, s, and the bridge's and the grid's phasors and speeds,
    # shape (N, 2) each
    stretches: list[_Stretch]
    # rates, states, modes, drive: of the circuit, see ``gfm_plant.circuit.Modes``, the rates in
    # that frame and the drive of bridge and grid alone
    rates: Response
    states: Response
    modes: Response
    drive: Response
    by_states: bool  # whether the bridge's voltage follows from the states

    @classmethod
    def of(cls, run: Run) -> _Path:
        scenario, signals = run.scenario, run.signals
        T_s, plant = scenario.T_s, make_plant(scenario.plant, scenario.T_s)
        omega_b, omega_0 = float(plant.net[0]["omega_b"]), scenario.plant.grid.omega_g
        steady = omega_b * (omega_0 - 1.0)  # speed of the frame against the common one
        back = np.exp(-1j * steady * T_s * np.arange(run.ticks))
        v = signals["v_re"] + 1j * signals["v_im"]
        i_o = np.conj((signals["p"] + 1j * signals["q"]) / v)
        w = np.column_stack([signals["i_re"] + 1j * signals["i_im"], v, i_o]) * back[:, None]
        speed_g = omega_b * (signals["omega_g"] - omega_0)
        theta = np.concatenate([[0.0], np.cumsum(speed_g[:-1] * T_s)])
        v_g = signals["V_g"] * np.exp(1j * theta)
        delta = signals["delta"] + theta
        modes, sources = plant.wiring.modes(frozenset(), None)
        drive = modes.drive[:, [sources.index(plant.wiring.units[0].bridge),
                                sources.index(GRID_SOURCE)]]  # fmt: skip
        rates, by_w = modes.rates - 1j * steady, modes.modes[:, :3].copy()
        if LINE in plant.wiring.order:  # behind a second inductor, with the same current
            by_w[:, 2] += modes.modes[:, plant.wiring.order.index(LINE)]
        by_states = scenario.plant.bridge.kind != "average" or "u_cmp_a" in signals
        if by_states:
            stretches = _one_stretch(T_s, w, v_g, speed_g, rates, modes.states[0], by_w, drive)
        else:
            stretches = _stretches_of(scenario, signals, plant.par[0], delta, v_g, speed_g)
        return cls(T_s, w, v_g, delta, stretches, rates, modes.states[:3], by_w, drive, by_states)

    def angle(self, window: slice) -> float:
        """Mean angle of the converter's frame, rad."""
        return float(self.delta[window].mean())

    def check(self, window: slice) -> None:
        """Compare each state with what the circuit makes of the one before. Raises UserError: they
        differ: a limit of the bridge acts."""
        if self.by_states:
            return
        z = self.w[window] @ self.modes.T
        for _, length, at, speeds in self.stretches:
            z = z * np.exp(self.rates * length)
            for k in range(2):
                gain = _gain(self.rates, speeds[window, k], length)
                z = z + self.drive[:, k] * gain * at[window, k, None]
        then = self.w[window.start + 1 : window.stop + 1]
        off = float(np.abs(z @ self.states.T - then).max())
        if off > _FOLLOWS:
            raise UserError(
                f"the bridge's voltage is not the controller's (the circuit is off by {off:.1e} "
                "p.u.): plant.i_peak or plant.modulation acts; measure where no limit acts"
            )

    def coefficients(self, window: slice, hz: Vector) -> Response:
        """Those of v, i_o and v_g at hz, shape (3, K, 2), in the converter's frame at rest."""
        first, last = window.start, window.stop
        t = self.T_s * np.arange(first, last)
        T = (last - first) * self.T_s
        z_0, z_1 = self.modes @ self.w[first], self.modes @ self.w[last]
        both = []
        for omega in 2 * np.pi * np.concatenate([hz, -hz]):
            S = np.zeros(2, complex)
            for begin, length, at, speeds in self.stretches:
                x = 1j * (speeds[window] - omega) * length
                whole = np.where(
                    np.abs(x) > 1e-6, np.expm1(x) / np.where(x == 0, 1.0, x), 1 + x / 2
                )
                S += length * np.exp(-1j * omega * (t + begin)) @ (at[window] * whole) / T
            ends = z_0 * np.exp(-1j * omega * t[0]) - z_1 * np.exp(-1j * omega * (t[0] + T))
            W = self.states @ ((self.drive @ S + ends / T) / (1j * omega - self.rates))
            both.append([W[1], W[2], S[1]])
        x = np.array(both).T * np.exp(-1j * self.angle(window))
        plus, minus = x[:, : len(hz)], x[:, len(hz) :].conj()
        return np.stack([(plus + minus) / 2, (plus - minus) / 2j], axis=-1)


_Stretch = tuple[float, float, Response, Vector]


def _gain(rates: Response, speed: Vector, length: float) -> Response:
    """What a phasor of a speed, (N,), rad/s, makes of each mode in a time: (e^(j Omega h)
    - e^(lambda h)) / (j Omega - lambda), shape (N, modes); no speed is a mode's rate."""
    x = 1j * speed[:, None]
    return np.asarray((np.exp(x * length) - np.exp(rates * length)) / (x - rates))


def _stretches_of(
    scenario: Scenario, signals: Any, par: Any, delta: Vector, v_g: Response, speed_g: Vector
) -> list[_Stretch]:
    """The bridge as its commands are, and the grid; as ``_Path.stretches``."""
    T_s, omega_b = scenario.T_s, float(par["omega_b"])
    u = {name: _through_dac(signals, name, par) for name in _COMMANDS[1:]}
    bridge, speed_u = (
        u["E_u"] + 1j * u["E_q"],
        omega_b * (u["omega_u"] - scenario.plant.grid.omega_g),
    )
    delay, part = scenario.plant.delay.samples, scenario.plant.delay.fraction
    stretches, angle = [], delta
    for begin, end, age in ((0.0, part, delay + 1), (part, 1.0, delay)):
        if end == begin:
            continue
        E, speed = np.roll(bridge, age), np.roll(speed_u, age)
        at = np.column_stack([E * np.exp(1j * angle), v_g * np.exp(1j * speed_g * begin * T_s)])
        speeds = np.column_stack([speed, speed_g])
        stretches.append((begin * T_s, (end - begin) * T_s, at, speeds))
        angle = angle + speed * (end - begin) * T_s
    return stretches


def _one_stretch(
    T_s: float, w: Response, v_g: Response, speed_g: Vector, rates: Response, i_f: Response,
    modes: Response, drive: Response,
) -> list[_Stretch]:  # fmt: skip
    """The bridge as the voltage which, held over each tick, takes i_f (a row of ``_Path.states``)
    to its next value, and the grid; as ``_Path.stretches``. The last tick has none."""
    z = (w @ modes.T) * np.exp(rates * T_s)
    z += drive[:, 1] * _gain(rates, speed_g, T_s) * v_g[:, None]
    by_bridge = i_f @ (drive[:, 0] * _gain(rates, np.zeros(1), T_s)[0])
    bridge = np.append((w[1:, 0] - (z @ i_f)[:-1]) / by_bridge, 0.0)
    at = np.column_stack([bridge, v_g])
    return [(0.0, T_s, at, np.column_stack([np.zeros(len(w)), speed_g]))]


def _through_dac(signals: Any, name: str, par: Any) -> Vector:
    """A command after the D/A, as ``gfm_plant.quantise`` rounds it."""
    j = _COMMANDS.index(name)
    column = f"u_{name}"
    value = signals[column] if column in signals else np.zeros(len(signals["t"]))
    lo, hi, lsb = (float(par[key][j]) for key in ("dac_lo", "dac_hi", "dac_lsb"))
    value = np.clip(value, lo, hi)
    return np.asarray(lo + lsb * np.floor((value - lo) / lsb + 0.5) if lsb > 0.0 else value)


def _make_scan(
    name: str,
    scenario: Scenario,
    hz: Vector,
    amplitude: float,
    settle_s: float,
    settled: float,
    sides: Sequence[_Spectra],
    Y_of: Callable[[Vector], Response] | None,
) -> FrequencyScan:
    """The result of an injection along d and one along q."""
    d, q = sides
    volts, amps = (np.stack([getattr(d, x), getattr(q, x)], axis=-1) for x in ("v", "i_o"))
    par = make_plant(scenario.plant, scenario.T_s).par[0]
    line = float(par["R_g"]), float(par["L_g"])
    omega = float(par["omega_b"]), float(scenario.plant.grid.omega_g)
    model = nfp_model = None
    nfp = _power(q.v, q.i_o, q.rest) / _frequency(q.v_g, hz, q.rest[2], omega[0])
    if Y_of is not None:
        model = Y_of(hz)
        Z = line_impedance(hz, *line, *omega)
        v = np.linalg.solve(np.eye(2) + Z @ model, q.v_g[..., None])
        answer = _power(np.asarray(v[..., 0]), np.asarray(-(model @ v)[..., 0]), q.rest)
        nfp_model = answer / _frequency(q.v_g, hz, q.rest[2], omega[0])
    return FrequencyScan(
        name, scenario, hz, -amps @ np.linalg.inv(volts), model, nfp, nfp_model, q.rest[:2], line,
        omega, amplitude, settle_s, settled,
    )  # fmt: skip


def _power(v: Response, i_o: Response, rest: tuple[complex, complex, complex]) -> Response:
    """The change of p = v_d i_od + v_q i_oq, to the first order."""
    v_0, i_0 = (np.array([x.real, x.imag]) for x in rest[:2])
    return np.asarray(i_o @ v_0 + v @ i_0)


def _frequency(v_g: Response, hz: Vector, at: complex, omega_b: float) -> Response:
    """The change of the grid's frequency, p.u.: what its voltage does across itself."""
    across = np.array([-at.imag, at.real]) / abs(at) ** 2
    return np.asarray(2j * np.pi * hz * (v_g @ across) / omega_b)


def _stretches(hz: Vector, where: NDArray[np.bool_]) -> list[list[float]]:
    """The first and the last frequency of each stretch in which ``where`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], where.astype(int), [0]])))
    return [[float(hz[a]), float(hz[b - 1])] for a, b in edges.reshape(-1, 2)]
