"""Laws from the systems of python-control and SciPy."""

import re

import control
import numpy as np
import pytest
from scipy import signal

import gfmhil
from gfm_runtime import pack_law
from gfm_runtime.firmware import CHECKED, check

S, ZERO = control.tf("s"), control.tf([0], [1], 0)
PHI = control.combine_tf(
    [
        [(90 * S + 400) / S, ZERO, ZERO, ZERO, ZERO],
        [ZERO, 0.01 / (0.167 * S + 1), ZERO, ZERO, ZERO],
        [ZERO, ZERO, ZERO, 1.9 / S, 38 / S],
    ]
)
NAMED = gfmhil.Law.from_toml("""
name = "named"
title = ""
source = ""
[phi]
11 = { type = "PI", k = 90.0, k_i = 400.0 }
22 = { type = "IF", k = 0.01, T = 0.167 }
34 = { type = "I", k_i = 1.9 }
35 = { type = "I", k_i = 38.0 }
""")


def bits(law: gfmhil.Law) -> bytes:
    return pack_law(law.discretised()).tobytes()


def test_a_system_of_python_control_has_the_bits_of_named_elements():
    law = gfmhil.Law.from_control(PHI, "mine")
    assert bits(law) == bits(NAMED)
    run, named = (gfmhil.run("pref_step", one, duration=2.5) for one in (law, NAMED))
    assert run.metrics == named.metrics
    assert all(np.array_equal(run.signals[n], named.signals[n]) for n in ("p", "v_dc", "u_E_u"))
    again = gfmhil.Law.from_toml(law.to_toml())
    assert bits(again) == bits(law) and again.gains == dict.fromkeys(law.gains, 1.0)


def test_tuning_says_gamma_of_the_law_that_it_began_with():
    """Its k_34 and k_35 share the operating point, to which the search moves."""
    law = gfmhil.Law.from_control(PHI, "mine")
    tuned = gfmhil.design.tune(law, starts=1, evaluations=64)
    assert tuned.before.value == gfmhil.design.gamma(law).value > tuned.gamma.value


def test_a_matrix_has_them_too_and_takes_every_kind_of_cell():
    second = signal.TransferFunction([38.0], [1.0, 0.0])
    integral = {"type": "I", "k_i": 1.9}
    cells = [
        [PHI[0, 0], 0, None, 0.0, 0],
        [0, ([0.01], [0.167, 1]), 0, 0, 0],
        [0, 0, 0, integral, second],
    ]
    law = gfmhil.Law.from_matrix(cells, "mine")
    assert bits(law) == bits(NAMED)
    assert [*law.gains] == ["k_11", "k_22", "k_35"]  # one that is as in a law file has its own
    cells[1][0], cells[1][2] = -0.05, signal.ZerosPolesGain([-3.0], [-1.0, -2.0], 5.0)
    more = gfmhil.Law.from_matrix(cells, "mine", u_0={"i_u": "P_ref"})
    assert more.gains["k_21"] == -0.05 and more.file.parameters["k_21"].free == (-0.5, -0.005)
    assert more.file.u_0.i_u == "P_ref"
    assert more.built().phi[1, 2](2j) == pytest.approx(5 * (2j + 3) / (2j + 1) / (2j + 2))


@pytest.mark.parametrize("name", ["mimo-gfm", "vsg-5", "psc-2"])
@pytest.mark.parametrize("of", [control.ss, lambda system: signal.StateSpace(*parts(system))])
def test_a_state_space_is_the_law_that_it_came_from(name, of):
    """With as few states: cells of a row share equal poles."""
    own = gfmhil.Law.load(name)
    law = gfmhil.Law.from_control(of(own.to_control()))
    assert law.discretised().order <= own.discretised().order
    for omega in (0.3, 10.0, 2000.0):
        ours, theirs = np.array(law.built()(1j * omega)), np.array(own.built()(1j * omega))
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-12)


def parts(system: control.TransferFunction) -> tuple[np.ndarray, ...]:
    found = control.ss(system)
    return found.A, found.B, found.C, found.D


UNSTABLE = control.tf([1], [1, -2])


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (
            control.c2d(PHI[1, 1], 1e-4),
            "system: is sampled (dt = 0.0001); Φ(s) is in continuous time",
        ),
        (UNSTABLE, "system: is 1 × 1; must be 3 × 5"),
        (3, "system: int is no transfer function or state space"),
    ],
)
def test_what_is_no_law_is_told(system, message):
    with pytest.raises(gfmhil.UserError, match=f"^{re.escape(message)}$"):
        gfmhil.Law.from_control(system)


@pytest.mark.parametrize(
    ("cell", "message"),
    [
        (UNSTABLE, "phi_22, TF: unstable: a pole at s = 2 rad/s"),
        (control.ss(UNSTABLE), "phi_22, SS: unstable: a pole at s = 2 rad/s"),
        (1 / S**2, "phi_22: unstable: a double integrator 1/s^2"),
        (S / 1, "phi_22: improper: its numerator has degree 1, its denominator 0; "
         "give it a pole (den of a TF, T_f of a D or PD, or an IF)"),
        ("1/s", "phi_22: system: str is no transfer function or state space"),
        (PHI, "phi_22: system: is 3 × 5; must be 1 × 1"),
        (("s", [1]), "phi_22: ('s', [1]): must be two lists of numbers"),
        (signal.StateSpace([[np.nan]], [[1.0]], [[1.0]], [[0.0]]),
         "phi_22: system: its numbers are too far apart to compute with"),
    ],
)  # fmt: skip
def test_what_is_no_cell_is_told_in_one_line(cell, message):
    cells = [[1, 0, 0, 0, 0], [0, cell, 0, 0, 0], [0, 0, 0, 0, 1]]
    with pytest.raises((gfmhil.UserError, gfmhil.LawError)) as problem:
        gfmhil.Law.from_matrix(cells)
    assert str(problem.value) == message
    with pytest.raises(gfmhil.UserError, match="cells: must be 3 rows of 5"):
        gfmhil.Law.from_matrix(cells[:2])


def lead_and_resonance() -> gfmhil.Law:
    """A fraction of the third degree, a state space with complex poles, and a sum."""
    fraction = {"type": "TF", "num": [4e-4, 0.01], "den": [1e-5, 4e-3, 0.3, 1.0]}
    system = {"type": "SS", "A": [[0, 1], [-400, -30]], "B": [0, 1], "C": [4, 0], "D": 0.1}
    total = {"type": "sum", "terms": [{"type": "I", "k_i": 20.0}, {"type": "P", "k": 0.01}]}
    cells = [[PHI[0, 0], 0, 0, 0, 0], [0, fraction, system, 0, 0], [0, 0, 0, 0, total]]
    return gfmhil.Law.from_matrix(cells, "any")


@pytest.mark.compilers
@pytest.mark.timeout(900)
@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize("target", ["host", "m4f"])
def test_its_c_has_the_kernels_bits(tmp_path, target, real):
    (found,) = check(lead_and_resonance().to_c(tmp_path / "c", real=real), target, "-O2")
    assert (found.rows, found.differ) == (CHECKED, 0)


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(gfmhil.UserError, match="is not empty"):
        NAMED.to_c(tmp_path)


def test_a_script_that_runs_again_may_replace_what_it_wrote(tmp_path):
    softer = gfmhil.Law.from_toml(NAMED.to_toml().replace("90.0", "80.0"))
    file, folder = NAMED.save(tmp_path / "law.toml"), NAMED.to_c(tmp_path / "c")
    before = {path.name for path in folder.iterdir()}
    with pytest.raises(gfmhil.UserError, match="is there already"):
        softer.save(file)
    assert softer.save(file, overwrite=True).read_text() == softer.to_toml() != NAMED.to_toml()
    assert softer.to_c(folder, overwrite=True) == folder
    assert {path.name for path in folder.iterdir()} == before
