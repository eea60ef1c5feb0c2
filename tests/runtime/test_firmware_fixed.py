"""Firmware in fixed point: ranges and bounds against float64, bits on targets, the proof by EVA."""

import json
import math
import re
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_runtime import LawError
from gfm_runtime.firmware import CHECKED, FIXED, SHIPPED, TARGETS, check, make_modules, prove
from gfm_runtime.firmware.fixed import (
    G_MOST,
    NEAR,
    REFS,
    TREND,
    US,
    WORD,
    YS,
    ClampedRow,
    Instance,
    X,
    deviations,
    make_fixed,
    powers,
    refusal,
    sector,
    sine_of_half,
    to_integers,
)
from gfm_runtime.firmware.golden import RESET, SEGMENT, SWITCH, inputs
from gfm_runtime.firmware.module import BAD_REF, Module
from gfm_runtime.kernel import state_dtype, step
from gfm_runtime.signals import NU, group
from gfm_runtime.states import OK
from gfm_runtime.switchover import settle_into

from ..support.firmware import SOME, STRICT, T_S, cc, exported
from ..support.laws import LAWS, drive, slow_but

PAGES = Path(__file__).parents[2] / "docs"
#: one of each error map, and the most states
FAST = ("vsg-2", "psc-dc", "dvoc", "hybrid-angle", "vsg-11")
EACH_LAW = slow_but(FAST, LAWS)
COMPILERS = [pytest.mark.compilers, pytest.mark.timeout(900)]


def module(name: str) -> Module:
    return make_modules({name: LAWS[name]}, T_S, FIXED)[0]


def instance(m: Module) -> Instance:
    assert m.fixed is not None
    return Instance(m.fixed)


def in_pu(values: Any, numbers: Any) -> Any:
    return np.array([math.ldexp(v, -n.q) for v, n in zip(values, numbers, strict=True)])


def twin_inputs(m: Module, ref: Any, y: Any) -> tuple[Any, Any]:
    """As float64 sees them. The map of dvoc saturates in fixed point only: the twin gets the p and
    q at which its own map has that value; V below the least is the least in both."""
    refs, ys = in_pu(ref, REFS), in_pu(y, YS)
    if m.law is not None and m.law.error_map == "dvoc":
        for values in (refs, ys):
            most = G_MOST * max(values[4], 1e-3) ** 2
            values[[1, 3]] = np.clip(values[[1, 3]], -most, most)
    return refs, ys


def beside(m: Module, ticks: int, settles: bool) -> Any:
    """Rows of tick, ticks since the last settle, |difference of u| (3): the exact reference of the
    fixed-point arithmetic beside the kernel in float64, over golden inputs.

    After a settle both begin from the same u and trend: the bounds are from there on.
    """
    op, refs, ys = inputs(zlib.crc32(m.prefix.encode()), ticks, np.dtype("f8"))
    ref_rows, y_rows = to_integers(refs, REFS).tolist(), to_integers(ys, YS).tolist()
    one, law, state = instance(m), np.array([m.record])[0], np.zeros(1, state_dtype())
    state["u"] = in_pu(one.u, US)
    trends = one.law.numbers[TREND : TREND + NU]
    u, age, rows = np.zeros(NU), 0, []
    for k, (what, ref, y) in enumerate(zip(op, ref_rows, y_rows, strict=True)):
        if refusal(ref, y, BAD_REF) != OK:
            continue
        as_float = twin_inputs(m, ref, y)
        if settles and what in (SWITCH, RESET):
            now = one.look(ref, y) if what == SWITCH else list(one.u)
            trend = list(one.trend) if what == SWITCH else [0] * NU
            one.settle(ref, y, now, trend)
            settle_into(law, state[0], *as_float, in_pu(now, US), in_pu(trend, trends))
            age = 0
        age += 1
        fixed = one.step(ref, y)
        step(law, state[0], *as_float, u)
        rows.append((k, age, *np.abs(in_pu(fixed, US) - u)))
    return np.array(rows)


# --- word lengths ---


def test_formats_are_the_finest_that_hold_the_signal_table():
    """3 p.u. fit 2^29, 6 fit 2^28, 1.3 fit 2^30, 2 do not fit 2^30."""
    assert [one.q for one in YS] == [29, 28, 30, 28, 29]
    assert [one.q for one in US] == [28, 30, 29]
    assert [one.q for one in REFS] == [30, 29, 30, 29, 30]
    for one, signal in zip((*REFS, *YS, *US), (*group("ref"), *group("y"), *group("u")),
                           strict=True):  # fmt: skip
        assert max(abs(one.low), abs(one.high)) <= WORD < 2 * max(abs(one.low), abs(one.high)) + 2
        assert signal.low <= one.span[0] and one.span[1] <= signal.high


def test_sums_of_powers_against_closed_forms():
    total, peak = powers(np.array([[0.9]]))
    assert total[0, 0] == pytest.approx(10, rel=1e-8) and total[0, 0] >= 10 * (1 - 1e-12)
    assert peak[0, 0] == pytest.approx(1)
    total, _ = powers(np.array([[0.5, 0.25], [0.0, -0.5]]))
    # |A^m| has 0.5^m on the diagonal; beside it 0.25 0.5^(m-1) for odd m, 0 for even m
    np.testing.assert_allclose(total, [[2, 1 / 3], [0, 2]], rtol=1e-8)
    with pytest.raises(ValueError):
        powers(np.eye(1))


def test_the_gain_of_a_clamped_row_against_its_closed_form():
    """One state a, anti-windup w along it: the gain is (a w/2)/(1 - a (1 - w/2)), below 1."""
    a, w = 0.998, 0.005
    *_, gain = sector(ClampedRow(np.array([[a]]), np.ones(1), np.array([w])))
    assert gain == pytest.approx(a * w / 2 / (1 - a * (1 - w / 2)), rel=1e-8) and gain < 1
    # a second, faster state that the anti-windup leaves alone changes nothing
    both = ClampedRow(np.diag([a, 0.9]), np.ones(2), np.array([w, 0.0]))
    assert sector(both)[3] == pytest.approx(gain, rel=1e-5)


@pytest.mark.parametrize("name", EACH_LAW)
def test_states_stay_in_their_ranges_and_sums_in_their_words(name):
    """The float64 law from extreme to extreme of its inputs: no state leaves its proven range, and
    no sum of the exact reference reaches 2^63, though inputs and states are at their ends."""
    m = module(name)
    law = instance(m).law
    rng = np.random.default_rng(1)
    record, state, u = np.array([m.record]), np.zeros(1, state_dtype()), np.zeros(NU)
    spans = np.array([one.span for one in law.numbers[X:]]).reshape(-1, 2)
    for _ in range(40):
        ref, y = (np.array([rng.choice(n.span) for n in many]) for many in (REFS, YS))
        ref, y = twin_inputs(m, *(to_integers(v, n).tolist() for v, n in ((ref, REFS), (y, YS))))
        drive(record, state, ref, y, u, 300)
        x = state["x"][0, : law.n]
        assert (spans[:, 0] <= x).all() and (x <= spans[:, 1]).all()
    ends = [(one.low, one.high) for one in law.numbers]
    for total in (*law.output, *law.state, *law.decay, *law.follow, *law.settle, *law.last):
        worst = abs(total.start) + sum(abs(c) * max(map(abs, ends[p])) for c, p in total.terms)
        assert worst < 2**62 and all(abs(c) <= WORD for c, _ in total.terms)


# --- arithmetic ---


def test_no_dead_band_holds_an_integrator():
    """An error of one unit of v_dc, 2^-29 p.u.: vsg-1 integrates 0.04 of it a tick, a 1,600th of a
    unit of its state, 2^-23 p.u.; after 20,000 ticks that is 12.5 units."""
    m = module("vsg-1")
    one = instance(m)
    ref, y = to_integers([1, 0.5, 1, 0, 1], REFS).tolist(), to_integers([1, 0.5, 1, 0, 1], YS)
    for _ in range(100):
        one.step(ref, y.tolist())
    before = one.x[0]
    y[0] -= 1
    for _ in range(20_000):
        one.step(ref, y.tolist())
    assert float(m.record["B_r"][0, 0]) == pytest.approx(0.04)
    assert abs(one.x[0] - before - 0.04 * 2.0**-29 * 20_000 * 2**23) <= 1


def test_equal_inputs_cancel_exactly():
    """At references equal to measurements no integrator moves: matched coefficients cancel."""
    for name in ("vsg-2", "mimo-gfm"):
        one = instance(module(name))
        rest = [1, 0.5, 1, 0, 1]
        ref, y = to_integers(rest, REFS).tolist(), to_integers(rest, YS).tolist()
        for _ in range(10_000):
            one.step(ref, y)
        assert one.x[0] == 0 and one.x[-1] == 0


def test_the_half_angle_against_libm():
    rng, pairs = np.random.default_rng(2), ([0, 0], [0, 0], [0, 0])
    for a, b in rng.uniform(-math.pi, math.pi, (500, 2)):
        size, other = 2.0 ** rng.uniform(20, 60, 2)
        vectors = [round(v) for v in (size * math.cos(a), size * math.sin(a),
                                      other * math.cos(b), other * math.sin(b))]  # fmt: skip
        a, b = math.atan2(vectors[1], vectors[0]), math.atan2(vectors[3], vectors[2])
        ours = sine_of_half(*vectors, *pairs) / 2**30
        assert ours == pytest.approx(math.sin((a - b) / 2), abs=1.2e-8)
    assert sine_of_half(0, 0, 1, 1, *pairs) == 0


# --- how far from float64 ---


@pytest.mark.parametrize("name", EACH_LAW)
def test_what_is_seen_is_within_what_is_proven(name):
    m = module(name)
    assert m.fixed is not None
    rows = beside(m, 12 * SHIPPED, settles=True)
    proven = deviations(m.fixed, m.record, FIXED)
    kind = rows[:, 0] // SEGMENT % 7
    assert len(rows) > 0.98 * 12 * SHIPPED and rows[:, 1].max() > 100
    for i, found in enumerate(proven):
        if name == "hybrid-angle" and i == 1:  # its map jumps: no bound for all inputs
            assert math.isinf(found.bound)
            continue
        assert (rows[:, 2 + i] <= found.after(rows[:, 1])).all()
        assert rows[:, 2 + i].max() > 1e-10
    angle = name == "hybrid-angle"
    assert rows[:, 2:][:, [0, 2] if angle else [0, 1, 2]].max() < 1e-4
    assert rows[kind == 0][:, 2:].max() < 1e-6  # the first ticks of each 210 have small signals
    first = rows[rows[:, 0] < SEGMENT]  # none before them that are not small
    for i, found in enumerate(deviations(m.fixed, m.record, FIXED, near=True)):
        assert (first[:, 2 + i] <= found.after(first[:, 1])).all()
        # the square of the DC voltage, up to 4.5 p.u., has half the resolution
        assert found.after(SEGMENT) < (1.5e-6 if name == "psc-dc" else 1e-6)


@pytest.mark.full
@pytest.mark.parametrize("name", ["vsg-2", "mimo-gfm", "vsg-10"])
def test_the_drift_of_integrators_is_within_its_bound(name):
    """20,160 ticks without a settle; only rows with an integrator may drift."""
    m = module(name)
    assert m.fixed is not None
    rows = beside(m, 2 * CHECKED, settles=False)
    for i, found in enumerate(deviations(m.fixed, m.record, FIXED)):
        assert (rows[:, 2 + i] <= found.after(rows[:, 1])).all()
        assert found.after(len(rows)) < 1e-4


@pytest.mark.parametrize("name", [pytest.param("vsg-11"), pytest.param(
    "mimo-gfm", marks=pytest.mark.full)])  # fmt: skip
def test_float32_is_within_its_bound(name):
    m = module(name)
    assert m.fixed is not None
    single = make_modules({name: LAWS[name]}, T_S, "float32")[0]
    proven = deviations(m.fixed, m.record, "float32")
    _, refs, ys = inputs(3, 2100, np.dtype("f4"))
    runs = []
    for one, real in ((m, np.float64), (single, np.float32)):
        law, state = np.array([one.record])[0], np.zeros(1, state_dtype(real))
        state["u"], out, u = [0, 1, 1], [], np.zeros(NU, real)
        for ref, y in zip(refs, ys, strict=True):
            inside = [np.clip(v, [n.span[0] for n in many], [n.span[1] for n in many])
                      for v, many in ((ref, REFS), (np.nan_to_num(y, nan=1.0), YS))]  # fmt: skip
            step(law, state[0], *(v.astype("f4").astype(real) for v in inside), u)
            out.append(u.astype(float))
        runs.append(np.array(out))
    difference = np.abs(runs[1] - runs[0])
    for i, found in enumerate(proven):
        assert (difference[:, i] <= found.after(1 + np.arange(len(difference)))).all()
        assert difference[:, i].max() > 1e-9


def test_small_signals_have_the_smaller_bound():
    m = module("vsg-1")
    assert m.fixed is not None and NEAR == 0.05
    near, whole = (deviations(m.fixed, m.record, FIXED, close) for close in (True, False))
    assert all(a.bound <= b.bound and a.drift <= b.drift for a, b in zip(near, whole, strict=True))
    assert max(one.bound for one in near) < 1e-6 and near[0].drift < whole[0].drift / 50


# --- the folder ---


def test_the_folder_says_formats_and_bounds(tmp_path):
    folder = exported(tmp_path, FIXED, "unrolled", "vsg-1")
    header = (folder / "gfm_vsg_1.h").read_text(encoding="utf-8")
    found = dict(re.findall(r"GFM_VSG_1_Q_(\w+) = (\d+)", header))
    assert (found["Y_V_DC"], found["REF_Q_REF"], found["U_OMEGA_U"]) == ("29", "29", "30")
    assert "float" not in re.sub(r"/\*.*?\*/", "", header, flags=re.DOTALL)
    (law,) = json.loads((folder / "report.json").read_text(encoding="utf-8"))["laws"]
    m = module("vsg-1")
    assert m.fixed is not None
    for said, proven in zip(
        law["deviation"]["fixed"], deviations(m.fixed, m.record, FIXED), strict=True
    ):
        assert proven.bound <= said["bound"] < 1.2 * proven.bound + 1e-12
        assert proven.drift / T_S <= said["drift"] <= 1.2 * proven.drift / T_S + 1e-12


def test_limits_beyond_the_signal_table_and_unbounded_states_are_refused():
    record = module("vsg-2").record.copy()
    record["high"][0] = 7.0
    with pytest.raises(LawError, match=r"limits.i_u = \[-5, 7\] must lie in"):
        make_fixed("x", record)
    record["high"][0] = 5.0
    record["W"][:] = 0
    with pytest.raises(LawError, match="the row of i_u has an integrator"):
        make_fixed("x", record)


@pytest.mark.parametrize(
    ("real", "said"),
    [("float32", "has float32; it proves --real fixed only"), (FIXED, "install frama-c-base")],
)
def test_eva_refuses_floats_and_names_its_package(real, said, tmp_path, refused, monkeypatch):
    folder = exported(tmp_path, real, "unrolled", "droop-1")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert said in refused("firmware", "check", str(folder), "--target", "eva")


# --- compiled ---


class TestCompiled:
    pytestmark = COMPILERS

    @pytest.fixture(scope="class")
    @staticmethod
    def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
        return exported(tmp_path_factory.mktemp("fixed"), FIXED, "unrolled")

    def test_every_law_has_the_references_bits(self, folder):
        """On a Cortex-M4F; the host has those of some in the self-test and in many rows."""
        found = check(folder, "m4f", ticks=SHIPPED)
        assert [c.name for c in found] == list(LAWS) and {c.rows for c in found} == {SHIPPED}
        assert sum(c.differ for c in found) == 0
        table = (PAGES / "tables" / "firmware_fixed.md").read_text(encoding="utf-8")
        compiler = TARGETS["m4f"].prefix + TARGETS["m4f"].compiler
        version = cc(PAGES, "--version", compiler=compiler).stdout.splitlines()[0]
        if version in table:
            for c in found:
                assert c.instructions is not None
                row = f"| {c.name} | {c.instructions[0]}…{c.instructions[1]} | {c.code} |"
                assert row in table, "python docs/make_firmware_tables.py makes the table anew"

    def test_many_rows_have_the_references_bits(self, tmp_path):
        folder = exported(tmp_path, FIXED, "unrolled", "vsg-2", "hybrid-angle")
        for target, flags in (("m4f", "-O2"), ("host", "-O3"), ("clang", "-O3")):
            found = check(folder, target, flags)
            assert [(c.rows, c.differ) for c in found] == [(CHECKED, 0)] * 2

    def test_a_wrong_bit_is_found(self, tmp_path):
        """The negative control: a coefficient that is one off."""
        folder = exported(tmp_path, FIXED, "unrolled", "vsg-1")
        source = folder / "gfm_vsg_1.c"
        one_off = source.read_text(encoding="utf-8").replace(
            "(42949673, t->ref", "(42949674, t->ref"
        )
        source.write_text(one_off, encoding="utf-8")
        assert main(["firmware", "check", str(folder)]) == 3

    @pytest.mark.parametrize("compiler", ["gcc", "clang"])
    def test_the_code_compiles_without_a_warning(self, folder, compiler):
        sources = [f"gfm_{name.replace('-', '_')}.c" for name in SOME]
        done = cc(folder, *STRICT, "-fsyntax-only", *sources, "selftest.c", compiler=compiler)
        assert (done.returncode, done.stderr) == (0, "")

    def test_sanitizers_find_nothing_and_nothing_else_is_called(self, tmp_path):
        folder = exported(tmp_path, FIXED, "unrolled", *SOME)
        sources = sorted(p.name for p in folder.glob("*.c"))
        flags = ["-O1", "-fsanitize=undefined,address", "-fno-sanitize-recover=all"]
        assert cc(folder, *STRICT, *flags, *sources, "-o", "selftest").returncode == 0
        ran = subprocess.run([folder / "selftest"], capture_output=True, text=True, check=False)
        rows = SHIPPED * len(SOME)
        assert (ran.returncode, ran.stdout) == (0, f"{rows} rows, 0 words differ\n")
        for source in sources:
            if source.startswith("gfm_"):
                assert cc(folder, *STRICT, "-O2", "-c", source, "-o", "one.o").returncode == 0
                said = cc(folder, "-u", "one.o", compiler="nm").stdout
                assert set(said.split()) <= {"U", "_GLOBAL_OFFSET_TABLE_"}

    def test_eva_has_no_alarm_but_with_a_wrong_exponent(self, tmp_path):
        """0 alarms for a linear law and the largest map; some where a coefficient is times 2^4."""
        folder = exported(tmp_path, FIXED, "unrolled", "vsg-1", "hybrid-angle")
        assert [p.alarms for p in prove(folder)] == [0, 0]
        (tmp_path / "wrong").mkdir()
        folder = exported(tmp_path / "wrong", FIXED, "unrolled", "vsg-1")
        source = folder / "gfm_vsg_1.c"
        text = source.read_text(encoding="utf-8")
        found = re.search(r"product\(\d+, s->x\[0\]\)", text)
        assert found is not None
        source.write_text(text.replace(found[0], f"16 * {found[0]}", 1), encoding="utf-8")
        (one,) = prove(folder)
        assert one.alarms >= 1
