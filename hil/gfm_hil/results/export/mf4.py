"""MDF 4.11, what measurement tools of the automotive world exchange, by asammdf.

A channel a column on the run's time, with unit and comment; codes carry their words as
value-to-text conversions; the log's lines are the file's events, at their tick exactly; scenario,
summary and log are attached as they are.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gfm_hil.recording.columns import ColumnInfo
from gfm_hil.recording.log import event_text
from gfm_hil.recording.run import Run

_ROWS = 1 << 17  # handed over at a time
_ATTACHED = {
    "scenario.toml": "application/toml",
    "summary.json": "application/json",
    "events.jsonl": "application/jsonl",
}


def write_mf4(run: Run, file: Path) -> None:
    """Write a run."""
    from asammdf import MDF, Signal

    def signal(c: ColumnInfo, rows: dict[str, NDArray[Any]]) -> Any:
        return Signal(
            rows[c.name],
            rows["t"],
            name=c.name,
            unit=c.unit,
            comment=c.comment,
            conversion=_words(c.words),
        )

    channels = [c for c in run.described if c.name != "t"]  # the group's master
    with MDF(version="4.11") as mdf:
        mdf.start_time = datetime.fromtimestamp(run.began, UTC)
        empty = {name: x[:0] for name, x in run.recorded.items()}
        for first, rows in run.blocks(_ROWS) if run.ticks else [(0, empty)]:
            if first:  # asammdf keeps what was appended in a file of its own
                mdf.extend(0, [(rows["t"], None), *((rows[c.name], None) for c in channels)])
            else:
                signals = [signal(c, rows) for c in channels]
                mdf.append(signals, comment=run.summary["title"], common_timebase=True)
        mdf.events = [_event(event, run.summary["T_s"]) for event in run.events]
        for name, mime in _ATTACHED.items():
            mdf.attach(run.text(name).encode(), name, mime=mime)
        mdf.save(file, overwrite=True, compression=2)


def _words(words: tuple[tuple[int, str], ...]) -> dict[str, Any] | None:
    if not words:
        return None
    values = {f"val_{k}": value for k, (value, _) in enumerate(words)}
    texts = {f"text_{k}": text.encode() for k, (_, text) in enumerate(words)}
    return {**values, **texts, "default": b""}


def _event(event: dict[str, Any], T_s: float) -> Any:
    """A line of the log as an event at ``tick`` times ``T_s``."""
    from asammdf.blocks import v4_constants as v4
    from asammdf.blocks.v4_blocks import EventBlock

    by_hand = event.get("by") == "operator"
    block = EventBlock(
        event_type=v4.EVENT_TYPE_MARKER,
        sync_type=v4.EVENT_SYNC_TYPE_S,
        cause=v4.EVENT_CAUSE_USER if by_hand else v4.EVENT_CAUSE_SCRIPT,
        flags=0,
        sync_base=event["tick"],
        sync_factor=T_s,
    )
    block.name, block.comment = event["event"], event_text(event)
    return block
