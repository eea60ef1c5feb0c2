"""Records of REGFM_A1 and REGFM_B1: the published ones become the shipped laws, and what is none is
refused in one line."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gfm_hil.api.dyr import read_dyr
from gfm_hil.api.dyr_nearest import nearest_record
from gfm_hil.api.law import Law
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


@pytest.mark.parametrize(("model", "apart"), [("REGFMA1", 1e-6), ("REGFMB1", 0.1)])
def test_the_record_of_a_law_read_again_has_the_swing_of_the_law(tmp_path, model, apart, capsys):
    """VSG-2 is REGFM_A1 but for what no limit touches, and REGFM_B1 but for its filters of 1 ms."""
    path = tmp_path / "plant.dyr"
    assert main(["laws", "export", "vsg-2", "--as", model, "--bus", "7", "-o", str(path)]) == 0
    (record,) = read_dyr(path)
    assert (record.bus, record.machine, record.model) == (7, "1", model)
    law = record.law(0.03, 0.15)  # the choke of pref_step
    ours, theirs = (each.closed_loop("pref_step").poles() for each in (Law.load("vsg-2"), law))
    swing = ours[np.argmin(abs(ours + 3.0 - 23.0j))]
    assert swing == pytest.approx(-2.93 + 23.08j, abs=0.01)
    assert abs(theirs - swing).min() < apart * abs(swing)
    capsys.readouterr()
    new = tmp_path / "laws" / "new"
    assert main(["laws", "import", str(path), "--impedance", "0.03", "0.15", "-o", str(new)]) == 0
    assert Law.load(next(new.iterdir())).gains == law.gains


@pytest.mark.parametrize("name", ["regfm-a1", "regfm-b1"])
def test_the_shipped_models_come_nearest_to_themselves(name):
    """To the last digits of a record, or by H in place of D2 where phasors cannot tell."""
    model = "REGFM" + name[-2:].upper()
    found = nearest_record(Law.load(name), model)
    assert found.without == () and max(found.far.values()) < (1e-9 if model == "REGFMA1" else 0.02)
    shipped = Law.load(name).gains
    for number in ("mp", "mq", "kpv", "kiv", "TQf"):
        assert found.numbers[number] == pytest.approx(shipped[number], rel=0.01, abs=1e-9)


def test_a_record_says_what_of_a_law_it_leaves_out():
    found = nearest_record(Law.load("mimo-gfm-deployable"), "REGFMA1")
    assert found.without == ("phi21", "phi24", "phi25", "phi31", "phi32")
    assert max(found.far.values()) < 1e-6
    assert nearest_record(Law.load("vsg-8"), "REGFMA1").far["phi22"] == pytest.approx(
        0.296, abs=1e-3
    )


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["droop-1"], "droop-1: it has no V on E_u (phi35), and REGFMA1 is not without"),
        (["matching-2"], "matching-2: it has no p on omega_u (phi22)"),
        (["hybrid-angle"], "hybrid-angle: REGFMA1 has not the errors of 'hybrid-angle'"),
        (["regfm-a1", "--as", "REGFMB1"], "regfm-a1: H of its swing (phi22) would be 0"),
        (["vsg-2", "--bus", "0"], "bus 0: must be a number from 1 to 999999"),
        (["vsg-2", "--machine", "abc"], "machine 'abc': must be one or two letters"),
    ],
)
def test_a_law_without_such_a_core_has_no_record(refused, line, said):
    assert said in refused("laws", "export", *line)


WORDS = st.sampled_from(
    ["'REGFMA1'", "'USRMDL'", "'REGFMB1U'", "1", "0", "-0.5", "1e9", "x", "/", "'", "\n", ",", "//"]
)


@example(text="0 REGFMA1/")
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
