"""Power-flow cases of PSS/E, against the voltages that their files hold."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gfmhil
from gfm_hil.api.raw import read_raw
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError

pandapower = pytest.importorskip("pandapower")

#: ANDES's kundur.raw, solved by PSS/E, with its parallel lines as one each
KUNDUR = """\
0,   100.00,  32, 0, 1, 60.00     / PSS(R)E 32
MODIFIED KUNDUR'S TWO-AREA TEST SYSTEM, DISTRIBUTED WITH ANDES
SEE THE BOOK "POWER SYSTEM STABILITY AND CONTROL" FOR ORIGINAL DATA
     1,'1           ',  20.0000,3,   1,   1,   1,1.00000,  32.6732
     2,'2           ',  20.0000,2,   1,   1,   1,1.00000,  21.6548
     3,'12          ',  20.0000,2,   2,   1,   1,1.00000,  11.2148
     4,'11          ',  20.0000,2,   2,   1,   1,1.00000,  21.6398
     5,'101         ', 230.0000,1,   1,   1,   1,0.98337,  27.6488
     6,'102         ', 230.0000,1,   1,   1,   1,0.96908,  16.8176
     7,'3, of area 1', 230.0000,1,   1,   1,   1,0.95621,   8.1662
     8,'13 / area 2 ', 230.0000,1,   2,   1,   1,0.95400,  -2.1295
     9,'112         ', 230.0000,1,   2,   1,   1,0.96856,   6.3774
    10,'111         ', 230.0000,1,   2,   1,   1,0.98377,  16.8036
    11,'OUT         ', 230.0000,4,   2,   1,   1,1.00000,   0.0000
 0 /End of Bus data, Begin Load data
     7,'2 ',1,   1,   1,  1159.000,   -73.500,     0.000,     0.000,     0.000,     0.000,   1,1
     8,'1 ',1,   1,   1,  1575.000,   -89.900,     0.000,     0.000,     0.000,     0.000,   1,1
     8,'2 ',0,   1,   1,   100.000,     0.000,     0.000,     0.000,     0.000,     0.000,   1,1
 0 /End of Load data, Begin Fixed shunt data
 0 /End of Fixed shunt data, Begin Generator data
     1,'1 ',   745.861,   143.612,   600.000,     0.000,1.00000,     0,   900.000, 0.0, 2.5E-1, 0.0, 0.0,1.0,1
     2,'1 ',   400.000,   300.000,   600.000,  -600.000,1.00000,     0,   500.000, 0.0, 2.5E-1, 0.0, 0.0,1.0,1
     2,'2 ',   300.000,   300.000,   600.000,  -600.000,1.00000,     0,   400.000, 0.0, 2.5E-1, 0.0, 0.0,1.0,1
     3,'1 ',   700.000,   550.000,   600.000,  -600.000,1.00000,     0,   900.000, 0.0, 2.5E-1, 0.0, 0.0,1.0,1
     4,'1 ',   700.000,  -100.000,   600.000,  -600.000,1.00000,     0,   900.000, 0.0, 2.5E-1, 0.0, 0.0,1.0,1
 0 /End of Generator data, Begin Branch data
     5,     6,'1 ', 5.00000E-3, 5.00000E-2,   0.07500
     5,     6,'2 ', 5.01000E-3, 5.00100E-2,   0.07500
     6,     7,'1 ', 2.00000E-3, 2.00000E-2,   0.03000
     6,    -7,'2 ', 2.01000E-3, 2.00100E-2,   0.03000
     7,     8,'1 ', 2.20100E-2, 2.20010E-1,   0.33000
     7,     8,'2 ', 2.20200E-2, 2.20020E-1,   0.33000
     7,     8,'3 ', 2.20000E-2, 2.20000E-1,   0.33000
     8,     9,'1 ', 2.00000E-3, 2.00000E-2,   0.03000
     8,     9,'2 ', 2.01000E-3, 2.00100E-2,   0.03000
     9,    10,'1 ', 5.00000E-3, 5.00000E-2,   0.07500
     9,    10,'2 ', 5.01000E-3, 5.00100E-2,   0.07500
 0 /End of Branch data, Begin Transformer data
     1,     5,     0,'1 ',1,1,1, 0.00000E+0, 0.00000E+0,2,'            ',1
 1.00000E-3, 1.20000E-2,   100.00
1.00000,   0.000,   0.000
1.00000,   0.000
     2,     6,     0,'1 ',2,2,1, 0.00000E+0, 0.00000E+0,2,'            ',1
 9.00000E-3, 1.08000E-1,   900.00
20.0000,   0.000,   0.000
230.000,   0.000
     3,     9,     0,'1 ',3,1,1, 0.00000E+0, 0.00000E+0,2,'            ',1
 1.00000E-3, 1.20000E-2,   100.00
1.00000,  20.000,   0.000
1.00000, 230.000
     4,    10,     0,'1 ',1,1,1, 0.00000E+0, 0.00000E+0,2,'            ',1
 1.00000E-3, 1.20000E-2,   100.00
1.00000,   0.000,   0.000
1.00000,   0.000
 0 /End of Transformer data
Q
"""  # noqa: E501


def test_a_published_case_has_the_voltages_of_its_file(tmp_path):
    """Within the 0.01 MW of its slack's power; with taps and impedances in each of their units."""
    file = tmp_path / "kundur.raw"
    file.write_text(KUNDUR)
    case = gfmhil.network_from(file, {"2": "droop-3"})
    lines = [line.split(",") for line in KUNDUR.splitlines()[3:13]]
    exact = [float(f[-2]) * np.exp(1j * np.radians(float(f[-1]))) for f in lines]
    own = np.array([case.voltages[f"bus{int(f[0])}"] for f in lines])
    turn = np.exp(1j * np.angle(np.vdot(own, exact)))
    assert np.abs(own * turn - exact).max() < 5e-5
    assert case.distance(case.save(tmp_path / "net")) < 1e-8
    assert case.converters["converter2.toml"]["S_n"] == 900e6 and "bus11" not in case.voltages
    assert case.ignored == []


def test_three_windings_are_three_transformers(tmp_path):
    """Z12 = 0.1j, Z23 = 0.2j and Z31 = 0.15j p.u. of 50 MVA, and 1.1 at the third."""
    file = tmp_path / "three.raw"
    file.write_text(
        "0, 100., 33, 0, 0, 50. /\n\n\n1,'a',110.,3\n2,'b',20.,1\n3,'c',10.,1\n0\n"
        "2,'1',1,1,1,20.,5.\n3,'1',1,1,1,10.,0.\n0\n0\n1,'1',30.,0,0,0,1,0,60.\n0\n0\n"
        "1,2,3,'1',1,2,1,0,0,2,'x',1\n0,.1,50,0,.2,50,0,.15,50,1,0\n1,0,0\n1,0,0\n1.1,0,0\n0\nQ\n"
    )
    net, ignored = read_raw(file)
    assert len(net.bus) == 4 and net.f_hz == 50.0 and ignored == []
    pandapower.runpp(net, init="dc", tolerance_mva=1e-9, numba=False)
    V = net.res_bus.vm_pu * np.exp(1j * np.radians(net.res_bus.va_degree))
    i2, i3 = np.conj((0.2 + 0.05j) / V[2]), 1.1 * np.conj(0.1 / V[3])
    star = V[1] - 0.05j * (i2 + i3)  # (0.1 + 0.15 - 0.2) / 2 of 50 MVA is 0.05 of 100
    assert abs(star - 0.15j * i2 - V[2]) < 1e-9 and abs(1.1 * (star - 0.25j * i3) - V[3]) < 1e-9


def test_a_series_capacitor_is_a_part_of_its_line(tmp_path):
    """Behind a line in the middle of two; a bus without anything goes with its branch."""
    file = tmp_path / "series.raw"
    buses = "".join(f"{k},'',110.,{t}\n" for k, t in ((1, 3), (2, 1), (3, 1), (4, 1), (5, 1)))
    file.write_text(
        f"0, 100., 33, 0, 0, 60. /\n\n\n{buses}0\n4,'1',1,1,1,20.,5.\n0\n0\n1,'1',20.,0,0,0,1,0,60."
        "\n0\n1,2,'1',.01,.1,.02\n2,3,'1',0,-.15,0\n3,4,'1',.01,.1,.02\n4,5,'1',0,.1\n0\n0\nQ\n"
    )
    case = gfmhil.network_from(file, {"1": "droop-3"})
    (line,) = case.content["network"]["lines"].values()
    assert (line["L"], line["R"], line["B"]) == pytest.approx((0.03, 0.012, 0.04 / 0.6))
    assert case.ignored == [
        "2 series capacitors: a part of their lines' reactance.",
        "bus 5: nothing is there, and it is left out with its branch.",
    ]


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("  32, 0", "  35, 0", "line 1, REV: revision 35: must be 31, 32 or 33"),
        ("0.98337", "0.98x37", "line 8, bus, VM: '0.98x37' is no number from -1e6 to 1e6"),
        ("     7,'2 ',1", "    77,'2 ',1", "line 16, load, I: 77: there is no such bus"),
        ("\n 0 /End of Transformer data\nQ", "", ""),
        ("1.00000,   0.000\n 0 /End of T", " 0 /End of T", "transformer: the record does not end"),
    ],
)
def test_a_file_that_is_none_is_one_line(old, new, line, tmp_path, capsys):
    file = tmp_path / "wrong.raw"
    file.write_text(KUNDUR.replace(old, new, 1))
    command = ["network", "import", str(file), "--converter", "2=droop-3"]
    code = main([*command, "-o", str(tmp_path / "net")])
    said = capsys.readouterr().err
    assert (code == 2) == bool(line)
    assert line in said and (not line or (str(file) in said and said.count("\n") == 1))


WORDS = st.sampled_from(
    ["0", "Q", "1", "-1", "'a'", "1e9", "x", "/", "'", "\n", "\n", ",", "", "0\n", "1,2,3\n"]
)


@settings(max_examples=60)
@given(text=st.one_of(st.text(), st.lists(WORDS, max_size=80).map(",".join)))
def test_any_text_is_a_case_or_a_user_error(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.raw"
    path.write_text("0,100,33\n\n\n1,'a',1,3\n" + text)
    try:
        read_raw(path)
    except UserError as problem:
        assert str(path) in str(problem) and "\n" not in str(problem)
