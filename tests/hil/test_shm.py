"""The shared-memory link in this process: the same runs, its ring, whom it refuses."""

from __future__ import annotations

import secrets
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.errors import UserError
from gfm_hil.links import open_link
from gfm_hil.links.shm import ring, segment
from gfm_hil.links.shm.link import ShmLink
from gfm_runtime import law_names

from .conftest import home_plant
from .test_links import PATIENT, RIG, assert_same, both_sides

Pair = tuple[ShmLink, ShmLink]


def segment_of(endpoint: str) -> Path:
    return segment.FOLDER / (segment.PREFIX + endpoint.removeprefix("shm://"))


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A fresh endpoint of which nothing may be left."""
    endpoint = f"shm://test-{secrets.token_hex(8)}"
    yield endpoint
    left = segment_of(endpoint).exists()
    segment_of(endpoint).unlink(missing_ok=True)
    assert not left


@pytest.fixture
def pair(endpoint: str) -> Iterator[Pair]:
    controller, plant = ShmLink("controller", endpoint), ShmLink("plant", endpoint)
    yield controller, plant
    plant.close()
    controller.close()


@pytest.mark.parametrize("law", law_names()[::6])
def test_lockstep_over_shared_memory_is_bit_for_bit_in_process(law, make, run, tmp_path, endpoint):
    content = {
        "law": law,
        "duration": 0.03,
        "seed": 7,
        "link": PATIENT,
        "plant": {**RIG, **home_plant(law)},
        "events": [
            {"tick": 50, "type": "reference", "P_ref": 0.55},
            {"tick": 150, "type": "grid-frequency", "f_hz": 49.99},
        ],
    }
    apart = both_sides(make(**content), tmp_path, endpoint, name="shm")
    together = run(**content)
    assert np.ptp(apart["true_p"]) > 0
    assert_same(apart, together.signals)


@pytest.mark.parametrize("back", [False, True])
def test_messages_arrive_whole_and_in_order_round_the_ring(back, pair):
    sender, receiver = reversed(pair) if back else pair
    for k in range(5 * ring.SLOTS):
        message = struct.pack("<q", k) * (1 + k % 63)
        assert sender.send(message)
        assert receiver.receive() == message
    assert receiver.receive() is None


@pytest.mark.parametrize("back", [False, True])
def test_a_full_ring_drops_what_comes_and_keeps_what_it_has(back, pair):
    sender, receiver = reversed(pair) if back else pair
    for lap in range(3):
        sent = [sender.send(b"%d.%d" % (lap, k)) for k in range(ring.SLOTS + 9)]
        assert sent == [True] * ring.SLOTS + [False] * 9
        heard = [receiver.receive() for _ in range(ring.SLOTS + 1)]
        assert heard == [b"%d.%d" % (lap, k) for k in range(ring.SLOTS)] + [None]


@given(st.lists(st.binary(min_size=1, max_size=ring.LONGEST), max_size=ring.SLOTS))
def test_any_messages_of_any_size(messages):
    endpoint = f"shm://test-{secrets.token_hex(8)}"
    controller, plant = ShmLink("controller", endpoint), ShmLink("plant", endpoint)
    try:
        assert all(controller.send(message) for message in messages)
        assert [plant.receive() for _ in messages] == messages
        assert plant.receive() is None
    finally:
        plant.close()
        controller.close()


@pytest.mark.parametrize("size", [0, ring.LONGEST + 1, 100_000])
def test_a_message_that_does_not_fit_is_dropped(size, pair):
    sender, receiver = pair
    assert not sender.send(bytes(size))
    assert sender.send(b"next")
    assert receiver.receive() == b"next"
