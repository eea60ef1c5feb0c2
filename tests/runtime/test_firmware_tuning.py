"""Gains that change while exported code runs: coefficients, bits, ranges, two sets, DLL and FMU."""

import ctypes as c
import functools
import zlib
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_runtime import (
    LawError,
    discretise,
    get_law,
    law_file,
    law_names,
    load_law,
    pack_law,
    tuned_names,
)
from gfm_runtime.catalogue import grid_names
from gfm_runtime.firmware import check, make_modules
from gfm_runtime.firmware.module import tunable
from gfm_runtime.firmware.tuning import FIELDS, GainChanges
from gfm_runtime.kernel import state_dtype
from gfm_runtime.lawfile import parse_law, tied
from gfm_runtime.switchover import settle_into

from ..support.firmware import T_S, accepted, bench, cc, exported
from ..support.laws import slow_but
from .test_firmware_dll import MESSAGE, OK, Model
from .test_firmware_fmu import Unit

TICKS, AT = 400, 200  # ticks of a run, and the one that changes gains
NEW = {"D_p": 0.02, "k_22": 9.0, "k_34": 2.5}  # of vsg-2


def tuning_of(name: str, real: str = "float64", inner: str | None = None) -> GainChanges:
    """What C knows of a law of the catalogue."""
    (law,) = load_law(name, inner).laws
    (module,) = make_modules({name: law}, T_S, real)
    found = tunable(module, law_file(name), T_S).tuning
    assert found is not None
    return found


@pytest.mark.parametrize(
    "name", [n for n in (*law_names(), *tuned_names(), *grid_names()) if not law_file(n).schedule]
)
def test_the_coefficients_are_those_of_the_law_with_these_gains(name):
    """Against ``discretise``, which uses LAPACK. C keeps the scale of a state, a power of two that
    other gains may change there: what is nearest to rest then is another state."""
    tuning = tuning_of(name)
    sets = tuning.sets(1)
    assert sets[0] == tuning.gains and len(sets) == 3
    for gains in sets:
        found = tuning.record_of(gains)
        law = get_law(name, **tied(tuning.file, gains))
        expected = pack_law(discretise(law, T_S))[0]
        n = int(found["n"])
        scale = np.ones(len(found["A"]))
        for row in range(3):
            own = [k for k in range(n) if found["row"][k] == row]
            scale[own] = found["C"][row, own] / expected["C"][row, own]
        np.testing.assert_allclose(np.log2(scale), np.round(np.log2(scale)), atol=1e-6)
        scale = np.exp2(np.round(np.log2(scale)))
        same = bool((scale == 1.0).all())
        for field in FIELDS if same else ("A", "B_r", "B_y", "C", "D_r", "D_y", "loop", "W"):
            factor = {"A": scale / scale[:, None], "C": scale}.get(field)
            if factor is None:
                by_state = field in ("B_r", "B_y", "W")
                factor = 1 / scale[:, None] if by_state else 1.0
            wanted = expected[field] * factor
            most = np.abs(wanted).max(initial=1e-300)
            assert np.abs(found[field] - wanted).max(initial=0.0) <= 1e-10 * most, field


@pytest.mark.full
@pytest.mark.parametrize(
    ("laws", "how"),
    [(("vsg-2", "vsg-12", "hybrid-angle", "matching-2", "dvoc"), ("--real", "float64")),
     (("mimo-gfm", "droop-4"), ("--inner", "cascaded", "--counts", "rig", "--real", "float32"))],
    ids=["plain", "counts"],
)  # fmt: skip
def test_golden_rows_with_changes_of_gains_have_the_kernels_bits(tmp_path, laws, how):
    """The self-test that the sanitizers run has plain laws in float32 in this style."""
    command = ["firmware", "export", *laws, *how, "--style", "tunable"]
    assert main([*command, "-o", str(tmp_path)]) == 0
    assert [(one.rows, one.differ) for one in check(tmp_path, "host")] == [(10080, 0)] * len(laws)
    # a wrong coefficient is found, so the rows depend on the gains
    source = tmp_path / f"gfm_{laws[0].replace('-', '_')}.c"
    source.write_text(source.read_text().replace("const double t0 = ", "const double t0 = 1.01 * "))
    assert check(tmp_path, "host")[0].differ > 0


class Library:
    """The C of vsg-2 in style tunable, and one instance."""

    def __init__(self, folder: Path) -> None:
        exported(folder, "float64", "tunable", "vsg-2")
        flags = ["-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
        assert cc(folder, *flags, "gfm_vsg_2.c", "-o", "law.so", "-lm").returncode == 0
        self.of = c.CDLL(str(folder / "law.so"))
        self.tuning = tuning_of("vsg-2")
        header = (folder / "gfm_vsg_2.h").read_text()
        assert f"GFM_VSG_2_NGAINS = {len(self.tuning.gains)}" in header
        numbers, n = c.c_double, len(self.tuning.first)

        class Set(c.Structure):
            _fields_ = (("c", numbers * n), ("crc", c.c_uint32))

        class Law(c.Structure):
            _fields_ = (
                ("x", numbers * 3), ("offset", numbers * 3), ("u", numbers * 3),
                ("trend", numbers * 3), ("reason", c.c_int), ("channel", c.c_int),
                ("set", Set * 2), ("active", c.c_int), ("ready", c.c_int),
            )  # fmt: skip

        self.law = Law()
        self.of.gfm_vsg_2_init(c.byref(self.law))

    def tune(self, **gains: float) -> int:
        values = {**self.tuning.gains, **gains}
        packed = (c.c_double * len(values))(*values.values())
        return int(self.of.gfm_vsg_2_tune(c.byref(self.law), packed))

    def step(self, ref: Any, y: Any) -> np.ndarray:
        u = np.zeros(3)
        given = [np.array(one).ctypes.data_as(c.c_void_p) for one in (ref, y)]
        assert self.of.gfm_vsg_2_step(c.byref(self.law), *given, u.ctypes.data_as(c.c_void_p)) == 0
        return u

    def coefficients(self) -> np.ndarray:
        return np.array(self.law.set[self.law.active].c)


@pytest.fixture
def library(tmp_path: Path) -> Library:
    return Library(tmp_path)


REF, Y = [1.0, 0.5, 1.0, 0.0, 1.0], [1.0, 0.4, 1.0, 0.1, 0.98]


def test_a_step_has_the_old_set_or_the_new_one(library):
    old, of = library.coefficients(), library.tuning
    library.step(REF, Y)
    before = library.step(REF, Y)
    assert library.tune(**NEW) == 0
    np.testing.assert_array_equal(library.coefficients(), old)  # no step has come yet
    after = library.step(REF, Y)
    np.testing.assert_allclose(after, before, atol=1e-3)  # no bump
    record = of.record_of(NEW)
    assert library.coefficients()[0] == record["A"][1, 1] != old[0]
    assert library.tune() == 0 and library.tune(D_p=0.03) == 0  # the newest holds
    library.step(REF, Y)
    assert library.coefficients()[2] == of.record_of({"D_p": 0.03})["B_r"][1, 1]
    library.of.gfm_vsg_2_init(c.byref(library.law))
    np.testing.assert_array_equal(library.coefficients(), old)


@pytest.mark.parametrize(
    ("gains", "why"),
    [({"k_22": 0.05}, 4), ({"k_34": 101.0}, 5), ({"D_p": float("nan")}, 3), ({"D_q": 0.0}, 7),
     ({"k_pdc": 1e13}, 7), ({"k_idc": float("inf")}, 2)],
)  # fmt: skip
def test_gains_that_no_law_has_are_refused_and_the_old_ones_stay(library, gains, why):
    old = bytes(library.law)
    assert library.tune(**gains) == why
    assert bytes(library.law) == old
    with pytest.raises(LawError):
        library.tuning.record_of(gains)


def test_the_crc_is_that_of_zlib_and_finds_any_bit_that_changed(library):
    def intact() -> int:
        return int(library.of.gfm_vsg_2_intact(c.byref(library.law)))

    for _ in range(2):
        active = library.law.set[library.law.active]
        assert active.crc == zlib.crc32(bytes(active.c)) and intact() == 1
        for k in (0, len(active.c) - 1):
            word = c.cast(c.byref(active.c, 8 * k), c.POINTER(c.c_uint64))[0]
            for bit in (0, 31, 63):
                c.cast(c.byref(active.c, 8 * k), c.POINTER(c.c_uint64))[0] = word ^ 1 << bit
                assert intact() == 0
            c.cast(c.byref(active.c, 8 * k), c.POINTER(c.c_uint64))[0] = word
        assert library.tune(**NEW) == 0
        library.step(REF, Y)


@functools.cache
def ticks(inner: str, real: str) -> tuple[Any, Any, Any, Any]:
    """References, measurements, the first u, and u and the states of the kernel, whose gains change
    at ``AT``."""
    refs, ys = accepted(1, TICKS, real, inner != "none")
    u = np.array([0.5, 1.0, 1.0, 0.05][: 3 + (inner != "none")], real).astype(float)
    kernel = bench("vsg-2", inner, real, refs[0], ys[0], u)
    out, now = [], u.copy()
    for k in range(TICKS):
        if k == AT:
            record = tuning_of("vsg-2", real, inner).record_of(NEW)
            kernel.retune(kernel.discrete[0], record.reshape(1), NEW)
        kernel.ctl["ref"] = kernel.ctl["ref_target"] = refs[k]
        kernel.step(ys[k], now)
        out.append(now.copy())
    assert int(kernel.ctl["active"][0]) != 0
    return refs, ys, u, out


@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize("inner", slow_but(["none"], ["none", "cascaded"]))
def test_a_dll_whose_parameters_change_has_the_kernels_bits(tmp_path, inner, real):
    command = ["firmware", "dll", "vsg-2", "--inner", inner, "--real", real, "-o", str(tmp_path)]
    assert main(command) == 0
    refs, ys, u, expected = ticks(inner, real)
    model, gains = Model(next(tmp_path.glob("*.so"))), tuning_of("vsg-2").gains
    model.parameters = np.array([*gains.values()])
    model.start(u)
    for k in range(TICKS):
        if k == AT - 5:
            model.parameters = np.array([*(gains | {"k_22": 1000.0}).values()])
            assert model.tick(refs[k], ys[k]) == MESSAGE  # once
            assert model.message == b"the gain k_22 is out of range"
        else:
            if k == AT:
                model.parameters = np.array([*(gains | NEW).values()])
            assert model.tick(refs[k], ys[k]) == OK
        assert model.outputs.tobytes() == np.append(expected[k], 0.0).tobytes(), k


@pytest.mark.parametrize("fmi", ["2", "3"])
@pytest.mark.parametrize("inner", ["none", "cascaded"])
def test_an_fmu_whose_parameters_change_has_the_kernels_bits(tmp_path, inner, fmi):
    file, folder = tmp_path / "law.fmu", tmp_path / "unpacked"
    command = ["firmware", "fmu", "vsg-2", "--inner", inner, "--real", "float64", "--fmi", fmi]
    assert main([*command, "-o", str(file)]) == 0
    fmpy.extract(str(file), folder)
    refs, ys, u, expected = ticks(inner, "float64")
    unit = Unit(folder)
    unit.start(u)
    places = [unit.place(f"gain.{name}") for name in NEW]
    for k in range(TICKS):
        if k == AT:
            unit.set(places, NEW.values())
        assert unit.tick(refs[k], ys[k])[: len(u)] == expected[k].tolist(), k
    assert unit.get(places) == [*NEW.values()]
    with pytest.raises(Exception, match=r"fmi\dSet(Real|Float64)"):
        unit.set(places[1:2], [1000.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("phi.22 = { type = 'TF', num = [1.0], den = [1.0, 'D_p', 3.0, 1.0] }", "tuned while it"),
        ("phi.22 = { type = 'P', k = '2 ** D_p' }", "power"),
    ],
)
def test_a_law_whose_form_follows_from_its_gains_is_refused(text, said):
    file = parse_law(f"name = 'x'\ntitle = 'x'\nsource = 'x'\nparameters.D_p = 3.0\n{text}\n")
    with pytest.raises((LawError, TypeError), match=said):
        GainChanges(file, pack_law(discretise(get_law("vsg-2"), T_S))[0], T_S)


def test_what_the_style_does_not_cover_is_said(tmp_path, refused):
    command = ["firmware", "export", "mimo-gfm-scheduled", "--style", "tunable"]
    assert "is scheduled, which --style tunable does not cover" in refused(
        *command, "-o", str(tmp_path)
    )
    assert "fixed point has its constants in the code" in refused(
        "firmware", "export", "vsg-2", "--style", "tunable", "--real", "fixed", "-o", str(tmp_path)
    )


def test_settle_takes_gains_at_once(library):
    """A law that is tuned before it starts has the state that the kernel gives it."""
    record = library.tuning.record_of(NEW)
    state = np.zeros(1, state_dtype("float64"))
    u, trend = np.array([0.5, 1.0, 1.0]), np.zeros(3)
    settle_into(record.reshape(1)[0], state[0], np.array(REF), np.array(Y), u.copy(), trend)
    assert library.tune(**NEW) == 0
    given = [np.array(one).ctypes.data_as(c.c_void_p) for one in (REF, Y)]
    out = [one.ctypes.data_as(c.c_void_p) for one in (u, trend)]
    assert library.of.gfm_vsg_2_settle(c.byref(library.law), *given, *out) == 0
    assert [*library.law.x] == state["x"][0, :3].tolist() and library.law.ready == 0
