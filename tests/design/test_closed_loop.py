"""The one closed loop: its readings against each other, other programs and the nonlinear bench."""

import subprocess
import sys
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import expm

from deployable.box import Point
from gfm_design.margins.all_margins import loop_margins
from gfm_design.margins.locus import locus_at_u, locus_at_y
from gfm_design.model.closed_loop import INPUTS, REFERENCES, T_S, ClosedLoop, response
from gfm_design.norms.hinf import Unstable
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.paper import PaperProblem
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import make_bench
from gfm_hil.recording.columns import CONTROLLER_COLUMNS, PLANT_COLUMNS
from gfm_hil.scenario import check_scenario
from gfm_plant import Plant
from gfm_plant.model import f, g
from gfm_runtime import discretise, get_law, law_file

from ..support.loops import reference_loop

RIG: dict[str, Any] = {
    "delay": {"samples": 1, "fraction": 0.25},
    "sensors": {"bandwidth_hz": 300.0},
    "factors": {"R_f": 3.0, "R_g": 3.0},
}


def loop(law: str = "mimo-gfm", plant: dict[str, Any] | None = None, **kind: Any) -> ClosedLoop:
    return ClosedLoop.of(law, Plant.model_validate(plant or {}), **kind)


@pytest.mark.parametrize(("law", "gamma"), [("mimo-gfm", 2.0209), ("vsg-2", 15.975)])
def test_gamma_of_the_printed_gains(law, gamma):
    assert loop(law, ideal=True).gamma() == pytest.approx(gamma, rel=5e-5)


def test_a_law_may_be_a_name_a_law_or_a_discrete_law():
    by_name, law = loop("vsg-5").A, get_law("vsg-5")
    np.testing.assert_array_equal(ClosedLoop.of(law).A, by_name)
    np.testing.assert_array_equal(ClosedLoop.of(discretise(law, 1e-4)).A, by_name)


@pytest.mark.parametrize("law", ["mimo-gfm-deployable", "vsg-2"])
def test_step_is_that_of_the_nonlinear_bench(law):
    # 1e-4 p.u. of P_ref: nonlinear terms are of the order of 1e-8
    size, ticks = 1e-4, 1500
    content = {"title": "", "duration": ticks * 1e-4, "law": law, "plant": RIG}
    bench = make_bench(check_scenario(content, "test"))
    c = bench.controller
    c.set("P_ref", REFERENCES[1] + size)
    signals = np.full((ticks, len(PLANT_COLUMNS)), np.nan)
    other = np.empty((1, ticks, len(CONTROLLER_COLUMNS)))
    run_ticks(bench.plant.records, stack([bench]), signals[None], other, 0, ticks)
    p = signals[:, PLANT_COLUMNS.index("true_p")] - REFERENCES[1]
    t, y = ClosedLoop.of(law, bench.scenario.plant).step_response("P_ref", seconds=ticks * 1e-4)
    assert t[1] == pytest.approx(1e-4) and y.shape == (ticks + 1, 5)
    assert np.abs(p / size - y[:ticks, 1]).max() < 2e-3 * np.abs(y[:, 1]).max()


@pytest.mark.full
def test_step_settles_where_the_response_at_rest_says():
    for of in (loop("mimo-gfm-deployable", RIG), loop("mimo-gfm-deployable", ideal=True)):
        rest = of.frequency_response([0.0])[0].real
        for k, name in enumerate(INPUTS):
            _, y = of.step_response(name, seconds=8.0, every=1e-3)
            np.testing.assert_allclose(
                y[-1], rest[:, k], atol=2e-3 * max(1.0, abs(rest[:, k]).max())
            )


@pytest.mark.parametrize("ideal", [True, False])
def test_frequency_response_is_that_of_python_control(ideal):
    of = loop("vsg-5", {} if ideal else RIG, ideal=ideal)
    omega = np.geomspace(0.1, 2e4, 20)
    system = control.ss(*of.state_space, *([] if ideal else [of.T_s]))
    expected = np.moveaxis(system.frequency_response(omega).frdata, -1, 0)
    np.testing.assert_allclose(of.frequency_response(omega), expected, rtol=1e-6, atol=1e-9)


def test_loop_transfer_gives_the_sensitivity_that_the_margins_use():
    of, omega = loop("mimo-gfm", RIG), np.geomspace(1.0, 3e4, 40)
    for at_y, locus, channels in (
        (False, locus_at_u(of), of.commands),
        (True, locus_at_y(of), of.measurements),
    ):
        L = of.loop_transfer(omega, at_y)
        S = np.linalg.inv(np.eye(L.shape[-1]) + L)
        H = (S - 0.5 * np.eye(L.shape[-1]))[:, list(channels)][:, :, list(channels)]
        np.testing.assert_allclose(locus(omega), H, atol=1e-8)


@pytest.mark.parametrize("ideal", [True, False])
def test_gain_of_one_loop_is_that_of_python_control_with_the_others_closed(ideal):
    of, omega = loop("mimo-gfm", {} if ideal else RIG, ideal=ideal), np.geomspace(1.0, 2e4, 20)
    p, c, step = of.held, of.law, [] if ideal else [of.T_s]
    plant = control.ss(p.A, p.B, p.C, np.zeros((5, 3)), *step)
    law = control.ss(c.A, c.B, c.C, c.D, *step)
    for whole, names in (
        (control.series(plant, law), {"i_u": 0, "omega_u": 1, "E_u": 2}),
        (control.series(law, plant), {"v_dc": 0, "p": 1, "q": 3, "V": 4}),
    ):
        for name, k in names.items():
            others = np.eye(whole.ninputs)
            others[k, k] = 0.0
            closed = control.feedback(whole, control.ss([], [], [], others, *step), sign=1)
            expected = -closed.frequency_response(omega).frdata[k, k]
            np.testing.assert_allclose(of.loop_gain(name, omega), expected, rtol=1e-5)
    with pytest.raises(ValueError, match="'omega_g' is no channel of the loop; use one of"):
        of.loop_gain("omega_g", omega)


@pytest.mark.parametrize("law", ["mimo-gfm", "vsg-5", "hybrid-angle"])
@pytest.mark.parametrize("plant", [{}, RIG, {"dc_source": {"mode": "regulated"}}])
def test_output_impedance_and_line_make_the_loop(law, plant):
    # a step of V_g through the line onto the impedance, against the loop's own response
    of, omega = loop(law, plant, ideal=True), np.geomspace(0.5, 2e4, 25)
    r, x = of.made_of.par[0], of.made_of.op.x
    i, v, delta = x[4:6], x[2:4], x[6]
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    s = (1j * omega)[:, None, None]
    line = (r["R_g"] + s * r["L_g"] / r["omega_b"]) * np.eye(2) + r["L_g"] * turn
    Z, v_g = of.output_impedance(omega), np.array([np.cos(delta), -np.sin(delta)])
    by_i = -np.linalg.solve(Z + line, np.broadcast_to(v_g[:, None], (len(omega), 2, 1)))
    by_v = -Z @ by_i
    i_by, v_by = by_i[..., 0], by_v[..., 0]
    expected = {
        "p": v_by @ i + i_by @ v,
        "q": v_by @ turn @ i + i_by @ turn.T @ v,
        "V": v_by @ v / np.hypot(*v),
    }
    response = of.frequency_response(omega)[:, :, INPUTS.index("grid.V_g")]
    for name, row in (("p", 1), ("q", 3), ("V", 4)):
        size = np.abs(response[:, row]).max()
        np.testing.assert_allclose(response[:, row], expected[name], atol=1e-7 * size, rtol=1e-6)


def test_output_impedance_of_a_sampled_loop_is_that_of_its_periodic_motion():
    # A current e^(j omega t) into the plant's own equations, and u held, 1.25 samples late. The
    # motion over one tick from (x at its end) = z (x at its start); then v's part at omega.
    of = loop("vsg-2", {"delay": {"samples": 1, "fraction": 0.25}, "factors": {"R_f": 3.0}})
    op, law, T, steps = of.made_of.op, of.law, 1e-4, 200
    keep, d, h = [0, 1, 2, 3, 6, 7], np.ones(2, complex), 1e-4 / 200

    def converter(z: Any) -> Any:
        """Rates (6), y (5) and the steady frame's v (2) of states (6), u (3) and its i_o (2)."""
        c, s = np.cos(z[4] - op.x[6]), np.sin(z[4] - op.x[6])
        i_d, i_q = c * z[9] + s * z[10], c * z[10] - s * z[9]
        x, u = np.concatenate([z[:4], [i_d, i_q], z[4:6]]), z[6:9]
        v = [c * x[2] - s * x[3], s * x[2] + c * x[3]]
        return np.concatenate([f(x, u, d, of.made_of.par)[keep], g(x, u), v])

    at = np.concatenate([op.x[keep], op.u, op.x[4:6]])
    S = np.column_stack([converter(at + 1e-30j * e).imag / 1e-30 for e in np.eye(11)])
    S[8] = 0.0  # the law is fed its own omega_u
    C_y, n, m = S[6:11, :6], 6, len(law.A)
    for omega in (3.0, 300.0, 9000.0):
        z, Z = np.exp(1j * omega * T), np.empty((2, 2), complex)
        for k in range(2):
            D_y, system = S[6:11, 9 + k], np.zeros((n + 4, n + 4), complex)
            system[:n] = np.column_stack([S[:6, :9], S[:6, 9 + k]])  # by x, u, the current
            system[-1, -1] = 1j * omega
            over, early, middle = expm(system * h), expm(system * T / 4), expm(system * h / 2)
            late = expm(system * 3 * T / 4)
            # x at the end by x, u[k-2] in the first quarter and u[k-1] then, the current
            by_x, by_i = late[:n, :n] @ early[:n, :n], (late @ early)[:n, -1]
            by_u = late[:n, :n] @ early[:n, n:-1] / z**2 + late[:n, n:-1] / z
            F = np.block([
                [by_x - z * np.eye(n), np.zeros((n, m)), by_u],
                [law.B @ C_y, law.A - z * np.eye(m), np.zeros((m, 3))],
                [law.D @ C_y, law.C, -np.eye(3)],
            ])  # fmt: skip
            found = -np.linalg.solve(F, np.concatenate([by_i, law.B @ D_y, law.D @ D_y]))
            x, u, values = found[:n], found[-3:], []
            for j in range(steps):
                acting = u / (z**2 if j < steps // 4 else z)
                state = np.concatenate([x, acting, [np.exp(1j * omega * j * h)]])
                values.append(
                    S[11:, :6] @ (middle @ state)[:n] * np.exp(-1j * omega * (j + 0.5) * h)
                )
                x = (over @ state)[:n]
            np.testing.assert_allclose(x, z * found[:n], rtol=1e-6)
            Z[:, k] = -np.mean(values, axis=0)
        # the mean over 200 midpoints is exact to some (omega_0 h)^2 of the filter
        np.testing.assert_allclose(of.output_impedance([omega])[0], Z, rtol=1e-4, atol=1e-5)


def test_many_plants_in_one_loop_are_each_of_them():
    law = discretise(get_law("mimo-gfm"), 1e-4)
    loops = [Point(0.1, 1.0, L_g, delay).loop(law) for L_g, delay in ((1.0, 1.4), (20.0, 2.0))]
    many = ClosedLoop.stacked(loops)
    again = ClosedLoop(many.plant, many.law, many.T_s, many.u_delay, many.y_delay)
    for one in (many, again):
        np.testing.assert_array_equal(one.A, [of.A for of in loops])
        np.testing.assert_allclose(one.sigma(), [of.sigma() for of in loops])
    for whole, parts in zip(many.state_space, zip(*(o.state_space for o in loops), strict=True),
                            strict=True):  # fmt: skip
        np.testing.assert_allclose(whole, parts, atol=1e-12)


@pytest.mark.parametrize("law", ["mimo-gfm", "vsg-5"])
def test_many_laws_in_one_loop_are_each_of_them(law):
    file = law_file(law)
    problem = PaperProblem(file, free_gains(file))
    start = np.array([g.start for g in problem.gains])
    values = start * np.array([[1.0], [1.01], [0.98]])
    loops = [problem.closed_loop(v) for v in values]
    many = problem.closed_loops(values)
    np.testing.assert_allclose(many.sigma(), [of.sigma() for of in loops], rtol=1e-6)
    late = [of.sampled(1e-4, 1.3e-4).sigma() for of in loops]
    np.testing.assert_allclose(many.sampled(1e-4, 1.3e-4).sigma(), late, rtol=1e-6)


def test_sampling_a_loop_is_discretising_its_law():
    # Tustin of the law with closed omega_u loop, against the runtime, which closes it after Tustin
    ideal, exact = loop("vsg-5", ideal=True), loop("vsg-5", {"delay": {"samples": 1}})
    ours = ideal.sampled(1e-4, 1e-4)
    np.testing.assert_allclose(
        sorted(np.abs(ours.poles())), sorted(np.abs(exact.poles())), rtol=1e-6
    )
    reference = reference_loop(exact.made_of.par, ideal.plant, ideal.law.sampled(1e-4))
    assert ours.sigma() == pytest.approx(
        np.log(np.abs(np.linalg.eigvals(reference)).max()) / 1e-4, abs=1e-6
    )


def test_sensors_are_in_the_loop_but_not_in_what_it_gives():
    ideal, gained = loop(), loop(plant={"sensors": {"gain": {"p": 1.05}}})
    np.testing.assert_array_equal(ideal.plant.C, ideal.plant.C_true)
    np.testing.assert_allclose(gained.plant.C[1], 1.05 * gained.plant.C_true[1])
    # a sensor that reads 5 % too much makes p settle 5 % lower
    for of, rest in ((ideal, 1.0), (gained, 1 / 1.05)):
        assert of.frequency_response([0.0])[0, 1, 1].real == pytest.approx(rest, rel=1e-6)


def test_changed_elements_are_those_of_another_plant():
    other = loop(plant={**RIG, "factors": {"R_f": 3.0, "R_g": 0.5, "L_g": 2.0}})
    np.testing.assert_allclose(
        loop(plant=RIG).changed({"R_g": 0.5, "L_g": 2.0}).A, other.A, atol=1e-9
    )


def test_what_cannot_be():
    ideal = loop(ideal=True)
    with pytest.raises(ValueError, match="continuous loop has no delay"):
        ideal.later(1e-4)
    with pytest.raises(ValueError, match="sample it first"):
        loop_margins(ideal)
    with pytest.raises(ValueError, match="'P_reff' is no input"):
        ideal.step_response("P_reff")
    with pytest.raises(ValueError, match="made of matrices"):
        ClosedLoop(ideal.plant, ideal.law).changed({"L_g": 2.0})
    with pytest.raises(Unstable):
        loop(plant={"delay": {"samples": 1}}).gamma()


def test_representation_and_margins():
    of = loop()
    assert repr(of) == "<ClosedLoop mimo-gfm, T_s = 0.0001 s, A (11, 11)>"
    assert repr(loop(ideal=True)) == "<ClosedLoop mimo-gfm, continuous, A (11, 11)>"
    least = loop_margins(of).worst
    assert least.ratio == min(mode.ratio for mode in of.modes()) < 0.1
    assert of.modes()[0].sigma > least.sigma  # the slowest to decay is another mode, well damped


def test_a_live_process_loads_neither_synthesis_nor_its_packages():
    code = "import sys, gfm_hil.engine.setup\nprint(*sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"gfm_design.model.closed_loop", "gfm_design.norms", "scipy.optimize", "cma"}
    loaded = set(said.stdout.split())
    assert "gfm_design.model.operating_point" in loaded
    assert not loaded & heavy


def test_one_schur_form_answers_as_a_solve_at_each_frequency():
    """On a sampled loop with delay lines, whose states are then scaled by powers of two over
    fourteen orders of magnitude: that is exact, and leaves the response as it is."""
    late = {"delay": {"samples": 3, "fraction": 0.4}}
    A, B, C, D = loop("mimo-gfm-deployable", late).state_space
    z = np.exp(1j * np.concatenate([[0.0], np.geomspace(1e-3, np.pi / T_S, 200)]) * T_S)
    plain = C @ np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, B.astype(complex)) + D
    scale = 2.0 ** np.random.default_rng(1).integers(-24, 24, len(A))
    found = response((A * scale[:, None] / scale, B * scale[:, None], C / scale, D), z)
    assert found.shape == plain.shape and scale.max() / scale.min() > 1e13
    size = np.abs(plain).max(axis=0)  # of each channel; some are 0, to rounding
    assert (np.abs(found - plain) <= 1e-9 * size + 1e-15).all()
