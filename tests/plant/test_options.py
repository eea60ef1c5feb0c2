"""Options: defaults are ideal; an error names the option, its value and what is allowed."""

import tomllib

import pytest
from pydantic import ValidationError

from gfm_plant import Plant, make_plant
from gfm_plant.options import DS2004, DS2101, MEASURED


def test_a_scenario_table():
    options = Plant.model_validate(
        tomllib.loads(
            """
            factors = { L_g = 1.2 }
            adc = "DS2004"
            dac = { bits = 12, range = { E_u = [0, 1.5] } }
            delay = { samples = 1, fraction = 0.25 }
            [protection.over_current]
            threshold = 1.5
            [sensors]
            bandwidth_hz = 1000
            noise_std = { p = 1e-3 }
            """
        )
    )
    assert options.adc == DS2004
    assert options.dac.range == {"E_u": (0.0, 1.5)}
    trip = options.protection.over_current
    assert (trip.threshold, trip.enabled) == (1.5, True)
    assert trip.delay_s == Plant().protection.over_current.delay_s
    assert Plant.model_validate(options.model_dump()) == options


@pytest.mark.parametrize(
    ("options", "where", "message"),
    [
        ({"substeps": 10}, "substeps", "Extra inputs"),
        ({"factors": {"L_f": -1.0}}, "", r"factors.L_f = -1.0: must be > 0"),
        ({"factors": {"L": 1.0}}, "factors.L", "'L_f', 'R_f'"),
        ({"grid": {"load_R": 36.1}}, "grid", "load_R = 36.1, load_L = None: give both"),
        ({"grid": {"load_R": 36.1, "load_L": -0.1}}, "grid.load_L", "greater than 0"),
        ({"dc_source": {"mode": "ideal"}}, "dc_source.mode", "'regulated' or 'array'"),
        ({"sensors": {"gain": {"omega_u": 1.0}}}, "sensors.gain.omega_u", "'v_dc', 'p'"),
        ({"sensors": {"bandwidth_hz": "1k"}}, "sensors.bandwidth_hz", "valid number"),
        ({"sensors": {"offset": {"p": float("nan")}}}, "sensors.offset.p", "finite"),
        ({"adc": "DS2005"}, "adc", "'DS2005': must be DS2004"),
        ({"adc": {"bits": 16}}, "adc", "bits = 16: range must give at least one channel"),
        ({"adc": {"range": {"p": [1, -1]}}}, "adc.range.p", r"\[1.0, -1.0\]: .*lo < hi"),
        ({"delay": {"samples": 6}}, "delay.samples", "less than or equal to 5"),
        ({"delay": {"fraction": 1.0}}, "delay.fraction", "less than 1"),
        ({"protection": {"over_current": {"threshold": 0.0}}}, "threshold", "greater than 0"),
    ],
)
def test_wrong_options(options, where, message):
    with pytest.raises(ValidationError, match=message) as caught:
        Plant.model_validate(options)
    assert where in ".".join(str(part) for part in caught.value.errors()[0]["loc"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"factors": {"L_g": 1e-9, "R_g": 0.0}},
            r"fastest mode = 1.58.*e\+08 rad/s: too fast for the DC link",
        ),
        ({"dc_source": {"mode": "regulated", "k_p": 1e6}}, r"dc_source.k_p.*1.63.*e\+07 rad/s"),
    ],
)
def test_what_the_dc_link_cannot_follow(options, message):
    with pytest.raises(ValueError, match=message):
        make_plant(Plant.model_validate(options), 1e-4)


@pytest.mark.parametrize("T_s", [0.0, -1e-4, float("nan")])
def test_sampling_period(T_s):
    with pytest.raises(ValueError, match="T_s = "):
        make_plant(Plant(), T_s)


def test_boards_of_the_rig():
    assert (DS2004.bits, DS2101.bits) == (16, 12)
    assert set(DS2004.range) == set(MEASURED)
    assert "omega_u" not in DS2101.range


def test_the_line_by_its_short_circuit_ratio():
    """SCR = 2 and X/R = 10, by hand: 1/2 p.u. = sqrt(R^2 + X^2) with X = 10 R."""
    par = make_plant(Plant.model_validate({"grid": {"scr": 2.0, "x_over_r": 10.0}}), 1e-4).par
    assert par["R_g"][0] == pytest.approx(0.0497518595, rel=1e-9)
    assert par["L_g"][0] == pytest.approx(0.497518595, rel=1e-9)
    assert par["L_line_n"][0] == make_plant(Plant(), 1e-4).par["L_g"][0]  # of the file, for events


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"grid": {"scr": 2.0}}, "scr = 2.0, x_over_r = None: give both or neither"),
        (
            {"grid": {"scr": 2.0, "x_over_r": 5.0}, "factors": {"L_g": 2.0}},
            "grid.scr = 2: sets the line; leave out factors.L_g",
        ),
    ],
)
def test_a_line_is_given_once_and_whole(options, message):
    with pytest.raises(ValidationError, match=message):
        Plant.model_validate(options)
