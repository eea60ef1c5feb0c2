"""From counts to y and from u to compare counts: closed forms, and mistakes in their tables."""

import math
from typing import Any

import numpy as np
import pytest

from gfm_runtime import LawError, discretise, load_law, pack_law, state_dtype
from gfm_runtime.counts import (
    Counts,
    Measure,
    Modulate,
    align,
    calibrate,
    measure,
    modulate,
    named_counts,
)
from gfm_runtime.signals import CHANNELS

T_S, OMEGA_B, TOP = 1e-4, 100 * math.pi, 10_000
AXES = np.exp(2j * np.pi / 3 * np.arange(3))
LEG = math.sqrt(2 / 3) * 700 / 380


def made(measure_by: dict[str, Any] | None = None, **modulate_by: Any) -> tuple[Any, Any]:
    """The records of vsg-2 with these tables, and of an instance along the axis of phase a."""
    counts = Counts(measure=Measure(**(measure_by or {})), modulate=Modulate(**modulate_by))
    (law,) = load_law("vsg-2").laws
    object.__setattr__(law, "counts", counts)
    laws = pack_law(discretise(law, T_S), omega_b=OMEGA_B)
    states = np.zeros(1, state_dtype())
    states["angle"], states["speed"], states["omega"] = (1.0, 0.0), 1.0, 1.0
    states["m"][0, 0] = 1.0
    return laws, states


def read(bits: int, v_dc: float, *vectors: complex, errors: Any = 0.0) -> np.ndarray:
    """The counts of i, v and i_o in the ranges of ``Measure``; ``errors`` (10,) are added."""
    values = np.array([v_dc, *((z * AXES.conj()).real[x] for z in vectors for x in range(3))])
    low, high = np.array([[0.0] + [-4.0] * 3 + [-2.0] * 3 + [-4.0] * 3, [2.0] + [4.0] * 3
                          + [2.0] * 3 + [4.0] * 3])  # fmt: skip
    return np.clip(np.rint((values + errors - low) / (high - low) * 2**bits), 0, 2**bits - 1)


@pytest.mark.parametrize("phases", [2, 3])
def test_counts_become_p_q_V_and_the_components_along_the_frame(phases):
    laws, states = made({"bits": 16, "phases": phases})
    i, v, i_o, frame = 0.8 - 0.3j, 1.02 + 0.1j, 0.75 - 0.35j, np.exp(0.7j)
    states["angle"] = frame.real, frame.imag
    counts = read(16, 1.05, i * frame, v * frame, i_o * frame)
    if phases == 2:
        counts[[3, 9]] = 0  # nobody reads them
    measure(laws[0], states[0], counts, 0)
    s = v * i_o.conjugate()
    wanted = [1.05, s.real, 1.0, s.imag, abs(v), i.real, i.imag, v.real, v.imag, i_o.real, i_o.imag]
    assert states["sensed"][0] == pytest.approx(wanted, abs=8 * 2**-16)


def test_known_errors_of_a_channel_are_taken_off():
    errors = np.zeros(10)
    errors[1], errors[5] = 0.05, 0.1 * (-0.5)  # v_b reads a tenth more of its -0.5
    laws, states = made({"bits": 16, "offset": {"i_a": 0.05}, "gain": {"v_b": 1.1}})
    measure(laws[0], states[0], read(16, 1.0, 0.5, 1.0, 0.5, errors=errors), 0)
    assert states["sensed"][0, 5:] == pytest.approx([0.5, 0, 1, 0, 0.5, 0], abs=1e-4)


def test_the_frame_turns_by_the_speed_and_is_aligned_with_the_voltage():
    laws, states = made()
    speeds = 1.0 + 0.05 * np.sin(np.arange(2000) / 50)
    for omega in speeds:
        states["omega"] = omega
        modulate(laws[0], states[0])
    angle = OMEGA_B * T_S * speeds.sum()
    assert complex(*states["angle"][0]) == pytest.approx(np.exp(1j * angle), abs=1e-10)
    states["sensed"][0, 7:9] = 0.6, 0.8
    align(laws[0], states[0], read(12, 1.0, 0.0, 1.1 * np.exp(2j), 0.0), 0)
    assert complex(*states["angle"][0]) * (0.6 + 0.8j) == pytest.approx(np.exp(2j), abs=2e-3)


@pytest.mark.parametrize("samples", [4, 16])
def test_a_sum_of_conversions_in_the_last_period_is_what_the_tick_would_read(samples):
    """Of vectors that turn at 1.02 p.u.; a mean over 1.8 degrees is 4e-5 less."""
    laws, states = made({"samples": samples})
    states["speed"], turn = 1.02, 1.02 * OMEGA_B * T_S
    i, v, i_o = 0.8 - 0.3j, 1.02 + 0.1j, 0.75 - 0.35j
    ages = np.exp(-1j * turn * np.arange(samples)[::-1] / samples)
    counts = np.sum([read(12, 1.05, i * e, v * e, i_o * e) for e in ages], axis=0)
    measure(laws[0], states[0], counts, 0)
    wanted = [1.05, i.real, i.imag, v.real, v.imag, i_o.real, i_o.imag]
    found = states["sensed"][0][[0, *range(5, 11)]]
    assert found == pytest.approx(wanted, abs=8 * 2**-12 / math.sqrt(samples))
    align(laws[0], states[0], counts, 0)  # where that voltage already is
    assert complex(*states["angle"][0]) == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize(("largest", "suspect"), [(-0.09, -1), (-0.11, 8)])
def test_the_start_finds_the_offsets_of_the_currents(largest, suspect):
    """To the standard deviation of a mean; those of voltages, and of a sensor that is not there,
    stay. More than 0.1 p.u. is not plausible."""
    rng, offsets = np.random.default_rng(1), np.zeros(10)
    offsets[1:] = 0.05, -0.03, 0.4, 0.2, 0.2, 0.2, 0.04, largest, 0.4
    laws, states = made({"bits": 16, "phases": 2, "calibrate": 200})
    for _ in range(200):
        assert states["suspect"][0] in (0, -1)
        noise = 0.01 * rng.standard_normal(10)
        calibrate(laws[0], states[0], read(16, 1.0, 0.0, 0.0, 0.0, errors=offsets + noise), 0)
    assert states["suspect"] == suspect
    kept = states["shift"][0].copy()
    assert kept[[1, 2, 7, 8]] * 8 / 2**16 == pytest.approx(offsets[[1, 2, 7, 8]], abs=3e-3)
    assert not kept[[0, 3, 4, 5, 6, 9]].any()
    calibrate(laws[0], states[0], read(16, 1.0, 0.0, 0.0, 0.0), 0)  # one more than it takes
    assert np.array_equal(states["shift"][0], kept)


def modulated(E: complex, v_dc: float = 1.0, **by: Any) -> tuple[np.ndarray, np.ndarray]:
    """Compare counts (n, 3) over a turn of E, and the angles of the frame in between, rad."""
    laws, states = made(**by)
    states["m"][0, 0], states["e_now"] = v_dc, (E.real, E.imag)
    found, angles = [], 2 * np.pi * np.arange(720) / 720
    for angle in angles:
        states["angle"] = math.cos(angle), math.sin(angle)
        modulate(laws[0], states[0])
        found.append(states["compare"][0].astype(int))
    return np.array(found), angles + OMEGA_B * T_S * by.get("advance", 1.5)


@pytest.mark.parametrize("kind", ["space-vector", "sine", "third-harmonic", "discontinuous"])
@pytest.mark.parametrize("advance", [0.5, 1.5])
def test_every_modulator_gives_the_voltage_when_the_counts_act(kind, advance):
    E, v_dc = 0.9 * np.exp(0.2j), 0.9
    counts, angles = modulated(E, v_dc, kind=kind, advance=advance)
    mean = LEG * v_dc * (counts / TOP) @ AXES
    assert mean == pytest.approx(E * np.exp(1j * angles), abs=2 * LEG / TOP)
    phases = (E * np.exp(1j * angles)[:, None] * AXES.conj()).real / (1.5 * LEG * v_dc)
    common = (counts / TOP - phases).mean(axis=1) - 0.5
    third = -abs(E) / (1.5 * LEG * v_dc) / 6 * np.cos(3 * (angles + 0.2))
    if kind in ("sine", "third-harmonic"):
        assert common == pytest.approx(third if kind != "sine" else 0 * third, abs=1e-4)
    elif kind == "space-vector":
        assert counts.max(axis=1) + counts.min(axis=1) == pytest.approx(TOP, abs=1)
    else:
        assert np.all(((counts == 0) | (counts == TOP)).any(axis=1))


def test_over_modulation_ends_in_six_steps_or_keeps_the_angle():
    counts, angles = modulated(1e3 + 0j)
    mean = LEG * (counts / TOP) @ AXES
    assert (mean * np.exp(-1j * angles)).mean() == pytest.approx(3 / math.pi * LEG, rel=1e-3)
    counts, angles = modulated(1.5 + 0j, over="scale")
    mean = LEG * (counts / TOP) @ AXES * np.exp(-1j * angles)
    assert mean.imag == pytest.approx(0 * angles, abs=2e-4) and mean.real.max() < 1.505


def test_pulses_are_at_least_as_long_as_they_must_be():
    counts, _ = modulated(1.29 + 0j, min_pulse_s=2e-6)
    on = np.unique(counts)
    assert not np.any((on > 0) & (on < 200)) and not np.any((on > 9800) & (on < TOP))
    assert {200, 9800} <= set(on)


@pytest.mark.parametrize("compensate", ["sign", "predicted"])
def test_dead_time_is_added_by_the_sign_of_the_current(compensate):
    """2 us of 100 us are 200 of 10,000 counts; within the band they go with the current."""
    by = {"dead_time_s": 2e-6, "band": 0.1, "advance": 0.0}
    i = 0.06 * np.exp(0.3j)
    laws, states = made({"bits": 16}, compensate=compensate, **by)
    measure(laws[0], states[0], read(16, 1.0, i, 1.0, i), 0)
    states["e_now"] = 0.0, 0.0
    modulate(laws[0], states[0])
    wanted = 200 * np.clip((i * AXES.conj()).real / 0.1, -1, 1)
    assert states["compare"][0] - 5000.5 == pytest.approx(wanted, abs=1)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({5: None}, "v_b"), ({8: 2048.0}, "i_o_b"), ({3: 0.0}, "i_c"), ({0: 4095.0}, "v_dc"),
        ({7: "more"}, "i_o_a"), ({}, ""),
    ],
)  # fmt: skip
def test_a_channel_that_is_not_plausible_is_named(wrong, named):
    """One that keeps its count, reads nothing, or is at an end; and a sum that is not zero."""
    laws, states = made()
    suspects = set()
    for k in range(400):
        turn = np.exp(0.0314j * k)
        states["angle"] = turn.real, turn.imag
        counts = read(12, 1.0, 0.5 * turn, turn, 0.5 * turn)
        for j, value in wrong.items():
            kept = counts[j] if k == 0 else states["last"][0, j]
            counts[j] = kept if value is None else counts[j] + 200 if value == "more" else value
        measure(laws[0], states[0], counts, 0)
        suspects.add(int(states["suspect"][0]))
    assert suspects == ({-1, CHANNELS.index(named)} if named else {-1})


@pytest.mark.parametrize(
    ("by", "says"),
    [
        ({"timer_hz": 199.99e6}, "modulate.timer_hz: 1.9999e+08: must be a multiple of 20000 Hz"),
        ({"timer_hz": 4e5}, "modulate.timer_hz: 400000: too coarse, 20 counts"),
        ({"timer_hz": 2e9}, "modulate.timer_hz: 2e+09: more than 16 bits hold"),
        ({"dead_time_s": 6e-5}, "modulate.dead_time_s: 6e-05: must be less than 5e-05 s, half a"),
        ({"min_pulse_s": 1e-4}, "modulate.min_pulse_s: 0.0001: must be less than 0.0001 s, a per"),
    ],
)
def test_a_timer_that_does_not_fit_is_told_in_one_line(by, says):
    with pytest.raises(LawError) as told:
        Modulate(**by).top(T_S)
    assert str(told.value).startswith(says) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[measure]\nbits = 7", "measure.bits: must be greater than or equal to 8, not 7"),
        ("[measure]\nbits = 17", "measure.bits: must be less than or equal to 16, not 17"),
        ("[measure]\ni = [2.0, -2.0]", "measure.i: must be [lo, hi], ascending"),
        ("[modulate]\nkind = 'six-step'", "modulate.kind: must be 'space-vector', 'sine'"),
        ("[modulate]\ncarriers = 3", "modulate.carriers: must be 1 or 2, not 3"),
    ],
)
def test_a_mistake_in_a_file_is_told_in_one_line(tmp_path, text, says):
    file = tmp_path / "own.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(LawError) as told:
        named_counts(str(file))
    assert says in str(told.value) and "\n" not in str(told.value)
    with pytest.raises(LawError, match=r"unknown; use a \.toml file or one of"):
        named_counts("rigg")


def test_a_sum_that_does_not_fit_16_bits_is_told_in_one_line():
    with pytest.raises(LawError, match=r"measure\.samples: 32: .* with bits = 12 at most 16"):
        made({"samples": 32})


def test_a_law_file_has_both_tables_or_none(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text('base = "vsg-2"\nname = "own"\n[measure]\n', encoding="utf-8")
    with pytest.raises(LawError, match="modulate: missing"):
        load_law(str(file))
    file.write_text(file.read_text() + "[modulate]\nadvance = 0.5\n", encoding="utf-8")
    (law,) = load_law(str(file)).laws
    assert law.counts is not None and law.counts.modulate.advance == 0.5
    assert load_law(str(file), None, "none").laws[0].counts is None
