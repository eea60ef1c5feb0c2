"""Margins against closed forms, python-control, SLICOT, eigenvalues and the nonlinear bench."""

import json
import math
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from gfm_design.margins.all_margins import loop_margins
from gfm_design.margins.delays import DelayMargins, first_loss, longest, overall_delay
from gfm_design.margins.locus import disk_margin, gain_phase, locus_at_u, locus_at_y, mu_bound
from gfm_design.margins.tolerance import (
    CEILING,
    FLOOR,
    element_ranges,
    factor,
    grid_strength,
    sigma,
    stable_region,
)
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import LinearLaw, LinearPlant
from gfm_hil.cli import main
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import make_bench
from gfm_hil.recording.columns import PLANT_COLUMNS
from gfm_hil.recording.parts import RolePart
from gfm_hil.recording.run import Run
from gfm_hil.run.loop_delay import loop_delay
from gfm_hil.scenario import Scenario, check_scenario, load_scenario
from gfm_plant import load_converter, phase_jump
from gfm_runtime import BuiltLaw, load_law

from ..support.loops import reference_loop

T = 0.01


def chain(num: list[float], den: list[float], gain: float, samples: float = 0.0) -> ClosedLoop:
    """One loop: E_u drives num/den, read as V and fed back by -gain."""
    A, B, C, _ = control.ssdata(control.ss(control.tf(num, den)))
    n = len(A)
    reads = np.zeros((5, n))
    reads[4] = C[0]
    plant = LinearPlant(A, np.zeros((n, 3)), np.zeros((n, 2)), reads, reads)
    plant.B[:, 2] = B[:, 0]
    D = np.zeros((3, 5))
    D[2, 4] = -gain
    law = LinearLaw(
        np.zeros((0, 0)), np.zeros((0, 5)), np.zeros((3, 0)), D, np.zeros((0, 5)), np.zeros((3, 5))
    )
    return ClosedLoop(plant, law, T, samples * T)


def loop_of(law: str | BuiltLaw, scenario: str, **plant: Any) -> ClosedLoop:
    s = load_scenario(scenario)
    changed = type(s.plant).model_validate({**s.plant.model_dump(exclude_unset=True), **plant})
    return ClosedLoop.of(law, changed, s.references.vector())


def test_integrator_has_the_margins_that_algebra_gives():
    # z-transform of 1/s is T/(z-1): 1 + k T/(z-1) = 0 at z = 1 - k T, on the circle at k T = 2;
    # |T/(e^(j w T) - 1)| = 1 at 2 sin(w T/2) = k T, where the phase is -90 deg - w T/2
    k = 20.0
    loop = chain([1.0], [1.0, 0.0], k)
    locus = locus_at_u(loop)
    m = gain_phase(locus, *locus.sampled(), 0)
    omega = 2 / T * np.arcsin(k * T / 2)
    assert m.gain_high == pytest.approx(2 / (k * T), rel=1e-9)
    assert m.gain_high_hz == pytest.approx(1 / (2 * T))
    assert m.gain_low == 0.0
    assert m.phase_deg == pytest.approx(90 - np.degrees(omega * T / 2), rel=1e-9)
    assert m.phase_hz == pytest.approx(omega / (2 * np.pi), rel=1e-9)
    # H = (z - 1 - k T)/(2 (z - 1 + k T)) is largest at z = -1
    assert m.disk == pytest.approx(2 * (2 - k * T) / (2 + k * T), rel=1e-9)
    # one more whole sample: z (z - 1) + k T has its product of roots at k T
    one = first_loss(lambda g: chain([1.0], [1.0, 0.0], g, 1.0).sigma(), [1.0, 300.0])
    assert one == pytest.approx(1 / T, rel=1e-5)


@pytest.mark.parametrize("samples", [0.0, 1.0, 1.4])
@pytest.mark.parametrize("part", [0.0, 0.3])
def test_fractional_delay_of_an_integrator(samples, part):
    # u acts with its delay: the integral over a tick is that of two held values, at u and at y
    loop = chain([1.0], [1.0, 0.0], 5.0, samples)
    for extra in ({"u": part * T}, {"y": part * T}):
        p = loop.later(**extra).held
        total = samples + part
        x = np.zeros(len(p.A))
        y = []
        for k in range(6):
            y.append(float((p.C @ x)[4]))
            x = p.A @ x + p.B @ np.array([0.0, 0.0, 1.0 if k == 0 else 0.0])
        # a pulse of one tick, a time ``total`` later, integrated: a ramp
        ramp = [T * float(np.clip(k - total, 0.0, 1.0)) for k in range(6)]
        np.testing.assert_allclose(y, ramp, atol=1e-12)


def test_agrees_with_python_control():
    loop = chain([1200.0], [1.0, 10.0, 416.0, 800.0], 2.0)
    locus = locus_at_u(loop)
    m = gain_phase(locus, *locus.sampled(), 0)
    p = loop.held
    L = control.ss(p.A, p.B[:, [2]], 2.0 * p.C[[4]], 0, T)
    gm, pm, _, w_g, w_p, _ = control.stability_margins(L)
    assert m.gain_high == pytest.approx(gm, rel=1e-4)
    assert 2 * np.pi * m.gain_high_hz == pytest.approx(w_g, rel=1e-4)
    assert m.phase_deg == pytest.approx(abs(pm), rel=1e-4)
    assert 2 * np.pi * m.phase_hz == pytest.approx(w_p, rel=1e-4)
    omega = np.linspace(0.01, np.pi / T, 20_000)
    assert m.disk == pytest.approx(control.disk_margins(L, omega, 0.0)[0], rel=1e-4)
    # far below the sampling rate, the exact held delay equals that from the phase margin
    assert DelayMargins(loop).at_u(2).seconds == pytest.approx(np.radians(pm) / w_p, rel=0.01)
    assert DelayMargins(loop).at_y(4).seconds == pytest.approx(
        DelayMargins(loop).at_u(2).seconds, rel=1e-5
    )


def test_scan_stops_at_the_first_loss():
    def island(value: float) -> float:  # lost in (2, 3) and from 7 on
        return 0.5 if 2.0 < value < 3.0 or value > 7.0 else -0.5

    assert first_loss(island, list(np.arange(0.0, 10.0, 0.5))) == pytest.approx(2.0, rel=1e-5)
    assert first_loss(lambda value: -0.5, [0.0, 1.0]) is None


def test_mu_of_known_matrices():
    # rank one: mu = sum |u_i v_i|; a triangular matrix: its largest diagonal entry
    u, v = np.array([1.0, 2j, -3.0, 0.5]), np.array([0.1, 1.0, 2.0, 4j])
    found = mu_bound(np.outer(u, v)[None])[0]
    assert found == pytest.approx(np.abs(u * v).sum(), rel=1e-4)
    assert mu_bound(np.array([[[1.0, 1e3], [0.0, 2.0]]], complex))[0] == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("at", [locus_at_u, locus_at_y])
def test_disk_margin_is_mu(at):
    slycot = pytest.importorskip("slycot")
    locus = at(loop_of("mimo-gfm", "rig_pref_step"))
    m = len(locus.channels)
    found = disk_margin(locus)
    near = 2 * np.pi * found.frequency_hz * np.linspace(0.999, 1.001, 51)
    omega = np.concatenate([np.geomspace(0.01, np.pi / 1e-4, 300), near])
    mu = max(slycot.ab13md(H, np.ones(m, int), 2 * np.ones(m, int))[0] for H in locus(omega))
    assert found.alpha == pytest.approx(1 / mu, rel=1e-4)
    assert found.full <= found.alpha


CASES = [
    ("mimo-gfm", "rig_pref_step", {}),
    ("mimo-gfm", "pref_step", {}),
    ("mimo-gfm", "rig_pref_step", {"delay": {"samples": 1, "fraction": 0.37}}),
    ("droop-5", "rig_pref_step", {"delay": {"samples": 2, "fraction": 0.5}}),
    ("vsg-2", "pref_step", {}),
]


@pytest.mark.parametrize(("law", "scenario", "plant"), CASES)
def test_loop_is_that_of_the_modes(law, scenario, plant):
    # the emulator's own record of its delay, against the delay in seconds
    loop = loop_of(law, scenario, **plant)
    ours = np.sort(np.abs(np.linalg.eigvals(loop.A)))[::-1]
    reference = reference_loop(loop.made_of.par, loop.plant, loop.law)
    theirs = np.sort(np.abs(np.linalg.eigvals(reference)))[::-1]
    np.testing.assert_allclose(ours, theirs[: len(ours)], atol=1e-9)
    assert loop.made_of.op.u[0] > 0.0


@pytest.mark.parametrize(("law", "scenario", "plant"), CASES[1:4])
def test_margins_are_where_eigenvalues_cross(law, scenario, plant):
    loop = loop_of(law, scenario, **plant)
    m = loop_margins(loop)
    assert all(c.confirmed for c in (*m.u, *m.y))
    if np.isfinite(m.delay.seconds):
        for share, held in ((0.99, True), (1.01, False)):
            assert (loop.later(share * m.delay.seconds).sigma() < 0.0) == held
    # every channel's disk margin is at least that of all at once
    for channels, disk in ((m.u, m.disk_u), (m.y, m.disk_y)):
        assert min(c.gain_phase.disk for c in channels) >= disk.alpha * (1 - 1e-6)
        # random factors inside the disk, all at once
        rng = np.random.default_rng(1)
        for _ in range(100):
            turn = np.exp(2j * np.pi * rng.random(5))
            f = (1 + 0.999 * disk.alpha / 2 * turn) / (1 - 0.999 * disk.alpha / 2 * turn)
            changed = loop.scaled(u=f[:3]) if channels is m.u else loop.scaled(y=f)
            assert changed.sigma() < 0.0


@pytest.mark.parametrize(
    ("law", "inner", "plant"),
    [
        ("mimo-gfm", None, {}),
        ("droop-5", None, {"delay": {"samples": 2, "fraction": 0.37}}),
        ("vsg-2", "cascaded", {"delay": {"samples": 1}}),
    ],
)
def test_turns_count_the_unstable_poles(law, inner, plant):
    """The first unstable value of each scan by the argument principle is that by eigenvalues."""
    given = load_law(law, inner).laws[0]
    loop = loop_of(given, "rig_pref_step", **plant)
    found, ends = DelayMargins(loop), set()
    cuts = [(True, [j]) for j in loop.commands] + [(False, [i]) for i in loop.measurements]
    for at_u, channels in [(True, list(range(len(loop.u_delay)))), *cuts]:
        late = np.zeros(len(loop.u_delay if at_u else loop.y_delay))
        late[channels] = 1.0
        each = [(late * s, 0.0) if at_u else (0.0, late * s) for s in found.scan]
        lost = (k for k, by in enumerate(each) if loop.later(*by).sigma() >= 0.0)
        expected = next(lost, len(each))
        assert found._first_unstable(at_u, channels) == expected
        ends.add(expected)
    assert len(ends) > 1  # some are lost, at different values


def swing(law: str, plant: dict[str, Any], tmp: Path, ticks: int = 6000) -> float:
    """Growth of p's swing on the nonlinear bench: its last third over its middle third."""
    content = {"title": "", "duration": ticks * 1e-4, "law": law, "plant": plant}
    bench = make_bench(check_scenario(content, "test"))
    phase_jump(bench.plant, -math.degrees(1e-7))
    parts = [RolePart.create(tmp, role, ticks) for role in ("plant", "controller")]
    run_ticks(
        bench.plant.records,
        stack([bench]),
        parts[0].signals[None],
        parts[1].signals[None],
        0,
        ticks,
    )
    p = np.diff(parts[0].signals[:, PLANT_COLUMNS.index("true_p")])
    third = ticks // 3
    return float(np.abs(p[2 * third :]).max() / np.abs(p[third : 2 * third]).max())


def test_delay_margin_on_the_nonlinear_bench(tmp_path):
    # the ideal mimo-gfm loses 1181 Hz half a sample out; 5 % of that is 2.6 us
    margin = overall_delay(loop_of("mimo-gfm", "pref_step"))
    assert 0.0 < margin.seconds < 1e-4
    fraction = margin.seconds / 1e-4
    for k, (share, grows) in enumerate(((0.95, False), (1.05, True))):
        plant = {"delay": {"fraction": share * fraction}}
        found = swing("mimo-gfm", plant, tmp_path / str(k))
        assert (found > 1.0) is grows


def test_element_ranges_are_where_eigenvalues_cross():
    loop = loop_of("mimo-gfm", "rig_pref_step")
    bounded = 0
    for name, found in element_ranges(loop).items():
        assert found is not None
        for end, out in ((found.low, 1 / 1.01), (found.high, 1.01)):
            now = factor(loop, name)
            inside = end.factor / (out if end.bounded else 1.0)
            assert sigma(loop, {name: now * inside}) < 0.0
            if end.bounded:
                bounded += 1
                assert sigma(loop, {name: now * end.factor * out}) >= 0.0
            else:
                assert end.factor in (FLOOR, CEILING)
    assert bounded >= 3


def test_grid_strength_and_region():
    loop = loop_of("mimo-gfm", "rig_pref_step")
    grid = grid_strength(loop)
    # the paper's line is 1.75 % of Z_b; R_g at half of it
    nominal = load_converter(loop.made_of.plant.converter).pu()
    assert grid.now == pytest.approx(1 / abs(0.5 * nominal["R_g"] + 1j * nominal["L_g"]))
    assert grid.weakest == pytest.approx(grid.now / grid.range.high.factor)
    weak = grid_strength(loop_of("mimo-gfm", "pref_step", grid={"scr": 20.0, "x_over_r": 8.0}))
    assert (weak.now, weak.x_over_r) == (pytest.approx(20.0), pytest.approx(8.0))
    assert grid.range.high.lost is not None
    assert grid.range.high.lost.frequency_hz == pytest.approx(1008.0, abs=2.0)
    region = stable_region(loop, points=4)
    for i, R_g in enumerate(region.R_g):
        for j, L_g in enumerate(region.L_g):
            found = sigma(loop, {"L_g": float(L_g), "R_g": float(R_g)})
            assert (found < 0.0) == (region.sigma[i, j] < 0.0)


def late_run(missed: slice) -> Run:
    """A run in real time with some ticks missed, 60 us there and back."""
    due = np.arange(1000, dtype=np.int64) * 100_000
    received = due + 60_000
    received[missed] = -1
    timing = {"plant_scheduled": due, "plant_sent": due, "plant_received": received}
    scenario = Scenario(title="late", duration=0.1, mode="realtime")
    columns = {"tick": np.arange(1000)}
    return Run(scenario, {"mode": "realtime"}, columns, timing=timing)


@pytest.mark.parametrize(
    ("missed", "fits", "word", "worst"),
    [
        (slice(0), True, "no tick was missed", 100.0),
        (slice(500, 503), True, "3 in a row", 400.0),
        (slice(500, 520), False, "does not fit", 2100.0),
    ],
)
def test_measured_delay(missed, fits, word, worst):
    found = loop_delay(late_run(missed), 1e-4, 1.5e-3)
    assert found.fits(1500.0) is fits
    assert word in found.words(1500.0)
    assert found.acting_us is not None and found.round_trip_us is not None
    assert found.acting_us["max"] == worst
    assert found.round_trip_us["p50"] == 60.0
    assert found.beyond == (0 if fits else 6)  # holds of 15 to 20 ticks


def command(*arguments: str) -> int:
    return main(["design", "margins", *arguments])


def test_command_as_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("gfm_hil.cli.design.margins.POINTS", 3)
    run, pictures = tmp_path / "run", tmp_path / "pictures"
    arguments = ["run", "rig_pref_step", "--link", "inproc", "--duration", "1.1"]
    assert main([*arguments, "--out", str(run), "--quiet", "--no-figures"]) == 0
    capsys.readouterr()
    assert command("--run", str(run), "--json", "--figures", str(pictures)) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["law"] == "mimo-gfm" and out["stable"] is True
    assert out["delay_us"] == pytest.approx(1505.0, abs=1.0)
    assert set(out["u"]) == {"omega_u", "E_u"}
    assert set(out["y"]) == {"v_dc", "p", "q", "V"}
    assert out["elements"]["L_g"]["high"]["percent"] == pytest.approx(20.8, abs=0.1)
    assert out["run"]["fits"] is None and "lockstep" in out["run"]["verdict"]
    assert {p.name for p in pictures.iterdir()} == {"region.png", "delay.png"}
    assert np.shape(out["region"]["sigma"]) == (3, 3)


def test_the_command_names_the_least_damped_mode_by_its_ratio(capsys):
    assert command("--law", "vsg-2") == 0  # on pref_step, as bode, nyquist, poles and step
    said = capsys.readouterr().out
    assert "P_ref steps from 0.5 to 1 p.u." in said
    assert "least damped: damping ratio 0.00148 at 1075 Hz" in said  # of filter and line


def test_unstable_loop_has_no_margins(capsys, tmp_path):
    assert command("--law", "vsg-2", "--scenario", "rig_pref_step", "--json") == 3
    out = json.loads(capsys.readouterr().out)
    assert out["stable"] is False and "delay_us" not in out
    assert out["mode"]["frequency_hz"] == pytest.approx(49.5, abs=0.1)
    figures = ("--figures", str(tmp_path / "none"))
    assert command("--law", "vsg-2", "--scenario", "rig_pref_step", *figures) == 3
    (line,) = capsys.readouterr().out.splitlines()
    assert "grows with sigma" in line and "--figures: there is none to draw" in line
    assert not (tmp_path / "none").exists()
    # a regulated source holds v_dc, from which this law takes its frequency: an open integrator
    assert command("--law", "matching-1", "--scenario", "rig_pref_step") == 3
    assert "neither grows nor decays" in " ".join(capsys.readouterr().out.split())


def test_wrong_input(tmp_path, capsys):
    assert command("--run", str(tmp_path / "nothing")) == 2
    assert "is not a run folder (signals.npz is missing)" in capsys.readouterr().err
    (tmp_path / "scenario.toml").write_text("")
    assert command("--run", str(tmp_path)) == 2
    assert "the run is not over" in capsys.readouterr().err
    assert command("--scenario", "pref_step", "--law", "nobody") == 2
    assert "nobody" in capsys.readouterr().err


def test_longest_delay_keeps_the_matrices_small():
    assert longest(1e-4) == pytest.approx(0.01)
    assert longest(1e-5) == pytest.approx(0.003)
    assert longest(1e-3) == pytest.approx(0.05)
