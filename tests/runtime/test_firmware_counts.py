"""Firmware from pin to pin: every bit of the whole interrupt, on this machine and in QEMU."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_runtime import BuiltLaw, LawError, load_law
from gfm_runtime.counts import Counts, Measure, Modulate
from gfm_runtime.firmware import CHECKED, FIXED, check, golden, make_modules
from gfm_runtime.states import BAD_SENSOR, BAD_U, BAD_Y, OK

from ..support.firmware import STRICT, T_S, cc, exported

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]


def law(name: str, inner: str, measure: dict[str, Any], **modulate: Any) -> BuiltLaw:
    """A law that finds faults of sensors soon, so that golden rows reach them."""
    measured = Measure(**measure, still_s=1e-3, sum_s=5e-4)
    return replace(
        load_law(name, inner).laws[0],
        counts=Counts(measure=measured, modulate=Modulate(**modulate)),
    )


#: each modulator and compensation once, over-modulation of both kinds, two currents, short pulses,
#: calibration, sums of conversions
COUNTED = {
    "vsg-2": law("vsg-2", "none", {"f_y": 300.0, "calibrate": 8, "offset_most": 0.05}),
    "third": law("mimo-gfm", "cascaded", {"phases": 2}, kind="third-harmonic", dead_time_s=2e-6,
                 compensate="sign", over="scale"),
    "sine": law("droop-1", "none", {"bits": 16, "offset": {"i_a": 0.01}, "gain": {"v_b": 1.01}},
                kind="sine", dead_time_s=2e-6, compensate="predicted", min_pulse_s=3e-6),
    "discontinuous": law("psc-1", "virtual-stator", {"bits": 10, "samples": 8},
                         kind="discontinuous", v_dc="nominal", carriers=2, min_pulse_s=2e-6,
                         over="scale"),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Path]:
    """A folder with all laws in a precision and style; made once."""

    @cache
    def made(real: str, style: str) -> Path:
        return exported(tmp_path_factory.mktemp(f"{style}-{real}"), real, style, of=COUNTED)

    return made


def test_after_a_law_that_refuses_its_last_row_the_next_one_begins_anew(folder):
    """A change of law would ask the refusing one for its output."""
    found = check(folder("float32", "unrolled"), "host", ticks=300)
    assert [(c.rows, c.differ) for c in found] == [(300, 0)] * len(COUNTED)


@pytest.mark.parametrize(
    ("target", "real", "style", "flags"),
    [
        ("host", "float32", "unrolled", "-O2"), ("host", "float64", "records", "-O3"),
        ("clang", "float64", "unrolled", "-O2"), ("m4f", "float32", "unrolled", "-Os"),
        ("m4f", "float32", "records", "-O2"), ("m7", "float64", "unrolled", "-O2"),
        ("m3", "float32", "unrolled", "-O2"), ("s390x", "float32", "unrolled", "-O2"),
        ("aarch64", "float64", "unrolled", "-O2"), ("i386", "float32", "unrolled", "-O2"),
    ],
)  # fmt: skip
def test_the_whole_interrupt_has_the_kernels_bits(folder, target, real, style, flags):
    """With an A/D at its ends, too little v_dc, faults of sensors, resets and changes of law."""
    found = check(folder(real, style), target, flags)
    assert [(c.name, c.rows, c.differ) for c in found] == [(n, CHECKED, 0) for n in COUNTED]
    if (target, style) == ("m4f", "unrolled"):
        most = {c.name: c.instructions[1] for c in found if c.instructions}
        assert most.pop("third") <= 980  # three states and a cascaded stage
        assert max(most.values()) <= 860


def test_the_rows_reach_what_they_are_for():
    rows = golden(make_modules(COUNTED, T_S, "float64"), CHECKED)
    at = rows.columns.index
    results = rows.words[:, at("result")].astype(int)
    assert {OK, BAD_Y, BAD_U, BAD_SENSOR} <= {*results}
    assert np.mean(results == OK) > 0.5
    calibrations = rows.words[:, at("op")] == 6
    assert {OK, BAD_SENSOR} == {*results[calibrations]} and np.sum(calibrations) > 500
    compare = rows.words[:, at("u_cmp_a") : at("u_cmp_a") + 3].view(float)[results == OK]
    adc = rows.words[:, at("y_adc_v_dc") + 1 : at("y_adc_v_dc") + 10].view(float)[results == OK]
    assert np.sum(compare == 0) > 500 and np.sum(compare == 10_000) > 500
    assert np.sum(adc == 0) > 500 and np.sum(adc == 4095) > 500


@pytest.mark.parametrize("style", ["unrolled", "records"])
@pytest.mark.parametrize("real", ["float32", "float64"])
def test_the_code_compiles_without_a_warning(folder, real, style):
    at = folder(real, style)
    done = cc(at, *STRICT, "-Wdouble-promotion", "-ffp-contract=off", "-fsyntax-only",
              *sorted(p.name for p in at.glob("*.c")))  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_the_command_exports_and_checks_it(tmp_path, capsys):
    folder = str(tmp_path / "pins")
    assert main(["firmware", "export", "vsg-2", "--counts", "rig", "-o", folder]) == 0
    assert "gfm_vsg_2_isr(" in (tmp_path / "pins" / "gfm_vsg_2.h").read_text(encoding="utf-8")
    assert main(["firmware", "check", folder]) == 0
    assert main(["firmware", "export", "vsg-2", "--counts", "rigg", "-o", folder]) == 2
    assert "counts rigg: unknown" in capsys.readouterr().err


def test_what_has_no_interrupt_is_refused():
    with pytest.raises(LawError, match="fixed point does not"):
        make_modules(COUNTED | {"third": COUNTED["vsg-2"]}, T_S, FIXED)
    with pytest.raises(LawError, match=r"has no \[measure\] and \[modulate\], which others have"):
        make_modules(COUNTED | {"plain": load_law("vsg-1").laws[0]}, T_S, "float32")
