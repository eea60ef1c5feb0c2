"""The three phases of recorded runs, against phasors, single-phase circuits and the recording."""

import cmath
import csv
import math
from importlib.resources import files
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pyarrow import parquet
from scipy.integrate import solve_ivp
from scipy.io import loadmat

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.ports.scope.channels import make_channels
from gfm_hil.ports.scope.picture import Trigger, edges
from gfm_hil.recording.columns import DERIVED, PHASES, WAVES, describe, wave
from gfm_hil.recording.run import Run
from gfm_hil.recording.waveforms import three_phase
from gfm_hil.results.export import export_run
from gfm_hil.results.figures import draw_waveforms
from gfm_plant import (
    TRUTH,
    Bases,
    Plant,
    grid_unbalance,
    make_plant,
    phase_jump,
    plant_advance,
    plant_equilibrium,
    plant_truth,
)

W, T_S = 100 * math.pi, 1e-4
ALPHA = cmath.exp(2j * math.pi / 3)
SHIFT = {"a": 0.0, "b": -2 * math.pi / 3, "c": 2 * math.pi / 3}
WEAK = {"scr": 3.0, "x_over_r": 6.0}
OFF = {name: {"enabled": False} for name in ("over_current", "over_voltage", "under_voltage")}
SAG = {"t": 0.1, "type": "grid-unbalance", "retained": [1.0, 0.5, 0.5]}


def phasor(t: NDArray[Any], x: NDArray[Any]) -> complex:
    """The complex amplitude at 50 Hz over whole cycles: x = Re(phasor e^(j W t))."""
    return complex(2 * np.mean(x * np.exp(-1j * W * t)))


def negative_sequence(t: NDArray[Any], abc: list[NDArray[Any]]) -> complex:
    """Of Fortescue (1918), from the phases' phasors."""
    a, b, c = (phasor(t, x) for x in abc)
    return (a + ALPHA**2 * b + ALPHA * c) / 3


class Still:
    """A plant under a constant command, whose true values are recorded at every tick."""

    def __init__(self, **options: Any) -> None:
        content = {"protection": OFF, "dc_source": {"mode": "regulated"}, **options}
        self.plant = make_plant(Plant.model_validate(content), T_S)
        self.x, self.u = plant_equilibrium(self.plant.par, 0.5, 1.0)
        self.plant.start(self.x, self.u)
        self.rows: list[NDArray[Any]] = []

    def advance(self, ticks: int) -> None:
        for _ in range(ticks):
            self.rows.append(np.empty(len(TRUTH)))
            plant_truth(self.plant.records, 0, self.rows[-1])
            plant_advance(self.plant.records, self.u)

    @property
    def waves(self) -> dict[str, NDArray[Any]]:
        rows = np.array(self.rows)
        columns = {f"true_{name}": rows[:, j] for j, name in enumerate(TRUTH)}
        columns["t"] = np.arange(len(rows)) * T_S
        return {name: x[:] for name, x in three_phase(columns, Bases()).items()}


def test_a_balanced_steady_state_is_three_sines(run):
    one = run(duration=0.1, plant={"grid": WEAK})
    waves, V = one.three_phase(), one.signals["V"][0]
    start = math.atan2(one.signals["v_im"][0], one.signals["v_re"][0])
    for phase, shift in SHIFT.items():
        sine = V * np.cos(W * waves["t"] + start + shift)
        np.testing.assert_allclose(waves[f"v_{phase}"], sine, atol=1e-7)
    # the grid's phase a peaks at t = 0, and delta is positive: the bridge, and so v, leads
    assert 0 < start < one.signals["delta"][0]
    Z_g = complex(1, 6) / (3 * math.hypot(1, 6))
    v, i = phasor(waves["t"], waves["v_a"]), phasor(waves["t"], waves["i_oa"])
    assert v - Z_g * i == pytest.approx(1.0, abs=1e-7)  # the grid's phase a


def test_power_is_that_of_the_three_phases_in_watts(run):
    one = run(events=[{"t": 0.02, "type": "reference", "P_ref": 0.9}])
    for si, scale in ((False, 2 / 3), (True, 1 / Bases().S_n)):
        waves = one.three_phase(si=si)
        unit = ("_V", "_A") if si else ("", "")
        p = sum(waves[f"v_{k}{unit[0]}"] * waves[f"i_o{k}{unit[1]}"] for k in PHASES)
        np.testing.assert_allclose(scale * p, one.signals["p"], atol=1e-12)
    assert np.ptp(one.signals["p"]) > 0.05


def test_the_capacitor_takes_what_the_bridge_gives_and_the_line_does_not(run):
    """In F, V and A: the line's current follows from p and q, the charge from v alone."""
    one = run(law="vsg-2", plant={"grid": WEAK}, events=[{**SAG, "t": 0.02}])
    waves = one.three_phase(si=True)
    for k in PHASES:
        i = waves[f"i_{k}_A"] - waves[f"i_o{k}_A"]
        charge = np.cumsum((i[1:] + i[:-1]) / 2) * T_S  # trapezoids
        v = waves[f"v_{k}_V"]
        assert np.abs(v[1:] - v[0] - charge / 20e-6).max() < 0.01 * np.abs(v).max()


def test_each_phase_is_a_circuit_of_its_own():
    """Two phases sag while the grid's angle jumps: R, L and C of each phase by SciPy, in volts that
    nothing turns; phase voltages of the grid without their zero sequence, as three wires have."""
    plant = Still(grid=WEAK)
    plant.advance(50)
    grid_unbalance(plant.plant, (1.0, 0.5, 0.5))
    phase_jump(plant.plant, 20.0)
    plant.advance(150)
    found, r, x = plant.waves, plant.plant.par[0], plant.x
    kept = dict(zip(PHASES, (1.0, 0.5, 0.5), strict=True))

    def grid(t: float) -> dict[str, float]:
        sags = t >= 0.005
        angle = W * t + (math.radians(20) if sags else 0.0)
        v = {k: (kept[k] if sags else 1.0) * math.cos(angle + SHIFT[k]) for k in PHASES}
        star = sum(v.values()) / 3
        return {k: value - star for k, value in v.items()}

    for k, shift in SHIFT.items():

        def slope(t: float, w: Any, k: str = k, shift: float = shift) -> Any:
            i, v, i_o = w
            e = plant.u[2] * math.cos(W * t + x[6] + shift)
            return [
                W / r["L_f"] * (e - v - r["R_f"] * i),
                W / r["C_f"] * (i - i_o),
                W / r["L_g"] * (v - grid(t)[k] - r["R_g"] * i_o),
            ]

        turn = cmath.exp(1j * (x[6] + shift))
        w = [(complex(x[j], x[j + 1]) * turn).real for j in (0, 2, 4)]
        for first, last in ((0, 50), (50, 200)):
            t = np.arange(first, last) * T_S
            end = (last * T_S) - (1e-12 if last == 50 else 0.0)
            span = (t[0], end)
            solution = solve_ivp(
                slope, span, w, "DOP853", t, dense_output=True, rtol=1e-11, atol=1e-12
            )
            for name, row in zip((f"i_{k}", f"v_{k}", f"i_o{k}"), solution.y, strict=True):
                np.testing.assert_allclose(found[name][first:last], row, atol=1e-8)
            w = solution.sol(end)


def test_the_negative_sequence_is_that_of_the_network():
    """In the steady state of an unbalanced grid, by the phasors of each sequence's circuit."""
    plant = Still(grid=WEAK)
    grid_unbalance(plant.plant, (1.0, 0.5, 0.5))
    plant.advance(30_200)
    waves, t = plant.waves, np.arange(30_000, 30_200) * T_S
    r = plant.plant.par[0]
    Z_f, Z_g = complex(r["R_f"], r["L_f"]), complex(r["R_g"], r["L_g"])
    Y = 1 / Z_f + 1 / Z_g + 1j * r["C_f"]
    E = plant.u[2] * cmath.exp(1j * plant.x[6])
    positive = (E / Z_f + (1 + 0.5 + 0.5) / 3 / Z_g) / Y
    negative = (1 + 0.5 * ALPHA**2 * ALPHA**2 + 0.5 * ALPHA * ALPHA) / 3 / Z_g / Y
    for k, shift in SHIFT.items():
        turned = positive * cmath.exp(1j * shift) + negative * cmath.exp(-1j * shift)
        assert phasor(t, waves[f"v_{k}"][-200:]) == pytest.approx(turned, abs=1e-6)
        assert abs(phasor(t, waves[f"v_{k}"][-200:])) == pytest.approx(abs(turned), abs=1e-6)
    v, i_o = ([waves[f"{name}{k}"][-200:] for k in PHASES] for name in ("v_", "i_o"))
    assert negative_sequence(t, v) == pytest.approx(negative, abs=1e-6)
    # what the grid imposes, back from behind the line's drop
    behind = negative_sequence(t, v) - Z_g * negative_sequence(t, i_o)
    assert behind == pytest.approx(1 / 6, abs=1e-6)


def test_a_bolted_fault_leaves_no_voltage_and_the_lines_current(run):
    """v is 0.001 p.u. times what flows into the fault; the line alone feeds it from the grid."""
    bolted = {"t": 0.02, "type": "fault", "position": 0.0, "R": 0.001}
    plant = {"grid": WEAK, "protection": OFF, "i_peak": 1.5}
    one = run(duration=1.0, law="vsg-2", inner="virtual-stator", plant=plant, events=[bolted])
    late = one.three_phase(0.98, 1.0)
    Z = abs(complex(1, 6)) / (3 * math.hypot(1, 6))
    assert len(late["t"]) == 200
    for k in PHASES:
        assert abs(phasor(late["t"], late[f"i_o{k}"])) == pytest.approx(1 / Z, rel=0.01)
        assert np.abs(late[f"v_{k}"]).max() < 0.01


def test_a_blocked_bridge_carries_no_current(run):
    one = run(
        plant={"protection": {"over_current": {"threshold": 0.7}}},
        after_trip="wait",
        expect="tripped",
        events=[{"t": 0.02, "type": "grid-phase-jump", "degrees": -30.0}],
    )
    after = one.signals["trip"] != 0
    assert after.any() and not after.all()
    for k in PHASES:
        assert not one.three_phase()[f"i_{k}"][after].any()


@pytest.mark.full
def test_converters_of_a_network_see_one_node(tmp_path):
    """Of different ratings, in volts and amperes: behind their lines is the same voltage, and the
    load takes what both bring."""
    big = tmp_path / "big.toml"
    text = files("gfm_plant").joinpath("converters/paper.toml").read_text("utf-8")
    big.write_text(text.replace("S_n = 4000.0", "S_n = 8000.0"), encoding="utf-8")
    converters = {
        "small": {"node": "bus", "law": "vsg-2"},
        "big": {"node": "bus", "law": "vsg-2", "plant": {"converter": str(big)}},
    }
    loads = {"load": {"node": "bus", "P": 0.8, "Q": 0.2}}
    network = {"converters": converters, "loads": loads}
    runs = gfmhil.run_network({"title": "two", "duration": 1.0, "network": network})
    seen, currents = [], []
    for one in runs.values():
        late = one.three_phase(0.9, 1.0, si=True)
        turn = 2 * math.pi * one.signals["f_hz"][-1] * late["t"]  # an island finds its own
        v, i = (2 * np.mean(late[n] * np.exp(-1j * turn)) for n in ("v_a_V", "i_oa_A"))
        seen.append(v - complex(0.06, 2e-3 * turn[-1] / late["t"][-1]) * i)
        currents.append(i)
    assert abs(seen[0] - seen[1]) < 1e-3 * abs(seen[0])
    power = 1.5 * seen[0] * sum(currents).conjugate()
    assert power.imag / power.real == pytest.approx(0.2 / 0.8, rel=0.01)


def test_a_recording_without_them_says_so(run):
    one = run(duration=0.01)
    columns = {name: x for name, x in one.columns.items() if name != "true_v_re"}
    with pytest.raises(UserError, match="the three phases need true_v_re, which the recording"):
        three_phase(columns, Bases())


def test_the_names_are_described():
    named = three_phase(dict.fromkeys(["t", *(f"true_{n}" for n in TRUTH)], np.zeros(1)), Bases())
    volts = three_phase(
        dict.fromkeys(["t", *(f"true_{n}" for n in TRUTH)], np.zeros(1)), Bases(), si=True
    )
    assert [*named, *volts] == [*DERIVED] and len(DERIVED) == 2 * 3 * len(WAVES)
    assert describe("v_b_V", []).unit == "V" and describe("i_oc_A", []).unit == "A"
    assert describe("i_a", []).comment.startswith("current of L_f, phase a")


def test_exports_have_them_on_request(run, tmp_path):
    one = run(duration=0.02)
    volts, pu = one.three_phase(si=True), one.three_phase()
    export_run(one.folder, "parquet", tmp_path / "run.parquet", "si")
    found = parquet.read_table(tmp_path / "run.parquet")
    export_run(one.folder, "mat", tmp_path / "run.mat", "si")
    mat = loadmat(tmp_path / "run.mat", simplify_cells=True)
    export_run(one.folder, "csv", tmp_path / "run.csv", "pu")
    with (tmp_path / "run.csv").open(newline="", encoding="utf-8") as file:
        head, *lines = list(csv.reader(file))
    for name, x in volts.items():
        assert np.array_equal(found[name].to_numpy(), x) and np.array_equal(mat[name], x)
    assert found.schema.field("i_ob_A").metadata[b"unit"] == b"A"
    for name, x in pu.items():
        assert [float(line[head.index(name)]) for line in lines] == x.tolist()
    with pytest.raises(UserError, match="si: goes with mf4, csv, mat, parquet, cfg, cff, not"):
        export_run(one.folder, "blf", tmp_path / "run.blf", "si")
    export_run(one.folder, "csv", tmp_path / "run.csv")
    assert "v_a" not in (tmp_path / "run.csv").read_text(encoding="utf-8").partition("\n")[0]


def test_the_scope_draws_them_and_its_trigger_finds_a_zero_crossing(run):
    one = run(plant={"grid": WEAK}, events=[{**SAG, "t": 0.02}])
    channels = {c.name: c for c in make_channels(T_S, 50.0) if c.group == "wave"}
    waves = one.three_phase(0.03, 0.05)
    for name, channel in channels.items():
        live = {n: x for n, x in one.columns.items() if n not in ("t", "tick")}  # as while it runs
        assert np.array_equal(channel.read(live, 300, 500), waves[name].astype(np.float32))
    assert [*channels] == [wave(name, phase, si=False) for name in "vi" for phase in PHASES]
    up = edges(channels["v_a"].read(one.columns, 0, 1000), Trigger(channel="v_a", level=0.0))
    assert len(up) == 5 and np.abs(np.diff(up) - 200).max() < 15  # 50 Hz, an angle that swings


def test_the_figure_shows_the_cycles_around_the_first_event(run):
    one = run(duration=0.4, law="vsg-2", plant={"grid": WEAK}, events=[SAG])
    axes = draw_waveforms(Figure(), one)
    assert axes[0].get_xlim() == pytest.approx((0.04, 0.24))
    curves = {line.get_label(): line for line in axes[0].lines}
    shown = one.three_phase(0.04, 0.2401)
    for phase in PHASES:
        assert np.array_equal(curves[phase].get_xdata(), shown["t"])
        assert np.array_equal(curves[phase].get_ydata(), shown[f"v_{phase}"])
    assert [text.get_text() for text in axes[0].texts] == [one.summary["events"][0]["label"]]
    other = draw_waveforms(Figure(), one, (0.3, 0.35))
    assert other[2].get_xlim() == pytest.approx((0.3, 0.35)) and not other[0].texts
    assert draw_waveforms(Figure(), one, (0.5, 0.6)) == []


def test_the_window_of_the_report_is_that_of_the_scenario(make, tmp_path, drawn):
    file = tmp_path / "scenario.toml"
    file.write_text('title = "t"\nduration = 0.05\nlink.type = "inproc"\n', encoding="utf-8")
    folder = tmp_path / "run"
    assert main(["run", str(file), "--out", str(folder), "--waveforms", "0.01:0.03"]) == 0
    one = Run.load(folder)
    assert one.scenario.waveforms == (0.01, 0.03)
    assert (folder / "waveforms.png").stat().st_size > 20_000
    assert 'data-group="waves"' in (folder / "report.html").read_text(encoding="utf-8")
    with pytest.raises(UserError, match=r"waveforms = \[0.03, 0.01\]: must be \[from, to\]"):
        make(waveforms=[0.03, 0.01])
    with pytest.raises(UserError, match=r"from before the end of the run at 0\.1 s"):
        make(waveforms=[0.2, 0.3])
    assert make(waveforms=[0.0, 0.3]).digest() == make().digest()  # two machines may differ in it


@pytest.mark.parametrize("text", ["0.1", "0.1:0.2:0.3", "a:b"])
def test_a_window_that_is_none(text, capsys):
    with pytest.raises(SystemExit):
        main(["run", "pref_step", "--waveforms", text])
    assert f"{text!r}: must be FROM:TO, two numbers in s" in capsys.readouterr().err
