"""Starts controller and plant as processes, watches them to their end, and leaves none behind."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.links import link_kind
from gfm_hil.recording.log import Outcome
from gfm_hil.recording.parts import Part, keep_in_memory
from gfm_hil.scenario.model import Scenario

#: told (ticks done, misses so far); may be called a few times a second
Progress = Callable[[int, int], None]

_LOOK_S = 0.05
_GRACE_S = 2.0  # time that a side gets to end, beyond link.peer_timeout_s


@dataclass
class Processes:
    """One run's two processes.

    Args:
        scenario: checked; its resolved form lies in ``folder``/scenario.toml.
        folder: where both record.
        progress, notice: as for ``run_scenario``.
        interrupt: set when the operator wants it to end.
        controller_command: program and arguments to start as the controller; ours if empty.
            ``{endpoint}`` and ``{scenario}`` in an argument become the endpoint and the path of
            the resolved scenario.
    """

    scenario: Scenario
    folder: Path
    progress: Progress
    notice: Callable[[str], None]
    interrupt: Interrupt
    controller_command: tuple[str, ...] = ()

    def run(self) -> tuple[float, Outcome | None]:
        """Start both, watch them to their end.

        Returns:
            When the first tick ran (``time.monotonic``), and how a killed side ended that could not
            say so itself.

        Raises:
            UserError: a side refused to start, for example because the endpoint is occupied.
        """
        with contextlib.ExitStack() as stack:
            endpoint = self.scenario.link.endpoint
            if endpoint is None:  # a Unix socket's path may hold 107 bytes, so not the run folder
                place = stack.enter_context(scratch.temporary("gfmhil-run-"))
                endpoint = link_kind(self.scenario.link.type).fresh(place)
            if self.scenario.mode == "realtime":
                keep_in_memory(self.folder, self.scenario.ticks, self.notice)
            self.notice("starting controller and plant …")
            self._told: set[Role] = set()  # by a signal of ours to end
            self._roles = {role: self._start(role, endpoint) for role in ROLES}
            try:
                began = self._watch()
            finally:
                for process in self._roles.values():
                    if process.poll() is None:
                        process.kill()
                        process.wait()
        return began, self._judge()

    @property
    def _interrupted(self) -> Outcome:
        return Outcome("interrupted", "stopped by the operator", 0)

    def _start(self, role: Role, endpoint: str) -> subprocess.Popen[bytes]:
        folder = self.folder.absolute()  # a name such as "--" must not look like an option
        scenario = str(folder / "scenario.toml")
        # -P: a file of the operator's folder must not stand in for a module
        command = [sys.executable, "-P", "-m", "gfm_hil", role, scenario]
        command += ["--endpoint", endpoint, "--out", str(folder), "--quiet"]
        command += ["--part", str(os.getpid())]
        if role == "controller" and self.controller_command:
            command = [
                argument.replace("{endpoint}", endpoint).replace("{scenario}", scenario)
                for argument in self.controller_command
            ]
        with self._log(role).open("wb") as log:
            try:
                # a session of its own: Ctrl-C reaches the process through us, once
                return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            except OSError as problem:
                raise UserError(f"{command[0]}: cannot be started: {problem.strerror}") from None

    def _log(self, role: Role) -> Path:
        return self.folder / f"{role}.log"

    def _watch(self) -> float:
        """Wait until both have ended; stop and then kill a side that takes too long.

        A side ends by itself when the other one says goodbye or falls silent, but not while it
        still waits for its handshake.
        """
        part, began = None, time.monotonic()
        stop_at = kill_at = float("inf")
        ended: list[Role] = []
        told = False
        while len(ended) < len(self._roles):
            time.sleep(_LOOK_S)
            now = time.monotonic()
            part = part or Part.open(self.folder, "plant")
            if part is not None:
                if int(part.progress[0]) == 0:
                    began = now
                self.progress(int(part.progress[0]), int(part.progress[1]))
            for role, process in self._roles.items():
                if role not in ended and process.poll() is not None:
                    ended.append(role)
                    if self._crash(role) and not self.interrupt.came:
                        self.notice(self._crash(role))
                    wait = self.scenario.link.peer_timeout_s + _GRACE_S
                    stop_at = min(stop_at, now + wait if process.returncode <= 0 else now)
            if not told and (self.interrupt.came or now >= stop_at):
                self._send(signal.SIGINT)
                told, kill_at = True, now + _GRACE_S
            if now >= kill_at:
                self._send(signal.SIGKILL)
        return began

    def _send(self, number: signal.Signals) -> None:
        for role, process in self._roles.items():
            if process.poll() is None:
                self._told.add(role)
                process.send_signal(number)

    def _crash(self, role: Role) -> str:
        """How a side ended that did not end by itself."""
        code = self._roles[role].returncode
        if code < 0:
            return f"the {role} was ended by {signal.Signals(-code).name}"
        return f"the {role} failed, see {self._log(role)}" if code not in (0, 2) else ""

    def _judge(self) -> Outcome | None:
        said = {role: self._log(role).read_text("utf-8").strip() for role in ROLES}
        refused = [said[s] for s, process in self._roles.items() if process.returncode == 2]
        if refused:
            raise UserError("\n".join(text.removeprefix("gfmhil: ") for text in refused))
        for role, text in said.items():
            if not text:
                self._log(role).unlink()
        crashed = [role for role in ROLES if self._crash(role)]
        first = [role for role in crashed if role not in self._told]  # not by our own signal
        crashes = [self._crash(role) for role in first or crashed]
        if crashes and self.interrupt.came:
            return self._interrupted
        return Outcome("safe", "; ".join(crashes), 0) if crashes else None
