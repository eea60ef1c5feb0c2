"""Plant controllers: their block diagram, their cycle and delay, and what they hold."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

import gfmhil
from gfm_hil.core.errors import UserError
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import load_scenario

T_S = 1e-4
PARK: dict[str, Any] = {"line": "feeder", "node": "bus"}
#: all of the block diagram acts at once
ALL: dict[str, Any] = {
    "period_s": 0.02, "delay_s": 0.013, "P_ref": 0.35, "P_max": 0.4, "V_frz": 0.9, "R_c": 0.01,
    "X_c": 0.1, "K_c": 0.05, "dbd": 0.002, "e_max": 0.01, "K_p": 0.5, "K_i": 2.0, "fdbd": 0.001,
    "D_dn": 8.0, "D_up": 12.0, "fe_max": 0.1, "fe_min": -0.05, "K_pg": 0.3, "K_ig": 4.0,
    "T_fltr": 0.015, "T_p": 0.01,
}  # fmt: skip
NO_LAGS = {"T_ft": 0.0, "T_fv": 0.0, "T_g": 0.0}
SAG = {"type": "grid-voltage", "t": 0.6, "V_g": 0.7, "duration": 0.1}


def network(park: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """Two converters behind one feeder to the grid."""
    own = {"title": "park", "duration": 1.0, "law": "droop-3", "link": {"type": "inproc"}}
    return own | {
        "references": {"P_ref": 0.3},
        "network": {
            "grid": "far",
            "converters": {
                "A": {"node": "bus"}, "B": {"node": "bus", "references": {"P_ref": 0.2}}
            },
            "lines": {"feeder": {"start": "bus", "end": "far", "L": 0.1, "R": 0.01}},
            "plant_controllers": {"park": PARK | (park or {})},
        },
    } | more  # fmt: skip


def run(content: dict[str, Any]) -> NetworkRun:
    """The run, in memory, of a scenario."""
    done = gfmhil.run_network(load_scenario(content))
    assert {one.status for one in done.values()} == {"completed"}
    return done


def column(done: NetworkRun, name: str) -> NDArray[np.float64]:
    """A column of the network, or of a converter as ``A.ref_P_ref``."""
    part, _, own = name.partition(".")
    return np.asarray(done[part].columns[own][:] if part in done else done.flows[name][:])


def block_diagram(done: NetworkRun, park: dict[str, Any], S: float = 2.0) -> NDArray[np.float64]:
    """P_set and V_set or Q_set of each cycle, (cycles, 2), from what the run recorded, after
    the equations of the module's text."""
    P, Q, V, omega, i_re, i_im = (
        column(done, f"park.{x}") for x in ("P", "Q", "V", "omega", "i_re", "i_im")
    )
    i = (i_re + 1j * i_im) / S
    P, Q = P / S, Q / S
    v = S * (P + 1j * Q) / np.conj(i * S)

    def lagged(x: NDArray[np.float64], T: float) -> NDArray[np.float64]:
        a = 1 - np.exp(-T_S / T)
        return lfilter([a], [1, a - 1], x, zi=[(1 - a) * x[0]])[0]

    V_m = np.abs(v - (park["R_c"] + 1j * park["X_c"]) * i) + park["K_c"] * Q
    V_m, Q_m, P_m = lagged(V_m, park["T_fltr"]), lagged(Q, park["T_fltr"]), lagged(P, park["T_p"])
    seen = V_m if park["control"] == "V" else Q_m
    aim, every, x = seen[0], round(park["period_s"] / T_S), np.array([0.25, 0.0])
    x[1], limits = (1.0, (0.9, 1.1)) if park["sends"] == "V_ref" else (0.0, (-0.5, 0.5))
    rows, begin = [], x.copy()

    def dz(e: float, band: float) -> float:
        return float(np.sign(e) * max(abs(e) - band, 0))

    for k in range(0, len(P), every):
        omega_m = omega[min(k + 1, len(P) - 1)]  # a column has what was measured a tick before
        f = dz(1.0 - omega_m, park["fdbd"])
        e = park["P_ref"] - P_m[k] + (park["D_up"] if f > 0 else park["D_dn"]) * f
        e = np.clip(e, park["fe_min"], park["fe_max"])
        x[0] = np.clip(x[0] + park["period_s"] * park["K_ig"] * e, 0, park["P_max"])
        P_set = np.clip(x[0] + park["K_pg"] * e, 0, park["P_max"])
        e = np.clip(dz(aim - seen[k], park["dbd"]), -park["e_max"], park["e_max"])
        if V[k] >= park["V_frz"]:
            x[1] = np.clip(x[1] + park["period_s"] * park["K_i"] * e, *limits)
        rows.append((P_set, np.clip(x[1] + park["K_p"] * e, *limits)))
    sent, leads = np.array(rows), ((0.0, park["T_g"]), (park["T_ft"], park["T_fv"]))
    for j, (lead, lag) in enumerate(leads):
        if lag > 0.0:
            b, a, _ = cont2discrete(
                (np.trim_zeros([lead, 1.0], "f"), [lag, 1.0]), park["period_s"], "zoh"
            )
            sent[:, j] = begin[j] + lfilter(b[0], a, sent[:, j] - begin[j])
    return sent


@pytest.mark.full
@pytest.mark.parametrize("control", ["V", "Q"])
@pytest.mark.parametrize("sends", ["V_ref", "Q_ref"])
@pytest.mark.parametrize("lags", [NO_LAGS, {"T_ft": 0.03, "T_fv": 0.1, "T_g": 0.05}], ids=["", "s"])
def test_its_commands_are_those_of_the_block_diagram(control: str, sends: str, lags: Any) -> None:
    """With a swing of the grid's frequency, a sag that freezes an integral, limits and bands."""
    park = {**ALL, **lags, "control": control, "sends": sends}
    events = [
        {"type": "grid-frequency", "t": 0.1, "f_hz": 49.7, "rate": 2.5},
        {"type": "grid-frequency", "t": 0.4, "f_hz": 50.3, "rate": 2.5},
        SAG,
    ]
    law = {"V_ref": "droop-3", "Q_ref": "vsg-2"}[sends]
    done = run(network(park, events=events, law=law))
    rows, every = block_diagram(done, park), round(park["period_s"] / T_S)
    for j, name in enumerate(("P_set", sends.replace("ref", "set"))):
        recorded = column(done, f"park.{name}")
        assert recorded[1::every] == pytest.approx(rows[:, j], abs=1e-9)
        assert np.ptp(recorded) > 0.001  # it has moved
        assert (np.flatnonzero(np.diff(recorded)) % every == 0).all()


@pytest.mark.full
def test_each_converter_takes_a_command_over_after_the_delay() -> None:
    """Its reference moves as the command has moved since the start; the others are its own."""
    park = {"period_s": 0.02, "delay_s": 0.05, "P_ref": 0.4, "K_i": 0.0, "T_p": 0.0}
    done = run(network(park))
    sent = column(done, "park.P_set")
    for name, begin in (("A", 0.3), ("B", 0.2)):
        ref = column(done, f"{name}.ref_P_ref")
        assert (ref[:500] == begin).all()
        assert ref[500:] == pytest.approx(begin + sent[1:-499] - 0.25, abs=1e-12)
        assert np.ptp(column(done, f"{name}.ref_V_ref")) == 0
    assert sent[-1] > 0.3


@pytest.mark.full
def test_an_integral_alone_takes_the_same_part_of_the_error_in_each_cycle() -> None:
    """e[k + 1] = (1 - g K_ig T) e[k], with the gain g from P_set to P that the run shows at rest;
    the law settles within a cycle."""
    park = {"period_s": 4.0, "delay_s": 0.1, "P_ref": 0.45, "K_ig": 0.1, "K_i": 0.0, "T_p": 0.0}
    done = run(network(park, duration=24.0))
    P, sent = column(done, "park.P") / 2, column(done, "park.P_set")
    e, g = 0.45 - P[::40_000], (P[-1] - P[0]) / (sent[-2] - sent[0])
    assert e[2:] / e[1:-1] == pytest.approx(1 - 0.4 * g, abs=2e-3)
    assert abs(g - 1) < 0.05


@pytest.mark.full
@pytest.mark.parametrize(
    ("park", "grid", "left"),
    [
        # droop by frequency, beyond its band: P = P_ref + D (omega_ref - omega -+ fdbd)
        ({"D_up": 20.0, "P_ref": 0.25, "P_min": -1.0}, {"omega_g": 0.995},
         lambda x: x["P"] / 2 - 0.25 - 20 * (0.005 - 0.0006)),
        ({"D_dn": 20.0, "P_ref": 0.35}, {"omega_g": 1.005},
         lambda x: x["P"] / 2 - 0.35 + 20 * (0.005 - 0.0006)),
        ({"V_ref": 1.01}, {}, lambda x: x["V"] - 1.01),
        # droop by the reactive power
        ({"V_ref": 1.02, "K_c": 0.2}, {}, lambda x: x["V"] + 0.2 * x["Q"] / 2 - 1.02),
        ({"control": "Q", "Q_ref": 0.1}, {}, lambda x: x["Q"] / 2 - 0.1),
        # the other end of the line is the point of connection
        ({"control": "Q", "Q_ref": 0.05, "node": "far", "plant_end": "bus"}, {},
         lambda x: x["Q"] / 2 - 0.05),
        ({"control": "Q", "Q_ref": 0.05, "law": "vsg-2", "sends": "Q_ref", "K_i": 5.0}, {},
         lambda x: x["Q"] / 2 - 0.05),
    ],
)  # fmt: skip
def test_it_holds_what_its_droops_say_at_rest(park: Any, grid: Any, left: Any) -> None:
    quick = {"period_s": 0.05, "delay_s": 0.02, "K_ig": 2.0, "K_i": 2.0}
    own = {"law": park.get("law", "droop-3"), "duration": 12.0, "plant": {"grid": grid}}
    done = run(network({x: v for x, v in (quick | park).items() if x != "law"}, **own))
    end = {x: column(done, f"park.{x}")[-1] for x in ("P", "Q", "V", "omega")}
    assert abs(left(end)) < 2e-4
    assert end["omega"] == pytest.approx(grid.get("omega_g", 1.0), abs=1e-6)


@pytest.mark.full
def test_an_event_gives_it_references_and_cuts_its_link() -> None:
    """What is under way still arrives; the converters then keep their set-points."""
    events = [
        {"type": "plant-reference", "t": 0.2, "name": "park", "P_ref": 0.4},
        {"type": "plant-reference", "t": 0.4, "name": "park", "sends": False},
        {"type": "plant-reference", "t": 0.8, "name": "park", "sends": True},
    ]
    done = run(network({"period_s": 0.02, "delay_s": 0.1}, events=events))
    ref, sent = column(done, "A.ref_P_ref"), column(done, "park.P_set")
    assert np.ptp(ref[:3000]) < 1e-4  # it held the power of the start
    assert ref[4900] > ref[4500] > ref[3000] > 0.3
    assert np.ptp(ref[5000:9000]) == 0
    assert np.ptp(sent[5000:8000]) > 0.01
    assert ref[9001] == pytest.approx(0.3 + sent[8001] - 0.25, abs=1e-12)


def wind_park(park: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Converter A at the point of connection of two neighbours that follow the grid."""
    content = network(None, **more)
    lines = {w: {"start": f"at_{w}", "end": "hub", "L": 0.02, "R": 0.002} for w in ("w1", "w2")}
    lines |= {"to_hub": {"start": "hub", "end": "bus", "L": 0.02, "R": 0.002}}
    content["network"] |= {
        "converters": {"A": {"node": "bus"}},
        "grid_following": {
            "w1": {"node": "at_w1", "S": 2.0, "P": 0.4, "T_i": 0.01},
            "w2": {"node": "at_w2", "S": 1.0, "P": 0.6, "Q": 0.1, "T_i": 0.01},
        },
        "capacitors": {f"c{w}": {"node": f"at_{w}", "Q": 0.05} for w in ("w1", "w2")},
        "lines": content["network"]["lines"] | {f"l_{w}": x for w, x in lines.items()},
        "plant_controllers": {"park": {
            "line": "l_to_hub", "node": "bus", "plant_end": "hub", "converters": ["w1", "w2"],
            "control": "Q", "sends": "Q_ref",
        } | park},
        "record": ["w1", "w2"],
    }  # fmt: skip
    return content


@pytest.mark.full
def test_neighbours_that_follow_the_grid_take_its_set_points() -> None:
    """After the delay, in p.u. of their own; the circuit may change meanwhile."""
    park = {"period_s": 0.05, "delay_s": 0.03, "P_ref": 0.6, "Q_ref": 0.1, "K_i": 2.0, "K_ig": 2.0}
    bump = {"type": "breaker", "t": 4.0, "name": "bump", "closed": True}
    content = wind_park(park, duration=8.0, events=[bump])
    load = {"node": "hub", "P": 0.2, "closed": False}
    content["network"]["loads"] = {"bump": load}
    done = run(content)
    begin, S = {"w1": (0.4, 0.0), "w2": (0.6, 0.1)}, {"w1": 2.0, "w2": 1.0}
    sent = np.stack([column(done, f"park.{x}_set") for x in "PQ"])
    mean = sum(S[w] * np.array(begin[w]) for w in S) / 3
    for w in S:
        own = np.stack([column(done, f"{w}.{x}") for x in "PQ"]) / S[w]
        assert np.ptp(own[:, :300], axis=1).max() < 1e-6
        assert abs(own[0, 310] - begin[w][0]) > 1e-3
        assert own[:, -1] - begin[w] == pytest.approx(sent[:, -1] - mean, abs=1e-6)
    for x, ref in (("P", 0.6), ("Q", 0.1)):
        assert column(done, f"park.{x}")[[39_999, -1]] / 3 == pytest.approx(ref, abs=1e-4)


def test_the_frames_of_converters_that_it_does_not_command_are_those_without_it() -> None:
    assert load_scenario(wind_park({}, link={"type": "can"})).frame_signals == 0
    assert load_scenario(wind_park({"converters": ["w1", "A"]})).frame_signals == 4


@pytest.mark.full
@pytest.mark.parametrize(
    "more", [{"inner": "cascaded"}, {"counts": "rig"}, {"law": "grid-following"}], ids=str
)
def test_set_points_follow_the_signals_of_stages_and_of_counts(more: dict[str, Any]) -> None:
    """The references of those runs move as they do without."""
    park = {"period_s": 0.02, "delay_s": 0.05, "P_ref": 0.4, "K_i": 0.0}
    done = run(network(park, duration=0.3, **more))
    sent, ref = column(done, "park.P_set"), column(done, "A.ref_P_ref")
    assert ref[500:] == pytest.approx(0.3 + sent[1:-499] - 0.25, abs=1e-12)
    assert ref[-1] > 0.31


@pytest.mark.processes
def test_over_two_links_every_bit_is_that_in_process(tmp_path: Path) -> None:
    content = network({**ALL, "control": "V"}, duration=0.3)
    alone = gfmhil.run_network(load_scenario(content), folder=tmp_path / "alone")
    other = copy.deepcopy(content) | {"link": {"type": "shm"}}
    other["network"]["converters"]["A"]["link"] = {"type": "zmq"}
    apart = gfmhil.run_network(load_scenario(other), folder=tmp_path / "apart")
    assert alone.status == "completed"
    assert [apart[name].summary["link"] for name in "AB"] == ["zmq", "shm"]
    for name in "AB":
        a, b = (np.load(tmp_path / x / name / "signals.npz") for x in ("alone", "apart"))
        assert a.files == b.files
        assert all(a[x].tobytes() == b[x].tobytes() for x in a.files)


@pytest.mark.parametrize(
    ("park", "more", "named"),
    [
        ({"line": "cable"}, {}, "plant_controllers.park.line = 'cable': must be one of ['feeder']"),
        ({"node": "hub"}, {}, "plant_controllers.park.node = 'hub': must be an end of feeder"),
        ({"plant_end": "hub"}, {}, "plant_controllers.park.plant_end = 'hub'"),
        ({"converters": ["C"]}, {}, "plant_controllers.park.converters: 'C' must be one of"),
        ({"converters": ["A", "A"]}, {}, "park.converters: 'A' is there twice"),
        ({"Q_ref": 0.1}, {}, "Q_ref: has no effect with control = 'V'"),
        ({"converters": ["A", "w"]}, {"network": {"grid_following": {"w": {
            "node": "bus", "S": 1.0, "P": 0.1}}, "capacitors": {"c": {"node": "bus", "Q": 0.1}}}},
         'park.sends = "V_ref": w follows the grid and takes "Q_ref" only'),
        ({"period_s": 0.00015}, {}, "park.period_s = 0.00015: must be a multiple of T_s"),
        ({"delay_s": 9.0}, {}, "park.delay_s = 9: at most 63 cycles"),
        ({"P_ref": 2.5}, {}, "P_ref = 2.5: must lie in [-2, 2]"),
        ({"P_max": 3.0}, {}, "P_min = 0, P_max = 3: must rise within [-2, 2]"),
        ({"K_i": 0.0, "K_ig": 0.0}, {}, "K_p, K_i, K_pg and K_ig are 0: it would send nothing"),
        ({"T_ft": 0.1}, {}, "T_fv = 0: must be above 0 with T_ft = 0.1"),
        ({"sends": "Q_ref"}, {}, "park: sends Q_ref, which none of its laws takes: droop-3"),
        ({"sends": "V_ref"}, {"law": "grid-following"}, "park: sends V_ref, which none of its"),
        ({}, {"link": {"type": "can"}}, "carries no set-points"),
        ({}, {"cores": 1}, "cores = 1: cannot go with network.plant_controllers"),
        ({}, {"events": [{"type": "reference", "t": 0.1, "P_ref": 0.5}]},
         "P_ref: network.plant_controllers.park commands it"),
        ({}, {"events": [{"type": "plant-reference", "t": 0.1, "name": "x", "P_ref": 0.5}]},
         "events.0: name = 'x': must be a plant controller of the network, ['park']"),
        ({"control": "Q"}, {"events": [{"type": "plant-reference", "t": 0.1, "name": "park",
                                        "V_ref": 1.0}]},
         "V_ref: has no effect, park has control = 'Q'"),
        ({}, {"events": [{"type": "plant-reference", "t": 0.1, "name": "park"}]},
         "nothing changes: give one of"),
        ({}, {"events": [{"type": "plant-reference", "t": 0.1, "name": "park", "P_ref": 5.0}]},
         "P_ref = 5.0: must lie in [-2, 2]"),
    ],
)  # fmt: skip
def test_what_it_cannot_do_is_refused(park: Any, more: dict[str, Any], named: str) -> None:
    content = network(park) | {key: value for key, value in more.items() if key != "network"}
    content["network"] |= more.get("network", {})
    with pytest.raises(UserError) as problem:
        load_scenario(content)
    assert named in str(problem.value)


def test_its_name_is_no_other_part_s() -> None:
    content = network()
    content["network"]["plant_controllers"] = {"feeder": PARK}
    with pytest.raises(UserError, match="feeder is the name of two parts"):
        load_scenario(content)


@pytest.mark.full
def test_a_start_beyond_its_limits_is_refused() -> None:
    with pytest.raises(UserError, match=r"P_ref of its converters, 0.25 at the start, must lie"):
        run(network({"P_max": 0.2}))
