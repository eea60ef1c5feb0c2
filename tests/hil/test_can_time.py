"""Frame times: the longest of all frames, found by brute force; and what fits a period."""

from __future__ import annotations

import itertools

import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.links.can import KIND, CanOptions
from gfm_hil.links.can.bus_time import classic_time, fd_time


def bits_of(value: int, width: int) -> list[int]:
    return [value >> k & 1 for k in range(width - 1, -1, -1)]


def stuffed(bits: list[int]) -> tuple[list[int], list[int]]:
    """The bits on the wire; for each, its index or, for a stuff bit, that of the bit before."""
    out, of, run = [], [], 0
    for k, bit in enumerate(bits):
        run = run + 1 if out and out[-1] == bit else 1
        out.append(bit)
        of.append(k)
        if run == 5:
            out.append(1 - bit)
            of.append(k + 1)
            run = 1
    return out, of


def crc_15(bits: list[int]) -> int:
    """CRC by long division, as in the standard's text."""
    crc = 0
    for bit in bits:
        top = bit ^ (crc >> 14)
        crc = crc << 1 & 0x7FFF
        if top:
            crc ^= 0x4599
    return crc


def classic_bits(number: int, payload: bytes) -> int:
    """Bits of one classic frame, to the end of the interframe space."""
    data = [b for byte in payload for b in bits_of(byte, 8)]
    bits = [0, *bits_of(number, 11), 0, 0, 0, *bits_of(len(payload), 4), *data]
    bits += bits_of(crc_15(bits), 15)
    return len(stuffed(bits)[0]) + 1 + 2 + 7 + 3


def fd_bits(number: int, payload: bytes) -> tuple[int, int]:
    """Slow and fast bits of one CAN FD frame of up to 8 bytes."""
    data = [b for byte in payload for b in bits_of(byte, 8)]
    head = [0, *bits_of(number, 11), 0, 0, 1, 0, 1]
    bits = [*head, 0, *bits_of(len(payload), 4), *data]
    _, of = stuffed(bits)
    of = [k for k in of if k < len(bits)]  # a fixed stuff bit replaces another
    slow = sum(k < len(head) for k in of)
    count_and_crc = 4 + 17
    fixed = len(range(0, count_and_crc + 1, 4))  # before its bits 0, 4, 8 … 20
    return slow + 2 + 7 + 3, len(of) - slow + count_and_crc + fixed + 1


NUMBERS = [0, 0x7FF, 0x100, 0x120, 0x0F0, 0x078, 0x555, 0x41F, 0x3C3]


@pytest.mark.parametrize("size", [0, 1])
@pytest.mark.parametrize("number", NUMBERS)
def test_classic_frames_of_every_payload(number, size):
    payloads = map(bytes, itertools.product(range(256), repeat=size))
    worst = max(classic_bits(number, payload) for payload in payloads)
    assert classic_time(size, 1.0, number) == worst


def test_classic_frames_of_every_identifier():
    worst = max(classic_bits(number, b"") for number in range(2048))
    assert classic_time(0, 1.0) == worst


def test_a_classic_frame_of_two_bytes():
    worst = max(classic_bits(0x078, bytes(p)) for p in itertools.product(range(256), repeat=2))
    assert classic_time(2, 500e3, 0x078) == worst / 500e3


@pytest.mark.parametrize("size", [0, 1])
@pytest.mark.parametrize("number", NUMBERS)
def test_fd_frames_of_every_payload(number, size):
    payloads = map(bytes, itertools.product(range(256), repeat=size))
    found = [fd_bits(number, payload) for payload in payloads]
    for ratio in (1.0, 2.0, 8.0, 100.0):
        worst = max(slow + fast / ratio for slow, fast in found)
        assert fd_time(size, 1.0, ratio, number) == pytest.approx(worst, rel=1e-12)


def test_fd_frames_of_every_identifier():
    found = [fd_bits(number, b"") for number in range(2048)]
    assert fd_time(0, 1.0, 8.0) == pytest.approx(max(s + f / 8.0 for s, f in found), rel=1e-12)


def test_the_longest_frames_that_the_link_sends():
    """In µs; a stuff bit in the data of a CAN FD frame at 1/8 Mbit/s takes 0.125 µs."""
    assert fd_time(12, 1e6, 8e6) * 1e6 == pytest.approx(51.0)
    assert fd_time(8, 1e6, 8e6) * 1e6 == pytest.approx(46.125)
    assert classic_time(8, 1e6) * 1e6 == pytest.approx(133)
    # Davis et al. 2007 bound a classic frame by one stuff bit per four bits of the stuffed part
    assert classic_time(8, 1.0) <= 8 * 8 + 47 + (34 + 8 * 8 - 1) // 4


@pytest.mark.parametrize(
    ("options", "T_s", "said"),
    [
        ({}, 1e-4, None),
        ({"data_bitrate": 5_000_000, "every": 2}, 1e-4, None),
        ({"fd": False, "every": 4}, 1e-4, None),
        ({}, 97.2e-6, None),
        ({}, 97.1e-6, "y (51.0 µs) and u (46.1 µs) keep a bus of 1/8 Mbit/s for 97.1 µs at worst"),
        ({}, 2e-5, "486% of every × T_s = 20 µs; nearest that fits: every = 5"),
        ({"data_bitrate": 5_000_000}, 1e-4, "fits: every = 2 or data_bitrate = 8000000"),
        ({"fd": False}, 1e-4, "every = 4 or fd = true, data_bitrate = 8000000"),
        ({"fd": False, "bitrate": 500_000}, 2e-4, "every = 4 or fd = true, data_bitrate = 5000000"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_nearest_that_does(options, T_s, said):
    if said is None:
        KIND.check(CanOptions(**options), T_s)
        return
    with pytest.raises(ValueError) as found:
        KIND.check(CanOptions(**options), T_s)
    assert said in str(found.value)


def test_a_scenario_whose_bus_is_too_slow_never_starts(make):
    link = {"type": "can", "options": {"fd": False}}
    with pytest.raises(UserError, match=r"link\.options: y \(246\.0 µs\) and u \(133\.0 µs\)"):
        make(link=link)
