"""Gamma, gains and margins of a law, as a notebook and the design commands ask for them, and the
law file with the gains that a synthesis found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.all_margins import Margins
from gfm_design.margins.all_margins import margins as _margins
from gfm_design.misses.tolerance import LatencyTolerance
from gfm_design.misses.tolerance import latency_tolerance as _latency_tolerance
from gfm_design.model.closed_loop import least_stable
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import PAPER_WEIGHTS, Weight, WeightedChannel, read_weights
from gfm_design.tuning import paper as search
from gfm_design.tuning.full_order import FullOrder, full_order
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.synthesis import NotStabilised, Tuned
from gfm_hil.api.law import Law, as_law
from gfm_hil.core.errors import UserError, need
from gfm_hil.results.report import finite
from gfm_hil.scenario import Scenario, check_scenario, load_scenario, toml_text
from gfm_hil.scenario.loading import drop_line
from gfm_hil.scenario.schema import LatePolicy
from gfm_hil.studies.linear_loop import loop_under, title_of
from gfm_hil.studies.workers import SILENT, Watch
from gfm_plant import NoEquilibrium, Plant, make_plant
from gfm_runtime import law_file
from gfm_runtime.law import HomeGrid
from gfm_runtime.lawfile import LawFile, shipped_law

if TYPE_CHECKING:
    import pandas

Weights = str | Path | Sequence[Weight] | None

_PAPERS_GRID = HomeGrid().model_dump(mode="json")
_AT = 1e-4  # relative: a gain this close to its bound is at it
_SAME = 1e-4  # relative: a norm this close to another is the same


@dataclass(frozen=True)
class Gamma:
    """The H-infinity norm of diag(W_ij T_ij), by channel; Section III-B of the paper.

    Attributes:
        law: name of the law.
        channels: i, j, norm and the frequency omega [rad/s] of its peak, of each weight W_ij.
    """

    law: str
    channels: tuple[WeightedChannel, ...]

    @property
    def value(self) -> float:
        """gamma, the largest of the channels' norms."""
        return max(channel.norm for channel in self.channels)

    def to_pandas(self) -> pandas.DataFrame:
        """One row a channel: i, j, norm, omega [rad/s].

        Raises:
            UserError: pandas is not installed.
        """
        need("pandas", "pandas", "to_pandas", "notebook")
        import pandas

        return pandas.DataFrame(list(self.channels))

    def __repr__(self) -> str:
        return f"<Gamma {self.law}: {self.value:.6g}>"


@dataclass(frozen=True)
class Tuning:
    """What a search of gains found.

    Attributes:
        law: the law with its new gains; run it, draw its loop, save it.
        gamma: of that law.
        before: of the gains that the search began with; None if the loop is unstable there.
        gains: those that changed, and those that are tied to them.
        unmoved: the largest channels, if no free gain moves them.
        evaluations, seconds: what the search took.
        seed: what makes it repeatable.
        problem: the problem that was solved.
    """

    law: Law
    gamma: Gamma
    before: Gamma | None
    gains: dict[str, float]
    unmoved: list[WeightedChannel]
    evaluations: int
    seconds: float
    seed: int
    problem: search.PaperProblem

    @property
    def at_bounds(self) -> dict[str, float]:
        """The free gains that lie at one of their bounds, by that bound; gamma may fall further
        beyond it."""
        return {
            gain.name: bound
            for gain in self.problem.gains
            for bound in (gain.low, gain.high)
            if abs(self.gains[gain.name] - bound) <= _AT * (abs(bound) or gain.high - gain.low)
        }

    def bound(self) -> FullOrder | None:
        """A gamma below which no controller of any order comes; None if the solver found none.

        Raises:
            UserError: python-control or slycot is not installed, or the law has an inner stage.
        """
        if self.problem.is_sampled:
            raise UserError(
                "the full-order bound is that of a law on the bridge of the paper's converter"
            )
        try:
            return full_order(self.problem.linear, self.problem.weights)
        except ModuleNotFoundError as missing:
            raise UserError(str(missing)) from None

    def __repr__(self) -> str:
        return f"<Tuning {self.law.name}: gamma {self.gamma.value:.6g}, seed {self.seed}>"


class NotTuned(ArithmeticError):
    """No gains within their bounds stabilise the loop; the message names the mode in the way."""


def gamma(
    law: str | Path | Law,
    weights: Weights = None,
    T_s: float | None = None,
    *,
    on: str | Path | Scenario | None = None,
    converter: str | None = None,
) -> Gamma:
    """gamma of a law on the paper's converter at P_ref = 0.5 p.u., or on a scenario.

    With an inner stage it is that of the loop sampled at 10 kHz with u one sample late. On a
    scenario it is that of the sampled loop with the scenario's delay and sensors.

    Args:
        law: name, law file or ``Law``; ``Law.with_gains`` gives other gains.
        weights: file of weights or the weights; the paper's six if None.
        T_s: sampling time [s] of law and weights, by Tustin, without delay; None for the
            continuous loop of the paper. Not with an inner stage, nor on a scenario.
        on: a scenario: its name or file, or a checked one.
        converter: of a scenario with a network the converter that gets this law, while the others
            keep theirs.

    Raises:
        Unstable: the loop is not stable; it has no gamma.
        UserError: a weight that cannot be, there is no operating point, T_s with an inner stage or
            a scenario, or no such scenario or converter.
        LawError: the law is none.
    """
    law = as_law(law)
    staged = law.file.inner is not None
    if T_s is not None and (staged or on is not None):
        of = "an inner stage is sampled at 10 kHz" if on is None else "a scenario is sampled"
        raise UserError(f"gamma: the loop of {of} in any case")
    if on is not None:
        loop = law.closed_loop(on, converter=converter)
    else:
        loop = law.closed_loop(search.LATE) if staged else law.closed_loop(ideal=True)
    if T_s is not None:
        loop = loop.sampled(T_s)
    return Gamma(law.name, loop.channels(_weights(weights)))


def tune(
    law: str | Path | Law,
    name: str | None = None,
    *,
    start: Mapping[str, float] | None = None,
    only: Sequence[str] | None = None,
    weights: Weights = None,
    on: str | Path | Scenario | None = None,
    converter: str | None = None,
    decay: float = 0.0,
    scr: Sequence[float] = (),
    seed: int = 0,
    evaluations: int = search.EVALUATIONS,
    starts: int | None = None,
    watch: Watch = SILENT,
) -> Tuning:
    """Choose the free gains of a law for the least gamma (Section III-B of the paper).

    gamma is that of the function ``gamma``, with the law's inner stage if it has one.

    Args:
        law: name, law file or ``Law``; its parameters with ``free`` bounds may move.
        name: of the new law; ``<name>-tuned`` if None.
        start: other values to start from; without a scenario MIMO-GFM starts from the paper's
            initial K.
        only: the free gains to move; all if None.
        weights: file of weights or the weights; the paper's six if None.
        on, converter: as for the function ``gamma``.
        decay: how fast every mode of the loop, and so of the whole network, must decay at least,
            1/s: the search then minimises the norm of W_ij(s) T_ij(s - decay).
        scr: short-circuit ratios of the scenario's grid; gamma is the largest of all, and every
            loop must be stable, and decay so fast.
        seed: of the search, >= 0; the same seed gives the same gains.
        evaluations: of each start, before its polish.
        starts: the given start and random ones; 6, and one more a gain, if None.
        watch: told the evaluations done, how many there are to be, and the best gamma.

    Raises:
        NotTuned: no gains within the bounds stabilise the loop.
        UserError: a number or a weight that cannot be; the package cma is missing.
        LawError: the law is none, or declares no such free gain.
    """
    _check_search(evaluations, starts, seed, decay)
    law = as_law(law)
    scenario = None if on is None else load_scenario(on)
    if scenario is None and scr:
        raise UserError("scr: are those of a scenario's grid; say which scenario")
    loops = [
        partial(loop_under, scenario=one, converter=converter)
        for one in ([] if scenario is None else at_short_circuit_ratios(scenario, scr))
    ]
    paper = search.PAPER_START.get(law.name, {}) if scenario is None else {}
    at = {n: v for n, v in paper.items() if only is None or n in only} | dict(start or {})
    try:
        problem = search.PaperProblem(
            law.file if scenario is None else law.staged(scenario, converter),
            free_gains(law.file, at, only), weights=_weights(weights),
            among=loops[0] if loops else None, decay=decay, others=tuple(loops[1:]),
        )  # fmt: skip
    except NoEquilibrium as none:
        raise UserError(str(none)) from None
    starts = starts or search.starts_for(len(problem.gains))
    try:  # before the search, which moves the problem to the operating point of what it found
        before = _gamma_of(law.name, problem, np.array([gain.start for gain in problem.gains]))
    except Unstable:
        before = None
    try:
        found = search.tune_paper(
            problem, seed, evaluations, starts,
            lambda done, best: watch.progress(done, evaluations * starts, f"γ {best:.4g}"),
        )  # fmt: skip
    except NotStabilised as none:
        raise NotTuned(_in_the_way(none, problem, converter)) from None
    except ModuleNotFoundError as missing:
        raise UserError(str(missing)) from None
    return _tuning(law, name or f"{law.name}-tuned", problem, found, before)


def _tuning(
    law: Law, name: str, problem: search.PaperProblem, found: Tuned, before: Gamma | None
) -> Tuning:
    named = problem.law.named(found.values)
    tuned = law.with_gains(name, **named)
    after = _gamma_of(tuned.name, problem, found.values)
    fixed = _unmoved(problem, found.values, after)
    took = found.evaluations, found.seconds, found.seed
    return Tuning(tuned, after, before, named, fixed, *took, problem)


def _unmoved(
    problem: search.PaperProblem, values: NDArray[np.float64], now: Gamma
) -> list[WeightedChannel]:
    """The largest channels, if each is the same with any of the gains a hundredth away."""
    found = [c for c in now.channels if c.norm >= (1.0 - _SAME) * now.value]
    for k, gain in enumerate(problem.gains):
        away = values[k] * 1.01 if 0.0 < abs(values[k] * 1.01) <= gain.high else values[k] * 0.99
        near = values.copy()
        near[k] = away or 0.01 * gain.high
        try:
            there = {(c.i, c.j): c.norm for c in _gamma_of(now.law, problem, near).channels}
        except Unstable:
            return []
        found = [c for c in found if abs(there[c.i, c.j] - c.norm) <= 1e-9 * c.norm]
    return found


def _gamma_of(name: str, problem: search.PaperProblem, values: NDArray[np.float64]) -> Gamma:
    """gamma at a problem's free gains. Raises Unstable: a loop has none."""
    each = (loop.channels(problem.weights) for loop in problem.all_loops(values))
    return Gamma(name, search.worst_channels(each))


def _check_search(evaluations: int, starts: int | None, seed: int, decay: float) -> None:
    for what, value in (("evaluations", evaluations), ("starts", starts)):
        if value is not None and value < 1:
            raise UserError(f"{what} = {value}: must be at least 1")
    for what, number in (("seed", seed), ("decay", decay)):
        if not 0 <= number < np.inf:
            raise UserError(f"{what} = {number}: must be finite and not negative")


def _in_the_way(none: NotStabilised, problem: search.PaperProblem, converter: str | None) -> str:
    """Which mode is unstable, or too slow, where the search came closest."""
    loop = problem.closed_loop(none.values)
    where = "on the scenario" if converter is None else f"in the network of {converter}"
    mode = loop.modes()[0].words()
    if problem.among is None:
        where = f"on the paper's converter at P_ref = {problem.references[1]:g}"
        mode = least_stable(loop).words()
    wanted = f" against a decay of {problem.decay:g} 1/s" if problem.decay else ""
    return f"{none}{wanted}; in the way, {where}: {mode}"


def at_short_circuit_ratios(scenario: Scenario, scr: Sequence[float]) -> list[Scenario]:
    """A scenario at several short-circuit ratios; as it is without them. Without an X/R of its own
    its grid keeps that of its line. Raises UserError: one cannot be."""
    if not scr:
        return [scenario]
    content = scenario.model_dump(mode="json", exclude_unset=True)
    drop_line(content)
    plant = content.get("plant", {})
    line = make_plant(scenario.plant, scenario.T_s).par[0]
    own = {"x_over_r": float(line["L_g"] / line["R_g"])} if line["R_g"] > 0.0 else {}
    grids = [{**own, **plant.get("grid", {}), "scr": ratio} for ratio in scr]
    return [check_scenario({**content, "plant": {**plant, "grid": g}}, "scr") for g in grids]


def margins(
    law: str | Path | Law, on: str | Path | Scenario | Plant | None = None, **more: Any
) -> Margins:
    """What the sampled loop of a law stands: gain, phase, disk and delay margins of each channel
    in ``loop``, ranges of the circuit's elements in ``elements``, of the grid in ``grid``.

    Takes some seconds; the page on margins says how each is found.

    Args:
        law: name, law file or ``Law``.
        on, more: as for ``Law.closed_loop``.

    Raises:
        UnstableLoop: the loop is unstable and has no margins.
        UserError: no such scenario, or there is no operating point; or the converter is one of a
            network, for which ``loop_margins`` has the others.
    """
    loop = as_law(law).closed_loop(on, **more)
    if loop.around is not None:
        raise UserError(
            f"{title_of(loop)}: ranges of elements and grids are those of one converter on its"
            " line; loop_margins(Law.closed_loop(...)) has the other margins"
        )
    return _margins(loop)


def latency_tolerance(
    law: str | Path | Law,
    on: str | Path | Scenario | Plant | None = None,
    *,
    hold: int | None = None,
    extrapolate: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
    **more: Any,
) -> LatencyTolerance:
    """What a law bears of late and of lost commands: its delay margin; how many ticks in a row
    without a new u, by words, if the controller stands still and if it steps; for how many in a
    row, and in any ten ticks, every sequence is stable. ``LatencyTolerance.used`` says how much of
    that a measurement used.

    Takes some seconds, for a network a minute; the page on benchmarks says how each is obtained.

    Args:
        law: name, law file or ``Law``.
        on, more: as for ``Law.closed_loop``.
        hold, extrapolate: of the plant's late policy, ticks; by default those of the scenario.
        progress: called with the share of the work that is done.

    Raises:
        UnstableLoop: the loop is unstable without any miss.
        UserError: no such scenario, or there is no operating point.
    """
    if isinstance(on, str | Path):
        on = load_scenario(on)
    policy = on.late_policy if isinstance(on, Scenario) else LatePolicy()
    return _latency_tolerance(
        as_law(law).closed_loop(on, **more),
        policy.hold if hold is None else hold,
        policy.extrapolate if extrapolate is None else extrapolate,
        progress,
    )


def _weights(given: Weights) -> tuple[Weight, ...]:
    if given is None:
        return PAPER_WEIGHTS
    if not isinstance(given, str | Path):
        return tuple(given)
    try:
        return read_weights(Path(given))
    except ValueError as problem:
        raise UserError(f"weights {given}: {problem}") from None


def channels_as_json(channels: Sequence[WeightedChannel]) -> dict[str, Any]:
    """gamma and its channels as plain data; a peak that is only a limit has no frequency."""
    rows = [{"i": c.i, "j": c.j, "norm": c.norm, "omega_rad_s": finite(c.omega)} for c in channels]
    return {"gamma": max(c.norm for c in channels), "channels": rows}


def problem_name(
    file: LawFile,
    on: Scenario | None = None,
    converter: str | None = None,
    weights: str | None = None,
    scr: Sequence[float] = (),
) -> str:
    """The problem whose gamma a synthesis gives: the paper's, or that of a scenario; arguments as
    for ``tune``."""
    if on is not None:
        who = "" if converter is None else f"converter {converter} of "
        whose = "the paper's weights" if weights is None else f"the weights of {weights}"
        ratios = f" at SCR {', '.join(f'{x:g}' for x in scr)}" if scr else ""
        return f"{whose} on {who}{on.title!r}{ratios}, sampled"
    if file.inner is None:
        return "the paper's problem (Section III-B)"
    return f"the paper's weights, behind {file.inner.type}, sampled at 10 kHz, u one sample late"


def law_text(
    file: LawFile, gains: Mapping[str, float], by: str, comments: Sequence[str], **about: Any
) -> str:
    """A law file with other gains, and comments above them: what differs from the law of the
    catalogue that ``file`` is, or all of it if the law is no such one.

    Args:
        file: the law.
        gains: the parameters that change.
        by: what found the gains; their source.
        comments: one a line.
        about: other keys of the file that change, such as name and title.
    """
    content = {**file.model_dump(mode="json", exclude_none=True), **about}
    for name, value in gains.items():
        content["parameters"][name] |= {"value": value, "source": by}
    if shipped_law(file.name) is not None:
        base = law_file(file.name).model_dump(mode="json", exclude_none=True)
        changed = _difference(content, base)
        content = content if changed is None else {"base": file.name, **changed}
    return "".join(f"# {line}\n" for line in comments) + "\n" + toml_text(content)


def _difference(new: Mapping[str, Any], old: Mapping[str, Any]) -> dict[str, Any] | None:
    """What of ``new`` is not in ``old``, table by table; None if ``new`` lacks what ``old`` has."""
    if old.keys() - new.keys():
        return None
    out: dict[str, Any] = {}
    for key, value in new.items():
        before = old.get(key)
        if value == before:
            continue
        if isinstance(value, dict) and isinstance(before, dict) and "type" not in value:
            value = _difference(value, before)
            if value is None:
                return None
        out[key] = value
    return out


def write_law(
    path: Path,
    file: LawFile,
    gains: Mapping[str, float],
    result: Mapping[str, Any],
    notes: Sequence[str] = (),
    by: str = "gfmhil design tune",
    problem: str | None = None,
) -> None:
    """Write a law file with its tuned gains and, as comments, what they were tuned for.

    Args:
        path: the new file; its stem is the name of the law.
        file: the law that was tuned. The new one is meant for the paper's grid, whatever this one
            was meant for.
        gains: the parameters that change.
        result: gamma, channels, evaluations, seconds and seed, as ``gfmhil design tune --json``.
        notes: more lines of comment.
        by: the command that found the gains.
        problem: whose gamma it is; the paper's if None.

    Raises:
        OSError: the file cannot be written.
    """
    comments = [
        f"gamma = {result['gamma']:.6g} of {problem or f'{problem_name(file)}, P_ref = 0.5'}",
        *(f"W_{c['i']}{c['j']}: {c['norm']:.6g}" for c in result["channels"]),
        f"{result['evaluations']} evaluations, {result['seconds']:.1f} s, seed {result['seed']}",
        *notes,
    ]
    source = f"{file.source.strip()}; tuned by {by}, see the comments"
    about = {"name": path.stem, "title": f"{file.title}, tuned", "source": source}
    changed_by = f"{by}, seed {result['seed']}"
    text = law_text(file, gains, changed_by, comments, home_grid=_PAPERS_GRID, **about)
    path.write_text(text, encoding="utf-8")
