"""The events of the grid simulator, called between two ticks.

Frequencies and voltages are in p.u., times in s. An event acts from the coming tick on.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from gfm_plant.build import CONNECTION, FAR, LINE
from gfm_plant.circuit import GROUND, Branch
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.emulator import clear, reconnect, synchronise
from gfm_plant.model import DELTA
from gfm_plant.names import CLEARINGS, FAULTED_PHASES, THE_GRID
from gfm_plant.network import Network
from gfm_plant.synchro_check import NONE, TIME_OVER, WATCHING
from gfm_plant.wiring import GRID_SOURCE, Check, FaultPlace, OpeningBreaker, Wiring

LEAST_FAULT_R = 1e-4
"""p.u., at a capacitor: a metallic short circuit there would discharge it in no time."""

LEAST_SEGMENT = 1e-3
"""Of a line: a fault nearer to an end is at that end. The end's voltage would drive a current of
1/LEAST_SEGMENT times the line's own short-circuit current, or more, through what is left of it."""


def grid_frequency(plant: Network, omega_g: float, rate: float | None = None) -> None:
    """Step the frequency of an ideal grid to `omega_g`, or ramp it there at `rate` (p.u./s, > 0).
    Raises ValueError: If a value is out of range, the grid is finite and has its own frequency, or
    there is none."""
    _needs_grid(plant)
    if len(plant.of(FiniteGrid)):
        raise ValueError("plant.grid.finite: such a grid sets its own frequency; use grid-load")
    _require("omega_g", omega_g, omega_g > 0, "> 0 p.u.")
    plant.now["omega_g_to"], plant.now["omega_g_rate"] = omega_g, _rate(rate)
    if rate is None:
        plant.now["omega_g"] = omega_g


def grid_voltage(
    plant: Network, V_g: float, rate: float | None = None, duration: float | None = None
) -> None:
    """Step the grid voltage to `V_g`, ramp it there, or let it sag and recover.

    Args:
        plant: The plant.
        V_g: Voltage in p.u., >= 0.
        rate: Slope of a ramp in p.u./s, > 0.
        duration: Length of a sag in s, > 0, after which the voltage steps back to where it
            was, or was going. A sag within a sag recovers to the voltage before both; a step or
            ramp within a sag cancels the recovery.

    Raises:
        ValueError: If a value is out of range, both `rate` and `duration` are given, or there is
            no grid.
    """
    _needs_grid(plant)
    _require("V_g", V_g, V_g >= 0, ">= 0 p.u.")
    if rate is not None and duration is not None:
        raise ValueError(f"rate = {rate}, duration = {duration}: give one, a ramp or a sag")
    if duration is None:
        plant.now["sag_left"] = 0.0
    else:
        _require("duration", duration, duration > 0, "> 0 s")
        if plant.now[0]["sag_left"] == 0.0:
            plant.now["V_g_after"] = plant.now["V_g_to"]
        plant.now["sag_left"] = duration
    plant.now["V_g_to"], plant.now["V_g_rate"] = V_g, _rate(rate)
    if rate is None:
        plant.now["V_g"] = V_g


def grid_load(plant: Network, change: float) -> None:
    """Add `change` to the load of a finite grid, p.u. of the grid's rating. Raises ValueError: If
    the grid is ideal, or `change` is not finite."""
    _require("change", change, True, "finite")
    if not len(plant.of(FiniteGrid)):
        raise ValueError("plant.grid.finite: not set; an ideal grid has no load of its own")
    plant.of(FiniteGrid)["P_load"] += change


def fault(
    plant: Network,
    position: float | None,
    R: float,
    duration: float | None = None,
    line: str | None = None,
    node: str | None = None,
    kind: str = "3ph",
    phases: str | None = None,
    Z_0: complex | None = None,
    clearing: str = "zero",
) -> None:
    """Short phases through `R`: all three or one (LG) or two (LLG) of them to ground, or two (LL).

    An unbalanced fault couples positive and negative sequence. The plant solves it exactly too, see
    `gfm_plant.circuit`.

    Args:
        plant: The plant.
        position: Place on the line: 0 at its start, the filter capacitor, or with a second inductor
            the point of connection; 1 at its end, which is a node; `LEAST_SEGMENT` from both at
            least; None: at a node.
        R: Resistance from each phase to ground, or between the two phases of an LL fault, p.u. of
            the first converter; > 0 at a capacitor.
        duration: Time until the fault is cleared, s; None: `clear_fault` clears it.
        line: Name of the line, or of the converter whose line it is; None: that of the only one.
        node: The node.
        kind: "3ph", "LG", "LL" or "LLG".
        phases: The phases that an unbalanced fault connects; None: a, of two phases b and c.
        Z_0: Impedance R + jX, X at nominal frequency, between the place and ground for the zero
            sequence of LG and LLG, p.u. of the first converter; None: that of the closed lines
            between the place and earthed star points, with their own L and R.
        clearing: "zero": from the end of its duration on, or a call of `clear_fault`, each phase
            opens as soon as its current passes zero; "instant": all phases open at once.

    Raises:
        ValueError: If there is no such place or kind, or a value is out of range. The plant is then
            unchanged.
    """
    wiring = plant.wiring
    phases = _phases(kind, phases, Z_0)
    node, inside, where = _place(wiring, position, line, node)
    charged = {unit.terminal for unit in wiring.units} | {c.node for c in wiring.capacitors}
    least = LEAST_FAULT_R if inside is None and node in charged else 0.0
    _require("R", R, least <= R, f">= {least:g} p.u. at {where}")
    if duration is not None:
        _require("duration", duration, duration > 0, "> 0 s")
    _require_clearing(clearing)
    place = FaultPlace(
        node=node, branch=inside, position=position or 0.0, R=R, kind=kind, phases=phases, Z_0=Z_0,
        clearing=clearing,
    )  # fmt: skip
    changed = replace(wiring, fault=place)
    if kind in ("LG", "LLG") and changed.zero_sequence is None:
        raise ValueError(
            f"X_0: not set, and no closed line leads from {where} to the earthed star point of the"
            f" grid or of a transformer; an {kind} fault needs a path to ground"
        )
    plant.rewire(changed)
    plant.now["contact"], plant.now["clearing"] = 1, bool(plant.wiring.opening)
    plant.now["made"], plant.now["conducts"][0, 0] = 0, [p in phases for p in "abc"]
    plant.now["opens"][0, 0] = 0
    plant.now["fault_left"] = math.inf if duration is None else duration
    reconnect(plant.records)


def _phases(kind: str, phases: str | None, Z_0: complex | None) -> str:
    """The phases that a fault connects. Raises ValueError: If there is no such kind, or it cannot
    have these phases or this impedance."""
    if kind not in FAULTED_PHASES:
        raise ValueError(f"kind = {kind!r}: must be one of {list(FAULTED_PHASES)}")
    allowed = list(FAULTED_PHASES[kind])
    if phases is not None and phases not in allowed:
        raise ValueError(f"phases = {phases!r}: must be one of {allowed} for kind {kind!r}")
    if Z_0 is not None:
        if kind not in ("LG", "LLG"):
            raise ValueError(
                f"X_0, R_0: no current of kind {kind!r} goes to ground; leave them out"
            )
        _require("X_0", Z_0.imag, Z_0.imag >= 0, ">= 0 p.u.")
        _require("R_0", Z_0.real, Z_0.real >= 0, ">= 0 p.u.")
    return phases or allowed[0]


def _place(
    wiring: Wiring, position: float | None, line: str | None, node: str | None
) -> tuple[str, str | None, str]:
    """The node of a fault, or that at the start of its branch; the name of the branch if the fault
    is inside one; and the words for the place. Raises ValueError: If there is no such place, or no
    current could flow there."""
    inside = None
    if position is not None:
        inner = LEAST_SEGMENT <= position <= 1 - LEAST_SEGMENT
        ends = f"0, or in [{LEAST_SEGMENT:g}, {1 - LEAST_SEGMENT:g}]"
        _require("position", position, position == 0 or inner, ends)
        lines = {n: one for n, one in wiring.named_lines().items() if not one.earthed}
        if line is None:
            line = LINE if wiring.units[0].node == CONNECTION else wiring.units[0].name
        if line not in lines:
            raise ValueError(f"line = {line!r}: must be one of {sorted(lines)}")
        node = lines[line].start
        inside = lines[line].name if position > 0 else None
    elif node not in wiring.nodes:
        raise ValueError(f"node = {node!r}: must be one of {sorted(wiring.nodes)}")
    if inside is None and node == wiring.grid and wiring.closed:
        raise ValueError(f"node = {node!r}: is an ideal voltage; put the fault on a line to it")
    return node, inside, f"node {node}" if line is None else f"position {position or 0.0:g}"


def clear_fault(plant: Network) -> None:
    """Clear the fault, if there is one: at once, or phase by phase as their currents pass zero."""
    clear(plant.records)


def grid_unbalance(
    plant: Network, phases: Sequence[complex], duration: float | None = None
) -> None:
    """Multiply the three phase voltages of the grid; (1, 1, 1) makes them equal again.

    Their positive sequence is (a + b + c) / 3 of what it was, and they have a negative sequence of
    (a + b e^(j 120 deg) + c e^(-j 120 deg)) / 3. A zero sequence finds no path: the converter has
    three wires.

    Args:
        phases: Factors of phases a, b, c: their length is the retained voltage, their angle a jump
            of that phase.
        duration: Time until they are equal again, s; None: until another call.

    Raises:
        ValueError: If a value is out of range, or there is no grid. The plant is then unchanged.
    """
    _needs_grid(plant)
    a, b, c = phases
    for value in phases:
        _require("phases", abs(value), True, "finite")
    if duration is not None:
        _require("duration", duration, duration > 0, "> 0 s")
    turn = complex(-0.5, math.sqrt(0.75))
    positive, negative = (a + b + c) / 3, (a + turn * b + turn.conjugate() * c) / 3
    # of the space vector v = v+ e^(j omega t) + conj(v-) e^(-j omega t)
    plant.now["sequence"] = positive, negative.conjugate()
    # what turns the other way, in a frame that turns with omega_b
    n, g = plant.net[0], _grid_source(plant)
    angle = 2 * math.remainder(float(n["omega_b"] * n["T_s"]) * int(plant.st[0]["tick"]), math.pi)
    unit = plant.now["unit"][0]
    unit[g + 1] = complex(unit[g]).conjugate() * cmath.exp(-1j * angle)
    balanced = a == b == c == 1
    plant.now["unbalance_left"] = 0.0 if balanced else math.inf if duration is None else duration


def phase_jump(plant: Network, degrees: float) -> None:
    """Advance the grid's angle by `degrees`, so that delta falls by as much. Raises ValueError: If
    `degrees` is not finite, or there is no grid."""
    _needs_grid(plant)
    _require("degrees", degrees, True, "finite")
    angle = math.radians(degrees)
    plant.st["x"][:, DELTA] -= angle
    g = _grid_source(plant)
    for place, turn in ((g, angle), (g + 1, -angle)):
        unit = plant.now["unit"][0]
        unit[place] = complex(unit[place]) * cmath.exp(1j * turn)


def grid_impedance(plant: Network, L_g: float, R_g: float) -> None:
    """Set the line to `L_g` and `R_g` times the elements of the converter file.

    The line's current does not jump. In an island the flux of line and load does not jump, so that
    the current may. The ``factors`` of the options are not applied again. Raises ValueError: If L_g
    <= 0 or R_g < 0, or a mode becomes too fast for the DC link. The plant is then unchanged.
    """
    _require("L_g", L_g, L_g > 0, "a factor > 0")
    _require("R_g", R_g, R_g >= 0, "a factor >= 0")
    r, wiring = plant.par[0], plant.wiring
    unit, ratio = wiring.units[0], float(r["current"])
    new_L, new_R = float(L_g * r["L_line_n"]), float(R_g * r["R_line_n"])
    if unit.node == CONNECTION:
        branches = (Branch(LINE, CONNECTION, FAR, new_L, new_R), *wiring.branches[1:])
        plant.rewire(replace(wiring, branches=branches))
        new_L, new_R = unit.L_g + new_L, unit.R_g + new_R
    else:
        changed = replace(unit, L_g=new_L * ratio, R_g=new_R * ratio)
        plant.rewire(replace(wiring, units=(changed, *wiring.units[1:])))
    plant.par["L_g"][0], plant.par["R_g"][0] = new_L, new_R


def breaker(plant: Network, closed: bool, clearing: str = "zero") -> None:
    """Open or close the breaker between the grid and the local load at the far end of the line.

    While it is closed the grid alone sets the load's voltage. When it opens at once, line and load
    are in series, and what current they share follows from the flux that both held:
    (L_g i_o + L_load i_load) / (L_g + L_load). The angle delta stays that to the grid, so closing
    again meets whatever phase has built up.

    Args:
        plant: The plant.
        closed: False opens it.
        clearing: How it opens, see `line_breaker`.

    Raises:
        ValueError: If it opens onto no load, or there is no such clearing.
    """
    if closed == bool(plant.now[0]["closed"]):
        return
    if plant.wiring.grid is None:
        raise ValueError("network.grid: not set; an island has no grid breaker")
    if not closed and not plant.wiring.has_load:
        raise ValueError(
            "plant.grid.load_R, plant.grid.load_L: not set; the breaker opens only onto a load"
        )
    _switch(plant, replace(_without_check(plant, ""), closed=closed), GRID_SOURCE, closed, clearing)
    plant.now["closed"] = closed


def line_breaker(plant: Network, name: str, closed: bool, clearing: str = "zero") -> None:
    """Open or close the breaker of a line or a load.

    Args:
        plant: The plant.
        name: Of the line or load, or of the converter whose line it is.
        closed: False opens it.
        clearing: "zero": each pole opens as soon as its current passes zero; "instant": all poles
            open at once, and the flux that the current shared with others stays in them.
            Resistors and constant powers, which hold no flux, always open at once.

    Raises:
        ValueError: If there is no such breaker or clearing.
    """
    part, *_ = _breaker(plant, name)
    wiring, one = _without_check(plant, name), frozenset({part})
    if (part in wiring.opened) != closed:  # it stays as it is
        plant.rewire(wiring)
        return
    opened = wiring.opened - one if closed else wiring.opened | one
    _switch(plant, replace(wiring, opened=opened), part, closed, clearing)


def _switch(plant: Network, wiring: Wiring, name: str, closed: bool, clearing: str) -> None:
    """Go on with a breaker closed or open in the wiring, or with its poles as they open."""
    _require_clearing(clearing)
    others = tuple(one for one in wiring.opening if one.name != name)
    at_once = name in [s.name for s in wiring.shunts] + [s.name for s in wiring.sinks]
    if closed or clearing == "instant" or at_once:
        plant.rewire(replace(wiring, opening=others))
        return
    fault = wiring.fault if plant.conducting().get("", ("", 0))[0] else None
    plant.rewire(replace(wiring, fault=fault, opening=(*others, OpeningBreaker(name=name))))
    if fault is None:
        plant.now["fault_left"] = math.inf


def _require_clearing(clearing: str) -> None:
    if clearing not in CLEARINGS:
        raise ValueError(f"clearing = {clearing!r}: must be one of {list(CLEARINGS)}")


def check_synchronism(
    plant: Network, name: str, V: float, omega: float, degrees: float, lasting: float, within: float
) -> None:
    """Let a synchro-check close an open breaker: as soon as its two sides have agreed for a time.

    What is closed already stays closed, without a check. To switch the breaker in another way ends
    its check. The plant says in ``now["check"]`` when the time has come, and `finish_check` then
    acts.

    Args:
        plant: The plant.
        name: Of a line or a machine, or of the converter whose line it is; "": the grid's breaker.
        V: Largest difference of the voltages, p.u., >= 0.
        omega: Of the speeds, p.u., >= 0.
        degrees: Of the angles, >= 0.
        lasting: For how long all three must be within, s.
        within: After this time the breaker stays open, s.

    Raises:
        ValueError: If there is no such breaker with two sides, a value is out of range, or another
            check is not over yet. The plant is then unchanged.
    """
    wiring = plant.wiring
    if name:
        part, *sides = _breaker(plant, name)
        opened = part in wiring.opened
    elif wiring.grid is None:
        raise ValueError("network.grid: not set; an island has no grid breaker")
    else:
        sides, opened = [wiring.grid, GRID_SOURCE], not wiring.closed
    if GROUND in sides:
        raise ValueError(f"name = {name!r}: a load has one side; a check is for what has two")
    for what, value in (("V", V), ("omega", omega), ("degrees", degrees), ("lasting", lasting)):
        _require(what, value, value >= 0, ">= 0")
    _require("within", within, within > lasting, f"> {lasting:g} s, for which it must last")
    if not opened:
        return
    if wiring.check is not None:
        other = wiring.check.name or "the grid's breaker"
        raise ValueError(f"check: that of {other} is not over yet; there can be one at a time")
    plant.connect(replace(wiring, check=Check(name, (sides[0], sides[1]))))
    plant.net["check_limits"] = V, omega * wiring.omega_b, math.radians(degrees)
    plant.net["check_lasting"] = lasting
    now = plant.now
    now["check"], now["check_looks"], now["check_lasted"] = WATCHING, 0, 0.0
    now["check_seen"], now["check_left"] = 0.0, within


@dataclass(frozen=True)
class SynchroCheckResult:
    """How a synchro-check ended."""

    name: str  # of the breaker; "" for that of the grid
    closed: bool  # whether it has closed
    # V, omega, degrees: the differences by then, of the first side to the second: p.u. and degrees
    V: float
    omega: float
    degrees: float


def finish_check(plant: Network) -> SynchroCheckResult | None:
    """Close the breaker whose synchro-check has agreed, or end a check whose time is over; None if
    there is nothing to do."""
    state, check = int(plant.now[0]["check"]), plant.wiring.check
    if check is None or state in (NONE, WATCHING):
        return None
    V, speed, angle = (float(x) for x in plant.now[0]["check_seen"])
    if state == TIME_OVER:
        plant.wiring = _without_check(plant, check.name)
    elif check.name:
        line_breaker(plant, check.name, True)
    else:
        breaker(plant, True)
    differences = V, speed / plant.wiring.omega_b, math.degrees(angle)
    return SynchroCheckResult(check.name, state != TIME_OVER, *differences)


def _breaker(plant: Network, name: str) -> tuple[str, str, str]:
    """The branch or shunt that a breaker opens, and the nodes at its ends. Raises ValueError: If
    there is no such breaker."""
    breakers = plant.wiring.breakers()
    if name not in breakers:
        raise ValueError(f"name = {name!r}: must be one of {sorted(breakers)}")
    return breakers[name]


def _without_check(plant: Network, name: str) -> Wiring:
    """The wiring without the synchro-check of a breaker, which is thereby over."""
    check = plant.wiring.check
    if check is None or check.name != name:
        return plant.wiring
    plant.now["check"] = NONE
    return replace(plant.wiring, check=None)


def take_out(plant: Network) -> None:
    """Make the circuits for the next trip, after one of several converters has tripped."""
    row = int(plant.now[0]["row"])
    if row == 0 or not plant.net[0]["joins"]:
        return
    out = plant.wiring.blocked | {row - 1}
    plant.now["row"] = 0
    plant.rewire(replace(plant.wiring, blocked=out))


def start_again(plant: Network, k: int) -> None:
    """Start the bridge of a converter of a network that has tripped, on the voltage of its
    capacitor.

    Its protection's trip is cleared. The others go on.

    Args:
        plant: a network, after `take_out`.
        k: index of the converter, whose `protection.start_condition` is MAY_START.
    """
    plant.rewire(replace(plant.wiring, blocked=plant.wiring.blocked - {k}))
    synchronise(plant.records, k)


def _needs_grid(plant: Network) -> None:
    if plant.wiring.grid is None and THE_GRID not in plant.elsewhere:
        raise ValueError("network.grid: not set; an island has no grid whose voltage could change")


def _grid_source(plant: Network) -> int:
    """Place of the grid's positive sequence among the sources; the negative one follows."""
    return len(plant.par)


def _rate(rate: float | None) -> float:
    if rate is None:
        return math.inf
    _require("rate", rate, rate > 0, "> 0 p.u./s")
    return rate


def _require(name: str, value: float, holds: bool, allowed: str) -> None:
    if not (holds and math.isfinite(value)):
        raise ValueError(f"{name} = {value}: must be {allowed}")
