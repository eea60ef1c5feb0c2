"""Figures of recordings that are complete, cut short, or lack a side."""

import warnings

import numpy as np
import pytest
from matplotlib.figure import Figure

from gfm_hil.recording.run import Run
from gfm_hil.results.figures import draw_comparison, draw_signals
from gfm_hil.results.figures import draw_run as drawn

from ...support.laws import slow_but

RUN = {"laws": ["a", "b"], "mode": "lockstep", "round_trip_us": None, "misses": 0, "ticks": 0}


def recording(ticks: int) -> dict[str, np.ndarray]:
    """Signals with an oscillation, in the form that plant and controller record."""
    t = np.arange(ticks) * 1e-4
    names = ("p", "q", "omega_u", "omega_g", "V", "v_dc", "i")
    wave = 1 + 0.1 * np.sin(2 * np.pi * 50 * t)
    controller = ("ref_P_ref", "ref_Q_ref")
    plant = (*(f"true_{n}" for n in names), "u_E_u", "u_i_u")
    return {"t": t, **{n: wave.copy() for n in (*plant, *controller)}}


def draw_run(folder, scenario, signals, summary) -> None:
    with drawn(Run(scenario, summary, signals, folder=folder)):
        pass


def events(count: int) -> list[dict[str, object]]:
    return [{"t": 0.01 * k, "label": f"event {k}"} for k in range(count)]


@pytest.mark.parametrize("ticks", slow_but([1, 3000], [1, 7, 3000, 50_000]))
def test_a_run_of_any_length_is_drawn_without_a_warning(ticks, make, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # from another test
        draw_run(tmp_path, make(), recording(ticks), {**RUN, "events": events(5)})
    (picture,) = tmp_path.iterdir()
    assert picture.name == "signals.png" and picture.stat().st_size > 20_000


def test_a_controller_that_died_leaves_a_gap_not_a_warning(make, tmp_path):
    signals = recording(50_000)
    for name in ("ref_P_ref", "ref_Q_ref"):
        signals[name][30_000:] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)  # from another test
        draw_run(tmp_path, make(), signals, {**RUN, "events": []})


def test_a_trip_is_marked_and_no_curve_hides_another(make):
    """The recording's curves are all identical; p's reference is dashed over p."""
    trips = [{"t": 0.2, "reason": "over-current: |i_dq| = 3.1 p.u."}]
    summary = {**RUN, "controller": "a foreign one", "events": events(2), "trips": trips}
    figure = Figure()
    axes = draw_signals(figure, Run(make(), summary, recording(3000)))
    assert "over-current" in [text.get_text() for text in axes[0].texts]
    assert figure.get_suptitle() == "test — a foreign one"
    assert [line.get_linestyle() for line in axes[0].lines] == ["-", "--"]


def test_a_controller_alone_has_no_picture_of_the_plant(make, tmp_path):
    signals = {"t": np.zeros(9), "ref_P_ref": np.zeros(9)}
    draw_run(tmp_path, make(), signals, {**RUN, "events": []})
    assert not [*tmp_path.iterdir()]


def test_many_laws_are_compared_in_one_figure(make, tmp_path):
    runs = {f"law-{k}": recording(1000 + 100 * k) for k in range(9)}
    draw_comparison(tmp_path / "comparison.png", make(), runs, events(2))
    assert (tmp_path / "comparison.png").stat().st_size > 30_000
