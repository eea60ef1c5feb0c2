"""CAN frames rebuilt from a recording, against those that a third node received."""

import threading
from pathlib import Path

import can
import cantools
import numpy as np
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.links.can.dbc import INNER, STATUS, TRANSPORT, VECTORS
from gfm_hil.links.can.loopback import LoopbackBus
from gfm_hil.recording.run import Run
from gfm_hil.results.export import export_run
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario

BUS = "127.0.0.1:{port}"
LAST = 4  # words of a side that end a run


class Listener(threading.Thread):
    """A third node on a loopback bus, which stores all frames."""

    def __init__(self, channel: str) -> None:
        super().__init__()
        self.bus, self.over, self.heard = LoopbackBus(channel, place=2), threading.Event(), []

    def run(self) -> None:
        while not self.over.is_set():
            message = self.bus.recv(0.05)
            if message is not None:
                self.heard.append(message)

    def stop(self) -> None:
        self.over.set()
        self.join()
        self.bus.shutdown()


CONTENT = {
    "title": "on a bus",
    "duration": 0.03,
    "events": [{"type": "reference", "t": 0.01, "P_ref": 0.8}],
}


def run_over_can(folder: Path, port: int, content=CONTENT, **options) -> list[can.Message]:
    """A short run over CAN; returns the frames on the bus."""
    channel = BUS.format(port=port)
    link = {"type": "can", "endpoint": f"can+udp://{channel}", "repeat_s": 5.0}
    content = {**content, "link": {**link, "options": {"heartbeat": 50, **options}}}
    listener = Listener(channel)
    listener.start()
    try:
        run_scenario(check_scenario(content, "test"), folder)
    finally:
        listener.stop()
    return listener.heard


def exported(folder: Path, place: Path) -> tuple[list[can.Message], cantools.database.Database]:
    """The frames of a BLF file and the DBC beside it."""
    files = export_run(folder, "blf", place / "run.blf")
    assert [file.name for file in files] == ["run.blf", "run.dbc"]
    with can.BLFReader(files[0]) as reader:
        return list(reader), cantools.database.load_file(files[1])


@pytest.mark.processes
@pytest.mark.parametrize(
    ("port", "options", "frames", "content"),
    [
        (19500, {}, {"y": 1, "u": 1}, CONTENT),
        (19510, {"every": 3}, {"y": 1, "u": 1}, CONTENT),
        (19520, {"fd": False, "bitrate": 1_000_000, "every": 10}, {"y": 2, "u": 1}, CONTENT),
        pytest.param(
            19550, {"every": 2}, {"y": 1, "u": 1}, {**CONTENT, "law": "vsg-2", "inner": "cascaded"}
        ),
    ],
    ids=["FD", "FD every third tick", "classic", "inner stage"],
)
def test_the_frames_are_those_that_were_on_the_bus(tmp_path, port, options, frames, content):
    heard = run_over_can(tmp_path / "run", port, content, **options)
    found, dbc = exported(tmp_path / "run", tmp_path)
    for role, group, count in (("plant", "y", frames["y"]), ("controller", "u", frames["u"])):
        title = (INNER if "inner" in content else VECTORS)[group]
        numbers = {m.frame_id for m in dbc.messages if m.name.partition("_")[0] == title}
        assert len(numbers) == count
        numbers.add(dbc.get_message_by_name(STATUS[role]).frame_id)
        there = [(m.arbitration_id, bytes(m.data), m.is_fd) for m in heard
                 if m.arbitration_id in numbers]  # fmt: skip
        rebuilt = [(m.arbitration_id, bytes(m.data), m.is_fd) for m in found
                   if m.arbitration_id in numbers]  # fmt: skip
        assert rebuilt == there[: len(rebuilt)]
        # the rest: a side's last frames and, of u, frames that the plant no longer read
        said_last = (count + 1) * LAST
        nobody_took = count if role == "controller" and options.get("every", 1) > 1 else 0
        assert 0 < len(there) - len(rebuilt) <= said_last + nobody_took
    transport = {dbc.get_message_by_name(name).frame_id for name in TRANSPORT.values()}
    assert not transport & {m.arbitration_id for m in found}
    assert transport <= {m.arbitration_id for m in heard}


@pytest.mark.processes
def test_cantools_decodes_what_the_run_recorded(tmp_path):
    run_over_can(tmp_path / "run", 19530)
    found, dbc = exported(tmp_path / "run", tmp_path)
    table = Run.load(tmp_path / "run")
    for group in ("y", "u"):
        message = dbc.get_message_by_name(VECTORS[group])
        frames = [m for m in found if m.arbitration_id == message.frame_id]
        assert len(frames) == len(table.recorded["tick"])
        np.testing.assert_allclose([m.timestamp for m in frames], table.recorded["t"][:], atol=1e-9)
        values = [message.decode(m.data) for m in frames]
        for signal in message.signals[2:]:
            seen = np.array([v[signal.name] for v in values])
            away = np.abs(seen - table.recorded[f"{group}_{signal.name}"][:])
            # commands came over the bus in counts; measurements are recorded as the A/D read them
            assert away.max() <= (1e-12 if group == "u" else signal.scale / 2 + 1e-12)


def test_any_run_can_be_put_into_frames(run, tmp_path):
    found, dbc = exported(run(duration=0.02).folder, tmp_path)
    assert [dbc.decode_message(m.arbitration_id, m.data).get("State") for m in found[:4]] == [
        "INIT", None, "RUNNING", None,
    ]  # fmt: skip
    assert len(found) == 2 * 200 + 2 * 2  # a status goes with the first two vectors of a state


@pytest.mark.processes
def test_a_safe_state_is_said_with_its_reason(tmp_path):
    """The plant trips at a phase jump and both sides report it, until the reset."""
    content = {
        "title": "tripped on a bus",
        "duration": 0.04,
        "after_trip": "wait",
        "events": [
            {"type": "grid-phase-jump", "t": 0.01, "degrees": 120.0},
            {"type": "reset", "t": 0.03},
        ],
    }
    heard = run_over_can(tmp_path / "run", 19540, content)
    found, dbc = exported(tmp_path / "run", tmp_path)
    for role in ("plant", "controller"):
        message = dbc.get_message_by_name(STATUS[role])
        told = [bytes(m.data) for m in heard if m.arbitration_id == message.frame_id]
        again = [bytes(m.data) for m in found if m.arbitration_id == message.frame_id]
        assert again == told[: len(again)]
        assert len(told) - len(again) <= LAST
        said = {(str(s["State"]), str(s["Reason"])) for s in map(message.decode, again)}
        assert ("SAFE", "the plant's protection tripped") in said


def test_both_roles_are_needed(run, tmp_path):
    folder = run(duration=0.02).folder
    with np.load(folder / "signals.npz") as file:
        kept = {name: file[name] for name in file.files if not name.startswith("y_")}
    np.savez(folder / "signals.npz", **kept)
    with pytest.raises(UserError, match="one side; frames need both"):
        export_run(folder, "blf", tmp_path / "x.blf")
    assert not (tmp_path / "x.blf").exists()
