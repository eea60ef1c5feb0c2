"""The list of metrics, for the server and the documentation."""

from __future__ import annotations

from dataclasses import dataclass

from gfm_hil.recording.timing import ROUND_TRIP, SLACK


@dataclass(frozen=True)
class About:
    """A metric's label, if any, and a short description."""

    label: str
    text: str


METRICS = {
    "gfmhil_ticks_total": About("role", "ticks recorded"),
    "gfmhil_misses_total": About("", "ticks without a fresh u at the plant"),
    "gfmhil_slack_seconds": About("quantile", f"{SLACK.meaning}; in real time"),
    "gfmhil_round_trip_seconds": About("quantile", ROUND_TRIP.meaning),
    "gfmhil_state": About("state", "1 for the state of the controller, 0 for others"),
    "gfmhil_law_info": About("law", "the law in force"),
    "gfmhil_reason_info": About("reason", "why the controller is in SAFE"),
    "gfmhil_trip_info": About("trip", "what has tripped"),
}
