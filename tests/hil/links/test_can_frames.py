"""CAN frames: they match the DBC and cantools' packing, and every damage is detected."""

import numpy as np
import pytest
from cantools.database.can import Database
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.links.can.dbc import INT16, INVALID, VECTORS, offset, read_dbc, write_dbc
from gfm_hil.links.can.layout import plan_of
from gfm_hil.links.can.vectors import VectorSender
from gfm_hil.links.can.wire import crc8
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter, frame_dtype
from gfm_runtime.signals import Group, carried_rows, group, names
from gfm_runtime.states import RUNNING, SAFE

from ...support.can import VectorReceiver

DBC = {fd: read_dbc(write_dbc(fd)) for fd in (True, False)}
PLAN = {fd: plan_of(dbc) for fd, dbc in DBC.items()}
INNER_PLAN = {fd: plan_of(dbc, True) for fd, dbc in DBC.items()}
ALL = [
    (fd, name, plan, part)
    for fd in DBC
    for plan in (PLAN[fd], INNER_PLAN[fd])
    for name in VECTORS
    for part in plan.vectors[name]
]
WIDTH = {name: len(names(name)) for name in VECTORS}

either = st.booleans()
vectors = st.sampled_from(["y", "u"])
values = st.floats(-100, 100)


def sample(name: Group, k: int = 0) -> np.ndarray:
    """Values that fit 16 bits, different for each k."""
    return np.array([s.default + s.scale * (j + 10 * k) for j, s in enumerate(group(name))])


class Bus:
    """A sender, a receiver and the bench's reader; the test changes frames in between."""

    def __init__(self, name: Group, fd: bool = True, heartbeat: int = 10**9) -> None:
        self.sender = VectorSender(PLAN[fd], name, heartbeat)
        self.receiver = VectorReceiver(PLAN[fd], name)
        self.writer, self.reader = FrameWriter(name), FrameReader(name)
        self.values = np.full(WIDTH[name], 7.0)

    def frames(self, tick: int, state: int = RUNNING, reason: int = 0) -> list:
        """CAN frames of a tick, its values ``sample(tick)``."""
        message = self.writer.pack(tick, state, reason, sample(self.reader.group, tick % 100))
        frames = self.sender.frames(message)
        assert frames
        return frames

    def hear(self, *frames) -> list:
        """Ticks accepted, or the faults of refused frames."""
        out: list = []
        for number, payload in frames:
            assert self.receiver.belongs(number)
            message = self.receiver.take(number, payload)
            if message is None:
                continue
            try:
                out.append(self.reader.unpack(message, self.values))
            except FrameError as problem:
                out.append(problem.fault)
        return out


@pytest.mark.parametrize("fd", [True, False])
def test_the_dbc_survives_its_own_text(fd):
    dbc = DBC[fd]
    for message in dbc.messages:
        assert message.is_fd == fd
        assert message.length <= (64 if fd else 8)
    found = {
        s.name: s for m in dbc.messages if m.name.startswith("Measurements") for s in m.signals
    }
    for row in group("y"):
        signal = found[row.name]
        assert (signal.scale, signal.minimum, signal.maximum) == (row.scale, row.low, row.high)
        assert signal.receivers == ["Controller"]
        assert signal.comment == row.description


@pytest.mark.parametrize(
    "row", [*carried_rows("y", True), *carried_rows("u", True)], ids=lambda r: f"{r.group}-{r.name}"
)
def test_the_range_of_every_signal_fits(row):
    for end in (row.low, row.high):
        assert abs(end - offset(row)) / row.scale <= INT16


@given(st.data(), st.sampled_from(ALL))
def test_packing_is_that_of_cantools(data, frame):
    fd, name, plan, part = frame
    rows = carried_rows(name, plan.signal_set)
    names = [row.name for row in rows]
    sent = np.array(data.draw(st.lists(values, min_size=len(rows), max_size=len(rows))))
    tick = data.draw(st.integers(0, 2**40))
    sender = VectorSender(plan, name, 1)
    payloads = dict(sender.frames(FrameWriter(name, plan.signal_set).pack(tick, RUNNING, 0, sent)))
    payload = payloads[part.number]

    message = DBC[fd].get_message_by_frame_id(part.number)
    ends = {names[k]: (o - INT16 * s, o + INT16 * s) for k, _, s, o in part.values.tolist()}
    physical = {n: float(np.clip(sent[names.index(n)], *ends[n])) for n in ends}
    crc = crc8(part.data_id, np.frombuffer(payload, np.uint8))
    header = {"Crc": int(crc), "Counter": tick % 2 * 64 + 128}  # of sequence 0
    assert message.encode({**physical, **header}, strict=False) == payload

    decoded = message.decode(payload, decode_choices=False)
    receiver = VectorReceiver(plan, name)
    *_, whole = (receiver.take(*one) for one in payloads.items())
    got = np.frombuffer(whole, frame_dtype(name, plan.signal_set))
    assert {n: got[n][0] for n in ends} == {n: decoded[n] for n in ends}
    for n, (low, high) in ends.items():
        value, scale = sent[names.index(n)], rows[names.index(n)].scale
        if low <= value <= high:
            assert abs(decoded[n] - value) <= 0.5001 * scale


@given(vectors, either, st.integers(0, 255), st.integers(0, 6), st.integers(0, 2**40))
def test_a_state_is_packed_as_cantools_does(name, fd, state, reason, tick):
    (number, payload), *_ = VectorSender(PLAN[fd], name, 1).frames(
        FrameWriter(name).pack(tick, state, reason, sample(name))
    )
    message = DBC[fd].get_message_by_frame_id(number)
    decoded = message.decode(payload, decode_choices=False)
    assert decoded == {
        "Crc": payload[0],
        "Counter": tick % 2 * 64 + 128,
        "State": state,
        "Reason": reason,
        "Tick": tick % 2**32,
    }
    assert message.encode(decoded, strict=False) == payload


def test_the_check_is_crc_8_of_sae_j1850():
    assert crc8(0, np.array([0, 0, 0], np.uint8)) == 0x59  # four zero bytes, published vector
    # the usual check value is that of "123456789"; the data id is its first two characters
    text = np.frombuffer(b"?3456789", np.uint8)
    assert crc8(ord("1") | ord("2") << 8, text) == 0x4B


@pytest.mark.parametrize("fd", [True, False])
@pytest.mark.parametrize("name", VECTORS)
def test_a_vector_arrives_in_its_counts(name, fd):
    bus = Bus(name, fd)
    for tick in range(1000):
        assert bus.hear(*bus.frames(tick)) == [tick]
        np.testing.assert_allclose(bus.values, sample(name, tick % 100), rtol=0, atol=1e-12)
    assert not any(bus.reader.faults.values())
    assert (bus.sender.record["saturated"][0], bus.receiver.incomplete) == (0, 0)


def test_what_is_not_a_number_stays_none():
    bus = Bus("y")
    sent = sample("y")
    sent[2] = np.nan
    state, (number, payload) = bus.sender.frames(bus.writer.pack(0, 0, 0, sent))
    raw = DBC[True].decode_message(number, payload, scaling=False, decode_choices=False)
    assert raw["omega_u"] == INVALID
    bus.hear(state, (number, payload))
    assert np.isnan(bus.values[2])
    assert np.isfinite(np.delete(bus.values, 2)).all()


@pytest.mark.parametrize("far", [50.0, np.inf])
def test_values_beyond_the_range_stay_beyond_it_and_are_counted(far):
    bus = Bus("y")
    bus.hear(*bus.sender.frames(bus.writer.pack(0, 0, 0, np.array([far, -far, 1.0, 0.0, far]))))
    assert bus.sender.record["saturated"][0] == 3
    v_dc, p, _, _, V = group("y")
    assert bus.values[0] > v_dc.high  # so that the controller refuses it
    assert bus.values[1] < p.low
    assert bus.values[4] > V.high


@given(vectors, either, st.data())
def test_no_damaged_frame_is_taken(name, fd, data):
    bus = Bus(name, fd)
    bus.hear(*bus.frames(0))
    *others, (number, payload) = bus.frames(1)
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    damaged = bytearray(payload)
    damaged[bit // 8] ^= 1 << bit % 8
    assert bus.hear(*others, (number, bytes(damaged))) == ["crc"]
    *_, (number, payload) = bus.frames(2)
    assert bus.hear((number, payload[:-1])) == ["crc"]
    assert bus.reader.tick == 0


def test_a_frame_of_another_definition_is_not_taken():
    """The same identifier and length, another scale: the data id differs."""
    other = write_dbc(True).replace("(0.0002,0.0)", "(0.0004,0.0)")
    sender = VectorSender(plan_of(read_dbc(other)), "y", 10)
    bus = Bus("y")
    assert bus.hear(*sender.frames(FrameWriter("y").pack(0, 0, 0, sample("y")))[1:]) == ["crc"]


def test_a_frame_damaged_before_the_bus_arrives_damaged():
    bus = Bus("u")
    bus.hear(*bus.frames(0))
    message = bytearray(bus.writer.pack(1, RUNNING, 0, sample("u")))
    message[30] ^= 1
    assert bus.hear(*bus.sender.frames(bytes(message))) == ["crc"]


@given(vectors, either, st.integers(0, 58))
def test_lost_vectors_are_counted(name, fd, gap):
    bus = Bus(name, fd)
    bus.hear(*bus.frames(0))
    for tick in range(1, gap + 1):
        bus.frames(tick)
    assert bus.hear(*bus.frames(gap + 1)) == [gap + 1]
    assert bus.reader.faults["lost"] == gap
    assert bus.hear(*bus.frames(gap + 2)) == [gap + 2]


@pytest.mark.attack("1.18", "CAN: the first status says tick 2**31 + 5", "taken for tick 0")
@given(vectors, either, st.sampled_from([2**31 + 5, 2**32 - 1]))
def test_a_tick_below_zero_is_refused(name, fd, tick):
    bus = Bus(name, fd)
    assert bus.hear(*bus.frames(tick)) == ["tick"]


@pytest.mark.attack("1.19", "CAN: the status of an old tick comes again", "its tick is used")
@given(vectors, either, st.integers(2, 200))
def test_an_old_status_moves_no_tick_back(name, fd, last):
    bus = Bus(name, fd, heartbeat=10)
    old, *values = bus.frames(0)
    bus.hear(old, *values)
    for tick in range(1, last):
        bus.hear(*bus.frames(tick))
    bus.hear(old)
    for tick in range(last, last + 40):  # until a heartbeat tells the sender's tick
        found = bus.hear(*bus.frames(tick))
        assert found in ([], ["tick"], [tick])
    assert found == [tick]


@pytest.mark.parametrize("gap", [300, 70_000])
def test_after_a_long_gap_a_heartbeat_finds_in_again(gap):
    bus = Bus("y", heartbeat=50)
    bus.hear(*bus.frames(0))
    for tick in range(1, gap):
        bus.frames(tick)
    ticks = [heard for tick in range(gap, gap + 100) for heard in bus.hear(*bus.frames(tick))]
    assert ticks[-50:] == list(range(gap + 50, gap + 100))
    # before it, new values may count as older ones, never as newer
    assert all(t <= now for now, t in enumerate(ticks, gap) if isinstance(t, int))
    assert sum(bus.reader.faults.values()) >= bus.reader.faults["lost"] > 0


@given(vectors, st.integers(1, 4))
def test_repeated_and_late_vectors_are_refused(name, late):
    bus = Bus(name)
    heard = [bus.frames(tick)[-1:] for tick in range(40)]
    for frames in heard:
        bus.hear(*frames)
    assert bus.hear(*heard[39]) == ["repeated"]
    assert bus.hear(*heard[40 - late]) == ["repeated" if late == 1 else "out_of_sequence"]
    assert bus.hear(*bus.frames(40)) == [40]


def test_a_part_that_never_came_makes_no_vector():
    bus = Bus("y", fd=False)
    bus.hear(*bus.frames(0), *bus.frames(1))
    one, two = bus.frames(2)
    assert bus.hear(one) == []
    assert bus.hear(*bus.frames(3)) == [3]
    assert bus.receiver.incomplete == 1
    assert bus.reader.faults["lost"] == 1
    assert bus.hear(two) == []  # late and alone


def test_a_state_goes_ahead_of_the_values_when_it_changes():
    bus = Bus("u")
    assert [len(bus.frames(tick)) for tick in (0, 1, 2, 3, 3, 4, 5)] == [2, 2, 1, 1, 2, 2, 1]
    bus = Bus("u", heartbeat=2)
    assert [len(bus.frames(tick)) for tick in range(7)] == [2, 2, 1, 2, 1, 2, 1]
    bus = Bus("u")
    bus.hear(*bus.frames(0), *bus.frames(1))
    assert bus.reader.state == RUNNING
    bus.hear(*bus.frames(2, SAFE, 3))
    assert (bus.reader.state, bus.reader.reason, bus.reader.tick) == (SAFE, 3, 2)


def test_the_last_word_under_a_tick_heard_already_is_heard():
    bus = Bus("u")
    bus.hear(*bus.frames(0), *bus.frames(1))
    assert bus.hear(*bus.frames(1, SAFE, 4)) == [1]
    assert (bus.reader.state, bus.reader.reason) == (SAFE, 4)
    assert not any(bus.reader.faults.values())


@given(vectors, either, st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans())))
def test_a_tick_asked_for_again_is_never_taken_for_the_next(name, fd, story):
    """Lockstep: a tick ends only once its frame was received; any frames may get lost."""
    bus = Bus(name, fd)
    tick, heard = 0, 0
    for status, *parts in story:
        kept = [
            f
            for f in bus.frames(tick)
            if (status if f[0] < 0x110 else parts[f[0] % 2])  # these frames arrive
        ]
        found = bus.hear(*kept)
        assert found in ([], [tick])
        tick += len(found)
        heard += len(found)
    assert sum(bus.reader.faults.values()) == bus.reader.faults["lost"] <= len(story) - heard


@given(st.lists(st.tuples(st.integers(0, 3), st.booleans())))
def test_real_time_ticks_that_are_skipped_are_never_taken_for_newer_ones(story):
    """A controller that misses measurements: its sequence continues, its tick jumps."""
    bus = Bus("u")
    tick, known = -1, True
    for skipped, kept in story:
        tick += 1 + skipped
        *state, values = bus.frames(tick)
        known = (known and not skipped) or bool(kept and state)
        for found in bus.hear(*(state if kept else []), values):
            assert found == tick or (found < tick and not known)
    assert sum(bus.reader.faults.values()) == bus.reader.faults["lost"] <= bus.receiver.incomplete


@given(vectors, either, st.data())
def test_every_value_of_an_inner_stage_comes_back_within_half_a_count(name, fd, data):
    plan, rows = INNER_PLAN[fd], carried_rows(name, True)
    sender, receiver = VectorSender(plan, name, 10), VectorReceiver(plan, name)
    writer, reader = FrameWriter(name, True), FrameReader(name, True)
    for tick in range(3):
        sent = np.array([data.draw(st.floats(row.low, row.high)) for row in rows])
        frames = sender.frames(writer.pack(tick, RUNNING, 0, sent))
        heard = [receiver.take(*frame) for frame in frames]
        (message,) = [one for one in heard if one is not None]
        got = np.zeros(len(rows))
        assert reader.unpack(message, got) == tick
        assert (np.abs(got - sent) <= 0.5001 * np.array([row.scale for row in rows])).all()


def test_frames_of_an_inner_stage_follow_those_of_the_vector():
    """0x110 and 0x120 begin the vectors of other runs; no identifier is used twice."""
    numbers = {
        (fd, name): [part.number for part in INNER_PLAN[fd].vectors[name]]
        for fd in DBC
        for name in VECTORS
    }
    assert numbers == {
        (True, "u"): [0x118],
        (True, "y"): [0x128],
        (False, "u"): [0x118, 0x119],
        (False, "y"): [0x128, 0x129, 0x12A, 0x12B],
    }
    for fd, dbc in DBC.items():
        assert [len(INNER_PLAN[fd].vectors[n]) for n in "yu"] == ([1, 1] if fd else [4, 2])
        assert len({m.frame_id for m in dbc.messages}) == len(dbc.messages)


def test_the_frames_of_an_inner_stage_count_only_in_its_runs():
    """A file that lacks them describes every other run, by the same digest."""
    older = Database([m for m in DBC[True].messages if "Inner" not in m.name])
    assert len(older.messages) == len(DBC[True].messages) - 2
    assert plan_of(older).digest == PLAN[True].digest != INNER_PLAN[True].digest
    with pytest.raises(ValueError, match=r"frames MeasurementsInner….*inner stage"):
        plan_of(older, True)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("BO_ 288 Measurements", "BO_ 288 Other", "must carry each of"),
        (" p ", " power ", "must carry each of"),
        ("BO_ 256 PlantStatus", "BO_ 256 Else", "frames ['PlantStatus'] are missing"),
        ("SG_ p : 32|16@1-", "SG_ p : 32|16@1+", "Measurements.p: must be a signed 16-bit value"),
        ("SG_ p : 32|16@1-", "SG_ p : 32|12@1-", "Measurements.p: must be 1, 2 or 4 whole bytes"),
        ("SG_ Crc :", "SG_ Check :", "must begin with Crc and Counter"),
    ],
)
def test_a_dbc_that_does_not_describe_the_link(old, new, fault):
    text = write_dbc(True)
    assert old in text
    with pytest.raises(ValueError) as found:
        plan_of(read_dbc(text.replace(old, new)))
    assert fault in str(found.value)


def test_a_dbc_may_move_signals_and_frames():
    """Values are read from their places in the DBC, in any order: here p and q are swapped."""
    text = write_dbc(True)
    text = text.replace("SG_ p : 32|", "SG_ p : X|").replace("SG_ q : 64|", "SG_ q : 32|")
    text = text.replace("SG_ p : X|", "SG_ p : 64|").replace(" 288 ", " 300 ")
    plan = plan_of(read_dbc(text))
    sender, receiver = VectorSender(plan, "y", 10), VectorReceiver(plan, "y")
    state, values = sender.frames(FrameWriter("y").pack(0, 0, 0, sample("y", 5)))
    assert values[0] == 300
    assert receiver.take(*state) is None
    got = np.zeros(5)
    FrameReader("y").unpack(receiver.take(*values), got)
    np.testing.assert_allclose(got, sample("y", 5), atol=1e-12)
