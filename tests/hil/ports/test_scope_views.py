"""A scope's view of a recording: no window loses a peak; the trigger's edge."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.ports.scope.channels import make_channels
from gfm_hil.ports.scope.picture import (
    ARMED,
    AUTO,
    FILLING,
    HEAD,
    HELD,
    Acquisition,
    PictureRequest,
    ScopePicture,
    Trigger,
    edges,
)
from gfm_hil.ports.scope.pyramid import Pyramid
from gfm_hil.ports.scope.recording import Recording
from gfm_hil.scenario import Scenario

T_S = 1e-4
SCENARIO = Scenario(title="growing", duration=2.0, T_s=T_S)
TICKS = 20_000


class Growing(Recording):
    """A recording in memory, of which ``there`` ticks are done."""

    def __init__(self, p: np.ndarray, **more: np.ndarray) -> None:
        super().__init__(folder=None, scenario=SCENARIO)  # type: ignore[arg-type]
        self.columns = {"y_p": p, **more}
        self.there = len(p)

    def done(self) -> int:
        return self.there


def pyramid_of(record: Recording) -> Pyramid:
    return Pyramid(record, make_channels(T_S, 50.0))


def noise(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=n)


@given(
    st.lists(st.integers(1, 7000), min_size=1, max_size=6),
    st.integers(0, TICKS - 1),
    st.integers(2, TICKS),
    st.integers(16, 900),
)
def test_bins_hold_the_extremes_of_their_ticks(chunks, first, span, wanted):
    p = noise(min(TICKS, sum(chunks)))
    record, done = Growing(p), 0
    pyramid = pyramid_of(record)
    for chunk in chunks:
        record.there = done = min(len(p), done + chunk)
        assert pyramid.update()
    width = pyramid.width(span, wanted)
    assert width * wanted <= max(span, wanted)  # at least as many bins as wanted
    a, b = first // width, -(-min(first + span, done) // width)
    if b <= a:
        return
    low, high = pyramid.bins("p", a, b, width)
    for k in range(a, b):
        rows = p[k * width : (k + 1) * width].astype(np.float32)
        assert (low[k - a], high[k - a]) == (rows.min(), rows.max())


def test_missing_values_hide_no_others():
    p = np.full(TICKS, np.nan)
    p[777] = 3.0
    pyramid = pyramid_of(Growing(p))
    pyramid.update()
    low, high = pyramid.bins("p", 0, TICKS // 64, 64)
    assert np.flatnonzero(~np.isnan(low)).tolist() == [777 // 64]
    assert high[777 // 64] == 3.0


def test_a_long_recording_is_taken_in_by_and_by():
    record = Growing(noise(100_000))
    record.capacity = 100_000
    pyramid = pyramid_of(record)
    assert not pyramid.update()
    while not pyramid.update():
        pass
    assert pyramid.done == 100_000


def test_frequencies_are_in_hertz_and_misses_are_counted():
    scheduled = np.arange(1000) * 100_000
    received = scheduled + 20_000
    received[[5, 500, 501]] = -1
    record = Growing(
        np.zeros(1000),
        y_omega_u=np.full(1000, 1.02),
        plant_scheduled=scheduled,
        plant_received=received,
        plant_sent=scheduled + 3_000,
    )
    pyramid = pyramid_of(record)
    pyramid.update()
    assert pyramid.values("omega_u", 3, 4) == pytest.approx([51.0])
    assert pyramid.values("slack", 4, 6) == pytest.approx([80.0, np.nan], nan_ok=True)
    assert pyramid.values("round_trip", 4, 5) == pytest.approx([17.0])
    assert [pyramid.misses(k) for k in (5, 6, 501, 1000)] == [0, 1, 2, 3]


def test_loop_figures_of_a_run_without_deadlines_are_left_out():
    never = np.full(64, -1)
    record = Growing(np.zeros(64), plant_scheduled=never, plant_received=never, plant_sent=never)
    pyramid = pyramid_of(record)
    for name in ("slack", "round_trip", "miss"):
        assert np.isnan(pyramid.values(name, 0, 64)).all()


def test_edges():
    values = np.array([0, 1, 1, 0, np.nan, 1, 0, 1], np.float32)
    rising = Trigger(channel="p", level=0.5)
    assert edges(values, rising).tolist() == [1, 7]
    assert edges(values, rising.model_copy(update={"edge": "falling"})).tolist() == [3, 6]
    assert edges(values, rising.model_copy(update={"edge": "both"})).tolist() == [1, 3, 6, 7]


def square(n: int, period: int) -> np.ndarray:
    return (np.arange(n) // (period // 2) % 2).astype(float)


def acquisition(mode: str, p: np.ndarray, span: int = 100) -> tuple[Acquisition, Pyramid]:
    pyramid = pyramid_of(Growing(p))
    while not pyramid.update():
        pass
    trigger = Trigger(channel="p", level=0.5, mode=mode)  # type: ignore[arg-type]
    return Acquisition(pyramid, trigger, span, 0), pyramid


def test_single_holds_the_first_edge_for_good():
    one, _ = acquisition("single", square(20_000, 4000))
    assert one.window(1000) == (900, 1000)
    assert one.doing == ARMED
    assert one.window(2010) == (1980, 2080)
    assert (one.doing, one.shown) == (FILLING, 2000)
    for head in (2080, 9000, 20_000):
        assert one.window(head) == (1980, 2080)
        assert one.doing == HELD


def test_normal_goes_from_edge_to_edge_and_waits_between_them():
    normal, _ = acquisition("normal", square(20_000, 4000))
    shown = []
    for head in range(0, 20_000, 50):
        normal.window(head)
        shown.append(normal.shown)
    assert sorted(set(shown)) == [-1, 2000, 6000, 10_000, 14_000, 18_000]


def test_auto_rolls_when_nothing_comes():
    auto, _ = acquisition("auto", np.zeros(20_000))
    assert auto.window(4000) == (3900, 4000)
    assert auto.doing == ARMED
    assert auto.window(6000) == (5900, 6000)
    assert auto.doing == AUTO


def look(**more) -> PictureRequest:
    content = {"kind": "look", "id": 7, "channels": ["p"], "bins": 100, "mode": "roll", "span": 0.5}
    return PictureRequest(**{**content, **more})


def taken_apart(frame: bytes, channels: int = 1, watched: int = 0):
    head = dict(zip(HEAD, np.frombuffer(frame, "<f8", len(HEAD)), strict=True))
    rest = np.frombuffer(frame, "<f4", offset=8 * len(HEAD))
    n = int(head["bins"])
    assert len(rest) == 2 * n * channels + channels + watched
    return head, rest[: 2 * n * channels].reshape(2 * channels, n), rest[2 * n * channels :]


def test_frames_roll_along_and_say_what_is_the_case():
    p = noise(TICKS)
    state = np.full(TICKS, 2.0)
    state[12_000:] = 3.0
    pyramid = pyramid_of(Growing(p, state=state, law=np.full(TICKS, 1.0)))
    pyramid.update()
    view = ScopePicture(pyramid, look(watched=["p"]), 0)
    head, values, now = taken_apart(view.frame(10_000), watched=1)
    assert (head["start"], head["stop"], head["head"]) == (5000, 10_000, 10_000)
    assert (head["view"], head["state"], head["law"], head["live"]) == (7, 2, 1, 1)
    assert (head["first"], head["width"]) == (4992, 48)  # 5000 ticks in at least 100 bins
    rows = p[4992:10_000].astype(np.float32)
    assert (values.min(), values.max()) == (rows.min(), rows.max())
    assert now == pytest.approx([p[9800:10_000].mean()] * 2, abs=1e-6)
    assert view.frame(10_000) is None
    head, _, _ = taken_apart(view.frame(12_001), watched=1)
    assert head["state"] == 3


def test_a_held_window_is_sent_once_and_then_only_what_else_is_new():
    pyramid = pyramid_of(Growing(noise(TICKS)))
    pyramid.update()
    view = ScopePicture(pyramid, look(mode="held", start=0.1, span=0.2), 0)
    head, values, _ = taken_apart(view.frame(10_000))
    assert (head["start"], head["stop"], head["same"]) == (1000, 3000, 0)
    assert values.size
    head, values, _ = taken_apart(view.frame(11_000))
    assert (head["same"], head["head"], values.size) == (1, 11_000, 0)


def test_a_window_beyond_what_is_recorded_is_empty():
    pyramid = pyramid_of(Growing(noise(TICKS)))
    pyramid.update()
    for start in (-5.0, 5.0):
        view = ScopePicture(pyramid, look(mode="held", start=start, span=0.2), 0)
        head, _, _ = taken_apart(view.frame(10_000))
        assert head["bins"] == 0


@pytest.mark.parametrize("wrong", [{"channels": ["x"]}, {"watched": ["x"]}, {"mode": "trigger"}])
def test_a_look_that_cannot_be_is_refused(wrong):
    pyramid = pyramid_of(Growing(noise(TICKS)))
    with pytest.raises(ValueError, match=r"channel = .*: unknown|trigger: missing"):
        ScopePicture(pyramid, look(**wrong), 0)


@given(
    st.floats(-3, 3),
    st.floats(1e-6, 10),
    st.integers(16, 4096),
    st.sampled_from(["roll", "held", "trigger"]),
    st.lists(st.integers(0, TICKS), min_size=1, max_size=4).map(sorted),
)
def test_no_look_is_too_odd(start, span, bins, mode, heads):
    pyramid = pyramid_of(Growing(noise(TICKS)))
    pyramid.update()
    trigger = Trigger(channel="p", level=0.0)
    view = ScopePicture(
        pyramid, look(start=start, span=span, bins=bins, mode=mode, trigger=trigger), 0
    )
    for done in heads:
        frame = view.frame(done)
        if frame is not None:
            head, values, _ = taken_apart(frame)
            assert np.isfinite(values).all()
            if head["bins"]:
                assert done - head["first"] - (head["bins"] - 1) * head["width"] >= 0
