"""Certificates for converters: to which grids any number of them may be connected."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.certificate import Certificate, GridClass, certify
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode
from gfm_hil.core.errors import UserError
from gfm_hil.run.runner import run_in_memory
from gfm_hil.scenario import Scenario, load_scenario, plant_of
from gfm_hil.studies.linear_loop import initial_law, scenario_loop
from gfm_hil.studies.workers import SILENT, Watch
from gfm_plant import NoEquilibrium
from gfm_plant.circuit import GROUND

Vector = NDArray[np.float64]

POINTS = 100  # frequencies, before intervals are halved
_LOWEST_HZ = 0.01
_TRIED = 5  # short-circuit ratios of the class on which one converter must be stable
_STIFF = 50.0  # over the weakest: up to there a class without a stiffest grid is tried
_KICK = {"t": 0.1, "type": "grid-phase-jump", "degrees": 0.5}
_RUN_S = 4.0


@dataclass(frozen=True)
class UnstableGrid:
    """A grid of the class with which one converter alone is unstable.

    Attributes:
        law, of: its name, and the name or file by which it was asked for.
        scr, x_over_r: of the grid, at the filter capacitor.
        P_ref: p.u.
        mode: the one that grows fastest; None: there is no operating point.
    """

    law: str
    of: str
    scr: float
    x_over_r: float
    P_ref: float
    mode: Mode | None

    def __str__(self) -> str:
        grid = f"{self.law} at SCR {self.scr:.4g}, X/R {self.x_over_r:.4g}, P_ref {self.P_ref:g}"
        if self.mode is None:
            return f"{grid}: no operating point"
        return f"{grid}: {self.mode.frequency_hz:.4g} Hz, {self.mode.sigma:+.3g} 1/s"


@dataclass(frozen=True)
class CertifiedLaws:
    """What ``certify`` says of laws.

    Attributes:
        laws: their names.
        powers: P_ref of the operating points, p.u.
        certificate: over the frequencies; None where a single converter is unstable already.
        unstable: the counter-example, or None.
    """

    laws: tuple[str, ...]
    powers: tuple[float, ...]
    grids: GridClass
    certificate: Certificate | None
    unstable: UnstableGrid | None

    @property
    def holds(self) -> bool:
        """Whether every network of the class is stable."""
        return self.certificate is not None and self.certificate.holds

    def __repr__(self) -> str:
        word = "certified" if self.holds else "unstable" if self.unstable else "void"
        return f"<CertifiedLaws {', '.join(self.laws)}: {word}>"


@dataclass(frozen=True)
class Strength:
    """Where a network lies among the classes.

    Attributes:
        weakest, stiffest, x_over_r, loads: as of ``GridClass``.
    """

    weakest: float
    stiffest: float
    x_over_r: tuple[float, float]
    loads: bool

    def within(self, grids: GridClass) -> bool:
        """Whether it belongs to a class."""
        (low, high), (least, most) = self.x_over_r, grids.x_over_r
        return (
            grids.weakest <= self.weakest
            and self.stiffest <= grids.stiffest
            and least * (1 - 1e-9) <= low
            and high <= most * (1 + 1e-9)
            and (grids.loads or not self.loads)
        )


def certify_laws(
    scenario: Scenario,
    laws: Sequence[str],
    grids: GridClass,
    powers: Sequence[float],
    watch: Watch = SILENT,
) -> CertifiedLaws:
    """Certify converters under laws, any number of each, for a class of grids.

    Each is linearised at each P_ref on the weakest and on the stiffest grid of the class; each
    alone is first tried on grids between them, at both ends of X/R. Without a stiffest one, 50
    times the weakest takes its place.

    Args:
        scenario: plant, inner stage, T_s and the other references.
        laws: names or files of laws.
        powers: values of P_ref, p.u.

    Raises:
        UserError: the scenario has a network, or one of the values cannot be.
    """
    if scenario.network is not None:
        raise UserError("network: a certificate is that of a converter, not of a network")
    if scenario.plant.lcl is not None or scenario.plant.grid.finite is not None:
        raise UserError(
            "plant.lcl, plant.grid.finite: a certificate is for R-L lines at the filter capacitor, "
            "and the transformer is one of them; leave them out"
        )
    each = [(law, P) for law in laws for P in powers]
    loops, names = list[ClosedLoop](), dict[str, None]()
    scrs = np.geomspace(grids.weakest, min(grids.stiffest, _STIFF * grids.weakest), _TRIED)
    for k, (law, P) in enumerate(each):
        watch.progress(k, len(each) + 1, f"{law} at P_ref = {P:g}")
        for scr in scrs:
            for x_over_r in dict.fromkeys(grids.x_over_r):
                one = on_grid(scenario, law, scr, x_over_r, P)
                name, loop, unstable = _try_loop(one)
                names[name] = None
                if unstable is not None or loop is None:
                    return CertifiedLaws(tuple(names), tuple(powers), grids, None, unstable)
                if scr in (scrs[0], scrs[-1]) and x_over_r == grids.x_over_r[0]:
                    loops.append(loop)

    watch.progress(len(each), len(each) + 1, "the class")
    hz = _frequencies(loops, scenario.T_s)
    found = certify(grids, hz, _admittances(loops, hz), lambda hz: _admittances(loops, hz))
    return CertifiedLaws(tuple(names), tuple(powers), grids, found, None)


def on_grid(scenario: Scenario, law: str, scr: float, x_over_r: float, P: float) -> Scenario:
    """The scenario with a law, a grid and a power. Raises UserError: they cannot be."""
    return load_scenario(
        scenario, law=law, events=[], plant__grid__scr=float(scr),
        plant__grid__x_over_r=float(x_over_r), references__P_ref=P,
    )  # fmt: skip


def counter_run(scenario: Scenario, unstable: UnstableGrid) -> str:
    """The status of a run of 4 s whose grid's angle jumps by 0.5 degrees, on the grid of a
    counter-example; empty where there is no operating point to begin at."""
    if unstable.mode is None:
        return ""
    one = on_grid(scenario, unstable.of, unstable.scr, unstable.x_over_r, unstable.P_ref)
    run = run_in_memory(load_scenario(one, duration=_RUN_S, events=[_KICK]))
    return str(run.status)


def strength_of(scenario: Scenario) -> Strength:
    """The strength of a network, from its lines alone.

    Its converters may be of any rating; nodes without one are eliminated. Where lines of different
    X/R meet at such a node, the stiffest is infinite.

    Raises:
        UserError: it has no grid, or parts of which no class is made.
    """
    plant = plant_of(scenario)
    wiring = plant.wiring
    if wiring.grid is None or not wiring.closed:
        raise UserError("network: without a grid there is no class; an island's angle is free")
    others = [name for name, _ in wiring.fed] + [bank.name for bank in wiring.capacitors]
    if others:
        raise UserError(
            f"network: {others[0]!r}: only R-L lines, loads and converters are certified"
        )
    branches = [b for b in (*wiring.units_lines, *wiring.branches) if b.name not in wiring.opened]
    lines = [b for b in branches if b.end != GROUND]
    terminals = [unit.terminal for unit in wiring.units]
    nodes = [*terminals, *(n for n in wiring.nodes if n != wiring.grid and n not in terminals)]
    B = np.zeros((len(nodes) + 1,) * 2)
    place = {**{n: k for k, n in enumerate(nodes)}, wiring.grid: len(nodes)}
    for line in lines:
        ends = [place[line.start], place[line.end]]
        B[np.ix_(ends, ends)] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / np.hypot(line.R, line.L)
    B = B[:-1, :-1]
    n, ratios = len(terminals), [line.L / line.R if line.R else np.inf for line in lines]
    alike = max(ratios) <= min(ratios) * (1 + 1e-9)
    inside = B[n:, n:]
    reduced = B[:n, :n] - B[:n, n:] @ np.linalg.solve(inside, B[n:, :n]) if len(inside) else B
    root = np.sqrt([float(r["current"]) for r in plant.par])  # ratings: 1/S
    strengths = np.linalg.eigvalsh(root[:, None] * reduced * root)
    stiffest = float(strengths[-1]) if alike or not len(inside) else np.inf
    loads = bool(wiring.shunts) or any(b.end == GROUND for b in branches)
    return Strength(float(strengths[0]), stiffest, (min(ratios), max(ratios)), loads)


def _try_loop(scenario: Scenario) -> tuple[str, ClosedLoop | None, UnstableGrid | None]:
    """The name of the law, and its loop if that is stable."""
    grid, P = scenario.plant.grid, scenario.references.P_ref
    name = initial_law(scenario)[0].law.name
    at = name, scenario.law, float(grid.scr or 0.0), float(grid.x_over_r or 0.0), P
    try:
        loop, _ = scenario_loop(scenario)
    except NoEquilibrium:
        return name, None, UnstableGrid(*at, None)
    worst = loop.modes()[0]
    return name, loop, UnstableGrid(*at, worst) if worst.sigma >= 0.0 else None


def _admittances(loops: Sequence[ClosedLoop], hz: Vector) -> list[NDArray[np.complex128]]:
    return [
        np.asarray(np.linalg.inv(z), complex)
        for z in (loop.output_impedance(2.0 * np.pi * hz) for loop in loops)
    ]


def _frequencies(loops: Sequence[ClosedLoop], T_s: float) -> Vector:
    """Evenly by ratio up to the Nyquist frequency, and about each mode as it is damped."""
    hz = [*np.geomspace(_LOWEST_HZ, 0.499 / T_s, POINTS)]
    for mode in (mode for loop in loops for mode in loop.modes() if mode.frequency_hz > _LOWEST_HZ):
        width = abs(mode.sigma) / (2.0 * np.pi)
        hz += [mode.frequency_hz + j * width for j in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    found = np.unique([f for f in hz if _LOWEST_HZ <= f <= 0.499 / T_s])
    return np.asarray(found[np.append(True, np.diff(found) > 1e-3 * found[1:])])
