"""The setting of a test: its initial scenario, changed by the test and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.scenario import INPROC, Scenario, load_scenario

_PLAIN = "pref_step"  # used for its grid and converter; its step is dropped


class Unfit(UserError):
    """The test cannot run over the link of the command line."""


@dataclass(frozen=True)
class Setting:
    """One test's bench before its steps.

    Attributes:
        scenario: checked, with its own events.
        controller_command: program and arguments of the user's controller process, or empty;
            ``{endpoint}`` and ``{scenario}`` in it are replaced.
        near: folder that is searched first for files.
    """

    scenario: Scenario
    controller_command: tuple[str, ...]
    near: Path

    @property
    def realtime(self) -> bool:
        """Whether the run is in real time."""
        return self.scenario.mode == "realtime"


def beside(near: Path, name: str) -> str:
    """The path of a file beside the test, or the name unchanged: a path or a catalogue name."""
    found = near / name
    return str(found) if found.is_file() else name


def make_setting(
    near: Path,
    scenario: str | None = None,
    *,
    law: str | None = None,
    link: str | None = None,
    mode: str | None = None,
    controller_command: Sequence[str] = (),
    link_wanted: str | None = None,
    **changed: Any,
) -> Setting:
    """Read and check the setting of a test.

    Args:
        near: folder of the test, searched first for scenario and law files.
        scenario: shipped name or file; by default the paper's grid and converter, without events.
        law, link, mode: by default the scenario's law, in process, lockstep.
        controller_command: of the user's controller; the link is then zmq by default.
        link_wanted: link of the command line; replaces the test's link.
        changed: any other key of a scenario by its path with ``__`` for the dot, for example
            ``references__P_ref=0.2`` or ``events=[]``.

    Raises:
        UserError: one line per mistake. ``Unfit`` if only ``link_wanted`` does not fit the test.
    """
    chosen = link or ("zmq" if controller_command else INPROC)
    if controller_command and chosen == INPROC:
        raise UserError("link = 'inproc': a controller_command is a process, which needs a link")
    if link_wanted not in (None, chosen):
        if controller_command:
            raise Unfit(f"the controller of this test is a process that talks {chosen}")
        if link_wanted == INPROC and mode == "realtime":
            raise Unfit("this test is about real time, which a run in process has not")
        if chosen != INPROC:  # they belong to the test's link
            changed = {k: v for k, v in changed.items() if not k.startswith("link__")}
        chosen = str(link_wanted)
    if scenario is None:
        changed = {"events": [], "title": "on the paper's grid", **changed}
    loaded = load_scenario(
        beside(near, scenario or _PLAIN),
        law=None if law is None else beside(near, law),
        link__type=chosen,
        mode=mode or "lockstep",
        **changed,
    )
    return Setting(loaded, tuple(map(str, controller_command)), near)
