"""The start of a run: what both sides agree on, and the refusal of each mismatch."""

import json
import re
import time
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine import handshake
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.links.can.link import CanLink
from gfm_hil.links.frame import FrameWriter
from gfm_hil.links.shm.link import ShmLink
from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.run.summary import clock_drift
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import NU, NY

from ...support.links import PATIENT, in_threads, run_pair

pytestmark = pytest.mark.processes


def meet(scenarios: dict[Role, Scenario], endpoint: str) -> dict[Role, Any]:
    """Shake hands, each side with its scenario."""

    def call(role: Role) -> Any:
        link = ZmqLink(role, endpoint)
        try:
            return shake_hands(role, link, scenarios[role], lambda: False, lambda text: None)
        finally:
            link.close()

    return in_threads(call)


def test_both_roles_agree_on_the_start(make, endpoint):
    scenario = make(link=PATIENT)
    found = meet(dict.fromkeys(ROLES, scenario), endpoint)
    assert found["controller"] == found["plant"]
    assert found["plant"].t0_ns > 0 and found["plant"].one_clock
    assert found["plant"].controller == "gfmhil" and len(found["plant"].run) == 16


def test_another_clock_is_not_read_as_ours(make, endpoint, monkeypatch):
    """The plant booted at another time: START's arrival sets tick 0, and the drift is measured."""
    boots = iter(["one", "another"])
    monkeypatch.setattr("gfm_hil.engine.handshake._boot", lambda: next(boots))
    before = time.monotonic_ns()
    found = meet(dict.fromkeys(ROLES, make(link=PATIENT)), endpoint)
    assert not found["plant"].one_clock and not found["controller"].one_clock
    assert before < found["controller"].t0_ns < time.monotonic_ns() + 20_000_000


def test_the_drift_of_two_clocks_is_read_off_the_earliest_arrivals():
    """A plant clock 37 ppm fast; frames take 0 to 400 us."""
    k = np.arange(20_000)
    way = np.random.default_rng(1).exponential(4e4, len(k)).astype(np.int64)
    received = 5_000_000 + np.round(k * 1e5 / (1 + 37e-6)).astype(np.int64) + way
    assert clock_drift({"controller_received": received}, 1e-4) == pytest.approx(37, abs=0.1)
    assert clock_drift({"controller_received": received[:10]}, 1e-4) is None
    assert clock_drift({}, 1e-4) is None


@pytest.mark.parametrize(
    ("other", "name"),
    [
        ({"seed": 3}, "scenario"),
        ({"plant": {"grid": {"V_g": 0.99}}}, "scenario"),
        ({"late_policy": {"hold": 3}}, "scenario"),
        ({"law": "vsg-2"}, "law or law file"),
        ({"events": [{"tick": 5, "type": "law", "law": "vsg-2"}]}, "law or law file"),
        ({"T_s": 5e-5}, "sampling time T_s (5e-05, ours is 0.0001)"),
    ],
)
def test_a_misfit_is_refused_on_both_roles_and_named(other, name, make, endpoint):
    found = meet({"controller": make(link=PATIENT), "plant": make(link=PATIENT, **other)}, endpoint)
    assert isinstance(found["controller"], PeerLost)
    assert isinstance(found["plant"], PeerLost)
    assert f"the plant runs another {name}" in str(found["controller"])
    assert f"the controller runs another {name.partition(' (')[0]}" in str(found["plant"])


@pytest.mark.parametrize(
    ("what", "name"),
    [
        ("TABLE_VERSION", "version of the signal table (1, ours is 4)"),
        ("table_hash", "signal table"),
    ],
)
def test_a_misfit_of_signal_tables_is_named(what, name, make, endpoint, monkeypatch, opened):
    given = iter("ab")
    new = 1 if what == "TABLE_VERSION" else lambda: next(given)
    link, scenario = opened(ZmqLink("plant", endpoint)), make(link=PATIENT)
    monkeypatch.setattr(handshake, what, new)
    hello = {"kind": "hello", "role": "plant", "boot": "", **handshake._what_runs(scenario)}
    monkeypatch.undo()
    controller = opened(ZmqLink("controller", endpoint))
    link.send(b"GFMHIL " + json.dumps(hello).encode())
    with pytest.raises(PeerLost, match=re.escape(f"the plant runs another {name}")):
        shake_hands("controller", controller, scenario, lambda: False, print)
    assert len(json.dumps({**hello, "boot": "x" * 36})) < 300


def test_a_plant_that_says_hello_and_no_more_is_not_waited_for(make, endpoint, opened):
    """From the first HELLO on, silence means that the peer is lost."""
    link, controller = opened(ZmqLink("plant", endpoint)), opened(ZmqLink("controller", endpoint))
    scenario = make(link={**PATIENT, "peer_timeout_s": 0.3})
    hello = {"kind": "hello", "role": "plant", "boot": "", **handshake._what_runs(scenario)}
    link.send(b"GFMHIL " + json.dumps(hello).encode())
    with pytest.raises(PeerLost, match="the plant came but did not start"):
        shake_hands("controller", controller, scenario, lambda: False, print)


def test_a_frame_says_that_the_plant_has_started(make, endpoint, opened):
    """A frame also tells when, if START was lost; other messages do not."""
    link, controller = opened(ZmqLink("plant", endpoint)), opened(ZmqLink("controller", endpoint))
    of_run = {**PATIENT, "type": "zmq"}
    scenario, frames = make(link=of_run, mode="realtime"), FrameWriter("y")
    hello = {"kind": "hello", "role": "plant", "boot": "", **handshake._what_runs(scenario)}
    k, T_ns, y = 7, 100_000, np.ones(NY)
    spoilt = bytearray(frames.pack(k, 0, 0, y))
    spoilt[30] ^= 1
    messages = [frames.pack(k, 0, 0, y), b"GFMHIL " + json.dumps(hello).encode(), bytes(spoilt)]
    for message in [*messages, FrameWriter("u").pack(k, 0, 0, np.ones(NU))]:
        link.send(message)
    before = time.monotonic_ns()
    link.send(frames.pack(k, 0, 0, y))
    found = shake_hands("controller", controller, scenario, lambda: False, print)
    assert before - k * T_ns <= found.t0_ns <= time.monotonic_ns() - k * T_ns


@pytest.mark.parametrize(
    ("kind", "end", "options"),
    [
        ("shm", ShmLink, {}),
        ("zmq", ZmqLink, {}),
        ("zmq", ZmqLink, {"portable": True}),
        ("can", CanLink, {}),
    ],
)
def test_a_run_does_without_START(kind, end, options, make, tmp_path, monkeypatch):
    """In lockstep it loses nothing."""
    send = end.send
    dropped: list[bytes] = []

    def drop(self: Any, message: bytes) -> bool:
        if b'"start"' not in message:
            return send(self, message)
        dropped.append(message)
        return True

    content = {"law": "vsg-2", "duration": 0.02, "link": PATIENT}
    as_it_is = run_pair(make(**content), tmp_path / "with", kind, options)
    monkeypatch.setattr(end, "send", drop)
    found = run_pair(make(**content), tmp_path / "without", kind, options)
    assert len(dropped) == 1
    assert {end[0] for end in found.ends().values()} == {"completed"}
    for name, column in as_it_is.signals.items():
        assert found.signals[name].tobytes() == column.tobytes(), name


@pytest.mark.parametrize("role", ROLES)
def test_nobody_comes(role, make, endpoint, opened):
    said: list[str] = []
    link = opened(ZmqLink(role, endpoint))
    scenario = make(link={**PATIENT, "start_timeout_s": 0.8, "endpoint": endpoint})
    other = {"controller": "plant", "plant": "controller"}[role]
    with pytest.raises(PeerLost, match=f"the {other} did not come within 0.8 s"):
        shake_hands(role, link, scenario, lambda: False, said.append)
    assert said == [f"waiting for the {other} at {endpoint} …"]


def test_an_interrupt_ends_the_waiting(make, endpoint, opened):
    link = opened(ZmqLink("plant", endpoint))
    with pytest.raises(PeerLost, match="interrupted while waiting for the controller"):
        shake_hands("plant", link, make(link=PATIENT), lambda: True, print)
