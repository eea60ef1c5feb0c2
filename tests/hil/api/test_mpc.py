"""Power-flow cases of MATPOWER, against published voltages and the equations of its manual."""

import numpy as np
import pytest

import gfmhil
from gfm_hil.api.mpc import MpcCase
from gfm_hil.cli import main
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import load_scenario

from ...support.files import FILES, text_of

pandapower = pytest.importorskip("pandapower")

CASE9 = text_of("case9.m")
#: of P. M. Anderson and A. A. Fouad, "Power System Control and Stability", figure 2.18
WSCC = {1: 1.040, 2: 1.025, 3: 1.025, 4: 1.026, 5: 1.013, 6: 1.032, 7: 1.016, 8: 1.026, 9: 0.996}


def test_a_published_case_has_its_published_voltages(tmp_path):
    case = gfmhil.network_from(FILES / "case9.m", {"2": "droop-3"})
    for bus, V in WSCC.items():
        assert abs(case.voltages[f"bus{bus}"]) == pytest.approx(V, abs=5.1e-4)
    network = case.save(tmp_path / "net")
    assert case.distance(network) < 1e-8
    assert nominal_frequency(load_scenario(network)) == pytest.approx(60.0)
    assert case.converters["converter2.toml"]["S_n"] == 300e6  # PMAX, which is above MBASE
    assert case.ignored == ["60 Hz is our assumption: a file of MATPOWER has no frequency."]
    european = gfmhil.network_from(FILES / "case9.m", {"2": "droop-3"}, frequency=50.0)
    assert not european.ignored
    assert european.voltages == pytest.approx(case.voltages, rel=1e-12)
    assert nominal_frequency(load_scenario(european.save(tmp_path / "eu"))) == pytest.approx(50.0)


#: taps and a shift on either side of the higher voltage, charging behind a tap, two generators at
#: a bus, one that holds no voltage, one out of service, and what is passed over
MESH = """\
mpc.version = '2'; % 50%
mpc.baseMVA = 50;
mpc.bus_name = { 'a }; % b'; 'c' };
mpc.bus = [ 1 3 0 0 0 0 1 1 0 110 1 1 1; 20 1 30 10 1 5 1 1 0 110 1 1 1
  3, 1, 20, 5, 0, 0, 1, 1, 0, 20, 1, 1, 1; % of low voltage
  4 2 10 0 0 0 1 1 0 20 1 1 1 ; 5 4 9 9 9 9 1 1 0 20 1 1 1;];
mpc.gen = [1 0 0 9 -9 1.02 0 1 80; 4 10 0 Inf -Inf 1.01 0 1 0; 4 5 0 9 -9 1.03 40 1 0
3 4 2 9 -9 1 20 1 0; 20 7 7 9 -9 1 20 0 0; 5 9 9 9 9 1 9 1 9];
mpc.branch = [
1 20 0.01 0.1 0.04 0 0 0 0 0 1; 1 20 0.02 0.2 0.02 0 0 0 1 0 1; 20 3 0.005 .1 0.03 0 0 0 .95 0 1
4 1 0.004 0.08 0.02 0 0 0 1.05 0 1
3 4 1e-2 0.1 0.01 0 0 0 0 0 1; 3 4 9 9 9 0 0 0 0 0 0; 4 5 0 1 0 0 0 0 0 0 1
];
"""


def test_branches_are_those_of_the_manual(tmp_path):
    """The admittances of MATPOWER's manual, (3.2), give the powers of all generators and loads."""
    file = tmp_path / "mesh.m"
    file.write_text(MESH)
    case = MpcCase(file)
    net = case.net()
    pandapower.runpp(net, init="dc", tolerance_mva=1e-9, numba=False, trafo_model="pi")
    V = net.res_bus.vm_pu * np.exp(1j * np.radians(net.res_bus.va_degree))
    assert [*V.index] == [1, 20, 3, 4] and (V[1], abs(V[4])) == pytest.approx((1.02, 1.01))
    drawn = dict.fromkeys(V.index, 0j)
    for a, b, R, X, B, tap in (
        (1, 20, 0.01, 0.1, 0.04, 1.0),
        (1, 20, 0.02, 0.2, 0.02, 1.0),
        (20, 3, 0.005, 0.1, 0.03, 0.95),
        (4, 1, 0.004, 0.08, 0.02, 1.05),
        (3, 4, 0.01, 0.1, 0.01, 1.0),
    ):
        y = 1 / complex(R, X)
        drawn[a] += V[a] * np.conj((y + 0.5j * B) / tap**2 * V[a] - y / tap * V[b])
        drawn[b] += V[b] * np.conj((y + 0.5j * B) * V[b] - y / tap * V[a])
    drawn[20] += abs(V[20]) ** 2 * (1 - 5j) / 50 + (30 + 10j) / 50
    drawn[3] += (16 + 3j) / 50  # 20 + 5j less what comes
    drawn[4] += 10 / 50
    assert abs(drawn[20]) < 1e-10 and abs(drawn[3]) < 1e-10
    assert drawn[4].real == pytest.approx(15 / 50)
    assert [*net.gen.sn_mva] == [50.0] and [*net.ext_grid.sn_mva] == [80.0]  # 10 + 40, and PMAX
    assert len(case.ignored) == 1


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("'2'", "'1'", "mpc.version = '1': must be '2'"),
        ("mpc.baseMVA = 100", "mpc.baseMVA = 300/3", "line 24, mpc.baseMVA: '300/3' is no number"),
        ("mpc.baseMVA = 100", "mpc.baseMVA = 0", "line 24, mpc.baseMVA: 0: must be above 0"),
        ("0.0576", "1/17.36", "line 51, mpc.branch: '1/17.36' is no number"),
        (" 2 163 ", " 22 163 ", "line 44, mpc.gen, GEN_BUS: 22: there is no such bus"),
        (" 5 1 90 30", " 5 1 90", "line 33, mpc.bus: must have 13 numbers, not 12"),
        ("mpc.gencost", "mpc.gen(:, 9)", "line 66: 'mpc.gen(:, 9) = [': only mpc.NAME"),
        ("mpc.branch", "mpc.lines", "has no mpc.branch"),
        ("0 0.0576 0", "0 0 0", "line 51, mpc.branch: BR_R, BR_X = 0"),
        ("2 1500 0 3 0.11 5 150;", "2 1500 0 3 0.11 5 150]; x", "line 67: 'x': only one mpc.NAME"),
        ("\n];\n\n%% gen", "\n\n%% gen", "line 41: mpc.bus does not end with ]"),
    ],
)  # fmt: skip
def test_a_file_that_is_none_is_one_line(old, new, line, tmp_path, capsys):
    file = tmp_path / "wrong.m"
    assert old in CASE9
    file.write_text(CASE9.replace(old, new, 1))
    command = ["network", "import", str(file), "--converter", "2=droop-3"]
    assert main([*command, "-o", str(tmp_path / "net")]) == 2
    said = capsys.readouterr().err
    assert line in said and str(file) in said and said.count("\n") == 1
