"""Firmware without a compiler: the text, the golden rows, the report, and what is refused."""

import json
import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.cli import main
from gfm_runtime import BuiltLaw, LawError, LawSet, get_law, load_law
from gfm_runtime.assembly import Controller
from gfm_runtime.firmware import REALS, SHIPPED, STYLES, check, export, golden, make_modules
from gfm_runtime.firmware.c_text import choose_parts, literal, plain
from gfm_runtime.firmware.golden import INIT, RESET, SPOIL, SPOIL_STAGE, SWITCH
from gfm_runtime.firmware.module import BAD_REF, fields, sources
from gfm_runtime.firmware.report import read_report
from gfm_runtime.inner import INNER_STATE, VirtualStator, settle
from gfm_runtime.signals import NU, NY, carried_rows, command_rows, group
from gfm_runtime.states import BAD_U, BAD_Y, OK, RUNNING, SAFE
from gfm_runtime.switchover import settle_into

from ..support.firmware import FEW_STAGED, SOME, STAGED, files_of
from ..support.laws import LAWS, repeatable

T_S = 1e-4
#: a few laws with inner stages
SOME_STAGED = ("vsg-2 cascaded", "threshold-impedance d", "virtual-stator q", "no stage")


def of(*names: str) -> dict[str, BuiltLaw]:
    return {name: (LAWS | STAGED)[name] for name in names}


@cache
def texts(laws: tuple[str, ...], real: str, style: Any) -> dict[str, str]:
    """The files of an export, made once."""
    return export(of(*laws), T_S, real, style, files=files_of(of(*laws)))


def columns(rows: Any, real: str, *prefixes: str) -> list[Any]:
    """Blocks of the columns whose names begin with a prefix, as numbers; x are the law's states."""
    found = [rf"{p}_{'[0-9]' * (p == 'x')}" for p in prefixes]
    return [
        rows.words[:, [bool(re.match(one, c)) for c in rows.columns]].view(real) for one in found
    ]


# --- golden rows ---


@pytest.mark.parametrize(
    ("name", "real"),
    [("vsg-2", "float64")]
    + [
        pytest.param(name, real, marks=pytest.mark.full)
        for name, real in [(n, "float64") for n in (*LAWS, *STAGED)]
        + [(n, "float32") for n in (*SOME, *FEW_STAGED)]
        if (name, real) != ("vsg-2", "float64")
    ],
)
def test_golden_rows_are_what_the_controller_does(name, real):
    """Rows against the tick of the bench: u, states, refusals, changes."""
    law = (LAWS | STAGED)[name]
    modules = make_modules({name: law}, T_S, real)
    rows = golden(modules, 2 * SHIPPED)
    refs, ys, us, xs, trends = (
        np.asarray(part, "f8") for part in columns(rows, real, "ref", "y", "u", "x", "trend")
    )
    twins = [LawSet(n, (law,)) for n in ("one", "other")]
    bench = Controller(twins, T_S, refs[0], real=real)
    start = np.array([s.default for s in group("u")])
    bench.start(np.zeros(modules[0].n), start)
    u, own = np.zeros(us.shape[1]), np.zeros(NU)
    bench.states["pll"], bench.states["omega_pll"] = (1.0, 0.0), 1.0  # as init leaves them
    bench.states["e"] = (start[2], 0.0)
    variables = [(v, columns(rows, real, v)[0]) for v, size, _ in INNER_STATE if size > 1]
    for k, (op, _, result) in enumerate(rows.words[:, :3]):
        assert (k == 0) == (op == INIT)
        if result == BAD_REF and bench.ctl["state"][0] == RUNNING:
            bench.ctl["state"] = SAFE  # the scenario's task on the bench
        bench.ctl["ref"] = bench.ctl["ref_target"] = refs[k]
        if op == SWITCH:
            bench.select("other" if bench.active == "one" else "one")
        if op == RESET:
            i = int(bench.ctl["active"][0])
            own[:] = bench.states[i]["u"]
            settle_into(bench.laws[i], bench.states[i], refs[k], ys[k], own, np.zeros(NU))
            if modules[0].stages:
                one = slice(i, i + 1)
                e = bench.states[i]["e"].astype(float)
                settle(bench.laws[one], bench.states[one], own, ys[k], *e)
            bench.reset()
            bench.ctl["state"] = RUNNING
        state = bench.states[int(bench.ctl["active"][0])]
        if op == SPOIL:
            state["offset"][0] = np.nan
        elif op == SPOIL_STAGE:
            state["away"][0] = np.nan
        bench.step(ys[k], u)
        state = bench.states[int(bench.ctl["active"][0])]
        assert (bench.ctl["state"][0] == RUNNING) == (result == OK)
        np.testing.assert_array_equal(us[k], u)
        np.testing.assert_array_equal(xs[k], state["x"][: xs.shape[1]])
        np.testing.assert_array_equal(trends[k], state["trend"])
        for variable, values in variables if modules[0].stages else ():
            np.testing.assert_array_equal(values[k], state[variable], variable)


@pytest.mark.full
@pytest.mark.parametrize("real", REALS)
def test_golden_rows_reach_all_paths(real):
    modules = make_modules(of("mimo-gfm", "vsg-1"), T_S, real)
    rows = golden(modules, 10_080)
    refs, ys, us, offsets = columns(rows, real, "ref", "y", "u", "offset")
    limits = LAWS["vsg-1"].limits
    for j in range(NU):
        assert {limits.low[j], limits.high[j]} <= set(us[:, j].astype(float).round(6))
    tiny = np.finfo(real).tiny
    assert np.sum((ys != 0) & (np.abs(ys) < tiny)) > 1000 and np.isnan(ys).any()
    assert np.isinf(ys).any() and offsets.any()
    ops, law, result = rows.words[:, :3].T
    assert {*ops} == {0, INIT, SWITCH, RESET, SPOIL}
    assert {*result} == {OK, BAD_Y, BAD_U, BAD_REF}
    assert sum((np.diff(law.astype(int)) != 0) & (ops[1:] == SWITCH)) == 1, (
        "a change to another law"
    )
    bumps = rows.words[:, rows.columns.index("bump")].view(real)
    assert bumps.max() < 1e3 * np.finfo(real).eps
    again = 1 + np.flatnonzero((result[1:] != OK) & (result[:-1] != OK))
    np.testing.assert_array_equal(us[again], us[again - 1])  # held in the safe state
    ramps = np.diff(refs[30:60, 1].astype(float))
    assert np.ptp(ramps) < 1e-6 < abs(ramps[0])


@pytest.mark.full
@pytest.mark.parametrize("name", [n for n in STAGED if n != "no stage"])
def test_golden_rows_reach_all_paths_of_a_stage(name):
    real = "float32"
    module = make_modules(of(name), T_S, real)[0]
    stage = module.law.inner if module.law else None
    assert stage is not None
    rows = golden([module], SHIPPED)
    limited = rows.words[:, rows.columns.index("limited")] == 1
    i_ref, e, i_f, pll = columns(rows, real, "i_ref", "e", "i_f", "pll")
    assert 20 < limited.sum() < SHIPPED - 20
    size = np.hypot(*i_ref.T.astype(float))
    at_limit = np.isclose(size, stage.I_max, rtol=1e-6)
    assert at_limit.any()
    if stage.kind == "threshold-impedance":
        assert (limited & ~at_limit).any() and (np.hypot(*i_f.T) < stage.I_thr).any()
    elif stage.kind == "dual-sequence":  # the negative sequence has its part of the limit
        assert (limited & ~at_limit).any() and np.nanmax(size) <= stage.I_max * (1 + 1e-6)
    else:
        np.testing.assert_array_equal(limited, limited & at_limit)
    most = stage.m * columns(rows, real, "y")[0][:, 0]
    at_modulation = np.isclose(np.hypot(*e.T), most, rtol=1e-6)
    assert at_modulation.any() and not at_modulation.all()
    if math.isfinite(stage.P_max):
        for side in ("x_high", "x_low"):
            assert rows.words[:, rows.columns.index(side)].any(), side
    x, y = columns(rows, real, "x", "y")
    voltage = np.hypot(y[:, 7], y[:, 8])
    assert (voltage < 0.05).any(), "the PLL holds its frequency"
    if stage.f_pll:
        assert len(np.unique(pll[:, 0])) > SHIPPED / 2
    held = [i for i in range(module.n) if module.record["row"][i] == 2]
    if stage.freeze and held:
        ops = rows.words[:, 0]
        running = limited[1:] & (ops[1:] == 0) & (rows.words[1:, 2] == OK)
        still = np.all(x[1:, held] == x[:-1, held], axis=1)
        assert 0.0 < still[running].mean() < 1.0, "held, and not where E_u moves towards v"
        assert not still[~limited[1:]].all()
    away = columns(rows, real, "away")[0]
    assert (away == 0).any() and (away != 0).any()


@pytest.mark.full
def test_golden_rows_of_a_law_do_not_depend_on_their_number():
    modules = make_modules(of("dvoc"), T_S, "float32")
    few, many = golden(modules, SHIPPED), golden(modules, 2 * SHIPPED)
    np.testing.assert_array_equal(few.words, many.words[:SHIPPED])


# --- text ---


@repeatable
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_literal_is_its_number_to_the_bit(value):
    for real in (np.float64, np.float32):
        with np.errstate(over="ignore"):
            rounded = real(value)
        if np.isfinite(rounded):
            text = literal(value, np.dtype(real))
            assert text.endswith("f") == (real is np.float32)
            found = real(float.fromhex(text.rstrip("f") if real is np.float32 else text))
            assert found.tobytes() == rounded.tobytes()


@pytest.mark.full
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("laws", [SOME, SOME_STAGED], ids=["plain", "staged"])
def test_the_code_calls_and_keeps_nothing_of_its_own(laws, real, style):
    """No libm but sqrt and fabs, no malloc, no variable outside of a function."""
    files = texts(laws, real, style)
    end = "f" if real == "float32" else ""
    for name, text in files.items():
        if not (name.startswith("gfm") and name.endswith(".c")):
            continue
        code = re.sub(r"/\*.*?\*/|\"[^\"]*\"", "", text, flags=re.DOTALL)
        if style == "tunable":  # gains become coefficients in double
            parts = r"^const \w+_gains_t .*?;$|^static int coefficients\(.*?^}$"
            code = re.sub(parts, "static int coefficients(", code, flags=re.DOTALL | re.MULTILINE)
        own = set(re.findall(r"^(?:static |IN_PLACE )?\w+ (\w+)\(", code, re.MULTILINE))
        called = set(re.findall(r"\b(\w+)\(", code)) - own
        language = {"if", "for", "switch", "sizeof", "__attribute__"}
        language |= {"memcpy"} if style == "tunable" else set()
        assert called <= {*language, f"sqrt{end}", f"fabs{end}"}, name
        for line in code.splitlines():
            if re.match(r"\s*(static|extern)\b", line) and "(" not in line:
                assert "const" in line, line
        numbers = re.findall(r"\b\d+\.\d+\w*|0x[\w.]+p[-+]\d+\w*", code)
        assert all(n.endswith("f") == (real == "float32") for n in numbers)


def test_the_header_is_the_signal_table():
    text = texts(SOME, "float32", "unrolled")["gfm_vsg_1.h"]
    for letter, vector in (("REF", "ref"), ("Y", "y"), ("U", "u")):
        found = re.findall(rf"^    GFM_VSG_1_{letter}_(\w+),", text, re.MULTILINE)
        assert found == [s.name.upper() for s in group(vector)]  # type: ignore[arg-type]
    for s in (*group("ref"), *group("y"), *group("u")):
        assert f"{s.description}, {s.unit} of {s.base}, {s.low:g} to {s.high:g}" in text
    assert "D_p = 0.01 p.u. (Table III)" in text


@pytest.mark.parametrize("style", STYLES)
def test_the_same_law_gives_the_same_bytes(style):
    again = export(of(*SOME), T_S, "float32", style, files=files_of(of(*SOME)))
    assert again == texts(SOME, "float32", style)


def test_a_set_point_of_minus_zero_keeps_its_zeros():
    """Then a row's sum may be -0, and a term of +0 would make it +0."""
    law = replace(LAWS["droop-1"], u_0=(-0.0, 1.0, 1.0))
    text = export({"x": law}, T_S, "float64", "unrolled")["gfm_x.c"]
    row = re.search(r"t->raw\[0\] = ([^;]*);", text)
    assert row is not None and row[1].count("->") == 1 + 1 + 2 * NY + NY


def test_a_remark_cannot_end_its_comment():
    assert plain("a */ b /* c\n d ??/ é\\") == "a * / b / * c d ? ?/ e"
    law = replace(LAWS["vsg-1"], title="*/ int x; /*", source="line\\\nline")
    text = export({"x": law}, T_S, "float32", "unrolled")["gfm_x.h"]
    assert "int x" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


CHOICE = """int f(void)
{
/* @if one@ */
    a();
/* @if two@ */
    b();
/* @end@ */
/* @elif three@ */
    c();
/* @else@ */
    d();
/* @end@ */
}
/* @if two@ */
int g(void);
/* @end@ */
"""


@pytest.mark.parametrize(
    ("one", "two", "three", "calls"),
    [
        (True, True, True, "ab"), (True, False, True, "a"), (False, True, True, "c"),
        (False, False, False, "d"),
    ],
)  # fmt: skip
def test_a_choice_is_made(one, two, three, calls):
    made = choose_parts(CHOICE, {"one": one, "two": two, "three": three})
    body = "".join(f"    {name}();\n" for name in calls)
    assert made == f"int f(void)\n{{\n{body}}}\n" + "int g(void);\n" * two


def test_the_header_of_a_stage_is_the_signal_table():
    text = texts(SOME_STAGED, "float32", "unrolled")["gfm_no_stage.h"]
    for letter, rows in (("Y", carried_rows("y", True)), ("U", command_rows(True))):
        found = re.findall(rf"^    GFM_NO_STAGE_{letter}_(\w+),", text, re.MULTILINE)
        assert found == [s.name.upper() for s in rows]
    law = load_law("vsg-2", "cascaded").laws
    text = export({"x": law[0]}, T_S, "float32", "records", 120 * math.pi)["gfm_x.h"]
    assert "Inner stage at f_n = 60 Hz: cascaded, m = 1.3025651232383768, freeze = True" in text
    assert "k_v = 1.0" in text and "I_thr" not in text, "only what acts"


def test_the_stage_is_that_of_the_converters_frequency():
    at_50, at_60 = (
        make_modules(of("virtual-stator d"), T_S, "float64", 2 * math.pi * f)[0].record
        for f in (50.0, 60.0)
    )
    assert at_60["stator_b"] == pytest.approx(1.2 * at_50["stator_b"], rel=1e-15)
    assert at_60["k_pll"] == pytest.approx(at_50["k_pll"] / 1.2, rel=1e-15)


# --- report ---


@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("laws", [SOME, SOME_STAGED], ids=["plain", "staged"])
def test_the_report_gives_the_records_back(laws, real, tmp_path):
    files = texts(laws, real, "records")
    (tmp_path / "report.json").write_text(files["report.json"], encoding="utf-8")
    found = read_report(tmp_path)
    assert (found.real, found.style) == (real, "records")
    for module, made in zip(found.modules, make_modules(of(*laws), T_S, real), strict=True):
        assert (module.name, module.stages) == (made.name, made.stages)
        record = made.record
        for field in (name for part in fields(made.stages) for name in part):
            assert module.record[field].tobytes() == record[field].tobytes()


def test_the_report_counts_the_operations_as_by_hand():
    """matching-2: i_u = P_ref, omega_u = 1 + m v, E_u = V_ref + k v with v = v_dc - V_dcref."""
    text = texts(("matching-2",), "float32", "unrolled")["report.json"]
    found = json.loads(text)["laws"][0]
    assert found["operations"] == {
        "multiplications": 0 + 2 + 2 + 3 + 3,  # rows of u, offsets, trends
        "additions": 2 + 3 + 4 + 3 * 3 + 5,  # rows of u with their offset, trends, is u finite
        "divisions": 0,
        "square_roots": 0,
        "comparisons": 3 * 2 + 6 + 10 + 6 + 1,  # limits, what fades, inputs (6 not symmetric), u
    }
    assert found["bytes"]["state"] == 4 * (1 + 3 + 3 + 3)


def test_the_report_counts_the_operations_of_a_stage_as_by_hand():
    """What a virtual stator adds; in brackets its equations in ``gfm_runtime.inner``."""
    counts = []
    for stage in (None, VirtualStator()):
        law = replace(LAWS["droop-1"], inner=stage)
        text = export({"x": law}, T_S, "float32", "unrolled")["report.json"]
        counts.append(json.loads(text)["laws"][0])
    plain, staged = counts
    more = {name: staged["operations"][name] - n for name, n in plain["operations"].items()}
    assert more == {
        # low-passes, i* (b, r_d, r_q, size, i*), limit, current loop, modulation, away
        "multiplications": 4 + (1 + 3 + 3 + 2 + 4) + (3 + 2) + 5 + (4 + 2) + 2,
        # E, low-passes, i* (keep and lose, r_d, r_q, size, i*), limit, current loop, modulation,
        # whether u is finite
        "additions": 1 + 8 + (2 + 3 + 3 + 1 + 2) + 1 + 8 + 1 + 2,
        "divisions": 2 + 1 + 1,
        "square_roots": 1 + 1,
        "comparisons": 1 + 1 + 2 + 6,  # limit, modulation, what fades, inputs
    }
    assert staged["bytes"]["state"] - plain["bytes"]["state"] == 4 * 35  # of all kinds


# --- refusals ---


def test_two_laws_with_one_name_in_c_are_refused():
    with pytest.raises(LawError, match=r"'VSG 1'.*'vsg-1' has the same name in C"):
        make_modules({"vsg-1": LAWS["vsg-1"], "VSG 1": LAWS["vsg-1"]}, T_S, "float32")
    with pytest.raises(LawError, match="no letter or digit"):
        make_modules({"Φ": LAWS["vsg-1"]}, T_S, "float32")


def test_limits_that_are_not_finite_are_refused():
    endless = LAWS["vsg-1"].limits.model_copy(update={"i_u": (-5.0, np.inf)})
    with pytest.raises(LawError, match=r"'x'.*high must be finite"):
        make_modules({"x": replace(LAWS["vsg-1"], limits=endless)}, T_S, "float32")


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [("priority", 4, "priority = 4 is not possible"), ("k_c", "0x0p+0", "k_c = 0.0 is not"),
     ("row", [0, 1], "record.row: must be 12 integers"), ("I_max", "inf", "I_max must be finite"),
     ("n", 13, "13 states"), ("n", -1, "-1 states"), ("error_map", 7, "error map 7"),
     ("A", "nan", "record.A: must be 144 hexadecimal"), ("loop", "inf", "loop must be finite"),
     ("decay", "0x1p+9999", "decay: must be 1 hexadecimal number")],
)  # fmt: skip
def test_a_record_that_the_kernel_cannot_hold_is_refused(key, value, why, tmp_path):
    whole = json.loads(texts(("vsg-2 cascaded",), "float32", "unrolled")["report.json"])
    whole["laws"][0]["record"][key] = value
    (tmp_path / "report.json").write_text(json.dumps(whole), encoding="utf-8")
    with pytest.raises(LawError, match=why):
        read_report(tmp_path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "is not there; gfmhil firmware export writes it"),
        ("{", "is not JSON"),
        ('{"format": 9}', "format: 9 must be 1"),
        ('{"format": 1, "real": "int8"}', "real: 'int8' must be float32 or float64"),
        ('{"format": 1, "real": "float32", "style": "records", "laws": []}', "laws: there must"),
        (
            '{"format": 1, "real": "float32", "style": "records", "laws": [{}]}',
            "is not as gfmhil firmware export writes it ('name' is missing); export the folder",
        ),
        ("[]", "is not as gfmhil firmware export writes it"),
    ],
)
def test_a_folder_that_is_none_is_refused(text, why, tmp_path, refused):
    if text is not None:
        (tmp_path / "report.json").write_text(text, encoding="utf-8")
    line = refused("firmware", "check", str(tmp_path))
    assert line.startswith(f"gfmhil: {tmp_path / 'report.json'}: {why}")


@pytest.mark.parametrize(
    ("target", "package"),
    [
        ("host", "gcc"), ("clang", "clang"), ("m4f", "gcc-arm-none-eabi"),
        ("m7", "qemu-system-arm"), ("rv64", "qemu-system-misc"),
    ],
)  # fmt: skip
def test_a_missing_toolchain_is_named(target, package, tmp_path, monkeypatch, capsys):
    assert main(["firmware", "export", "droop-1", "-o", str(tmp_path)]) == 0
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["firmware", "check", str(tmp_path), "--target", target]) == 2
    said = capsys.readouterr().err
    assert "apt-get install" in said and package in said and said.count("\n") == 1


def test_what_an_earlier_export_left_is_said(tmp_path, capsys):
    for law, left in (("vsg-1", ""), ("droop-1", "gfm_vsg_1.c, gfm_vsg_1.h of an earlier export")):
        assert main(["firmware", "export", law, "-o", str(tmp_path)]) == 0
        said = capsys.readouterr().err
        assert left in said and bool(left) == bool(said)


def test_the_command_writes_what_the_function_gives(tmp_path, capsys):
    arguments = [
        "firmware",
        "export",
        "mimo-gfm-scheduled",
        "--real",
        "float64",
        "-o",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    stages = of("mimo-gfm-scheduled[0]", "mimo-gfm-scheduled[1]")
    scheduled = [load_law("mimo-gfm-scheduled")]
    found = export(stages, T_S, "float64", "unrolled", scheduled=scheduled)
    for name, text in found.items():
        assert (tmp_path / name).read_text(encoding="utf-8") == text
    capsys.readouterr()
    assert main(["firmware", "golden", "vsg-1", "--ticks", "7"]) == 0
    rows = golden(make_modules({"vsg-1": get_law("vsg-1")}, T_S, "float32"), 7)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == ",".join(rows.columns)
    assert [[int(w, 16) for w in line.split(",")] for line in lines[1:]] == rows.words.tolist()


def test_the_command_exports_an_inner_stage(tmp_path):
    command = ["firmware", "export", "vsg-2", "droop-1", "--inner", "cascaded", "--f_n", "60"]
    assert main([*command, "-o", str(tmp_path)]) == 0
    laws = {name: load_law(name, "cascaded").laws[0] for name in ("vsg-2", "droop-1")}
    for name, text in export(laws, T_S, "float32", "unrolled", 120 * math.pi).items():
        assert (tmp_path / name).read_text(encoding="utf-8") == text


@pytest.mark.full
def test_export_of_all_in_fixed_point_leaves_out_what_is_scheduled(tmp_path, capsys):
    assert main(["firmware", "export", "all", "--real", "fixed", "-o", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert said.err == (
        "gfmhil: mimo-gfm-ride-through, mimo-gfm-scheduled: left out, since fixed point does not "
        "cover schedules\n"
    )
    assert len(said.out) < 200 + len(str(tmp_path)) and "files gfm_*" in said.out
    assert (tmp_path / "gfm_vsg_1.c").is_file()


@pytest.mark.parametrize("real", ["float32", "float64"])
def test_the_third_output_of_a_stage_is_e_d(real):
    """It is a component, which can be negative."""
    made = make_modules({"x": load_law("vsg-2", "cascaded").laws[0]}, T_S, real)
    header = sources(made, T_S, "unrolled")["gfm_x.h"]
    assert "GFM_X_U_E_D, /* d component of the bridge's voltage, p.u. of V_n, -3 to 3 */" in header
    assert "GFM_X_U_E_U" not in header
    rows = golden(made, 2100)
    of = rows.words[:, rows.columns.index("u_E_d")].copy().view(real)
    assert (of < 0).any()


def test_a_check_of_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(LawError, match="is not there"):
        check(tmp_path, "host")
