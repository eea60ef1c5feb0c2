"""Power-flow cases of PSS/E, against the voltages that their files hold."""

import re

import numpy as np
import pytest

import gfmhil
from gfm_hil.api.raw import RawCase
from gfm_hil.cli import main
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import load_scenario

from ...support.files import text_of

pandapower = pytest.importorskip("pandapower")

#: ANDES's, solved by PSS/E, with its parallel lines as one each
KUNDUR = text_of("kundur.raw")


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
    network = case.save(tmp_path / "net")
    assert case.distance(network) < 1e-8
    assert nominal_frequency(load_scenario(network)) == pytest.approx(60.0)
    assert case.converters["converter2.toml"]["S_n"] == 900e6 and "bus11" not in case.voltages
    assert case.ignored == []


def rewritten(revision: int) -> str:
    """KUNDUR in another revision, with shunts at buses 7 and 8 and parts out of service besides.

    The columns are those that published files have in their comments: case25_v35_savnwb.raw and
    RTS_30.raw of PowerSystems.jl, and 240busWECC_2018_PSS_fixedshunt.raw of GridPACK.
    """
    title, *rest = KUNDUR.split("\n", 3)
    parts = re.split(r"^ 0 .*\n", rest[-1], flags=re.MULTILINE)
    buses, loads, _, machines, branches, transformers = (
        [line.split(",") for line in part.splitlines()] for part in parts[:6]
    )
    machines += [[*machines[0][:14], "0"]]
    branches = [[*one, *["0"] * 3, *["0"] * 4, "1"] for one in branches]
    branches += [[*branches[0][:13], "0"], ["7", "8", "", "1", "1", "0", *["0"] * 3, "0", ".2"]]
    switched = ["8", "0", "0", "1", "1", "1", "0", "100", "''", "20"]
    fixed, switches = [["7", "'1'", "1", "10", "50"]], list[list[str]]()
    if revision == 30:
        Y = {"7": ("10", "50")}
        buses = [[*b[:-5], *Y.get(b[0].strip(), "00"), *b[-5:-3], *b[-2:], "1"] for b in buses]
        switched = [*switched[:2], *switched[4:]]
    if revision >= 34:
        branches = [[*b[:6], "''", *["0"] * 12, *b[9:]] for b in branches]
        off, on = (["7", "8", "'@'", ".0001", *["0"] * 12, one, "1"] for one in "01")
        switches = [off, ["10", "11", *on[2:]]]  # bus 11 is out of service
    if revision == 35:
        machines = [[*m[:8], "0", *m[8:]] for m in machines]
        switched = ["8", "'1'", *switched[1:7], "0", *switched[7:]]
    none = list[list[str]]()
    more = [switched]
    sections = {
        30: [buses, loads, machines, branches, transformers, none, none, none, more],
        34: [[["GENERAL", "THRSHZ=1"]], buses, loads, fixed, machines, branches, switches],
    }.get(min(revision, 34), [buses, loads, fixed, machines, branches])
    if revision != 30:
        sections += [transformers, *[none] * 10, more]
    text = "".join(
        "@! I, J\n" * (revision > 33) + "".join(",".join(one) + "\n" for one in rows) + "0 / END\n"
        for rows in sections
    )
    comment = "@!IC,SBASE,REV\n" * (revision > 33)
    return f"{comment}{title.replace('32', str(revision))}\n\n\n{text}Q\n"


@pytest.mark.parametrize("revision", [30, 31, 33, 34, 35])
def test_all_revisions_are_one_case(revision, tmp_path):
    cases = []
    for one in (32, revision):
        file = tmp_path / f"{one}.raw"
        file.write_text(rewritten(one))
        cases.append(RawCase(file))
    first, other = cases
    assert first.buses[7][3:5] == [10.0, 50.0 + 20.0] and first.buses[8][4] == 20.0
    assert len(first.branches) == 16 and first.generators[1][1] == 900.0
    for table in ("buses", "branches", "generators", "jumpers", "ignored"):
        assert getattr(other, table) == getattr(first, table), table


def test_three_windings_are_three_transformers(tmp_path):
    """Z12 = 0.1j, Z23 = 0.2j and Z31 = 0.15j p.u. of 50 MVA, and 1.1 at the third."""
    file = tmp_path / "three.raw"
    file.write_text(
        "0, 100., 33, 0, 0, 50. /\n\n\n1,'a',110.,3\n2,'b',20.,1\n3,'c',10.,1\n0\n"
        "2,'1',1,1,1,20.,5.\n3,'1',1,1,1,10.,0.\n0\n0\n1,'1',30.,0,0,0,1,0,60.\n0\n0\n"
        "1,2,3,'1',1,2,1,0,0,2,'x',1\n0,.1,50,0,.2,50,0,.15,50,1,0\n1,0,0\n1,0,0\n1.1,0,0\n0\nQ\n"
    )
    case = RawCase(file)
    net = case.net()
    assert len(net.bus) == 4 and net.f_hz == 50.0 and case.ignored == []
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
        "What leads to bus 5 alone is left out: nothing stands there.",
    ]


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("  32, 0", "  36, 0", "line 1, REV: revision 36: must be from 30 to 35"),
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
