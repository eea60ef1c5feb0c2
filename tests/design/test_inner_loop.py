"""The loop with an inner stage: against the compiled kernel, and against the nonlinear bench."""

import math
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

import gfmhil
from deployable.box import Point
from deployable.robust import Loops
from gfm_design.margins.all_margins import loop_margins
from gfm_design.model.closed_loop import INPUTS, REFERENCES, ClosedLoop
from gfm_design.model.inner import LinearStage, linearise_stage
from gfm_design.model.linear import linearise_plant
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import Bench, make_bench
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.scenario import check_scenario
from gfm_plant import NoEquilibrium, Plant, make_plant
from gfm_plant.model import DELTA, f
from gfm_runtime import LawError, LawSet, build_law, discretise, get_law, law_file, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.inner import (
    Cascaded,
    GridFollowingStage,
    InnerStage,
    PowerLimiter,
    ThresholdImpedance,
    VirtualStator,
)
from gfm_runtime.inner_file import named_inner
from gfm_runtime.lawfile import tied
from gfm_runtime.signals import NU_INNER, NY_INNER

T_S = 1e-4
PLANT: dict[str, Any] = {
    "grid": {"scr": 3.0, "x_over_r": 6.0},
    "delay": {"samples": 1, "fraction": 0.3},
    "modulation": "space-vector",
}
SHIPPED = ("virtual-stator", "cascaded", "threshold-impedance", "dual-sequence", "stiff-source")
#: every block of the stage once with and once without its states
STAGES = {
    **{name: load_law("vsg-2", name).laws[0].inner for name in SHIPPED},
    "stator with integral and PLL": VirtualStator(k_ci=20.0, f_pll=15.0),
    "voltage loop without integral": Cascaded(k_vi=0.0, k_ci=10.0, f_pll=30.0),
}
FOLLOWING = {
    "grid-following": GridFollowingStage(k_f=3.0),
    "grid-following without integral": GridFollowingStage(k_ci=0.0, k_dc=2.0),
}
LAWS = ("vsg-2", "dvoc", "vsg-5")
ARRAY = {"mode": "array", "pv": {"V_oc": 1.25, "I_sc": 0.6, "V_mp": 1.0, "I_mp": 0.55}}


def upto(P_max: float) -> PowerLimiter:
    return PowerLimiter(P_max=P_max, P_min=-math.inf)


def loop_of(stage: InnerStage | None, law: str = "vsg-2", **plant: Any) -> ClosedLoop:
    options = Plant.model_validate({**PLANT, **plant})
    return ClosedLoop.of(replace(get_law(law), inner=stage), options)


class Kernel:
    """One compiled tick of law and stage as a function of all it depends on, at rest."""

    def __init__(self, loop: ClosedLoop) -> None:
        of, self.loop = loop.made_of, loop
        law = of.law.law
        self.controller = Controller(
            [LawSet("it", (law,))], T_S, of.ref, omega_b=float(of.par[0]["omega_b"])
        )
        self.y = np.concatenate([of.op.y, of.op.x[:6]])
        self.controller.start(of.op.x_law, of.op.u, self.y, of.op.e)
        self.ctl, self.states = self.controller.ctl.copy(), self.controller.states.copy()
        self.n = of.law.order

    def places(self) -> list[tuple[str, int]]:
        """Where the states of ``LinearStage.states`` are kept; an angle has no place of its own."""
        short = {name: name for name in ("v_f", "x_v", "x_c", "i_p", "i_n", "E_p", "E_n")}
        short |= {"i*": "x_v", "V": "level"}
        assert self.loop.stage is not None
        names = [name.split()[0] for name in self.loop.stage.states]
        both = [name for name in names if name in short]
        return [(short[name], both[:k].count(name)) for k, name in enumerate(both)]

    def __call__(self, x: np.ndarray, y: np.ndarray, ref: np.ndarray) -> np.ndarray:
        """(next states, out) of deviations of the states, of y (11,) and of the references (5,)."""
        c, n, places = self.controller, self.n, self.places()
        c.ctl[:], c.states[:] = self.ctl, self.states
        state, pll = c.states[0], len(x) - n > len(places)
        state["x"][:n] += x[:n]
        for (name, axis), value in zip(places, x[n:], strict=False):
            state[name][axis] += value
        if pll:
            turned = complex(*state["pll"]) * np.exp(1j * x[-2])
            state["pll"][:] = turned.real, turned.imag
            state["omega_pll"] += x[-1]
        c.states[0] = state
        c.ctl["ref"] = c.ctl["ref_target"] = self.loop.made_of.ref + ref
        u = np.zeros(NU_INNER)
        c.step(self.y + y, u)
        state = c.states[0]
        after = [*state["x"][:n], *(state[name][axis] for name, axis in places)]
        if pll:
            after += [np.angle(complex(*state["pll"])), state["omega_pll"]]
        return np.array([*after, *u])


@pytest.mark.parametrize(
    ("stage", "law"), [*product(STAGES, LAWS), *((name, "grid-following") for name in FOLLOWING)]
)
def test_law_and_stage_are_the_compiled_kernels_slopes(stage, law):
    # differences of 1e-6 p.u. have an error of 1e-12 by curvature and of 1e-10 by rounding
    loop = loop_of({**STAGES, **FOLLOWING}[stage], law)
    c, kernel, h = loop.controller, Kernel(loop), 1e-6
    m = len(c.A)
    A, B, B_r = (np.vstack(pair) for pair in ((c.A, c.C), (c.B, c.D), (c.B_r, c.D_r)))
    zero = np.zeros(m), np.zeros(NY_INNER), np.zeros(5)
    for which, wanted in enumerate((A, B, B_r)):
        for k in range(wanted.shape[1]):
            up, down = [z.copy() for z in zero], [z.copy() for z in zero]
            up[which][k], down[which][k] = h, -h
            found = (kernel(*up) - kernel(*down)) / (2 * h)
            np.testing.assert_allclose(found, wanted[:, k], atol=1e-6, err_msg=f"{which}, {k}")


def test_the_plant_under_a_turned_voltage_is_the_plant_in_a_turned_frame():
    # central differences of f itself, with the voltage on f's own d axis
    par = make_plant(Plant.model_validate(PLANT), T_S).par
    op, h = loop_of(STAGES["cascaded"]).made_of.op, 1e-6
    plant = linearise_plant(par, op, inner=True)
    turn = np.conj(op.e) / abs(op.e)

    def rates(x: np.ndarray, e: complex) -> np.ndarray:
        there, by = x.copy(), np.conj(e) / abs(e)
        for k in (0, 2, 4):
            w = complex(x[k], x[k + 1]) * by
            there[k : k + 2] = w.real, w.imag
        there[DELTA] -= np.angle(by)
        out = f(there, np.array([op.u[0], op.u[1], abs(e)]), np.ones(2), par)
        for k in (0, 2, 4):
            w = complex(out[k], out[k + 1]) / by
            out[k : k + 2] = w.real, w.imag
        return out

    assert abs(turn - 1.0) > 1e-3
    for j in range(8):
        e = np.eye(8)[j] * h
        slope = (rates(op.x + e, op.e) - rates(op.x - e, op.e)) / (2 * h)
        np.testing.assert_allclose(plant.A[:, j], slope, atol=1e-4)
    for j, step in ((2, h), (3, 1j * h)):
        slope = (rates(op.x, op.e + step) - rates(op.x, op.e - step)) / (2 * h)
        np.testing.assert_allclose(plant.B[:, j], slope, atol=1e-4)


def bench_of(
    stage: str | None, law: str, ticks: int, plant: dict[str, Any], place: Any, **ref: float
) -> Bench:
    content = {"title": "", "duration": ticks * T_S, "law": law, "plant": plant, "references": ref}
    if stage is not None:
        path = place / "stage.toml"
        path.write_text(stage)
        content["inner"] = str(path)
    return make_bench(check_scenario(content, "test"))


def recorded(bench: Bench, ticks: int) -> dict[str, np.ndarray]:
    """The plant's columns by name, of a run from the bench's start."""
    names, others = (ColumnSet(True).signals(role) for role in ("plant", "controller"))
    rows, other = np.full((1, ticks, len(names)), np.nan), np.empty((1, ticks, len(others)))
    assert run_ticks(bench.plant.records, stack([bench]), rows, other, 0, ticks) == ticks
    return dict(zip(names, rows[0].T, strict=True))


FOLLOWS = 'type = "grid-following"\nk_f = 20.0'
PLL = 'type = "cascaded"\nk_ci = 5.0\nf_pll = 10.0'


@pytest.mark.parametrize(
    ("stage", "law", "plant"),
    [
        *(('type = "' + name + '"', "vsg-2", {}) for name in SHIPPED),
        ('type = "virtual-stator"', "mimo-gfm-practical", {"sensors": {"bandwidth_hz": 300.0}}),
        ('type = "virtual-stator"', "droop-3", {"delay": {"samples": 0}}),
        (PLL, "vsg-2", {}),
        (PLL, "vsg-5",
         {"delay": {"fraction": 0.7}, "grid": {"scr": 3.0, "x_over_r": 6.0, "omega_g": 1.002}}),
        (PLL, "vsg-5", {"dc_source": {"mode": "regulated"}, "delay": {"samples": 0}}),
        (FOLLOWS, "grid-following", {}),
        (None, "grid-following-pv", {"dc_source": ARRAY}),
        (FOLLOWS, "grid-following", {"dc_source": {"mode": "regulated"},
         "grid": {"scr": 8.0, "x_over_r": 6.0, "omega_g": 1.002}}),
    ],
)  # fmt: skip
def test_a_step_is_that_of_the_nonlinear_bench(stage, law, plant, tmp_path):
    # 1e-4 p.u. of P_ref: nonlinear terms are of the order of 1e-8
    size, ticks = 1e-4, 1500
    bench = bench_of(stage, law, ticks, {**PLANT, **plant}, tmp_path)
    c = bench.controller
    loop = ClosedLoop.of(c.active_law, bench.scenario.plant, REFERENCES)
    c.set("P_ref", REFERENCES[1] + size)
    rows = recorded(bench, ticks)
    _, y = loop.step_response("P_ref", seconds=ticks * T_S)
    for name, column, rest in (("true_p", 1, loop.made_of.op.y[1]), ("true_V", 4, None)):
        found = rows[name]
        moved = (found - (found[0] if rest is None else rest)) / size
        assert np.abs(moved - y[:ticks, column]).max() < 2e-3 * np.abs(y[:, column]).max(), name


def test_the_bench_rests_where_a_pll_measures_another_frequency(tmp_path):
    plant = {**PLANT, "grid": {"scr": 3.0, "x_over_r": 6.0, "omega_g": 1.002}}
    bench = bench_of(PLL, "vsg-5", 300, plant, tmp_path)
    assert np.ptp(recorded(bench, 300)["true_p"]) < 1e-11


@pytest.mark.parametrize(
    ("grid", "P", "Q"),
    [({"scr": 3.0}, 0.5, 0.1), ({"scr": 8.0, "omega_g": 0.996}, 0.5 + 20.0 * (0.004 - 0.001), 0.1),
     ({"scr": 5.0, "V_g": 0.75}, 0.5, None)],
)  # fmt: skip
def test_a_grid_following_law_rests_at_its_set_points(grid, P, Q, tmp_path):
    """Also where its droop or its support acts: the reactive power is then the support's too."""
    stage = FOLLOWS + "\nband_f = 0.001\nk_V = 2.0"
    plant = {**PLANT, "grid": {"x_over_r": 6.0, **grid}}
    rows = recorded(bench_of(stage, "grid-following", 300, plant, tmp_path, Q_ref=0.1), 300)
    assert max(np.ptp(rows[name]) for name in ("true_p", "true_q", "true_V")) < 1e-10
    assert rows["true_p"][0] == pytest.approx(P, abs=1e-9)
    V = rows["true_V"][0]
    Q = 0.1 + V * 2.0 * (0.9 - V) if Q is None else Q
    assert rows["true_q"][0] == pytest.approx(Q, abs=1e-4)  # C_f of the stage has four digits


@pytest.mark.parametrize("laws", [("grid-following", "vsg-2"), ("vsg-2", "grid-following")])
def test_following_and_forming_take_over_from_each_other(laws):
    content = {"title": "", "duration": 0.8, "law": laws[0], "inner": "virtual-stator",
               "references": {"P_ref": 0.7}, "plant": PLANT,
               "events": [{"t": 0.2, "type": "law", "law": laws[1]}]}  # fmt: skip
    p = gfmhil.run(content).signals["true_p"]
    assert np.ptp(p[:2000]) < 1e-10 and 1e-5 < np.abs(p - 0.7).max() < 0.03


def test_margins_are_those_at_the_bridge_and_hold_on_eigenvalues():
    loop = loop_of(STAGES["virtual-stator"])
    found = loop_margins(loop)
    assert [c.name for c in found.u] == ["i_u", "omega_u", "E_u", "E_q"]
    assert [c.name for c in found.y] == ["v_dc", "p", "q", "V", "i_d", "i_q", "v_d", "v_q"]
    assert all(c.confirmed for c in (*found.u, *found.y))
    late = [loop.later(share * found.delay.seconds).sigma() for share in (0.99, 1.01)]
    assert late[0] < 0.0 < late[1]


@pytest.mark.parametrize("stage", ["virtual-stator", "cascaded"])
def test_output_impedance_and_line_make_the_loop(stage):
    # A step of V_g through the line onto the impedance, against the loop's own response, which
    # holds V_g over a tick; at these frequencies the images of sampling are below 1e-3.
    loop, omega = loop_of(STAGES[stage]), np.geomspace(0.5, 600.0, 25)
    r, x = loop.made_of.par[0], loop.made_of.op.x
    i, v, s = x[4:6], x[2:4], (1j * omega)[:, None, None]
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    line = (r["R_g"] + s * r["L_g"] / r["omega_b"]) * np.eye(2) + r["L_g"] * turn
    Z, v_g = loop.output_impedance(omega), np.array([np.cos(x[DELTA]), -np.sin(x[DELTA])])
    by_i = -np.linalg.solve(Z + line, np.broadcast_to(v_g[:, None], (len(omega), 2, 1)))
    p = ((-Z @ by_i)[..., 0] @ i + by_i[..., 0] @ v) * (1.0 - np.exp(-s * T_S))[:, 0, 0]
    found = loop.frequency_response(omega)[:, 1, INPUTS.index("grid.V_g")]
    np.testing.assert_allclose(found, p / (1j * omega * T_S), atol=2e-3 * np.abs(found).max())


def test_many_loops_with_stages_are_each_of_them():
    loops = [loop_of(STAGES["cascaded"], grid={"scr": s, "x_over_r": 6.0}) for s in (2.0, 8.0)]
    many = ClosedLoop.stacked(loops)
    np.testing.assert_array_equal(many.A, [of.A for of in loops])
    law = loops[0].law
    changed = replace(law, B=1.1 * law.B)
    again = [of.with_law(changed).A for of in loops]
    np.testing.assert_array_equal(many.with_law(changed).A, again)
    two = replace(law, **{n: np.stack([getattr(law, n)] * 2) for n in
                          ("A", "B", "C", "D", "B_r", "D_r")})  # fmt: skip
    np.testing.assert_array_equal(loops[0].with_law(two).A, [loops[0].A] * 2)
    assert isinstance(many.stage, LinearStage)


@pytest.mark.parametrize(
    ("stage", "references", "said"),
    [
        (VirtualStator(I_max=0.4), {}, "inner.I_max: 0.4 p.u.: this operating point needs"),
        (VirtualStator(power=upto(0.3)), {}, "the power limiter acts: p is 0.5 p.u., not in"),
        (ThresholdImpedance(I_thr=0.3), {}, "the threshold impedance acts"),
        (VirtualStator(m=0.9), {}, "the limit of modulation acts"),
        (
            GridFollowingStage(k_V=2.0, band_V=0.003),
            {},
            "the support of the voltage acts: V is 1.009",
        ),
        (GridFollowingStage(V_least=1.2), {}, "V is 1.013 p.u., below V_least = 1.2"),
    ],
)
def test_a_limit_that_acts_is_named(stage, references, said):
    with pytest.raises(NoEquilibrium, match=said):
        loop_of(stage, "grid-following" if isinstance(stage, GridFollowingStage) else "vsg-2")


def test_a_continuous_loop_has_no_stage():
    law = replace(get_law("vsg-2"), inner=VirtualStator())
    with pytest.raises(LawError, match="inner: runs from tick to tick"):
        ClosedLoop.of(law, ideal=True)
    op = loop_of(None).made_of.op
    bare, stage = (
        ClosedLoop.of("vsg-2", ideal=True),
        linearise_stage(VirtualStator(), T_S, 314.0, op),
    )
    with pytest.raises(ValueError, match="a continuous loop has none"):
        ClosedLoop(bare.plant, bare.law, stage=stage)


def test_an_operating_point_at_the_power_limit_is_below_it():
    # the shipped stages limit p to 1 p.u., which is rated power
    point = Point(P_ref=1.0, delay=1.3)
    law = discretise(
        replace(get_law("mimo-gfm-practical"), inner=VirtualStator(power=upto(1.0))), T_S
    )
    free = discretise(replace(get_law("mimo-gfm-practical"), inner=VirtualStator()), T_S)
    np.testing.assert_array_equal(point.loop(law).A, point.loop(free).A)


def test_a_search_in_the_box_sees_the_stage_at_every_point():
    file = law_file("mimo-gfm-practical")
    file = file.model_copy(update={"inner": named_inner("cascaded")})
    gains = free_gains(file)
    points = [Point(L_g=8.0), Point(P_ref=0.1, delay=1.3), Point(dc="regulated")]
    values = np.array([g.start for g in gains]) * 1.02
    named = {g.name: float(v) for g, v in zip(gains, values, strict=True)}
    changed = build_law(file, tied(file, named))
    each = [p.loop(discretise(changed, T_S)).sigma() for p in points]
    np.testing.assert_allclose(Loops(file, gains, points).sigma(values), each, rtol=1e-6)


def test_the_searchs_loop_has_the_norms_of_the_sampled_one():
    """Its inverse Tustin transform on a grid, against the sampled loop's guaranteed norms."""
    file = law_file("vsg-2").model_copy(update={"inner": named_inner("virtual-stator")})
    problem = PaperProblem(file, free_gains(file))
    start = np.array([g.start for g in problem.gains])
    gamma = max(c.norm for c in problem.channels(start))
    assert problem(start) == pytest.approx(gamma, rel=1e-3)
