"""The inner stage for both sequences: against closed forms, and in real faults of the plant."""

import cmath
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_runtime import LawError, LawSet, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.inner import DualSequence
from gfm_runtime.inner_file import named_inner
from gfm_runtime.signals import NU_INNER

T_S, OMEGA_B = 1e-4, 100 * math.pi
REF = [1.0, 0.5, 1.0, 0.0, 1.0]


def steady(stage: DualSequence, v_p: complex, v_n: complex, ticks: int = 8000) -> np.ndarray:
    """i* of the last cycle, for a voltage with both sequences and the current that is asked for;
    a droop law that stays at nominal frequency with E_u = 1. The phasor v_n is of the frame that
    turns backwards."""
    law = replace(load_law("droop-1").laws[0], inner=stage)
    c = Controller([LawSet("it", (law,))], T_S, REF, omega_b=OMEGA_B)
    i, found, u = 0.5 + 0j, [], np.zeros(NU_INNER)
    c.start(
        np.zeros(c.active_law.order), np.array([0.5, 1.0, 1.0]),
        np.array([1.0, 0.5, 1.0, 0.0, 1.0, 0.5, 0.0, 1.0, 0.0, 0.5, 0.0]), 1.0,
    )  # fmt: skip
    c.states["away"] = 0.0
    for k in range(ticks):
        v = v_p + v_n * cmath.exp(-2j * OMEGA_B * T_S * k)
        y = [1.0, 0.5, 1.0, 0.0, abs(v), i.real, i.imag, v.real, v.imag, i.real, i.imag]
        c.step(np.array(y), u)
        i = complex(*c.states["i_ref"][int(c.ctl["active"][0])])
        found.append(i)
    return np.array(found[-200:])


def sequences(i: np.ndarray, ticks: int) -> tuple[complex, complex]:
    """The mean over a cycle of the last 200 ticks, and of the frame that turns backwards."""
    k = np.arange(ticks - 200, ticks)
    return complex(i.mean()), complex((i * np.exp(2j * OMEGA_B * T_S * k)).mean())


@pytest.mark.parametrize(("R_n", "X_n"), [(0.0, 0.6), (0.06, 0.6), (0.3, 0.4)])
def test_each_sequence_sees_its_own_impedance(R_n, X_n):
    stage = DualSequence(R_n=R_n, X_n=X_n, I_max=10.0, R_v=0.1, X_v=0.3)
    v_p, v_n = 0.9 * cmath.exp(-0.1j), 0.05 * cmath.exp(0.7j)
    positive, negative = sequences(steady(stage, v_p, v_n), 8000)
    assert positive == pytest.approx((1.0 - v_p) / (0.1 + 0.3j), abs=1e-6)
    assert negative == pytest.approx(-v_n / complex(R_n, -X_n), abs=1e-6)
    # the phasor of the negative sequence is the conjugate: I2 leads V2 by 90 degrees and more
    lead = cmath.phase(negative.conjugate() / v_n.conjugate())
    assert lead == pytest.approx(math.pi / 2 + math.atan2(R_n, X_n), abs=1e-6)


@pytest.mark.parametrize("priority", ["circular", "d", "q"])
@pytest.mark.parametrize("turn", [0.0, 1.0, 2.0, 4.0])
def test_no_phase_passes_the_limit_at_any_angle_between_the_sequences(turn, priority):
    stage = DualSequence(I_max=1.2, part_n=0.4, priority=priority)
    i = steady(stage, 0.5 * cmath.exp(0.3j), 0.45 * cmath.exp(1j * turn))
    positive, negative = sequences(i, 8000)
    assert abs(negative) == pytest.approx(0.48, abs=1e-6)
    assert abs(positive) == pytest.approx(0.72, abs=1e-6)
    k = np.arange(8000 - 200, 8000)
    turned = i * np.exp(1j * OMEGA_B * T_S * k)
    peaks = [np.max((turned * cmath.exp(-2j * math.pi * m / 3)).real) for m in range(3)]
    assert max(peaks) <= 1.2 + 1e-6


@pytest.mark.parametrize("part", [1.0, 1.5])
def test_the_positive_sequence_keeps_some_of_the_current(part, tmp_path):
    file = tmp_path / "stage.toml"
    file.write_text(f'type = "dual-sequence"\npart_n = {part}\n')
    with pytest.raises(LawError, match=f"part_n = {part}: must be below 1"):
        named_inner(str(file))


def faulted(inner: str, kind: str, scr: float) -> Any:
    """VSG-2 in a fault in mid line for 0.5 s, from 0.5 s on."""
    fault = {"t": 0.5, "type": "fault", "kind": kind, "position": 0.5, "R": 0.0, "duration": 0.5}
    return gfmhil.run(
        {
            "title": "unbalanced", "duration": 2.0, "law": "vsg-2", "inner": inner,
            "link": {"type": "inproc"}, "events": [fault],
            "plant": {
                "grid": {"scr": scr, "x_over_r": 6.0}, "modulation": "space-vector",
                "delay": {"samples": 1, "fraction": 0.3},
            },
        }
    )  # fmt: skip


def lead_and_peak(run: Any) -> tuple[float, float, float]:
    """By how many degrees I2 leads V2 in the last five cycles of the fault, |I2|, and the largest
    current of a phase from five cycles after its begin on, p.u."""
    t = run.signals["t"]
    vectors = [run.columns[f"true_{x}_re"] + 1j * run.columns[f"true_{x}_im"] for x in "vi"]
    late = slice(9000, 10_000)
    V2, I2 = (np.conj(np.mean(z[late] * np.exp(2j * OMEGA_B * t[late]))) for z in vectors)
    stays = slice(6000, 10_000)
    turned = vectors[1][stays] * np.exp(1j * OMEGA_B * t[stays])
    peaks = [np.max(np.abs((turned * cmath.exp(-2j * math.pi * m / 3)).real)) for m in range(3)]
    return math.degrees(cmath.phase(I2 / V2)), abs(I2), max(peaks)


@pytest.mark.parametrize("scr", [3.0, 10.0, 20.0])
@pytest.mark.parametrize("kind", ["LL", "LG", "LLG"])
def test_the_negative_sequence_current_leads_as_ieee_2800_asks(kind, scr):
    """90 to 100 degrees for a full converter; each phase within 10 % of I_max."""
    run = faulted("dual-sequence", kind, scr)
    lead, I2, peak = lead_and_peak(run)
    assert run.status == "completed"
    assert 90.0 <= lead <= 100.0 and I2 > 0.3
    assert peak <= 1.1 * 1.2
    assert run.signals["p"][-1] == pytest.approx(0.5, abs=0.1)


def test_the_virtual_stator_and_a_resistive_impedance_do_not(tmp_path):
    assert not 90.0 <= lead_and_peak(faulted("virtual-stator", "LL", 3.0))[0] <= 100.0
    file = tmp_path / "resistive.toml"
    file.write_text('type = "dual-sequence"\nR_n = 0.2\n')
    assert lead_and_peak(faulted(str(file), "LL", 10.0))[0] > 100.0
