"""The switched bridge: against DOP853 with the same edges, against closed forms, against the
averaged bridge, and what it refuses."""

import cmath
import itertools
import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from gfm_plant import (
    Plant,
    fault,
    make_network,
    make_plant,
    phase_jump,
    plant_advance,
    plant_equilibrium,
    plant_step,
)
from gfm_plant.bridge import modulate
from gfm_plant.circuit import (
    Branch,
    Capacitor,
    Circuit,
    Shunt,
    VoltageSource,
    find_modes,
    find_rates,
)
from gfm_plant.components import NetworkParts
from gfm_plant.model import V_DC
from gfm_plant.options import Grid
from gfm_plant.period import advance
from gfm_plant.protection import trip

from ..support.switched import Reference

T_S = 1e-4
Z_B = 380**2 / 4000
DROPS = {"V_switch": 1.5, "V_diode": 1.2, "R_switch": 0.03, "R_diode": 0.02}
CASES = {
    "ideal": ({}, {}),
    "twice": ({"updates": 2}, {"updates": 2}),
    "20 kHz": ({"carrier_hz": 20e3}, {"carriers": 2, "counts": 5000}),
    "dead time": ({"dead_time_s": 2e-6}, {"dead": 2e-6}),
    "drops": (
        {"dead_time_s": 2e-6, "carrier_hz": 20e3, "updates": 2, **DROPS},
        {"dead": 2e-6, "carriers": 2, "updates": 2, "counts": 5000,
         "drops": (1.5 / 700, 1.2 / 700, 0.03 / Z_B, 0.02 / Z_B)},
    ),
}  # fmt: skip


def switched(bridge=None, P=0.5, **options):
    """A plant with a switched bridge in its equilibrium; its u of four."""
    options = {"dc_source": {"mode": "regulated"}, **options}
    options["bridge"] = {"kind": "two-level", **(bridge or {})}
    plant = make_plant(Plant.model_validate(options), T_S)
    x, u = plant_equilibrium(plant.par, P, 1.0)
    plant.start(x, u)
    return plant, x, np.append(u, 0.0)


def error(periods, bridge, changes, before=0):
    """The largest error of all states at ticks against DOP853, and zeros of currents on the way."""
    plant, x, u = switched(bridge)
    turn, omega_b = cmath.exp(1j * x[6]), plant.par[0]["omega_b"]

    def states(tick):
        w = plant.now["w"][0, :3] * cmath.exp(1j * omega_b * tick * T_S)
        return np.array([*w, plant.st[0]["x"][V_DC], plant.st[0]["i_reg"]])

    for _ in range(before):
        plant_advance(plant.records, u)
    reference = Reference(plant.par[0], states(before), tick=before, **changes)
    worst = 0.0
    for k in range(before, before + periods):
        plant_advance(plant.records, u)
        reference.period(u[2] * turn * cmath.exp(1j * omega_b * u[1] * k * T_S), u)
        worst = max(worst, np.abs(states(k + 1) - reference.z).max())
    return worst, reference.zeros


@pytest.mark.parametrize("name", CASES)
def test_a_period_is_exact(name):
    worst, zeros = error(12, *CASES[name])
    assert worst < 1e-12
    assert (zeros > 0) == ("dead" in CASES[name][1])


@pytest.mark.parametrize("name", ["ideal", "twice", "20 kHz", "dead time"])
def test_a_period_by_strides_is_exact(name):
    """After a while the plant has matrices for whole counts of the timer."""
    worst, zeros = error(40, *CASES[name], before=1000)
    assert worst < 1e-12
    assert (zeros > 0) == ("dead" in CASES[name][1])


@pytest.mark.full
def test_half_a_cycle_is_exact():
    """The other half is this with the other sign."""
    worst, _ = error(100, *CASES["drops"])
    assert worst < 2e-12


def test_rates_and_modes_are_of_one_circuit():
    """A = X diag(lambda + j omega_b) X^-1, with a node where branches alone meet."""
    omega_b, order = 100 * math.pi, ("i_f", "v", "i_o", "i_l", "i_g")
    branches = (
        Branch("i_f", "bridge", "terminal", 0.02, 0.002),
        Branch("i_o", "terminal", "bus", 0.1, 0.01),
        Branch("i_l", "bus", "ground", 0.3, 0.9),
        Branch("i_g", "bus", "far", 0.2, 0.02),
    )
    sources = VoltageSource("bridge", "bridge"), VoltageSource("grid", "far")
    whole = Circuit(
        branches, (Capacitor("v", "terminal", 0.2),), sources, (Shunt("r", "terminal", 5.0),)
    )
    modes, rates = find_modes(whole, omega_b, order), find_rates(whole, omega_b, order)
    by_modes = modes.states @ np.diag(modes.rates + 1j * omega_b) @ modes.modes
    assert np.abs(by_modes - rates.by_w).max() < 1e-9 * rates.fastest
    assert np.abs(modes.states @ modes.drive - rates.by_s).max() < 1e-9 * rates.fastest


class Inside:
    """A plant that is driven through its periods in steps, so that what is between two ticks can be
    seen; its command acts without delay."""

    def __init__(self, plant, u, steps):
        self.plant, self.u, self.steps = plant, u, steps

    def period(self, seen):
        """Go on by a period; ``seen(plant, t)`` is called after each step, t from its beginning."""
        st, step = self.plant.st, T_S / self.steps
        st["u"][0, 0, : len(self.u)] = self.u
        for k in range(self.steps):
            advance(self.plant.records, k * step, (k + 1) * step)
            seen(self.plant, (k + 1) * step)
        st["tick"] += 1


STIFF = {"L_f": 10.0, "C_f": 0.05, "R_f": 10.0}  # little ripple, and soon at rest


def settled(bridge=None, P=0.8, factors=None, periods=4000, **options):
    """A plant under constant commands after a while."""
    options["protection"] = {"under_voltage": {"enabled": False}}
    plant, x, u = switched(bridge, P, factors=factors or {}, **options)
    for _ in range(periods):
        plant_advance(plant.records, u)
    return plant, x, u


def test_the_ripple_of_space_vector_modulation():
    """Where the command lies on a phase's axis in the middle of a period only one active vector is
    in use, for m T of it, and takes the phase's current up and down by V (1 - m) m T / 2 L, with V
    = 2/3 V_dc and m V the voltage."""
    plant, _, u = settled(factors={"L_f": 3.0, "C_f": 5.0}, periods=1000, P=0.0)
    r, st = plant.par[0], plant.st[0]

    def stands(t=0.0):
        return cmath.exp(1j * r["omega_b"] * (T_S * st["tick"] + t))

    while abs(cmath.phase(plant.now["unit"][0, 0] * stands(T_S / 2))) > 0.016:
        plant_advance(plant.records, u)
    before = (plant.now["w"][0, 0] * stands()).real
    currents, m = [], u[2] / (r["leg"] * st["x"][V_DC])
    Inside(plant, u, 400).period(
        lambda plant, t: currents.append((plant.now["w"][0, 0] * stands(t)).real)
    )
    fundamental = before + (currents[-1] - before) * np.arange(1, 401) / 400
    expected = r["omega_b"] / r["L_f"] * r["leg"] * (1 - m) * m * T_S / 2
    assert np.ptp(currents - fundamental) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("dead", [1e-6, 2e-6])
def test_dead_time_takes_a_square_wave_from_the_voltage(dead):
    """V_dc t_d f_s against the current of each leg, so 4/pi of it in the fundamental."""
    gives = []
    for time in (0.0, dead):  # what a tick sees of the capacitor's ripple is in both
        plant, _, u = settled({"dead_time_s": time}, factors=STIFF, periods=1500)
        r, rows = plant.par[0], []
        for _ in range(200):
            plant_advance(plant.records, u)
            rows.append(plant.st["x"][0].copy())
        x = np.mean(rows, axis=0)
        i, v = complex(x[0], x[1]), complex(x[2], x[3])
        gives.append(v + complex(r["R_f"], r["L_f"]) * i)
    lost = (gives[0] - gives[1]) * i.conjugate() / abs(i)  # along the current
    expected = 4 / math.pi * 1.5 * r["leg"] * x[V_DC] * dead / T_S
    assert lost.real == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("P", [0.8, -0.5])
def test_the_current_of_the_dc_capacitor(P):
    """Kolar and Round 2006, Eq. (1): I sqrt(2M (sqrt(3)/4pi + cos(phi)^2 (sqrt(3)/pi - 9M/16)))."""
    plant, _, u = settled(P=P, factors={**STIFF, "C_dc": 10.0}, periods=1000)
    drawn, rows, inside = [], [], Inside(plant, u, 97)

    def see(plant, t):
        s = plant.st[0]
        i = plant.now["w"][0, 0] * cmath.exp(1j * plant.par[0]["omega_b"] * (T_S * s["tick"] + t))
        drawn.append((s["by_dc"].conjugate() * i).real)

    for _ in range(200):
        inside.period(see)
        turn = plant.now["unit"][0, 0]
        rows.append([plant.now["w"][0, 0] / turn, plant.st[0]["x"][V_DC]])
    i, v_dc = np.mean(rows, axis=0)
    M = u[2] / (0.75 * plant.par[0]["leg"] * v_dc.real)  # of V_dc / 2
    cos = i.real / abs(i)
    # p.u. of a current on the DC side: S_n / V_dcref; on the AC side S_n / (sqrt(3) V_n)
    current = abs(i) * 700 / (math.sqrt(3) * 380)
    form = 2 * M * (math.sqrt(3) / (4 * math.pi) + cos**2 * (math.sqrt(3) / math.pi - 9 * M / 16))
    assert np.std(drawn) == pytest.approx(current * math.sqrt(form), rel=0.02)


@pytest.mark.parametrize(("E", "gives"), [(1.2, 1.2), (1e3, 2 / math.pi * 1.5 * 1.5040727)])
def test_what_v_dc_cannot_give_ends_in_six_steps(E, gives):
    """The fundamental of six steps is 2/pi V_dc; below the linear limit it is the command."""
    plant, _, _ = switched()
    turns = np.exp(2j * np.pi * (np.arange(3600) + 0.5) / 3600)
    counts = np.array([modulate(plant.par[0], plant.st[0], complex(E * t), 1.0) for t in turns])
    axes = np.exp(2j * np.pi / 3 * np.arange(3))
    mean = plant.par[0]["leg"] * (counts / plant.par[0]["counts"]) @ axes
    assert (mean / turns).mean() == pytest.approx(gives, rel=1e-3)
    assert (E < 2) == (len(np.unique(counts)) > 100)


def test_pulses_are_at_least_as_long_as_they_must_be():
    """2 us are 200 counts in half a carrier; shorter ones become that, or nothing."""
    plant, _, _ = switched({"min_pulse_s": 2e-6})
    turns = np.exp(2j * np.pi * (np.arange(3600) + 0.5) / 3600)
    counts = np.array([modulate(plant.par[0], plant.st[0], 1.29 * t, 1.0) for t in turns])
    on = np.unique(counts)
    assert not np.any((on > 0) & (on < 200)) and not np.any((on > 9800) & (on < 10_000))
    assert {200, 9800} <= set(on)


def test_a_blocked_bridge_is_a_rectifier():
    """Its diodes charge C_dc to the peak of the line voltage, and then nothing flows."""
    plant, _, u = switched({"V_diode": 1.0})
    plant.st["x"][0, V_DC] = 0.6
    plant.par["trip_ticks"] = -1
    trip(plant.records, 0, 1, 0.0)
    currents, v_dc = [], []
    for _ in range(6000):
        plant_advance(plant.records, u)
        currents.append(abs(plant.now["w"][0, 0]))
        v_dc.append(plant.st[0]["x"][V_DC])
    peak = math.sqrt(2) * 380 * np.hypot(*plant.st["x"][0, 2:4]) / 700
    assert max(currents) > 1.0
    assert np.all(np.diff(v_dc) >= -1e-15)
    assert v_dc[-1] == pytest.approx(peak - 2 / 700, rel=2e-3) or v_dc[-1] > peak - 2 / 700
    assert max(currents[-400:]) < 0.02


def test_each_of_several_bridges_is_as_it_is_alone():
    """On an ideal grid nothing passes between them; the network's series is not that of one."""
    options = [
        Plant.model_validate(
            {"bridge": {"kind": "two-level", "dead_time_s": dead, **DROPS}, "dc_source": source}
        )
        for dead, source in ((1e-6, {"mode": "regulated"}), (2e-6, {"i_max": 0.7}))
    ]
    names = {f"c{k}": (one, "bus") for k, one in enumerate(options)}
    both = make_network(names, T_S, Grid(), NetworkParts(grid="bus"))
    alone = [make_plant(one, T_S) for one in options]
    starts = [plant_equilibrium(one.par, P, 1.0) for one, P in zip(alone, (0.6, 0.2), strict=True)]
    for one, (x, u) in zip(alone, starts, strict=True):
        one.start(x, u)
    both.start(*(np.array(each) for each in zip(*starts, strict=True)))
    for _ in range(40):
        plant_step(both.records)
        for one in alone:
            plant_step(one.records)
    for k, one in enumerate(alone):
        assert np.abs(both.st["x"][k] - one.st["x"][0]).max() < 1e-12


def halves(plant, u, periods):
    """A t-type bridge of ideal switches by DOP853, phase by phase with both halves of C_dc, with
    the plant's edges: the largest error of all states at ticks."""
    r, st, now = plant.par[0], plant.st, plant.now
    axes, w = np.exp(2j * np.pi / 3 * np.arange(3)), float(r["omega_b"])
    per_v = math.sqrt(2 / 3) * 700 / 380

    def states():
        at = np.exp(1j * w * T_S * st["tick"][0])
        v_dc, mid = st[0]["x"][V_DC], st[0]["mid"]
        return np.array([*now["w"][0, :3] * at, (v_dc - mid) / 2, (v_dc + mid) / 2])

    def slope(t, z, levels, begin):
        i, v, i_o, low, high = z
        legs = np.array([0.0, low.real, low.real + high.real])[levels]
        i_x = (i * axes.conj()).real
        upper, middle = per_v * i_x[levels == 2].sum(), per_v * i_x[levels == 1].sum()
        return np.array([
            w / r["L_f"] * (per_v * legs @ axes - v - r["R_f"] * i),
            w / r["C_f"] * (i - i_o),
            w / r["L_g"] * (v - np.exp(1j * w * (begin + t)) - r["R_g"] * i_o),
            w / (2 * r["C_dc"]) * (u[0] - upper - middle),
            w / (2 * r["C_dc"]) * (u[0] - upper),
        ])  # fmt: skip

    z, worst = states(), 0.0
    for k in range(periods):
        plant_step(plant.records)
        edges, base = st[0]["edges"], st[0]["base"]
        times = np.unique([0.0, T_S, *edges[(edges > 0) & (edges < T_S)]])
        for a, b in itertools.pairwise(times):
            middle = (a + b) / 2
            levels = base + ((middle < edges[:, 0]) | (middle > edges[:, 1]))
            more = {"args": (levels, k * T_S), "rtol": 1e-13, "atol": 1e-15}
            z = solve_ivp(slope, (a, b), z, "DOP853", **more).y[:, -1]
        worst = max(worst, np.abs(states() - z).max())
    return worst


def test_three_levels_are_exact_and_both_halves_of_the_dc_link_stay_equal():
    plant, _, u = switched({"kind": "t-type"}, P=0.6, dc_source={"mode": "controlled"})
    plant.st["mid"] = 0.1
    assert halves(plant, u, 12) < 1e-11
    for _ in range(1500):
        plant_advance(plant.records, u)
    assert abs(plant.st[0]["mid"]) < 5e-3


@pytest.mark.parametrize(("kind", "levels"), [("two-level", 3), ("t-type", 5)])
def test_levels_of_the_voltages_between_phases(kind, levels):
    plant, _, u = switched({"kind": kind})
    seen, line = set(), np.exp(2j * np.pi / 3) - 1

    def see(plant, t):
        e = complex(plant.st[0]["by_dc"]) / (1.5 * plant.par[0]["leg"])
        seen.add(round((e * line.conjugate()).real, 6) + 0.0)

    inside = Inside(plant, u, 50)
    for _ in range(200):
        inside.period(see)
    assert seen == set(np.linspace(-1, 1, levels))


@pytest.mark.parametrize("kind", ["two-level", "t-type"])
def test_the_hardware_blocks_pulses_at_its_limit(kind):
    """No phase current passes i_peak after a jump of the grid's angle that would ask for more."""
    largest = {}
    for i_peak in (None, 1.5):
        off = {name: {"enabled": False} for name in ("over_current", "under_voltage")}
        plant, _, u = switched({"kind": kind, "dead_time_s": 1e-6}, i_peak=i_peak, protection=off)
        phase_jump(plant, -25.0)
        inside, currents = Inside(plant, u, 20), []

        def see(plant, t, currents=currents):
            i = plant.now["w"][0, 0] * np.exp(1j * plant.par[0]["omega_b"] * (
                T_S * plant.st[0]["tick"] + t))  # fmt: skip
            currents.append(np.abs((i * np.exp(-2j * np.pi / 3 * np.arange(3))).real).max())

        for _ in range(300):
            inside.period(see)
        largest[i_peak] = max(currents)
    assert largest[None] > 2.0
    assert 1.49 < largest[1.5] < 1.5 + 1e-9  # it is reached between two looks


@pytest.mark.parametrize("kind", ["3ph", "LG", "LLG"])
def test_a_fault_is_another_matrix(kind):
    """A switched bridge in a fault that is cleared phase by phase, beside an averaged one."""
    rows = []
    for bridge in ({}, {"kind": "two-level"}):
        off = {name: {"enabled": False} for name in ("over_current", "under_voltage")}
        options = {"dc_source": {"mode": "regulated"}, "grid": {"scr": 3.0, "x_over_r": 6.0}}
        plant = make_plant(
            Plant.model_validate({**options, "bridge": bridge, "protection": off}), T_S
        )
        x, u = plant_equilibrium(plant.par, 0.5, 1.0)
        plant.start(x, u)
        seen = []
        for k in range(600):
            if k == 100:
                fault(plant, 0.3, 0.02, 0.015, kind=kind, Z_0=None if kind == "3ph" else 0.3j)
            plant_advance(plant.records, u)
            seen.append(plant.st["x"][0, 2:6].copy())
        rows.append(seen)
    difference = np.abs(np.subtract(*rows))
    assert np.ptp(rows[0], axis=0).max() > 1.0
    assert difference.max() < 0.05


@pytest.mark.parametrize(
    ("bridge", "more", "words"),
    [
        ({"carrier_hz": 15e3}, {}, "carrier_hz = 15000: must be 10000 or 20000 Hz"),
        ({"dead_time_s": 6e-5}, {}, "dead_time_s = 6e-05: must be less than 5e-05 s, half a"),
        ({"min_pulse_s": 2e-4}, {}, "min_pulse_s = 0.0002: must be less than 0.0001 s, a period"),
        ({"timer_hz": 4e5}, {}, "too coarse, 20 counts"),
        ({"timer_hz": 200.01e6}, {}, "must be a multiple of 20000 Hz"),
        ({}, {"delay": {"fraction": 0.3}}, "fraction = 0.3: compare values are loaded 1 times"),
    ],
)  # fmt: skip
def test_times_that_do_not_fit_are_refused(bridge, more, words):
    with pytest.raises(ValueError, match=words.replace("(", "\\(")) as caught:
        switched(bridge, **more)
    assert str(caught.value).startswith("plant.") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"bridge": {"kind": "two-level", "V_diode": -1.0}}, "greater than or equal to 0"),
        ({"bridge": {"kind": "three-level"}}, "'average', 'two-level' or 't-type'"),
    ],
)
def test_options_that_make_no_bridge_are_refused(options, words):
    with pytest.raises(ValidationError, match=words):
        Plant.model_validate(options)
