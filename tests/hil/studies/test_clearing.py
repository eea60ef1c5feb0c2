"""Critical clearing times against the equal-area criterion, and what else may end a run."""

import json
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import gfmhil
from gfm_hil.cli.main import main
from gfm_hil.scenario import load_scenario
from gfm_hil.scenario.loading import plant_of
from gfm_hil.studies.clearing import NO_EQUILIBRIUM, NOT_REACHED

TRIPS = (
    "over_current", "over_voltage", "under_voltage", "dc_over_voltage", "dc_under_voltage",
    "over_frequency", "under_frequency",
)  # fmt: skip
OFF = {trip: {"enabled": False} for trip in TRIPS}


def machine(H: float, x_over_r: float, tmp_path) -> dict:
    """A swing equation behind 0.35 p.u. at 0.8 p.u.; the grid falls to 0 p.u. and returns. Its
    damping of 0.5 p.u. keeps it from being lost in a later swing than the first."""
    law = tmp_path / "swing.toml"
    law.write_text(
        f"""name = "swing"\ntitle = "A swing equation, constant E"\nsource = "test"\n[phi]
        11 = {{ type = "PI", k = 90.0, k_i = 400.0 }}
        22 = {{ type = "IF", k = 2.0, T = {4.0 * H} }}
        33 = {{ type = "P", k = 1e-9 }}\n"""
    )
    return {
        "title": "equal area",
        "duration": 1.0,
        "law": str(law),
        "references": {"P_ref": 0.8},
        "plant": {
            "grid": {"scr": 2.0, "x_over_r": x_over_r},
            "factors": {"L_f": 20.0},
            "dc_source": {"mode": "regulated"},
            "protection": OFF,
        },
        "events": [{"t": 0.1, "type": "grid-voltage", "V_g": 0.0, "duration": 0.1}],
    }


def equal_area(content: dict, H: float, E: float = 1.0) -> float:
    """The clearing time of the circuit's own p(δ), s. The offsets of the line's current brake by
    their energy, when the voltage falls and when it returns."""
    par = plant_of(load_scenario(content, in_process=True)).par[0]
    R_f, L_f, C_f, R_g, L_g = (float(par[n]) for n in ("R_f", "L_f", "C_f", "R_g", "L_g"))
    omega_b, P = float(par["omega_b"]), content["references"]["P_ref"]
    z_f, z_g = R_f + 1j * L_f, R_g + 1j * L_g

    def line(delta: float, V: float) -> tuple[float, complex]:
        """Power at the capacitor and current of the line, in the grid's frame."""
        e = E * np.exp(1j * delta)
        v = (e / z_f + V / z_g) / (1 / z_f + 1 / z_g + 1j * C_f)
        i = (v - V) / z_g
        return float((v * np.conj(i)).real), i

    def offset(before: complex, after: complex) -> float:
        return 0.5 * L_g / omega_b * abs(after - before) ** 2

    def lacks(delta: float) -> float:
        return line(delta, 1.0)[0] - P

    begin = brentq(lacks, 0.0, 1.2)
    end = brentq(lacks, 1.6, math.pi)
    p_sag = line(0.0, 0.0)[0]
    first = offset(line(begin, 1.0)[1], line(begin, 0.0)[1])

    def excess(t: float) -> float:
        delta = begin + omega_b * ((P - p_sag) * t * t / 2 - first * t) / (2 * H)
        second = offset(line(delta, 0.0)[1], line(delta, 1.0)[1])
        fast = ((P - p_sag) * t - first - second) / (2 * H)
        return float(H * fast**2 * omega_b - quad(lacks, delta, end)[0])

    return float(brentq(excess, 0.05, 0.4))


@pytest.mark.full
@pytest.mark.parametrize(("H", "x_over_r"), [(5.0, 30.0), (5.0, 100.0), (10.0, 30.0)])
def test_a_converter_like_a_machine_has_the_clearing_time_of_equal_areas(H, x_over_r, tmp_path):
    content = machine(H, x_over_r, tmp_path)
    made = gfmhil.clearing_time(None, content, longest=0.5, within=5e-4)
    assert made.seconds == pytest.approx(equal_area(content, H), abs=2e-3)
    assert made.loss == NOT_REACHED
    assert 0 < made.lost - made.seconds < 6e-4


def test_a_trip_is_named_and_a_sag_that_is_borne_has_no_end():
    kept = gfmhil.clearing_time("vsg-2", longest=0.2, after=0.5)
    assert (kept.seconds, kept.lost, kept.loss) == (0.2, math.inf, "")
    trip = {"threshold": 0.85, "delay_s": 0.1}
    made = gfmhil.clearing_time(
        "vsg-2", longest=0.2, after=0.5, within=1e-3, plant__protection__under_voltage=trip
    )
    assert made.loss.startswith("under-voltage")
    assert made.seconds == pytest.approx(0.1, abs=0.02)


def test_a_run_that_falls_out_of_step_says_so_and_no_other():
    """On either side of the clearing time."""
    lost, kept = (
        gfmhil.run("deep_sag", "vsg-2", duration=7.0, events__0__duration=lasts)
        for lasts in (1.05, 0.5)
    )
    assert (lost.status, kept.status, kept.summary["reason"]) == ("completed", "completed", "")
    first, turned = lost.summary["reason"].split(" s: its angle to the grid ends ")
    t = float(first.removeprefix("fell out of step at "))
    delta = np.asarray(lost.signals["delta"])
    assert abs(delta[round(t / 1e-4)] - delta[0]) == pytest.approx(math.pi, abs=0.05)
    assert turned == "+360° from before"


@pytest.mark.full
def test_a_run_goes_on_until_its_angle_is_back_or_lost():
    """After 1 s it still creeps along near half a turn."""
    soon, late = (gfmhil.clearing_time("vsg-2", after=after, within=5e-4) for after in (1.0, 12.0))
    assert (soon.seconds, soon.lost, soon.loss) == (late.seconds, late.lost, NOT_REACHED)


def test_what_is_lost_without_the_fault_has_no_equilibrium():
    content = load_scenario("deep_sag", in_process=True).model_dump(exclude_unset=True)
    content["events"] = [*content["events"], {"t": 1.0, "type": "grid-voltage", "V_g": 0.1}]
    content["plant"]["protection"] = OFF
    made = gfmhil.clearing_time("vsg-2", content, longest=0.2)
    assert (made.seconds, made.lost, made.loss) == (0.0, 0.0, NO_EQUILIBRIUM)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--scenario", "pref_step"], "events: one must have a duration, a fault or a sag; 0 have"),
        (["--longest", "100"], "longest = 100 s: must lie in [0.0002, 60]"),
        (["--scenario", "three_share_a_load"], "network: the clearing time is that of one"),
        (["--over", "events.1.V_g=0,0.1"], "events.1.V_g: '1' must be one of 1 entries, counted"),
        (["--over", "inner.I_mx=1.1,1.2"], "law file: inner.I_mx = 1.1: unknown key; did you mean"),
        (["--scenario", "pref_step", "--scr", "2"], "events: one must have a duration"),
        (["--scr", "4,2"], "scr = [4.0, 2.0]: must be finite and ascending values"),
        (["--out", "x.png"], "--out: the figure is one over --scr or --over"),
    ],
)
def test_what_has_no_clearing_time_is_refused_in_one_line(options, said, capsys):
    assert main(["design", "clearing", *options]) == 2
    assert capsys.readouterr().err.startswith(f"gfmhil: {said}")


def test_a_place_without_an_operating_point_is_told_and_the_rest_of_the_map_is_there():
    """A line of SCR 0.3 cannot carry 0.7 p.u."""
    over = {"scr": (0.3, 2.0)}
    made = gfmhil.clearing_map("vsg-2", over=over, workers=1, longest=0.1, after=0.3)
    assert [one.loss for one in made.found] == [NO_EQUILIBRIUM, ""]
    assert made.values("seconds").tolist() == [0.0, 0.1]
    made = gfmhil.attraction_map("vsg-2", "deep_sag", over=over, after=0.3, within=90.0)
    assert (made.found[0].below, made.found[0].runs) == (NO_EQUILIBRIUM, 0) and made.found[1].runs


@pytest.mark.full
def test_a_map_has_the_clearing_times_of_its_places():
    over = {"scr": (2.0, 6.0), "events.0.V_g": (0.0, 0.1), "inner.I_max": (1.1, 1.5)}
    how = {"longest": 1.0, "after": 1.0, "within": 5e-3}
    made = gfmhil.clearing_map("vsg-2", over=over, workers=2, **how)
    seconds = made.values("seconds")
    assert seconds.shape == (2, 2, 2) and len(made.to_pandas()) == 8
    law = gfmhil.Law.load("vsg-2").with_inner("virtual-stator", I_max=1.1)
    own = load_scenario("deep_sag").model_copy(update={"inner": None})
    one = gfmhil.clearing_time(law, own, plant__grid__scr=6.0, events__0__V_g=0.0, **how)
    assert 0.0 < one.seconds < 1.0
    assert seconds[1, 0, 0] == one.seconds
    # more current, a shallower sag or a weaker grid that is braked less: it is borne for longer
    assert (np.diff(seconds, axis=1) >= 0.0).all()
    assert (np.diff(seconds, axis=2) >= 0.0).all()


@pytest.mark.full
def test_the_command_has_a_row_for_each_grid_and_a_figure(tmp_path, capsys):
    figure = tmp_path / "times.png"
    options = ["--scr", "2,4", "--longest", "0.3", "--after", "0.5", "--out", str(figure)]
    assert main(["design", "clearing", "--law", "droop-5", *options]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[1:5] for row in rows if row[:1] in (["2"], ["4"])] == [
        ["≥", "0.3", "not", "tried"]
    ] * 2
    assert figure.stat().st_size > 5000
    assert main(["design", "clearing", "--law", "droop-5", *options, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["scr"], row["seconds"], row["law"]) for row in rows] == [
        (2.0, 0.3, "droop-5"), (4.0, 0.3, "droop-5")
    ]  # fmt: skip
    assert rows[0]["trials"][0]["duration"] == 0.0 and rows[0]["runs"] == 2
    options += ["--over", "events.0.V_g=0.1,0.3", "--over", "inner.I_max=1.2"]
    assert main(["design", "clearing", "--law", "droop-5", *options]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[:5] for row in rows if row[4:5] == ["0.3"]] == [
        [scr, V_g, "1.2", "≥", "0.3"] for scr in ("2", "4") for V_g in ("0.1", "0.3")
    ]
