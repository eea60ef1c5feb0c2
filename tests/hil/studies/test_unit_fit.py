"""D, H and X_eff of a law whose equations are those of the fit lie in the intervals, as noise, also
of a meter that filters it, leaves them; the run is read as a recording of others."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import tomlkit
from scipy.io import savemat
from scipy.signal import lfilter

import gfmhil
from gfm_hil.cli import main
from gfm_plant import load_converter
from gfmhil import envelopes

SCENARIO = {
    "title": "a jump of 1 degree",
    "duration": 5.0,
    "references": {"P_ref": 0.0},
    "plant": {"grid": {"scr": 3.0, "x_over_r": 100.0}},
    "events": [{"type": "grid-phase-jump", "t": 1.0, "degrees": 1.0}],
}
#: 2 H dw/dt = -p - D w: of VSG-2 its row from p to omega_u
GAINS = gfmhil.Law.load("vsg-2").gains
TRUE = {
    "D": 1 / GAINS["D_p"],
    "H": 1 / (2 * GAINS["k_22"] * GAINS["D_p"]),
    "X_eff": load_converter("paper").pu()["L_f"],
    "mp": GAINS["D_p"],
    "TPf": 1 / GAINS["k_22"],
}
CHANNELS = ("p", "q", "V", "f")
DRAWS = 40


@pytest.fixture(scope="module")
def run() -> gfmhil.Run:
    return gfmhil.run(SCENARIO, "vsg-2")


def record(run: gfmhil.Run, place: Path, seed: int, sigma: float, lag: float) -> None:
    """Write the run as recorded with noise of ``sigma`` [p.u.] a sample at 10 kHz before a lag."""
    noise = np.random.default_rng(seed).standard_normal((len(CHANNELS), run.ticks)) * sigma
    noise[3] = 0.0
    x = np.stack([run.signals[n] for n in ("p", "q", "V", "f_hz")])
    keep = math.exp(-run.scenario.T_s / lag)
    half = (1 - keep) / 2  # of the sample and of the one before: the lag of a line between them
    held = lfilter([half, half], [1, -keep], x + noise - x[:, :1], axis=1) + x[:, :1]
    savemat(place / "noisy.mat", {"t": run.signals["t"], **dict(zip(CHANNELS, held, strict=True))})
    lines = ["S_n = 4000.0", "V_n = 380.0", "event_s = 1.0", f"meter = {{ lag_s = {lag} }}"]
    lines += ["[channels]", *(f'{n} = "{n}"' for n in "pqV"), 'f = { channel = "f", unit = "Hz" }']
    (place / "map.toml").write_text("\n".join(lines))


@pytest.mark.full
def test_the_intervals_hold_what_is_true_in_95_percent_of_draws(run, tmp_path):
    """Half of them with a meter that is slow."""
    inside = dict.fromkeys(TRUE, 0)
    for seed in range(DRAWS):
        record(run, tmp_path, seed, *((0.02, 5e-4), (0.03, 0.01))[seed % 2])
        read = gfmhil.load_run(tmp_path / "noisy.mat", tmp_path / "map.toml", SCENARIO)
        fit = envelopes.fit_run(read)
        for name, (low, high) in fit.interval.items():
            inside[name] += low <= TRUE[name] <= high
    # 95 % of 40 draws: 35 or more in 98.6 % of all sets of draws
    assert min(inside.values()) >= 35, inside


def test_the_fit_of_a_run_without_noise_is_its_law(run):
    fit = envelopes.fit_run(run)
    for name in ("D", "H", "mp", "TPf"):
        assert getattr(fit, name) == pytest.approx(TRUE[name], rel=3e-3)
    assert fit.X_eff == pytest.approx(TRUE["X_eff"], abs=1e-3)
    assert fit.noise < 1e-9 and fit.left < 1e-5


@pytest.mark.parametrize(
    ("model", "mp", "H", "X_L"),
    [
        ("regfm_a1", 0.01, 0.01 / (2 * 0.01), 0.15),  # TPf/(2 mp)
        ("regfm_b1", 0.02, 0.5 + 100 / (2 * 50) + 0.02 / (2 * 0.02), 0.10),
    ],
)
def test_the_fit_of_wecc_s_models_has_the_numbers_of_their_records(model, mp, H, X_L):
    """As far as a swing equation has them: of B1 the inertia that H, D2/(s + omega_D) and TPf make
    of slow swings. The voltage's control, which the equation has not, moves them."""
    jump = {"type": "grid-phase-jump", "t": 1.0, "degrees": 1.0}
    fit = envelopes.fit_run(gfmhil.run(model, duration=4.0, events=[jump]))
    assert fit.mp == pytest.approx(mp, rel=0.05)
    assert pytest.approx(H, rel=0.15) == fit.H
    assert fit.X_eff == pytest.approx(X_L, rel=0.2)


def test_the_command_fits_a_recording(run, tmp_path, capsys):
    record(run, tmp_path, 1, 0.01, 5e-4)
    (tmp_path / "jump.toml").write_text(tomlkit.dumps(SCENARIO))
    recording = ["fit", str(tmp_path / "noisy.mat"), "--map", str(tmp_path / "map.toml")]
    recording += ["--scenario", str(tmp_path / "jump.toml")]
    assert main([*recording, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(low < TRUE[name] < high for name, (low, high) in found["interval"].items())
    assert main(recording) == 0 and "X_eff" in capsys.readouterr().out
    assert main(recording[:-2]) == 2
    assert capsys.readouterr().err.endswith("takes both, its map and the scenario\n")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"events": [{"type": "grid-frequency", "t": 1.0, "f_hz": 50.1}]}, "must be a grid-phase"),
        ({"duration": 1.2}, "0.16 s of p after the jump: must be 0.4 s at least"),
        ({"plant": {"grid": {"finite": {"H": 5.0, "S": 1e5}}}}, "the grid must be stiff"),
    ],
)
def test_what_cannot_be_fitted_is_told(changes, message):
    with pytest.raises(gfmhil.UserError, match=message):
        envelopes.fit_run(gfmhil.run(SCENARIO | changes, "vsg-2"))
