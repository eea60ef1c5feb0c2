"""Frame times: the longest of all frames, found by brute force; and what fits a period."""

import numpy as np
import pytest
from numba import njit

from gfm_hil.core.errors import UserError
from gfm_hil.links.can import KIND, CanOptions
from gfm_hil.links.can.bus_time import frame_time
from gfm_hil.links.can.dbc import PAYLOADS


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


@njit(cache=True)
def most_stuffed(bits):
    """Most stuff bits that a classic frame's bits (-1: any) and their CRC can need, by dynamic
    programming: of all contents that end in the same bit, the same run of it and the same CRC it
    keeps the longest."""
    # by CRC, last bit and its run 1 … 4: a stuff bit follows the fifth
    most = np.full((1 << 15, 2, 5), -9999, np.int16)
    most[0, 1, 0] = 0  # before the start of frame: run 0
    for k in range(len(bits) + 15):
        after = np.full_like(most, -9999)
        place = len(bits) + 14 - k  # below 15: the number of the CRC bit being sent
        for crc in range(1 << 15):
            for value in range(2):
                to = crc
                if place >= 15:
                    if bits[k] == 1 - value:
                        continue
                    to = (crc << 1 & 0x7FFF) ^ (0x4599 if crc >> 14 != value else 0)
                elif crc >> place & 1 != value:
                    continue
                other = most[crc, 1 - value].max()
                after[to, value, 1] = max(after[to, value, 1], other)
                for run in range(5 - 1):
                    after[to, value, run + 1] = max(
                        after[to, value, run + 1], most[crc, value, run]
                    )
                stuffed = most[crc, value, 5 - 1] + 1
                after[to, 1 - value, 1] = max(after[to, 1 - value, 1], stuffed)
        most = after
    return most.max()


def longest_classic(size: int, number: int | None = None) -> int:
    """Bits of the longest classic frame, over all contents and, without a number, identifiers."""
    identifier = [-1] * 11 if number is None else bits_of(number, 11)
    bits = [0, *identifier, 0, 0, 0, *bits_of(size, 4), *[-1] * (8 * size)]
    return len(bits) + 15 + int(most_stuffed(np.array(bits))) + 1 + 2 + 7 + 3


def longest_fd(size: int, slow: float, fast: float, number: int | None = None) -> float:
    """Time of the longest CAN FD frame before its stuff count, from the times of a bit."""
    identifier = [None] * 11 if number is None else bits_of(number, 11)
    head = [0, *identifier, 0, 0, 1, 0, 1]
    body = [0, *bits_of(PAYLOADS.index(size), 4), *[None] * (8 * size)]
    times = [slow] * len(head) + [fast] * len(body)
    best = {(1, 0): 0.0}  # (bit, run): longest time so far
    for k, bit in enumerate([*head, *body]):
        after: dict[tuple[int, int], float] = {}
        for (before, run), time in best.items():
            for value in (0, 1) if bit is None else (bit,):
                state, now = (value, run + 1 if value == before else 1), time + times[k]
                if state[1] == 5 and k < len(times) - 1:  # there a fixed stuff bit replaces it
                    state, now = (1 - value, 1), now + times[k + 1]
                after[state] = max(after.get(state, 0.0), now)
        best = after
    return max(best.values())


@pytest.mark.parametrize("number", [0, 0x7FF, 0x120, 0x078, 0x41F])
def test_the_search_finds_what_enumeration_finds(number):
    payloads = [bytes([byte]) for byte in range(256)]
    assert longest_classic(1, number) == max(classic_bits(number, data) for data in payloads)
    found = [fd_bits(number, data) for data in payloads]
    for ratio in (1.0, 8.0):
        rest = 12 + (21 + 6 + 1) / ratio
        worst = max(slow + fast / ratio for slow, fast in found)
        assert longest_fd(1, 1.0, 1.0 / ratio, number) + rest == pytest.approx(worst, rel=1e-12)


@pytest.mark.parametrize("size", range(9))
def test_classic_frames(size):
    assert frame_time(size, False, 0.5, 1.0) == longest_classic(size) / 0.5


@pytest.mark.parametrize("size", PAYLOADS)
@pytest.mark.parametrize("ratio", [1.0, 2.0, 5.0, 8.0])
def test_fd_frames(size, ratio):
    crc = 17 if size <= 16 else 21
    rest = 12 + (4 + crc + 1 + (4 + crc) // 4 + 1) / ratio
    worst = longest_fd(size, 1.0, 1.0 / ratio) + rest
    assert frame_time(size, True, 1.0, ratio) == pytest.approx(worst, rel=1e-12)


def test_the_longest_frames_that_the_link_sends():
    """In µs; a stuff bit in the data of a CAN FD frame at 1/8 Mbit/s takes 0.125 µs."""
    assert frame_time(12, True, 1e6, 8e6) * 1e6 == pytest.approx(51.0)
    assert frame_time(8, True, 1e6, 8e6) * 1e6 == pytest.approx(46.125)
    assert frame_time(8, False, 1e6, 8e6) * 1e6 == pytest.approx(133)
    # Davis et al. 2007 bound a classic frame by one stuff bit per four bits of the stuffed part
    assert frame_time(8, False, 1.0, 1.0) <= 8 * 8 + 47 + (34 + 8 * 8 - 1) // 4


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
