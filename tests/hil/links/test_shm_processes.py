"""The shared-memory link between processes: no torn message, and the rests of killed processes."""

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.links.shm.link import ShmLink

from ...support.processes import kill
from ...support.shm import endpoint, segment_of

pytestmark = pytest.mark.processes

__all__ = ["endpoint"]

Peer = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def peer(endpoint: str, spawn: Peer) -> Peer:
    """Start a side as a process and wait until it has opened its end."""

    def call(role: str, what: str = "hold", n: int = 0) -> subprocess.Popen[str]:
        script = Path(__file__).parents[2] / "support" / "shm_peer.py"
        process = spawn(str(script), role, endpoint, what, str(n))
        assert process.stdout.readline() == "ready\n"
        return process

    return call


def test_nothing_is_torn_lost_or_doubled_in_a_million_messages_each_way(peer):
    controller, plant = (peer(role, "flood", 1_000_000) for role in ("controller", "plant"))
    for process in (controller, plant):
        assert process.communicate(timeout=110)[0] == "1000000 0\n"


def test_a_name_is_had_by_one_controller_and_one_plant(peer, endpoint):
    controller = peer("controller")
    with pytest.raises(UserError) as found:
        ShmLink("controller", endpoint)
    assert str(found.value) == (
        f"link.endpoint = {endpoint!r}: cannot be created: "
        f"occupied by another run (process {controller.pid})"
    )
    plant = peer("plant")
    with pytest.raises(UserError, match=rf"another plant has joined it \(process {plant.pid}\)"):
        ShmLink("plant", endpoint)
    kill(controller)
    ShmLink("controller", endpoint).close()


def test_a_killed_controller_is_not_joined_and_its_name_is_free(peer, endpoint, opened):
    kill(peer("controller"))
    assert segment_of(endpoint).exists()
    plant = opened(ShmLink("plant", endpoint))
    assert not plant.send(b"to the dead")
    controller = opened(ShmLink("controller", endpoint))
    assert plant.send(b"to the living")
    assert controller.receive() == b"to the living"


def test_what_a_killed_controller_left_is_removed_by_its_plant(peer, endpoint):
    controller = peer("controller")
    plant = ShmLink("plant", endpoint)
    kill(controller)
    plant.close()
    assert not segment_of(endpoint).exists()


def test_a_killed_plant_leaves_its_place_to_the_next(peer, endpoint, opened):
    controller = ShmLink("controller", endpoint)
    kill(peer("plant"))
    plant = opened(ShmLink("plant", endpoint))
    assert controller.send(b"hello")
    assert plant.receive() == b"hello"
    controller.close()
    assert not segment_of(endpoint).exists()


def test_what_killed_runs_left_is_swept_by_a_run_of_another_name(peer, endpoint, opened):
    controller, plant = peer("controller"), peer("plant")
    kill(controller)
    kill(plant)
    opened(ShmLink("controller", endpoint + "-other"))
    assert not segment_of(endpoint).exists()


def test_a_living_run_is_not_swept(peer, endpoint):
    controller = peer("controller")
    ShmLink("controller", endpoint + "-other").close()
    assert segment_of(endpoint).exists()
    kill(controller)
    ShmLink("controller", endpoint).close()
