"""Endpoints and headers of shared-memory links."""

import secrets
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from gfm_hil.core.temporary import private_folder
from gfm_hil.links.shm import segment


def segment_of(endpoint: str) -> Path:
    return private_folder() / (segment.PREFIX + endpoint.removeprefix("shm://"))


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A new endpoint; checks at the end that nothing of it is left."""
    endpoint = f"shm://test-{secrets.token_hex(8)}"
    yield endpoint
    left = segment_of(endpoint).exists()
    segment_of(endpoint).unlink(missing_ok=True)
    assert not left


def header(version: int, owner: segment.Identity) -> bytes:
    return struct.pack("<8sq3q", segment.MAGIC, version, *owner).ljust(segment.SIZE, b"\0")
