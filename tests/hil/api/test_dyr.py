"""Records of REGFM_A1 and REGFM_B1: the published ones become the shipped laws, and what is none is
refused in one line."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.api.dyr import read_dyr
from gfm_hil.cli.main import main
from gfm_hil.core.errors import UserError
from gfm_runtime import law_file, load_law
from tests.support.files import FILES

RECORDS = FILES / "regfm.dyr"


def test_the_published_records_are_the_shipped_laws(tmp_path, capsys):
    command = ["laws", "import", str(RECORDS), "-o", str(tmp_path), "--impedance"]
    assert main([*command, "0.02", "0.1"]) == 0
    assert capsys.readouterr().out.split() == [
        str(tmp_path / f"{name}.toml") for name in ("regfm-b1-bus-401-1", "regfm-a1-bus-402-1")
    ]
    for name, shipped in (("regfm-b1-bus-401-1", "regfm-b1"), ("regfm-a1-bus-402-1", "regfm-a1")):
        own, known = law_file(str(tmp_path / f"{name}.toml")), law_file(shipped)
        values = {n: p.value for n, p in known.parameters.items()}
        values |= {"R_e": 0.02, "X_L": 0.1}
        assert {n: p.value for n, p in own.parameters.items()} == values
        assert own.limits == known.limits
        assert load_law(str(tmp_path / f"{name}.toml")).first.inner.kind == "stiff-source"
    assert main([*command, "0.02", "0.1"]) == 2  # they are there already


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("2.0 1.15", "2.0 x", "line 5, Emax: 'x' is no number"),
        ("2.0 1.15", "nan 1.15", "line 5, Imax: 'nan' is no number"),
        ("2.0 1.15", "0 1.15", "line 5, Imax: 0 must be > 0"),
        (", 1 1 0.01", ", 1 0 0.01", "line 5, flags: 1 0: only 1 1 is a law here"),
        ("0.0 5.86/", "0.0 /", "line 5: REGFMA1 has 20 numbers behind its name, not 19"),
        ("-0.44", "0.5", "line 5: .*Q"),
        ("    0 0.5 0 100", "    0.1 0.5 0 100", "line 2, Tp: 0.1: only 0 is a law here"),
        ("0.05 -0.05", "0.05 -0.04", "line 2, Dwmin: -0.04 must be -Dwmax, -0.05"),
        ("402,", "x,", "line 5, bus: 'x' is no number of a bus"),
        ("'REGFMA1', 1,", "'REGFMA1', '../',", "line 5, machine: '../' is not one or two"),
        ("0.0 0.0/", "0.0 0.0", "line 6: the record does not end with a slash"),
    ],
)
def test_what_is_no_record_is_refused_in_one_line(tmp_path, old, new, said):
    text = RECORDS.read_text()
    assert text.count(old) == 1
    path = tmp_path / "wrong.dyr"
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=f"wrong.dyr, {said}") as found:
        [record.law(0.03, 0.15) for record in read_dyr(path)]
    assert "\n" not in str(found.value)


def test_a_file_without_them_is_refused(tmp_path):
    path = tmp_path / "other.dyr"
    path.write_text("601 'PLBVF1' 1 1 0 'flat' 0.48 60 0.0 0.0/\n")
    with pytest.raises(UserError, match="no record of REGFMA1 or REGFMB1"):
        read_dyr(path)
    with pytest.raises(UserError, match="no such file"):
        read_dyr(tmp_path / "none.dyr")


WORDS = st.sampled_from(
    ["'REGFMA1'", "'USRMDL'", "'REGFMB1U'", "1", "0", "-0.5", "1e9", "x", "/", "'", "\n", ",", "//"]
)


@given(text=st.one_of(st.text(), st.lists(WORDS, max_size=50).map(" ".join)))
def test_any_text_is_records_or_a_user_error(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.dyr"
    path.write_text(text)
    try:
        records = read_dyr(path)
    except UserError as problem:
        assert str(path) in str(problem) and "\n" not in str(problem)
    else:
        assert all(len(record.numbers) in (18, 25) for record in records)
