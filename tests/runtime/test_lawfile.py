"""Law files: values are read as written, and every mistake gives one clear line."""

import tomllib

import pytest

from gfm_runtime import (
    BuiltLaw,
    LawError,
    Limits,
    build_law,
    grid_names,
    law_file,
    law_names,
    load_law,
    parse_law,
    read_law_file,
    tuned_names,
)
from gfm_runtime.elements import IF, PD, PI, D, Element, I, O, P
from gfm_runtime.lawfile import LawFile

from ..support.laws import EVERYTHING


def custom() -> BuiltLaw:
    return build_law(parse_law(EVERYTHING))


def test_round_trip():
    law = custom()
    integral = Element.of((-9.0,), ((0.0, 1.0),))
    assert law.phi == {
        (0, 0): P(90.0) + P(400.0) * I(1.0),
        (0, 1): PI(2.0, 0.5),
        (1, 0): PD(0.1, 0.02) * IF(1.0, 0.001),
        (1, 1): O(0.01, 0.03, 0.7) * PD(1.0, 0.02),
        (1, 2): IF(1.0, 0.2),
        (2, 3): I(2.0),
        (2, 4): integral,
    }
    assert law.psi == {(1, 1): D(0.1) * IF(1.0, 0.1)}
    assert law.u_0 == ("P_ref", 1.0, 1)
    assert (law.error_map, law.error_parameters) == ("hybrid-angle", (0.001, 0.1))
    assert law.limits == Limits(
        i_u=(-2.0, 2.0), omega_u=(0.95, 1.05), E_u=(0.1, 1.2), T_t=0.03, T_off=0.4
    )
    assert (law.home_grid.L_g, law.home_grid.R_g, law.home_grid.note) == (5.0, 1.0, "weak")
    assert law.parameters["D_p"].source == "Table III"


def test_from_a_path(tmp_path):
    path = tmp_path / "my law.toml"
    path.write_text(EVERYTHING, encoding="utf-8")
    assert load_law(str(path)).laws == (custom(),)


def test_parameters_can_be_changed():
    law = build_law(parse_law(EVERYTHING), {"D_p": 0.02, "k_p": 10.0})
    assert law.phi[1, 1] == O(0.02, 0.03, 0.7) * PD(1.0, 0.02)
    assert law.phi[2, 4](1.0) == pytest.approx(-1.0)
    assert law.parameters["D_p"].value == 0.02


def test_a_shape_may_be_a_list_of_one():
    one = 'name = "a"\ntitle = ""\nsource = ""\n[phi]\n22 = {}\n'
    element = '{ type = "P", k = 0.01 }'
    a, b = (build_law(parse_law(one.format(e))) for e in (element, f"[{element}]"))
    assert a == b


MISTAKES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    # name: the replaced text, its replacement, and the expected message
    "unknown key": ('"IF", k = 1.0, T = 0.2', '"IF", gain = 3, k = 1.0, T = 0.2',
        ("phi.23.gain", "3")),
    "unknown table": ("[psi]", "[chi]", ("chi", "unknown key", "did you mean 'phi'?")),
    "unknown type": ('"IF", k = 1.0, T = 0.2', '"XY", k = 1.0, T = 0.2',
        ("phi.23.type", "XY", "'PI'")),
    "wrong type of a number": ("T = 2.0 }", "T = [2.0] }",
        ("phi.34.T", "[2.0]", "number or an exp")),
    "a boolean number": ("T = 2.0 }", "T = true }",
        ("phi.34.T", "True", "number or an expression")),
    "a number for a name": ('name = "custom-1"', "name = 3", ("name", "3", "string")),
    "bad name": ('name = "custom-1"', 'name = "a b"',
        ("name: must be lower case letters, digits", "'a b'")),
    "no type": ('type = "I", T = 2.0', "T = 2.0", ("phi.34.type", "missing")),
    "no factors": ('{ type = "I", T = 2.0 }', "[]", ("phi.34", "at least 1")),
    "too many factors": ('{ type = "I", T = 2.0 }',
        str(["P"] * 9).replace("'P'", '{type="P", k=1}'), ("phi.34", "at most 8")),
    "missing number": ('"IF", k = 1.0, T = 0.2', '"IF", k = 1.0',
        ("phi_23", "IF takes ['T', 'k']", "['k']")),
    "number too many": ('"IF", k = 1.0, T = 0.2', '"IF", k = 1.0, T = 0.2, xi = 1',
        ("phi_23", "'xi'")),
    "both forms": ("T = 2.0 }", "T = 2.0, k_i = 1 }", ("phi_34", "['T'] or ['k_i']")),
    "improper": (", T_f = 0.001", "", ("phi_21", "improper", "T_f")),
    "unstable T": ("k = 1.0, T = 0.2", "k = 1.0, T = -0.2", ("phi_23, IF", "T = -0.2", "1e-09")),
    "unstable T_f": ("T_f = 0.001", "T_f = -1", ("phi_21.T_f", "-1", "1e-09")),
    "unstable xi": ("xi = 0.7", "xi = 0", ("phi_22, O", "xi = 0", "> 0")),
    "absurd T": ("T = 2.0 }", "T = 1e-200 }", ("phi_34, I", "1e-200", "1e-09")),
    "infinite gain": ("k_i = 400", "k_i = inf", ("phi_11.k_i", "inf", "finite")),
    "gigantic integer": ("k_i = 400", "k_i = 1" + 400 * "0", ("phi.11.k_i", "must be a number")),
    "gigantic parameter": ("value = 90.0", "value = 1" + 400 * "0", ("parameters.k_p.value",)),
    "absurd gain": ("k_i = 400", "k_i = 1e300", ("phi_11", "k_i = 1e+300", "1e+12")),
    "nan parameter": ("value = 90.0", "value = nan", ("parameters.k_p.value", "nan", "finite")),
    "text in place of a parameter": ('D_p = { value = 0.01, unit = "p.u.", source = "Table III" }',
        'D_p = "0.01"', ("parameters.D_p: must be a table with value, not '0.01'",)),
    "unknown parameter": ('k = "D_p"', 'k = "D_q"', ("phi_22.k", "'D_q'", "D_p")),
    "bad parameter name": ("k_p = {", '"k p" = {', ("parameters.k p", "pattern")),
    "parameter without value": ("value = 0.01, ", "", ("parameters.D_p.value", "missing")),
    "parameter as expression": ("value = 0.05", 'value = "0.1 / 2"',
        ("parameters.X_half.value", "number")),
    "syntax of an expression": ('"1 / 50"', '"1 /"', ("phi_22.T", "'1 /'", "no arithmetic")),
    "call in an expression": ('"1 / 50"', '"exit()"', ("phi_22.T", "'exit()'", "only + -")),
    "division by zero": ('"1 / 50"', '"1 / 0"', ("phi_22.T", "'1 / 0'", "zero")),
    "cell 46": ("34 = {", "46 = {", ("phi.46", "row 1..3", "column 1..5")),
    "cell 123": ("34 = {", "123 = {", ("phi.123", "row 1..3")),
    "cell x": ("34 = {", "x1 = {", ("phi.x1", "row 1..3")),
    "double integrator": ('[{ type = "D", T = 0.1 }, { type = "IF", k = 1.0, T = 0.1 }]',
        '[{ type = "I", T = 1.0 }, { type = "I", T = 1.0 }]', ("psi_22", "double integrator")),
    "unknown error map": ('type = "hybrid-angle"', 'type = "angle"',
        ("error_map.type", "'angle'", "dvoc")),
    "hybrid-angle without X": ('X = "2 * X_half"', "", ("error_map", "R and X", "hybrid-angle")),
    "hybrid-angle with X = 0": ('X = "2 * X_half"', "X = 0",
        ("error_map", "(0.001, 0.0)", "X > 0")),
    "X for another map": ('type = "hybrid-angle"', 'type = "dvoc"', ("error_map", "hybrid-angle")),
    "set-point": ('i_u = "P_ref"', 'i_u = "P"', ("u_0.i_u", "'P'", "P_ref")),
    "infinite set-point": ("omega_u = 1.0", "omega_u = nan", ("u_0.omega_u", "nan", "finite")),
    "limits upside down": ("[0.95, 1.05]", "[1.05, 0.95]",
        ("limits.omega_u", "[1.05, 0.95]", "ascending")),
    "one limit": ("[0.95, 1.05]", "[0.95]", ("limits.omega_u", "missing")),
    "T_t": ("T_t = 0.03", "T_t = 0.0", ("limits.T_t", "0.0", "greater than 0")),
    "T_off": ("T_off = 0.4", "T_off = nan", ("limits.T_off", "nan", "greater than 0")),
    "home grid": ("L_g = 5.0", "L_g = 0.0", ("home_grid.L_g", "0.0", "greater than 0")),
    "not TOML": ("[psi]", "[psi", ("law file", "not TOML", "line")),
    "key twice": ("34 = {", "23 = {", ("law file", "not TOML")),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_clear_line(mistake):
    old, new, says = MISTAKES[mistake]
    assert EVERYTHING.count(old) == 1
    with pytest.raises(LawError) as caught:
        build_law(parse_law(EVERYTHING.replace(old, new)))
    message = str(caught.value)
    assert all(part in message for part in says), message
    assert "\n" not in message and "; " not in caught.value.why.replace("; use", "").replace(
        "; give", ""
    ).replace("; known", "").replace("; did you", ""), f"one message for one mistake: {message}"


def test_all_mistakes_at_once():
    text = EVERYTHING.replace("T = 2.0 }", "T = true }").replace("T_t = 0.03", 'T_t = "x"')
    with pytest.raises(LawError) as caught:
        parse_law(text, "law file a.toml")
    assert str(caught.value).startswith("law file a.toml: ")
    assert "phi.34.T" in caught.value.why and "limits.T_t" in caught.value.why


def test_all_mistakes_of_a_law_at_once_name_its_file(tmp_path):
    text = EVERYTHING.replace('k = "D_p"', 'k = "D_q"').replace("34 = {", "46 = {")
    text = text.replace('type = "hybrid-angle"', 'type = "hybrid_angle"')
    text = text.replace(", T_f = 0.001", "")
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(LawError) as caught:
        load_law(str(path))
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"law file {path}: ") for line in lines)
    for part in (
        "phi_22.k: unknown parameter 'D_q'",
        "did you mean 'D_p'?",
        "phi.46: a cell is row",
        "did you mean 'hybrid-angle'?",
        "phi_21: improper",
    ):
        assert sum(part in line for line in lines) == 1, part


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(LawError, match=r"law file .*nowhere\.toml: cannot be read: .*No such file"):
        read_law_file(tmp_path / "nowhere.toml")
    with pytest.raises(LawError, match="cannot be read"):
        load_law(str(tmp_path / "nowhere.toml"))
    with pytest.raises(LawError, match="cannot be read"):
        read_law_file(tmp_path)
    (tmp_path / "latin.toml").write_bytes(b'name = "\xe9"')
    with pytest.raises(LawError, match="cannot be read"):
        read_law_file(tmp_path / "latin.toml")


@pytest.mark.parametrize(
    ("phi", "says"),
    [
        ({(3, 0): P(1.0)}, "phi_41: row must be 1..3"),
        ({(0, 5): P(1.0)}, "phi_16: row must be"),
        ({(1, 1): D(1.0)}, "phi_22: improper"),
        ({(1, 1): Element((float("nan"),))}, "phi_22: a coefficient is not finite"),
        ({(1, 1): Element((1.0,), ((1.0, -0.5),))}, "phi_22: unstable factor (1.0, -0.5)"),
        ({(1, 1): Element((1.0,), ((1.0, 0.0, 0.1),))}, "phi_22: undamped factor"),
        ({(1, 1): Element((1.0,), ((2.0, 1.0, 1.0, 1.0),))}, "phi_22: unstable factor"),
        ({(1, 1): Element((1.0,), ((0.0, 1.0), (0.0, 1.0)))}, "phi_22: unstable: a double integ"),
    ],
)
def test_laws_made_in_python_pass_the_same_checks(phi, says):
    with pytest.raises(LawError) as caught:
        BuiltLaw("a", "", "", phi)
    assert says in str(caught.value)


BASED = """
base = "vsg-2"
name = "softer"
title = "VSG-2 with more damping"
source = "here"
parameters.D_p = 0.02
phi.22 = { type = "P", k = "D_p" }
"""


def test_a_base_gives_what_the_file_does_not_say():
    softer, own = parse_law(BASED), law_file("vsg-2")
    assert (softer.name, softer.title, softer.base) == ("softer", "VSG-2 with more damping", None)
    assert softer.parameters["D_p"].value == 0.02
    assert softer.parameters["D_p"].unit == own.parameters["D_p"].unit
    assert softer.parameters["D_p"].source == "" != own.parameters["D_p"].source
    assert [factor.type for factor in softer.phi["22"]] == ["P"]
    assert {cell: softer.phi[cell] for cell in softer.phi if cell != "22"} == {
        cell: own.phi[cell] for cell in own.phi if cell != "22"
    }
    assert (softer.u_0, softer.limits, softer.psi) == (own.u_0, own.limits, own.psi)


def test_a_base_may_be_a_file_beside_the_law_with_a_base_of_its_own(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "softer.toml").write_text(BASED)
    (tmp_path / "own.toml").write_text(
        'base = "below/softer.toml"\nname = "own"\nlimits.T_t = 0.1\n'
    )
    own = read_law_file(tmp_path / "own.toml")
    assert (own.name, own.limits.T_t, own.parameters["D_p"].value) == ("own", 0.1, 0.02)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('base = "vsg-99"', "base: no law of the catalogue is named 'vsg-99'"),
        ("base = 3", "base: must be a law's name or a .toml file, in quotes"),
        ('base = "none.toml"', "base: none.toml: cannot be read: No such file or directory"),
        ('base = "circle.toml"', "base: circle.toml is based on circle.toml, a circle"),
        ('base = "../vsg-2"', "base: no law of the catalogue"),
    ],
)
def test_a_base_that_is_none(tmp_path, text, words):
    path = tmp_path / "circle.toml"
    path.write_text(f'name = "mine"\n{text}\n')
    with pytest.raises(LawError) as problem:
        read_law_file(path)
    (line,) = str(problem.value).splitlines()
    assert str(path) in line and words in line


def test_the_schema_lets_a_file_with_a_base_leave_the_rest_out():
    import jsonschema  # compiles grammars: a quarter of what all tests import

    schema = jsonschema.Draft202012Validator(LawFile.model_json_schema())
    content = tomllib.loads(BASED)
    assert schema.is_valid(content)
    assert not schema.is_valid({key: content[key] for key in content if key not in ("base", "phi")})


def told(text: str) -> list[str]:
    """What a person is told of the text of a law file."""
    with pytest.raises(LawError) as caught:
        build_law(parse_law(text))
    return caught.value.lines


def test_a_number_alone_is_a_parameter():
    bare = EVERYTHING.replace('{ value = 0.01, unit = "p.u.", source = "Table III" }', "0.01")
    valued = EVERYTHING.replace(', unit = "p.u.", source = "Table III" }', " }")
    for text in (bare, valued):
        law = build_law(parse_law(text))
        assert law.phi == custom().phi
        assert (law.parameters["D_p"].unit, law.parameters["D_p"].source) == ("", "")
    (line,) = told(
        EVERYTHING.replace('{ value = 0.01, unit = "p.u.", source = "Table III" }', "true")
    )
    assert "parameters.D_p: must be a table with value, not True" in line


@pytest.mark.parametrize("name", [*law_names(), *tuned_names(), *grid_names()])
def test_the_catalogue_says_unit_and_source_of_every_parameter(name):
    for parameter in law_file(name).parameters.values():
        assert {"unit", "source"} <= parameter.model_fields_set and parameter.source.strip()


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('22 = [{ type = "O"', '22 = [{ typ = "O"', "phi.22.0.typ = 'O': unknown key; did you"),
        ('34 = { type = "I"', '34 = { typ = "I"', "phi.34.typ = 'I': unknown key; did you mean"),
        ('34 = { type = "I"', '34 = { type = "J"', "phi.34.type: must be 'P', 'I', 'D', 'PI', '"),
        ("[phi]", "[phy]", "...: unknown key; did you mean 'phi'?"),
        ("D_p = {", "D_pp = {", "unknown parameter 'D_p'; known: ['D_pp', 'X_half', 'k_p']; did"),
    ],
)  # fmt: skip
def test_one_wrong_word_is_one_line_in_the_files_own_words(old, new, line):
    assert old in EVERYTHING
    (found,) = told(EVERYTHING.replace(old, new))
    assert line in found


def test_a_name_in_many_places_is_one_line_and_the_hint_stands_before_a_long_list():
    cells = "".join(f'{i}{j} = {{ type = "P", k = "D_q" }}\n' for i in "123" for j in "12345")
    names = "".join(f"{name} = 1.0\n" for name in ("D_p", "a", "b", "c", "d", "e", "f"))
    text = f'name = "a"\ntitle = ""\nsource = ""\n[parameters]\n{names}[phi]\n{cells}'
    (line,) = told(text)
    assert "phi_11.k, phi_12.k, phi_13.k and 12 more: unknown parameter 'D_q'; did you me" in line
    assert line.index("did you mean 'D_p'?") < line.index("known:")
