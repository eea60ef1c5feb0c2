"""The inner stage against what is known from outside: SciPy, closed forms, its own limits."""

import cmath
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gfm_runtime import LawError, LawSet, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.inner import (
    PRIORITIES,
    STAGES,
    Cascaded,
    GridFollowingStage,
    InnerStage,
    PowerLimiter,
    VirtualStator,
)
from gfm_runtime.inner_file import inner_names
from gfm_runtime.signals import NU_INNER

from ..support.laws import behind

T_S, OMEGA_B = 1e-4, 100 * math.pi
REF = [1.0, 0.5, 1.0, 0.0, 1.0]


def controller(*stages: InnerStage | None, law: str = "droop-1") -> Controller:
    """A droop law whose E_u is V_ref, once for each stage."""
    laws = [LawSet(f"law {k}", (behind(law, stage),)) for k, stage in enumerate(stages)]
    return Controller(laws, T_S, REF, omega_b=OMEGA_B)


def measured(
    i: complex = 0.5, v: complex = 1.0, i_o: complex = 0.5, p: float = 0.5, v_dc: float = 1.0
) -> np.ndarray:
    parts = [part for z in map(complex, (i, v, i_o)) for part in (z.real, z.imag)]
    return np.array([v_dc, p, 1.0, 0.0, abs(complex(v)), *parts])


def started(stage: InnerStage, e: complex = 1.0, **y: Any) -> Controller:
    c = controller(stage)
    c.start(np.zeros(c.active_law.order), np.array([0.5, 1.0, 1.0]), measured(**y), e)
    return c


def current(c: Controller) -> complex:
    return complex(*c.states["i_ref"][int(c.ctl["active"][0])])


def test_the_virtual_stator_is_its_differential_equation():
    """i* after a step of v against an adaptive integrator; the trapezoid is of second order."""
    stage = VirtualStator(I_max=100.0, X_v=0.3, R_v=0.1)
    v = 0.8 * cmath.exp(-0.2j)

    def slope(t: float, i: np.ndarray) -> np.ndarray:
        return (1.0 - v - (0.1 + 0.3j) * i) * OMEGA_B / 0.3

    c, u = started(stage, v=1.0, i=0.0), np.zeros(NU_INNER)
    begin = current(c)
    c.states["away"] = 0.0
    for k in range(100):
        c.step(measured(v=v, i=0.0), u)
        t = (k + 1) * T_S
    found = solve_ivp(slope, (0, t), [begin], method="DOP853", rtol=1e-12, atol=1e-12)
    assert abs(current(c) - found.y[0, -1]) < 3e-4
    for _ in range(5000):
        c.step(measured(v=v, i=0.0), u)
    assert abs(current(c) - (1.0 - v) / (0.1 + 0.3j)) < 1e-12


@pytest.mark.parametrize("kind", STAGES)
def test_a_change_of_law_and_stage_keeps_the_bridges_voltage(kind):
    stages = [None, STAGES[kind](), Cascaded(k_ci=5.0)]
    c, e = controller(*stages), 1.0 + 0.05j
    y, u = measured(i=0.5 - 0.1j, v=0.98 - 0.02j), np.zeros(NU_INNER)
    c.start(np.zeros(c.active_law.order), np.array([0.5, 1.0, 1.0]), y, e)
    for name in ("law 1", "law 2", "law 0", "law 2", "law 1", "law 0"):
        c.step(y, u)
        before = u.copy()
        c.select(name)
        c.step(y, u)
        assert abs(complex(*(u - before)[2:])) < 5e-3, name
        # a frame that stands at an angle to E begins to turn there, by up to 10 rad/s
        assert abs((u - before)[1]) < (10 / OMEGA_B if kind == "grid-following" else 1e-12)


def test_what_a_change_leaves_behind_decays():
    c, y, u = controller(VirtualStator(), None), measured(), np.zeros(NU_INNER)
    c.start(np.zeros(c.active_law.order), np.array([0.5, 1.0, 1.0]), y, 0.9 + 0.1j)
    c.select("law 1")
    for _ in range(20_000):  # ten time constants
        c.step(y, u)
    assert abs(complex(u[2], u[3]) - 1.0) < 1e-4


@pytest.mark.parametrize(
    ("priority", "wanted"),
    [
        ("circular", 1.2 * cmath.exp(1j * cmath.phase(1.5 - 2.0j))),
        ("d", 1.2 + 0j),
        ("q", -1.2j),
        ("angle", 1.2 * cmath.exp(1j * math.radians(-30.0))),
    ],
)
def test_priorities_of_the_limit(priority, wanted):
    """A cascaded stage that feeds i_o = 1.5 - 2 j forward asks for just that current."""
    assert priority in PRIORITIES
    stage = Cascaded(priority=priority, angle=-30.0, k_v=0.0, k_vi=0.0, k_ff=1.0, C_f=0.0)
    c, u = started(stage, v=0.2, i=1.0, i_o=1.0), np.zeros(NU_INNER)
    c.states["x_v"] = 0.0
    c.step(measured(v=0.2, i=1.0, i_o=1.5 - 2.0j), u)
    assert current(c) == pytest.approx(wanted, abs=1e-12)
    assert c.states["limited"][0] == 1


@pytest.mark.parametrize("kind", STAGES)
def test_the_bridge_never_gets_more_than_the_modulation_gives(kind):
    c, u = started(STAGES[kind](m=1.3)), np.zeros(NU_INNER)
    rng = np.random.default_rng(1)
    for _ in range(2000):
        z = rng.normal(0, 1.5, 6) @ np.array([[1, 0, 0], [1j, 0, 0], [0, 1, 0], [0, 1j, 0],
                                             [0, 0, 1], [0, 0, 1j]])  # fmt: skip
        v_dc = rng.uniform(0.5, 1.4)
        c.step(np.clip(measured(*z, p=0.5, v_dc=v_dc), -2.9, 2.9), u)
        assert math.hypot(u[2], u[3]) <= 1.3 * v_dc * (1 + 1e-12)


def test_the_e_row_freezes_while_the_current_is_limited():
    """VSG-2 integrates the voltage's error; in a fault of 0.1 s that would be 3 p.u."""
    raws = {}
    for freeze in (True, False):
        c = controller(VirtualStator(freeze=freeze), law="vsg-2")
        y, u = measured(), np.zeros(NU_INNER)
        c.start(np.zeros(c.active_law.order), np.array([0.5, 1.0, 1.0]), y, 1.0)
        for _ in range(1000):
            c.step(measured(v=0.1, i=1.2, i_o=1.2), u)
        raws[freeze] = float(c.states["raw"][0, 2])
    assert raws[True] < 1.05 < 1.4 < raws[False]


def test_the_pll_finds_the_frequency_that_column_3_is_told():
    """v turns against the converter's frame by 0.5 Hz: the PLL's omega is 1 + 0.01, column 3's."""
    c, u = started(VirtualStator(f_pll=20.0)), np.zeros(NU_INNER)
    for k in range(3000):
        angle = OMEGA_B * 0.01 * k * T_S
        c.step(measured(v=cmath.exp(1j * angle)), u)
    assert c.states["omega_pll"][0] == pytest.approx(1.01, abs=1e-6)
    assert c.states["ref"][0, 2] == c.states["omega_pll"][0]


def following(v: complex, ticks: int, **keys: Any) -> Controller:
    """A grid-following controller after ticks of a voltage v; its frame begins on the real axis."""
    c, u = started(GridFollowingStage(**keys), v=abs(v)), np.zeros(NU_INNER)
    c.states["away"] = 0.0
    for _ in range(ticks):
        y = measured(v=v, i=0.0, i_o=0.0)
        y[2] = u[1] or 1.0
        v *= cmath.exp(1j * OMEGA_B * T_S * (1.0 - y[2]))
        c.step(y, u)
    return c


def test_a_jump_of_the_angle_moves_the_pll_by_its_two_poles():
    """Damping ratio 1/sqrt(2): e^-at (cos at - sin at) of the jump is left, a = omega_n/sqrt(2)."""
    jump, a = 0.01, 2 * math.pi * 10.0 / math.sqrt(2)
    for ticks in (50, 150, 300):
        c, t = following(cmath.exp(1j * jump), ticks, f_pll=10.0), ticks * T_S
        m, pll = c.states["m"][0], complex(*c.states["pll"][0])
        left = cmath.phase(complex(m[5], m[6]) / pll) / jump
        assert left == pytest.approx(
            math.exp(-a * t) * (math.cos(a * t) - math.sin(a * t)), abs=0.03
        )


@pytest.mark.parametrize(
    ("V", "keys", "i_d", "i_q"),
    [
        (0.95, {}, 0.5 / 0.95, 0.0),
        (0.8, {"k_V": 2.0}, 0.5 / 0.8, -0.2),
        (1.15, {"k_V": 2.0, "band_V": 0.05}, 0.5 / 1.15, 0.2),
        (0.4, {"k_V": 2.0}, math.sqrt(1.2**2 - 1.0), -1.0),
        (0.4, {"k_V": 9.0}, 0.0, -1.2),
        (0.1, {}, 1.2, 0.0),
    ],
)
def test_the_current_that_follows_the_grid(V, keys, i_d, i_q):
    """P_ref = 0.5 and Q_ref = 0 at rest: power over V, and support that has the first place."""
    c = following(V, 3000, C_f=0.0, V_least=0.2, **keys)
    assert current(c) == pytest.approx(complex(i_d, i_q), abs=1e-9)
    assert c.states["limited"][0] == (math.hypot(0.5 / max(V, 0.2), i_q) > 1.2)


def test_the_power_limiter_lowers_the_frequency_only_beyond_its_limit():
    stage = VirtualStator(power=PowerLimiter(P_max=0.8, P_min=-0.8, k_p=0.02, k_i=0.0))
    c, u = started(stage), np.zeros(NU_INNER)
    law, _ = controller(None), np.zeros(3)
    law.start(np.zeros(law.active_law.order), np.array([0.5, 1.0, 1.0]))
    plain = np.zeros(3)
    for p, lower in ((0.7, 0.0), (1.0, 0.02 * 0.2), (-0.7, 0.0), (-1.3, -0.02 * 0.5)):
        law.step(measured(p=p)[:5], plain)
        c.step(measured(p=p), u)
        assert plain[1] - u[1] == pytest.approx(lower, abs=1e-12)


def test_shipped_stages_load_and_differ():
    found = {name: load_law("vsg-2", name).laws[0].inner for name in inner_names()}
    assert found.pop("none") is None
    kinds = {stage.kind for stage in found.values() if stage}
    follows = load_law("grid-following").laws[0].inner
    assert follows is not None and {*kinds, follows.kind} == {*STAGES}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('type = "virtual"', "inner stage .*: type = 'virtual': must be one of .*virtual-stator"),
        ('type = "cascaded"\nI_thr = 1.0', r"stage\.toml: I_thr = 1.0: unknown key"),
        ('type = "virtual-stator"\nX_v = 0.0', "inner.*X_v: must be > 0, not 0.0"),
        ('type = "cascaded"\nI_max = -1.0', "inner.*I_max: must be > 0, not -1.0"),
        (
            'type = "cascaded"\n[power]\nP_max = 0.1\nP_min = 0.5',
            "power: P_max = 0.1 must be above",
        ),
        (
            'type = "grid-following"',
            "law vsg-2: phi_22, phi_34, phi_35: no effect in front of the inner stage grid",
        ),
        ('type = "grid-following"\n[power]\nP_max = 1.0\nP_min = 0.0', "power: not with grid"),
        ('type = "grid-following"\nf_pll = 0.0', "f_pll: must be > 0, not 0.0"),
        ('type = "cascaded"\npriority = "both"', "priority: .*'circular', 'd', 'q' or 'angle'"),
    ],
)
def test_a_wrong_stage_is_refused_in_one_line(text, said, tmp_path):
    path = tmp_path / "stage.toml"
    path.write_text(text)
    with pytest.raises(LawError, match=said) as caught:
        load_law("vsg-2", str(path))
    assert "\n" not in str(caught.value)
