"""Frames: each arrives unchanged or not at all, every fault counts under its name; their CRC."""

import os
import subprocess
import sys
import zlib
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gfm_hil.links.crc import crc32, crc32_by_tables
from gfm_hil.links.frame import FAULTS, FrameError, FrameReader, FrameWriter, frame_dtype
from gfm_runtime.signals import TABLE_VERSION, names, table_hash
from gfm_runtime.states import REASONS, STOPPED

from ...support.frames import resealed

GROUPS = ("y", "u")
WIDTH = {group: len(names(group)) for group in GROUPS}

numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)


def frame(group: str = "y", sequence: int = 0, tick: int = 0) -> bytes:
    """A good frame of that sequence number."""
    writer = FrameWriter(group)
    writer.sequence[0] = sequence
    return writer.pack(tick, 2, 0, np.arange(1.0, WIDTH[group] + 1))


def refused(reader: FrameReader, message: bytes) -> str:
    """The fault of a refused frame; checks that the last values are unchanged."""
    values = np.full(WIDTH[reader.group], 7.0)
    before = reader.tick, reader.state, reader.reason
    with pytest.raises(FrameError) as found:
        reader.unpack(message, values)
    assert (values == 7.0).all()
    assert before == (reader.tick, reader.state, reader.reason)
    assert reader.faults[found.value.fault] == 1
    assert sum(reader.faults.values()) == 1
    return found.value.fault


@given(st.data(), st.sampled_from(GROUPS), st.integers(0, 2**63 - 1), st.integers(0, STOPPED),
       st.integers(0, len(REASONS) - 1))  # fmt: skip
def test_what_is_packed_is_unpacked_bit_for_bit(data, group, tick, state, reason):
    sent = np.array(data.draw(st.lists(numbers, min_size=WIDTH[group], max_size=WIDTH[group])))
    message = FrameWriter(group).pack(tick, state, reason, sent)
    reader, got = FrameReader(group), np.zeros(WIDTH[group])
    assert reader.unpack(message, got) == tick
    assert got.tobytes() == sent.tobytes()
    assert (reader.tick, reader.state, reader.reason) == (tick, state, reason)
    assert not any(reader.faults.values())


@pytest.mark.parametrize("group", GROUPS)
def test_every_single_flipped_bit_is_refused(group):
    good = frame(group)
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        assert refused(FrameReader(group), bytes(bad)) == "crc"


@given(st.binary(max_size=120))
def test_any_other_bytes_are_refused(message):
    assert refused(FrameReader("y"), message) in ("size", "crc")


def test_each_check_of_the_header_has_its_fault():
    good = frame("y")
    assert refused(FrameReader("y"), good[:-1]) == "size"
    assert refused(FrameReader("y"), good + b"\0") == "size"
    assert refused(FrameReader("y"), resealed(good, 0, 0)) == "magic"
    assert refused(FrameReader("y"), resealed(good, 2, TABLE_VERSION + 1)) == "version"
    assert refused(FrameReader("y"), resealed(good, 3, 2)) == "source"


def test_a_frame_that_comes_twice_is_used_once():
    reader, values = FrameReader("y"), np.zeros(5)
    reader.unpack(frame(sequence=0), values)
    with pytest.raises(FrameError, match="repeated"):
        reader.unpack(frame(sequence=0), values)
    assert reader.faults["repeated"] == 1


def test_an_older_frame_is_refused_and_counted():
    reader, values = FrameReader("y"), np.zeros(5)
    for sequence in (0, 1, 2):
        reader.unpack(frame(sequence=sequence), values)
    with pytest.raises(FrameError, match="out_of_sequence"):
        reader.unpack(frame(sequence=1), values)
    reader.unpack(frame(sequence=3), values)  # the sequence continues
    assert reader.faults == {**dict.fromkeys(FAULTS, 0), "out_of_sequence": 1}


def test_a_gap_is_counted_as_lost_frames_and_the_frame_is_used():
    reader, values = FrameReader("y"), np.zeros(5)
    reader.unpack(frame(sequence=0), values)
    assert reader.unpack(frame(sequence=5, tick=5), values) == 5
    assert values[0] == 1.0
    assert reader.faults == {**dict.fromkeys(FAULTS, 0), "lost": 4}


def test_the_sequence_wraps_without_a_fault():
    writer, reader, values = FrameWriter("u"), FrameReader("u"), np.zeros(3)
    writer.sequence[0] = reader.record["next"][0] = 2**32 - 2
    for tick in range(4):
        assert reader.unpack(writer.pack(tick, 2, 0, np.ones(3)), values) == tick
    assert not any(reader.faults.values())
    with pytest.raises(FrameError, match="out_of_sequence"):  # from before the wrap
        reader.unpack(frame("u", sequence=2**32 - 1), values)


@given(st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1))
def test_newer_and_older_are_told_apart_anywhere_on_the_ring(last, ahead):
    reader, values = FrameReader("y"), np.zeros(5)
    reader.record["next"] = (last + 1) % 2**32
    message = frame(sequence=(last + 1 + ahead) % 2**32)
    if ahead >= 0:
        reader.unpack(message, values)
        assert reader.faults["lost"] == ahead
    else:
        with pytest.raises(FrameError, match="repeated" if ahead == -1 else "out_of_sequence"):
            reader.unpack(message, values)


@pytest.mark.parametrize("group", GROUPS)
def test_the_record_type_for_tools_decodes_a_frame(group):
    message = frame(group, sequence=9, tick=2**40)
    kind = frame_dtype(group)
    assert kind.itemsize == len(message)
    record = np.frombuffer(message, kind)[0]
    assert (record["tick"], record["sequence"], record["state"]) == (2**40, 9, 2)
    assert record["crc"] == zlib.crc32(message[:-4])
    assert [record[name] for name in names(group)] == list(range(1, WIDTH[group] + 1))


CHECKED = [bytes(range(44)), bytes(range(60)), b"\xff" * 44, b"\x00" * 60]


@pytest.mark.parametrize("crc", [crc32, crc32_by_tables])
@given(message=st.binary(min_size=1, max_size=300), after=st.binary(max_size=20))
@example(message=CHECKED[0], after=b"")
@example(message=CHECKED[1], after=b"\x01")
@example(message=CHECKED[2], after=b"")
@example(message=CHECKED[3], after=b"")
def test_the_crc_is_that_of_zlib(crc, message, after):
    room = np.frombuffer(message + after, np.uint8)
    assert crc(room, len(message)) == zlib.crc32(message)


@pytest.mark.parametrize("crc", [crc32, crc32_by_tables])
def test_the_crc_of_every_length_and_the_published_check(crc):
    noise = np.random.default_rng(1).integers(0, 256, 600, np.uint8)
    for count in range(600):
        assert crc(noise, count) == zlib.crc32(noise[:count].tobytes())
    assert crc(np.frombuffer(b"123456789", np.uint8), 9) == 0xCBF43926  # of CRC-32/ISO-HDLC


def test_the_header_for_c_is_of_this_signal_table():
    header = files("gfm_hil.controllers").joinpath("gfmhil_frames.h").read_text("utf-8")
    assert f"GFMHIL_TABLE_VERSION = {TABLE_VERSION}," in header
    assert f'#define GFMHIL_TABLE "\\"{table_hash()}\\""' in header


def test_the_crc_is_that_of_the_processor_that_numba_compiles_for():
    code = "from gfm_hil.links import crc; print(crc.crc32 is crc.crc32_by_tables)"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "NUMBA_CPU_NAME": "generic"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "True\n"
