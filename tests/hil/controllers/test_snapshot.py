"""Networks of several models, and runs that go on from a snapshot: the bits of the run that was not
cut."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.engine import setup
from gfm_hil.recording.run import Run
from gfm_hil.run import runner
from gfm_plant import plant_sample
from gfm_runtime.switchover import settle_into

EMTHUB = Path(__file__).parents[3] / "examples" / "emthub"
RIG = {"dc_source": {"mode": "regulated"}}
CUT = 500  # tick of the snapshot
T_S = 1e-4
#: what no law fills where a model computes u, and what counts from the start of a run
OF_LAWS = {"law", "X_est", "E_law", "i_ref_d", "i_ref_q", "limited"}
OF_TIME = {"tick", "t"}


def compiles(test: Any) -> Any:
    return pytest.mark.apt(pytest.mark.timeout(900)(test))


def steps(*ticks: int, **more: Any) -> list[dict[str, Any]]:
    """Steps of P_ref at these ticks."""
    powers = (0.4, 0.25, 0.45)
    return [{"type": "reference", "tick": k, "P_ref": P, **more}
            for k, P in zip(ticks, powers, strict=False)]  # fmt: skip


def network(**changes: Any) -> dict[str, Any]:
    """Three converters of three laws at one node, with a grid behind a line."""
    laws = {"A": "vsg-2", "B": "droop-5", "C": "vsg-1"}
    return {
        "title": "three", "duration": 0.1, "references": {"P_ref": 0.3}, "plant": RIG,
        "link": {"type": "shm", "peer_timeout_s": 20.0},
        "network": {
            "converters": {name: {"node": "bus", "law": law} for name, law in laws.items()},
            "loads": {"base": {"node": "bus", "P": 0.6, "Q": 0.1}},
            "lines": {"to grid": {"start": "bus", "end": "g", "L": 0.2, "R": 0.02}}, "grid": "g",
        },
        "events": steps(200, 700, converter="A"),
        **changes,
    }  # fmt: skip


def check_equal(found: Run, whole: Run, first: int, without: set[str]) -> None:
    """The run is that of the other from a tick on, bit for bit."""
    assert np.ptp(whole.columns["true_p"][first:]) > 1e-3
    assert set(found.columns) == set(whole.columns)
    for name in whole.columns.keys() - without:
        rest = whole.columns[name][first:]
        assert found.columns[name][:].tobytes() == rest.tobytes(), name


@compiles
def test_two_dlls_and_a_law_in_a_network_and_their_snapshot(exported, tmp_path, monkeypatch):
    """Each converter has the bits of the network whose three laws are ours, settled at the first
    measurement as the models settle themselves; and those bits from a snapshot on."""
    models = {
        name: exported("dll", law, "none") for name, law in (("A", "vsg-2"), ("B", "droop-5"))
    }
    given, cut = network(snapshot=CUT * T_S), tmp_path / "cut"
    whole = gfmhil.run_network(given, cut, controllers=models, figures=False)
    assert whole.status == "completed"
    names = [run.summary["controller"] for run in whole.values()]
    assert names == ["dll vsg-2", "dll droop-5", "gfmhil"]
    rest = network(duration=0.05, events=steps(700 - CUT, converter="A"))
    rest["events"][0]["P_ref"] = given["events"][1]["P_ref"]
    goes_on = gfmhil.run_network(
        rest, tmp_path / "rest", controllers=models, figures=False, start_from=str(cut)
    )
    for name, run in goes_on.items():
        check_equal(run, whole[name], CUT, OF_TIME | (OF_LAWS if name != "C" else set()))

    def settled(scenario: Any, _: Any) -> Any:
        benches = setup.make_benches(scenario)
        for k, bench in enumerate(benches[:2]):
            c, y = bench.controller, bench.y.copy()
            plant_sample(bench.plant.copy().records, k, y)
            settle_into(c.laws[0], c.states[0], c.ctl["ref"][0], y, bench.u.copy(), np.zeros(3))
        return benches

    monkeypatch.setattr(runner, "compiled_benches", settled)
    ours = gfmhil.run_network(network())
    for name, run in whole.items():
        check_equal(run, ours[name], 0, OF_LAWS if name != "C" else set())


@compiles
@pytest.mark.parametrize("whose", ["tests", "EPRI's"])
def test_a_model_of_others_beside_ours_and_a_law(exported, foreign, whose, tmp_path):
    """EPRI's is ``GFMHIL_EMTHUB_MODEL``, compiled from one's own checkout: see examples/emthub."""
    from .test_controllers import MAP

    map_, changes = tmp_path / "map.toml", dict[str, Any]()
    map_.write_text(MAP + "parameters.droop = 2e-4\n")
    if whose != "tests":
        foreign, map_ = os.environ.get("GFMHIL_EMTHUB_MODEL", ""), EMTHUB / "gfm.toml"
        if not foreign:
            pytest.skip("GFMHIL_EMTHUB_MODEL is not set")
        plant = RIG | {"converter": str(EMTHUB / "converter.toml"), "modulation": "space-vector"}
        changes = {"T_s": 1e-5, "inner": "virtual-stator", "plant": plant}
    T_s, inner = changes.get("T_s", T_S), changes.get("inner", "none")
    how = {
        "controllers": {"A": f"dll:{foreign}", "B": exported("dll", "droop-5", inner)},
        "ports": {"A": map_}, "figures": False,
    }  # fmt: skip
    more = changes | {"duration": 1000 * T_s, "snapshot": CUT * T_s}
    whole = gfmhil.run_network(network(**more), tmp_path / "cut", **how)
    assert {run.ticks for run in whole.values()} == {1000}  # none trips
    assert len({run.summary["controller"] for run in whole.values()}) == 3
    rest = changes | {"duration": 500 * T_s, "events": steps(700 - CUT, converter="A")}
    rest["events"][0]["P_ref"] = network()["events"][1]["P_ref"]
    rest["start_from"] = str(tmp_path / "cut")
    for name, run in gfmhil.run_network(network(**rest), tmp_path / "rest", **how).items():
        check_equal(run, whole[name], CUT, OF_TIME | (OF_LAWS if name != "C" else set()))


@compiles
@pytest.mark.parametrize("kind", ["dll", "fmu"])
def test_a_model_goes_on_from_its_state(exported, kind, tmp_path):
    """A new instance in a new process gets what the interface gives of the model's state."""
    model = exported(kind, "vsg-2", "cascaded")
    given = {"title": "cut", "duration": 0.1, "law": "vsg-2", "inner": "cascaded",
             "link": {"type": "shm", "peer_timeout_s": 20.0}}  # fmt: skip
    whole = gfmhil.run(
        {**given, "events": steps(300), "snapshot": CUT * T_S}, folder=tmp_path / "cut",
        controller=model, figures=False,
    )  # fmt: skip
    goes_on = gfmhil.run(
        {**given, "duration": 0.05, "start_from": str(tmp_path / "cut")}, folder=tmp_path / "rest",
        controller=model, figures=False,
    )  # fmt: skip
    check_equal(goes_on, whole, CUT, OF_TIME | OF_LAWS)
    with pytest.raises(UserError, match="its snapshot is of the controller"):
        gfmhil.run(
            {**given, "duration": 0.05, "start_from": str(tmp_path / "cut")},
            folder=tmp_path / "other", controller=exported("dll", "droop-5", "cascaded"),
            figures=False,
        )  # fmt: skip
    name = "FMUState" if kind == "fmu" else "DoubleStates"
    file = tmp_path / "cut" / "snapshot_controller.npz"
    kept = {key: x for key, x in np.load(file).items() if key != f"external_{name}"}
    np.savez(file, **kept)
    with pytest.raises(UserError, match=f"{file}: .*the snapshot has nothing for its {name}") as no:
        gfmhil.run(
            {**given, "duration": 0.05, "start_from": str(tmp_path / "cut")},
            folder=tmp_path / "less", controller=model, figures=False,
        )  # fmt: skip
    assert "\n" not in str(no.value)


@compiles
def test_a_model_of_others_goes_on_between_two_of_its_steps(foreign, tmp_path):
    """Its step is two ticks, and the snapshot lies within one; ``at`` counts its steps."""
    from .test_controllers import MAP

    (tmp_path / "map.toml").write_text(MAP + "parameters.at = 300\nparameters.what = 3\n")
    given = {"title": "cut", "duration": 0.1, "law": "vsg-2", "plant": RIG,
             "link": {"type": "shm", "peer_timeout_s": 20.0}}  # fmt: skip
    how = {"controller": f"dll:{foreign}", "ports": tmp_path / "map.toml", "figures": False}
    whole = gfmhil.run(
        {**given, "events": steps(300), "snapshot": (CUT + 1) * T_S}, folder=tmp_path / "cut", **how
    )
    rest = {**given, "duration": 0.05, "start_from": str(tmp_path / "cut")}
    goes_on = gfmhil.run(rest, folder=tmp_path / "rest", **how)
    reason = "dll droop of others: blocks the bridge: block = 1"
    assert whole.summary["reason"] == goes_on.summary["reason"] == reason
    assert whole.ticks == goes_on.ticks + CUT + 1
    ran = goes_on.ticks - 1  # the last tick has no u of the controller
    for name in ("true_p", "true_q", "u_omega_u", "u_E_u", "y_V"):
        rest_of = whole.columns[name][CUT + 1 : CUT + 1 + ran]
        assert goes_on.columns[name][:ran].tobytes() == rest_of.tobytes(), name


NOISY = {"sensors": {"noise_std": {"p": 1e-3}}, "delay": {"samples": 1, "fraction": 0.5}}


@pytest.mark.parametrize("inner", [None, "cascaded"])
def test_a_run_of_a_law_goes_on_in_process(tmp_path, inner):
    """With noise, a delay, a ramp of a reference and one of the grid that go on, and a law that has
    changed."""
    events = [
        {"type": "law", "tick": 100, "law": "droop-5"},
        {"type": "reference", "tick": 450, "P_ref": 0.6, "ramp_s": 0.02},
        {"type": "grid-frequency", "tick": 400, "f_hz": 49.9, "rate": 5.0},
        {"type": "reference", "tick": 700, "P_ref": 0.3},
    ]
    given = {"title": "cut", "duration": 0.1, "law": "vsg-2", "plant": NOISY,
             "link": {"type": "inproc"}, "seed": 3}  # fmt: skip
    given |= {} if inner is None else {"inner": inner}
    cut = tmp_path / "cut"
    whole = gfmhil.run(
        {**given, "events": events, "snapshot": CUT * T_S}, folder=cut, figures=False
    )
    later = {**given, "duration": 0.05, "start_from": str(cut), "ready_laws": ["droop-5"],
             "events": [{**events[3], "tick": 700 - CUT}]}  # fmt: skip
    rest = gfmhil.run(later)
    check_equal(rest, whole, CUT, OF_TIME)
    of_laws = [[e["tick"] for e in r.events if e["event"] == "law-active"] for r in (whole, rest)]
    assert of_laws[1] == [tick - CUT for tick in of_laws[0] if tick >= CUT]


def test_a_trip_after_a_snapshot_has_the_tick_of_the_new_run(tmp_path):
    given = {"title": "cut", "duration": 0.1, "law": "vsg-2", "link": {"type": "inproc"}}
    dip = {"type": "grid-voltage", "V_g": 0.0}
    whole = gfmhil.run(
        {**given, "events": [{**dip, "tick": 700}], "snapshot": CUT * T_S},
        folder=tmp_path / "cut", figures=False,
    )  # fmt: skip
    later = {**given, "duration": 0.05, "start_from": str(tmp_path / "cut"),
             "events": [{**dip, "tick": 700 - CUT}]}  # fmt: skip
    found = gfmhil.run(later)
    at, before = (run.events[-1]["tick"] for run in (found, whole))
    assert at == before - CUT > 200
    for run, tick in ((found, at), (whole, before)):
        assert run.status == "tripped"
        assert run.summary["reason"].endswith(f" at tick {tick} (t = {tick * T_S:g} s)")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"T_s": 2e-4}, "T_s = 0.0002, there 0.0001: must be as in that run"),
        ({"references": {"P_ref": 0.2}}, "references"),
        ({"law": "droop-5"}, "its laws are others than droop-5"),
        ({"snapshot": 1.0}, "snapshot = 1 s: must lie within the run of 0.01 s"),
        ({"snapshot": 0.005}, "snapshot: is kept in a run folder"),
    ],
)
def test_wrong_snapshots_are_one_line(tmp_path_factory, changes, message):
    cut = tmp_path_factory.getbasetemp() / "cut"
    given = {"title": "cut", "duration": 0.01, "law": "vsg-2", "link": {"type": "inproc"}}
    if not cut.exists():
        gfmhil.run({**given, "snapshot": 0.005}, folder=cut, figures=False)
    start: dict[str, Any] = {} if "snapshot" in changes else {"start_from": str(cut)}
    with pytest.raises(UserError, match=message) as said:
        gfmhil.run({**given, **start, **changes})
    assert "\n" not in str(said.value)


def test_a_folder_without_a_snapshot_or_with_a_damaged_one(tmp_path):
    given = {"title": "cut", "duration": 0.01, "law": "vsg-2", "link": {"type": "inproc"}}
    gfmhil.run(given, folder=tmp_path / "cut", figures=False)
    start = {**given, "start_from": str(tmp_path / "cut")}
    with pytest.raises(UserError, match="is not there: it took no snapshot"):
        gfmhil.run(start)
    (tmp_path / "cut" / "snapshot_plant.npz").write_bytes(b"PK\x03\x04 nothing")
    with pytest.raises(UserError, match="cannot be read"):
        gfmhil.run(start)
    np.savez(tmp_path / "cut" / "snapshot_plant.npz", record_0=np.zeros(3, np.uint8))
    with pytest.raises(UserError, match="of another controller or plant"):
        gfmhil.run(start)


def test_a_snapshot_after_a_fault_and_a_trip(tmp_path):
    """Both are over, or go on, with the same bits; a reset brings the converter back."""
    given = {"title": "cut", "law": "vsg-2", "link": {"type": "inproc"}, "after_trip": "wait"}
    fault = {"type": "fault", "t": 0.001, "position": 0.3, "R": 0.01, "duration": 0.006}
    reset = {"type": "reset", "t": 0.03}
    for trips, R in ((1, 0.01), (0, 0.5)):
        events = [{**fault, "R": R}, *[reset] * trips]
        first = {"events": events, "duration": 0.05, "snapshot": 0.02}
        whole = gfmhil.run({**given, **first}, folder=tmp_path / f"{R}", figures=False)
        assert len(whole.summary["trips"]) == trips and whole.status == "completed"
        late = {"events": [{**reset, "t": 0.01}] * trips, "duration": 0.03}
        late["start_from"] = str(tmp_path / f"{R}")
        rest = gfmhil.run({**given, **late}, folder=tmp_path / f"{R}-rest", figures=False)
        assert [trip["tick"] for trip in rest.summary["trips"]] == [0] * trips
        for name in ("true_p", "true_v_dc", "u_omega_u"):
            assert rest.columns[name][:].tobytes() == whole.columns[name][200:].tobytes()


def test_a_snapshot_in_a_fault_is_refused(tmp_path):
    given = {"title": "cut", "duration": 0.01, "law": "vsg-2", "link": {"type": "inproc"},
             "snapshot": 0.006}  # fmt: skip
    fault = {"type": "fault", "t": 0.005, "position": 0.5, "R": 0.2, "duration": 0.004}
    run = gfmhil.run({**given, "events": [fault]}, folder=tmp_path / "cut", figures=False)
    said = "the snapshot cannot be kept: a fault, a breaker that opens or a synchro-check goes on"
    assert (run.status, run.summary["reason"]) == ("safe", said)


@pytest.mark.full
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ({"type": "breaker", "name": "base", "closed": False}, []),
        ({"type": "breaker", "name": "base", "closed": False}, [{"type": "breaker",
          "name": "base", "closed": True}]),
        ({"type": "grid-breaker", "closed": False}, [{"type": "grid-breaker", "closed": True}]),
        ({"type": "grid-phase-jump", "degrees": -30.0}, [{"type": "reset", "converter": "C"}]),
    ],
)  # fmt: skip
def test_a_snapshot_has_the_breakers_of_its_tick(before, after, tmp_path):
    given = network(
        link={"type": "inproc"}, after_trip="wait",
        events=[{"t": 0.01, **before}, *({"t": 0.07, **one} for one in after)],
    )  # fmt: skip
    given["network"]["loads"]["far"] = {"node": "bus", "P": 0.1}
    low = {"over_current": {"threshold": 0.6, "delay_s": 0.0}}
    given["network"]["converters"]["C"]["plant"] = {**RIG, "protection": low}
    whole = gfmhil.run_network(given, tmp_path / "cut", figures=False, snapshot=CUT * T_S)
    assert len(whole["C"].summary["trips"]) == (before["type"] == "grid-phase-jump")
    later = {**given, "events": [{"t": 0.02, **one} for one in after], "duration": 0.05}
    rest = gfmhil.run_network(later, start_from=str(tmp_path / "cut"))
    for name, run in rest.items():
        assert run.status == whole[name].status == "completed"
        check_equal(run, whole[name], CUT, OF_TIME)


def test_a_snapshot_has_the_line_of_its_tick(tmp_path):
    given = {"title": "cut", "law": "vsg-2", "link": {"type": "inproc"},
             "plant": {"grid": {"scr": 3.0, "x_over_r": 5.0}}}  # fmt: skip
    weaker = [{"type": "grid-impedance", "t": 0.01, "scr": 2.0, "x_over_r": 5.0}]
    first = {"events": weaker, "duration": 0.1, "snapshot": CUT * T_S}
    whole = gfmhil.run({**given, **first}, folder=tmp_path / "cut", figures=False)
    rest = gfmhil.run({**given, "duration": 0.05, "start_from": str(tmp_path / "cut")})
    check_equal(rest, whole, CUT, OF_TIME)
