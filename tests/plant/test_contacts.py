"""Poles that open while a fault stands or is cleared, or other poles open, against three phases."""

import cmath
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import null_space

from gfm_plant import NetworkParts, Plant, fault, make_network, plant_command, plant_step
from gfm_plant.contacts import join
from gfm_plant.grid import line_breaker
from gfm_plant.model import DELTA, V_DC
from gfm_plant.wiring import FaultPlace, OpeningBreaker

from .test_unbalanced_fault import NO_TRIP, STIFF, W, phases, vector

T_S, END, E, DELTA_0 = 1e-4, 0.05, 1.03, 0.3
LINES = {"first": ("bus", "hub", 0.2, 0.03), "second": ("bus", "hub", 0.1, 0.015)}
"""Of one X/R, so that one impedance for the zero sequence of a fault alone is exact."""
LOAD = 0.5 + 0.15j
BRANCHES = ["i_f", "i_o", "near", "beyond", "second", "tie", "load"]


def network(scr: float, **more: Any) -> Any:
    """Two lines from a converter with a load to a hub, and from there one to the grid."""
    options = Plant.model_validate({"protection": NO_TRIP, "dc_source": STIFF, **more})
    lines = {n: dict(zip(("start", "end", "L", "R"), v, strict=True)) for n, v in LINES.items()}
    lines["tie"] = {"start": "hub", "end": "far", "L": 1 / scr, "R": 0.1 / scr}
    loads = {"load": {"node": "bus", "P": LOAD.real, "Q": LOAD.imag}}
    parts = NetworkParts.model_validate({"grid": "far", "lines": lines, "loads": loads})
    plant = make_network({"a": (options, "bus")}, T_S, Plant().grid, parts)
    x, u = np.zeros((1, 8)), np.array([[0.0, 1.0, E, 0.0]])
    x[0, DELTA], x[0, V_DC] = DELTA_0, 1.0
    modes, _ = plant.wiring.modes(frozenset(), None)
    unit = cmath.exp(1j * DELTA_0)
    w = modes.states @ (modes.drive @ [E * unit, 1.0] / -modes.rates)
    x[0, 0:6:2], x[0, 1:6:2] = (w[:3] / unit).real, (w[:3] / unit).imag
    u[0, 0] = E * x[0, 0]
    plant.start(x, u)
    return plant, u[0]


class ThreePhases:
    """The same network phase by phase: L i' = -R i + e + C' (what keeps C i at zero)."""

    def __init__(self, plant: Any, scr: float) -> None:
        r, half, Z = plant.par[0], [x / 2 for x in LINES["first"][2:]], 1 / LOAD.conjugate()
        each = [(r["L_f"], r["R_f"]), (r["L_g"], r["R_g"]), half, half, LINES["second"][2:],
                (1 / scr, 0.1 / scr), (Z.imag, Z.real)]  # fmt: skip
        self.L, self.R = (np.repeat([z[k] for z in each], 3).astype(float) for k in (0, 1))
        self.C_f, self.omega_b = r["C_f"], r["omega_b"]
        self.kind, self.R_fault, self.faulted, self.shorted = "", 0.0, False, []
        self.poles: dict[str, list[int]] = {}

    def row(self, p: int, **factors: float) -> NDArray[np.float64]:
        found = np.zeros(3 * len(BRANCHES))
        for name, factor in factors.items():
            found[3 * BRANCHES.index(name) + p] = factor
        return found

    def current(self, what: str, p: int) -> NDArray[np.float64]:
        """That of a phase of a pole or, as "fault", of the fault, by the branches."""
        if what != "fault":
            return self.row(p, **{what: 1.0})
        two = self.kind == "LL" and p in self.shorted
        if two and p == self.shorted[1]:
            return -self.current("fault", self.shorted[0])
        return self.row(p, near=1.0, beyond=-1.0)

    def close(self) -> None:
        """Find the equations of the present contacts."""
        three = [sum(self.row(p, **{n: 1.0}) for p in range(3)) for n in ("i_f", "i_o", "load")]
        rows = [np.array(three)]
        for p in range(3):
            bus, hub = {"i_o": 1, "near": -1, "second": -1, "load": -1}, {"beyond": 1, "second": 1}
            rows += [self.row(p, **bus)[None], self.row(p, **hub, tie=-1)[None]]
            through = self.row(p, near=1.0, beyond=-1.0)[None]
            rows += [] if p in self.shorted else [through]
            rows += [self.row(p, **{n: 1.0})[None] for n, on in self.poles.items() if p not in on]
        R = np.diag(self.R)
        if self.kind == "LL" and self.shorted:
            one, two = (self.row(p, near=1.0, beyond=-1.0) for p in self.shorted)
            rows.append((one + two)[None])
            R = R + self.R_fault * np.outer(one - two, one - two) / 4
        else:
            for p in self.shorted:
                through = self.row(p, near=1.0, beyond=-1.0)
                R = R + self.R_fault * np.outer(through, through)
        K = null_space(np.vstack(rows))
        self.free = K @ np.linalg.solve(K.T @ (self.L[:, None] * K), K.T)
        self.by_i = -self.free @ R

    def slope(self, t: float, s: Any) -> Any:
        i, v = s[:-3], s[-3:]
        e = np.zeros(len(i))
        turn = cmath.exp(1j * W * t)
        e[:3], e[3:6] = phases(E * cmath.exp(1j * DELTA_0) * turn) - v, v
        e[15:18] = -phases(turn)
        charge = (np.eye(3) - 1 / 3) @ (i[:3] - i[3:6]) / self.C_f
        return self.omega_b * np.concatenate([self.by_i @ i + self.free @ e, charge])

    def run(self, s: Any, t: float, end: float) -> tuple[Any, list[tuple[str, int, float]]]:
        """Go on to ``end``; with what opened, its phase, and when."""
        opened = []
        while True:
            self.close()
            live = [(n, p) for n, on in self.poles.items() for p in on]
            live += [("fault", p) for p in self.shorted if not self.faulted]
            dead = [x for x in live if np.abs(self.current(*x) @ self.free).max() < 1e-9]
            events = [lambda t, s, x=x: self.current(*x) @ s[:-3] for x in live]
            for event in events:
                event.terminal = True
            if not dead:
                tight = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
                part = solve_ivp(self.slope, (t, end), s, events=events, **tight)
                t, s = part.t[-1], part.y[:, -1]
                dead = [x for x, at in zip(live, part.t_events, strict=True) if len(at)]
                if not dead:
                    return s, opened
            for what, p in dead:
                (self.shorted if what == "fault" else self.poles[what]).remove(p)
                opened.append((what, p, t))


def both(scr: float, doings: list[tuple[int, Any]]) -> Any:
    """The states w of plant and model after doings at ticks, and what opened in both and when."""
    plant, u = network(scr)
    model = ThreePhases(plant, scr)
    w = dict(zip(plant.wiring.order, plant.now["w"][0], strict=False))
    start = [w[n] for n in ("a.i_f", "a.i_o", "first", "first", "second", "tie", "load", "a.v")]
    s, t, exact, seen, before = np.concatenate([phases(x) for x in start]), 0.0, [], [], {}
    for at, do in [*doings, (round(END / T_S), None)]:
        s, opened = model.run(s, t, at * T_S)
        exact, t = exact + opened, at * T_S
        while plant.st["tick"][0] < at:
            plant_command(plant.records, 0, u)
            plant_step(plant.records)
            now = {n: list(one) for n, (one, _) in plant.conducting().items()}
            for part in before:
                gone = set(before[part]) - set(now.get(part, ""))
                seen += [(part, "abc".index(p), int(plant.st["tick"][0])) for p in gone]
            before = now
        if do is not None:
            do(plant, model)
            before = {n: list(one) for n, (one, _) in plant.conducting().items()}
    found = dict(zip(plant.wiring.order, plant.now["w"][0], strict=False))
    names = [("a.i_f", "i_f"), ("a.i_o", "i_o"), ("second", "second"), ("tie", "tie")]
    back, states = cmath.exp(-1j * W * END), s.reshape(-1, 3)
    ours = [found["a.v"]] + [found[n] for n, _ in names]
    theirs = [vector(states[-1]) * back]
    theirs += [vector(states[BRANCHES.index(n)]) * back for _, n in names]
    place = {"fault": "", "near": "first", "tie": "tie"}
    order = [(place.get(n, n), p, math.ceil(at / T_S - 1e-9)) for n, p, at in exact]
    return np.array(ours), np.array(theirs), sorted(seen, key=str), sorted(order, key=str), exact


def short(kind: str, which: str, R: float, line: str = "first") -> Any:
    def do(plant: Any, model: ThreePhases) -> None:
        fault(plant, 0.5, R, line=line, kind=kind, phases=which)
        model.kind, model.R_fault, model.shorted = kind, R, ["abc".index(p) for p in which]
        model.faulted = True

    return do


def clear(plant: Any, model: ThreePhases) -> None:
    from gfm_plant import clear_fault

    clear_fault(plant)
    model.faulted = False


def opens(name: str, *parts: str) -> Any:
    def do(plant: Any, model: ThreePhases) -> None:
        line_breaker(plant, name, closed=False)
        model.poles |= {part: [0, 1, 2] for part in parts}

    return do


@pytest.mark.parametrize("scr", [3.0, 10.0])
@pytest.mark.parametrize(
    ("kind", "which", "R"),
    [("3ph", "abc", 0.0), ("3ph", "abc", 0.05), ("LLG", "bc", 0.0), ("LG", "a", 0.02),
     ("LL", "ca", 0.01)],
)  # fmt: skip
def test_both_ends_of_a_line_open_to_clear_its_fault(scr, kind, which, R):
    ours, exact, seen, order, each = both(
        scr, [(13, short(kind, which, R)), (63, opens("first", "near", "beyond"))]
    )
    assert len(each) == 6
    assert seen == order
    assert ours == pytest.approx(exact, abs=1e-7)


def test_two_breakers_open_in_one_half_period(monkeypatch):
    # of another X/R: with one and the same no current would be left around both lines
    monkeypatch.setitem(LINES, "second", ("bus", "hub", 0.1, 0.01))
    ours, exact, seen, order, each = both(
        10.0, [(7, opens("first", "near")), (22, opens("tie", "tie"))]
    )
    assert len(each) == 6 and each[-1][2] - each[1][2] < 0.02
    assert seen == order
    assert ours == pytest.approx(exact, abs=1e-7)


@pytest.mark.parametrize(("kind", "which"), [("3ph", "abc"), ("LLG", "ab"), ("LG", "c")])
def test_a_fault_is_cleared_while_a_breaker_opens(kind, which):
    ours, exact, _, _, each = both(
        3.0, [(5, short(kind, which, 0.01)), (100, opens("second", "second")), (110, clear)]
    )
    assert {what for what, *_ in each} == {"second", "fault"}
    assert ours == pytest.approx(exact, abs=1e-7)


@pytest.mark.parametrize(
    ("more", "place"),
    [({}, "beyond"), ({"Z_0": 0.02 + 0.3j}, "beyond"), ({"Z_0": 0.1 + 0j}, "beyond"),
     ({"Z_0": 0j}, "beyond"), ({}, "hub"), ({}, "a.terminal")],
)  # fmt: skip
@pytest.mark.parametrize(
    ("kind", "which"), [("3ph", "abc"), ("LG", "b"), ("LL", "ca"), ("LLG", "bc")]
)
def test_closed_contacts_have_the_modes_of_their_axes(kind, which, more, place):
    """With one path of the zero sequence, whose impedance an axis has in series."""
    plant, _ = network(3.0)
    inside = place == "beyond"
    if kind in ("3ph", "LL"):
        more = {}
    one = FaultPlace(kind=kind, phases=which, R=0.1, node="bus" if inside else place,
                     branch="tie" if inside else None, position=0.5, **more)  # fmt: skip
    wiring = replace(plant.wiring, fault=one, opened=frozenset({"second"}))
    modes, _ = wiring.modes(frozenset(), wiring.contacts[1])
    wiring = replace(
        wiring, opened=wiring.opened | {"load"}, opening=(OpeningBreaker(name="load"),)
    )
    joint, of = join(wiring), sum(1 << "abc".index(p) for p in which)
    bars = joint.fault_bars[of]
    K = null_space(bars) if np.abs(bars).max() > 1e-9 else np.eye(bars.shape[1])
    found = np.linalg.eigvals(K.T @ joint.flow[of] @ K)
    for rate in modes.rates + 1j * wiring.omega_b:
        assert np.abs(found - rate).min() < 1e-6 * max(1.0, abs(rate))


@pytest.mark.full
def test_the_series_of_a_switched_bridge_has_the_equations_of_the_modes():
    plant, _ = network(3.0, bridge={"kind": "two-level"})
    short("LG", "b", 0.02)(plant, ThreePhases(plant, 3.0))
    line_breaker(plant, "first", closed=False)
    n, c = plant.net[0], int(plant.net[0]["n_c"]) - 1
    size, n_w, n_s = int(n["n_modes"][c]), int(n["n_states"]), int(plant.now[0]["n_s"])
    rate, states = n["rate"][c, :size] + 1j * n["omega_b"], n["states"][c, :n_w, :size]
    modes, drive = n["modes"][c, :, :size, :n_w], n["drive"][c, :, :size]
    chance = np.random.default_rng(1)
    w, s = (chance.normal(size=(k, 2)) @ [1, 1j] for k in (n_w, n_s))
    s[0] = 0.0  # the bridge's voltage drives i_f alone
    z = modes[0] @ w + modes[1] @ w.conj()
    w = states @ z  # what the circuit can hold
    exact = states @ (rate * z + drive[0] @ s + drive[1] @ s.conj())
    found = np.zeros(n_w, complex)
    for row, column, j in ((1, 0, 0), (1, 1, 1), (1, 2, 2), (2, 1, 3), (2, 2, 4)):
        a, b = n["own_rates"][c, 0, :, j]
        found[row] += complex(a * w[column].real, b * w[column].imag)
    for which, x in enumerate((w, s)):
        for e in range(int(n["n_links"][c, which])):
            (row, column), (aa, bb, ab, ba) = n["link_place"][c, which, e], n["link"][c, which, e]
            re, im = x[column].real, x[column].imag
            found[row] += complex(aa * re + ab * im, bb * im + ba * re)
    assert found[1:] == pytest.approx(exact[1:], rel=1e-9, abs=1e-6)
