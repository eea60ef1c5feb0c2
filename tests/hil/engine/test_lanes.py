"""Several runs side by side: each has the bits of a run alone, whatever happens to the others."""

import inspect
import re

import numpy as np
import pytest

from gfm_hil.engine import lanes
from gfm_hil.engine.lanes import LANES, Lanes, run_together
from gfm_hil.engine.setup import make_bench
from gfm_hil.run.runner import memory_steps, run_in_memory
from gfm_hil.run.summary import READ
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.campaign.worker import kept
from gfm_plant.records import converter_par_dtype

_STEP = {"t": 0.1, "type": "reference", "P_ref": 0.9}
_RAMP = {"t": 0.1, "type": "reference", "P_ref": 0.7, "ramp_s": 0.05}
_GRID = [
    {"t": 0.05, "type": "grid-frequency", "f_hz": 50.2, "rate": 4.0},
    {"t": 0.15, "type": "grid-voltage", "V_g": 0.9, "duration": 0.03},
    {"t": 0.25, "type": "grid-phase-jump", "degrees": 5.0},
]
_LAWS = ["mimo-gfm", "vsg-2", "droop-1", "hybrid-angle", "vsg-12"]  # of orders 3, 3, 1, -, 5


def _scenario(k, fraction, events, **more):
    delay = {"samples": 1 + k % 2, "fraction": fraction}
    factors = {"L_g": 0.5 + k, "R_f": 0.5, "R_g": 0.5}
    changed = {"duration": 0.4, "seed": 1 + k, "events": events, "law": _LAWS[k % 2]} | more
    return load_scenario(
        "rig_pref_step", in_process=True, plant__delay=delay, plant__factors=factors, **changed
    )


def _steps(scenario):
    (run,) = yield from memory_steps([make_bench(scenario)], [kept(scenario)])
    return {name: np.array(run.columns[name][:]) for name in READ}, _told(run)


def _told(run):
    clocks = "wall_s", "date", "clock_ns"
    return [{k: v for k, v in e.items() if k not in clocks} for e in (run.summary, *run.events)]


@pytest.mark.full
@pytest.mark.parametrize(
    "fraction, events, more, share",
    [
        (0.0, [_STEP], {}, 0.6),
        (0.3, [_STEP], {}, 0.6),
        (0.3, [_RAMP], {}, 0.15),
        (0.3, _GRID, {}, 0.1),
        (0.3, [_STEP, {"t": 0.2, "type": "law", "law": "droop-1"}], {}, 0.3),
        # some trip, and what a wide limit lets pass clamps the law
        (0.3, [{**_STEP, "P_ref": 1.3}], {"references__P_ref": 0.9}, 0.05),
        (0.3, [_STEP], {"after_trip": "wait", "references__P_ref": 1.0}, 0.05),
    ],
)
def test_runs_side_by_side_have_the_bits_of_runs_alone(monkeypatch, fraction, events, more, share):
    ticks, run = 0, Lanes.run

    def counted(lanes, most):
        nonlocal ticks
        done, upset = run(lanes, most)
        ticks += done * int(lanes._used.sum())
        return done, upset

    monkeypatch.setattr(Lanes, "run", counted)
    scenarios = [_scenario(k, fraction, events, **more) for k in range(LANES + 3)]
    together = run_together(map(_steps, scenarios))
    recorded = 0
    for scenario, (columns, told) in zip(scenarios, together, strict=True):
        alone = run_in_memory(scenario)
        recorded += len(columns["true_p"])
        for name, column in columns.items():
            assert column.tobytes() == np.asarray(alone.columns[name][:]).tobytes(), name
        assert told == _told(alone)
    assert ticks > share * recorded


@pytest.mark.full
@pytest.mark.parametrize("law", _LAWS)
def test_laws_of_each_order_side_by_side(law):
    scenarios = [_scenario(k, 0.3, [_STEP], law=law) for k in range(2)]
    for scenario, (columns, _) in zip(scenarios, run_together(map(_steps, scenarios)), strict=True):
        alone = run_in_memory(scenario)
        for name, column in columns.items():
            assert column.tobytes() == np.asarray(alone.columns[name][:]).tobytes(), name


#: of a converter's parameters what the modes of its circuit contain, what only goes with something
#: that ``is_plain`` refuses, and what nothing reads after the start
_ELEMENTS = {"L_f", "R_f", "C_f", "L_g", "R_g", "L_line_n", "R_line_n"}
_OF_OTHERS = {
    "soc", "P_most", "R_battery", "place_ticks", "by_voltage", "levels", "counts", "count_s",
    "dead", "least", "leg", "wide", "band", "band_kind", "cancels", "I_sc", "I_0", "v_T",
    "irradiance", "phase_gain", "phase_offset", "phase_noise", "phase_skew", "skewed", "phase_lo",
    "phase_per_lsb", "phase_top", "phase_weights", "phase_samples",
}  # fmt: skip
_OF_THE_START = {"omega_s", "T_s", "fraction", "i_max"}


def test_lanes_know_every_parameter_of_a_converter_or_refuse_what_it_goes_with():
    """A new one has to be copied to a lane, refused by ``is_plain``, or named above."""
    known = {*re.findall(r'"(\w+)"', inspect.getsource(lanes))}
    assert {*converter_par_dtype.names} - known == _ELEMENTS | _OF_OTHERS | _OF_THE_START
