"""The paper's problem: weights, channels, and gamma of the printed gains."""

import control
import numpy as np
import pytest

from gfm_design.norms.performance import PAPER_WEIGHTS, Weight, channel_system, read_weights
from gfm_design.tuning.paper import PaperProblem
from gfm_runtime import law_file

NONE = np.zeros(0)


def problem(law: str) -> PaperProblem:
    return PaperProblem(law_file(law), ())


@pytest.mark.parametrize(("law", "gamma"), [("mimo-gfm", 2.0209), ("vsg-2", 15.975)])
def test_printed_gains(law, gamma):
    # computed before this module existed, with other programs, to four digits
    assert max(c.norm for c in problem(law).channels(NONE)) == pytest.approx(gamma, rel=5e-5)


@pytest.mark.parametrize("law", ["mimo-gfm", "vsg-2"])
def test_channels_agree_with_control_and_a_dense_grid(law):
    p = problem(law)
    A, B, C, D = p.closed_loop(NONE).performance()
    for channel, weight in zip(p.channels(NONE), PAPER_WEIGHTS, strict=True):
        system = channel_system((A, B, C, D), weight)
        # its search comes from below, and may end early: on some processors 1e-6 below the peak
        found = [control.linfnorm(control.ss(*system), tol=t)[0] for t in (1e-6, 1e-8, 1e-10)]
        assert channel.norm == pytest.approx(max(found), rel=1e-6)
        near = channel.omega * np.linspace(0.99, 1.01, 2001)
        w = np.concatenate([np.logspace(-3, 5, 2000), near])
        inner = np.linalg.solve(1j * w[:, None, None] * np.eye(len(A)) - A, B[None])
        T = (C @ inner + D)[:, weight.i - 1, weight.j - 1] * weight(1j * w)
        assert np.abs(T).max() == pytest.approx(channel.norm, rel=1e-6)


@pytest.mark.parametrize("weight", PAPER_WEIGHTS, ids=lambda w: f"W_{w.i}{w.j}")
def test_state_space_of_a_weight(weight):
    s, T = 1j * np.array([1e-3, 3.0, 1e3, 2e4]), 1e-4
    A, B, C, D = weight.state_space()
    for x in s:
        value = (C @ np.linalg.solve(x * np.eye(len(A)) - A, B) + D)[0, 0]
        assert value == pytest.approx(complex(weight(np.array([x]))[0]), rel=1e-9)
    A, B, C, D = weight.state_space(T)
    for x in s:
        z = (2 + x * T) / (2 - x * T)  # Tustin: the same value at the warped frequency
        value = (C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D)[0, 0]
        assert value == pytest.approx(complex(weight(np.array([x]))[0]), rel=1e-7)


def test_sampled_fast_leads_to_the_continuous_norm():
    p = PaperProblem(law_file("mimo-gfm"), (), T_s=1e-6)
    for sampled, ideal in zip(
        p.closed_loop(NONE).sampled(p.T_s).channels(), p.channels(NONE), strict=True
    ):
        # half a microsecond of hold turns 6785 rad/s by 0.2 degrees
        assert sampled.norm == pytest.approx(ideal.norm, rel=0.02)


@pytest.mark.parametrize(
    ("num", "den", "words"),
    [
        ((1.0, 2.0), (1.0,), "improper"),
        ((1.0,), (1.0, -1.0), "stable"),
        ((1.0,), (1.0, 0.0), "stable"),
        ((np.nan,), (1.0,), "finite"),
        ((1.0,), (0.0, 1.0), "den"),
        ((0.0, 0.0), (1.0, 1.0), "numerator is zero"),
    ],
)
def test_weights_that_cannot_be(num, den, words):
    with pytest.raises(ValueError, match=words):
        Weight(1, 1, num, den)


def test_weights_from_a_file(tmp_path):
    path = tmp_path / "w.toml"
    path.write_text("[W_11]\nnum = [1.0, 4]\nden = [1.0, 0.0004]\n")
    assert read_weights(path) == (PAPER_WEIGHTS[0],)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no weight"),
        ("[W_51]\nnum=[1]\nden=[1]", "W_51"),
        ("[W_11]\nnum=[1]", "needs num and den"),
        ('[W_11]\nnum="1"\nden=[1]', "list"),
        ("[W_11]\nnum=[1, 2]\nden=[1]", "improper"),
        ("[W_11", "table declaration"),
    ],
)
def test_weight_files_that_cannot_be(text, words, tmp_path):
    path = tmp_path / "w.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        read_weights(path)
