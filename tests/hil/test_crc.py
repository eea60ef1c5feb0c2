"""The frames' CRC-32, by tables and by this processor's instructions, against zlib's."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gfm_hil.links.crc import crc32, crc32_by_tables

FRAMES = [bytes(range(44)), bytes(range(60)), b"\xff" * 44, b"\x00" * 60]


@pytest.mark.parametrize("crc", [crc32, crc32_by_tables])
@given(message=st.binary(min_size=1, max_size=300), after=st.binary(max_size=20))
@example(message=FRAMES[0], after=b"")
@example(message=FRAMES[1], after=b"\x01")
@example(message=FRAMES[2], after=b"")
@example(message=FRAMES[3], after=b"")
def test_it_is_that_of_zlib(crc, message: bytes, after: bytes) -> None:
    room = np.frombuffer(message + after, np.uint8)
    assert crc(room, len(message)) == zlib.crc32(message)


@pytest.mark.parametrize("crc", [crc32, crc32_by_tables])
def test_every_length_and_the_published_check(crc) -> None:
    noise = np.random.default_rng(1).integers(0, 256, 600, np.uint8)
    for count in range(600):
        assert crc(noise, count) == zlib.crc32(noise[:count].tobytes())
    assert crc(np.frombuffer(b"123456789", np.uint8), 9) == 0xCBF43926  # of CRC-32/ISO-HDLC
