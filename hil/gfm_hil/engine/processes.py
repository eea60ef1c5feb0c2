"""Starts controllers and plant as processes, watches them to their end, and leaves none behind."""

import contextlib
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.links import link_kind
from gfm_hil.realtime.environment import available_memory
from gfm_hil.realtime.priority import processors
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.log import Outcome, read_events
from gfm_hil.recording.parts import RolePart, keep_in_memory
from gfm_hil.scenario import Scenario
from gfm_runtime import children

#: told (ticks done, misses so far); may be called a few times a second
Progress = Callable[[int, int], None]

_LOOK_S = 0.05
_SHOWN = 2000  # characters of what a foreign controller prints that refuses to start
_GRACE_S = 2.0  # time that a side gets to end, beyond link.peer_timeout_s


@dataclass
class _Process:
    """One role as a process: of the controllers of a network one for each converter.

    Attributes:
        name: for messages.
        folder: which has its log.
    """

    role: Role
    name: str
    folder: Path
    command: list[str]
    told: bool = False  # by a signal of ours to end

    @property
    def log(self) -> Path:
        """What it prints."""
        return self.folder / f"{self.role}.log"

    def start(self) -> None:
        """Start it, behind a guard that ends it with us and keeps its log short."""
        with self.log.open("wb") as log:
            self.popen = children.start(self.command, log.fileno())

    def send(self, number: signal.Signals) -> None:
        """Send it a signal while it lives."""
        if self.popen.poll() is None:
            self.told = True
            self.popen.send_signal(number)

    @property
    def crash(self) -> str:
        """How it ended, if not by itself."""
        code = self.popen.returncode
        if code < 0:
            return f"the {self.name} was ended by {signal.Signals(-code).name}"
        return f"the {self.name} failed, see {self.log}" if code not in (0, 2) else ""


def fill_in(command: Sequence[str], endpoint: str, folder: Path) -> list[str]:
    """The command of a controller for this endpoint and this run folder."""
    own = str(folder.absolute())
    return [
        word.replace("{endpoint}", endpoint)
        .replace("{scenario}", f"{own}/scenario.toml")
        .replace("{folder}", own)
        for word in command
    ]


@dataclass
class Processes:
    """One run's processes: the plant, and a controller for each converter.

    Args:
        scenario: checked; its resolved form lies in ``folder``/scenario.toml, and in the folders
            of the converters of a network.
        folder: where they record.
        progress, notice: as for ``run_scenario``.
        interrupt: set when the operator wants it to end.
        controller_commands: program and arguments to start as the controller, by converter ("" for
            that of a scenario without a network); ours if empty or not there. ``{endpoint}``,
            ``{scenario}`` and ``{folder}`` in an argument become the endpoint, the path of the
            resolved scenario and the run folder of the converter.
    """

    scenario: Scenario
    folder: Path
    progress: Progress
    notice: Callable[[str], None]
    interrupt: Interrupt
    controller_commands: Mapping[str, Sequence[str]]

    def run(self) -> tuple[float, dict[str, Outcome]]:
        """Start all, watch them to their end.

        Returns:
            When the first tick ran (``time.monotonic``), and how the run of a converter ended where
            a killed process could not say so itself, by the converter's name ("" without a
            network).

        Raises:
            UserError: a process refused to start, for example because the endpoint is occupied.
        """
        self._places = {name: self.folder / name for name in self.scenario.parts or [""]}
        recording = self._recording()
        with contextlib.ExitStack() as stack:
            endpoints = {}
            for k, name in enumerate(self._places):
                link = (self.scenario.each[name] if name else self.scenario).link
                if link.endpoint is None:  # a Unix socket's path may hold 107 bytes
                    fresh = stack.enter_context(scratch.temporary("gfmhil-run-"))
                    endpoints[name] = link_kind(link.type).fresh(fresh)
                else:
                    endpoints[name] = link.endpoint
                if self.scenario.mode == "realtime":
                    columns = ColumnSet.of(self.scenario, k)
                    keep_in_memory(self._places[name], self.scenario.ticks, self.notice, columns)
            self._say_what_starts(recording)
            self._plant = _Process("plant", "plant", self.folder, self._plant_command(endpoints))
            self._controllers = {
                name: _Process(
                    "controller", f"controller of {name}" if name else "controller", place,
                    self._controller_command(name, place, endpoints[name]),
                )
                for name, place in self._places.items()
            }  # fmt: skip
            self._all = [*self._controllers.values(), self._plant]
            started: list[_Process] = []
            try:
                for process in self._all:
                    process.start()
                    started.append(process)
                began = self._watch()
            finally:
                for process in started:
                    if process.popen.poll() is None:
                        children.end_now(process.popen)
                        process.popen.wait()
        return began, self._judge()

    def _recording(self) -> float:
        """What a run in real time records in memory, which it locks, GB; 0 in lockstep. Raises
        UserError: there is less."""
        if self.scenario.mode != "realtime":
            return 0.0
        a_tick = ColumnSet.of(self.scenario).bytes_per_tick(len(self._places))
        needed, free = self.scenario.ticks * a_tick / 1e9, available_memory() / 1e9
        if needed > free:
            raise UserError(
                f"duration = {self.scenario.duration:g}: in real time the recording takes "
                f"{needed:.1f} GB of memory, and {free:.1f} GB are free; run for a shorter time"
                + (", or record less by network.record" if self.scenario.flows else "")
            )
        return needed

    def _say_what_starts(self, recording: float) -> None:
        loops, room = len(self._places) + 1, processors()
        if self.scenario.mode == "realtime" and loops > max(room, 2):
            self.notice(
                f"{loops} loops in real time share {room} processors: they will miss more ticks"
                " than with one for each"
            )
        which = f"{loops - 1} controllers" if loops > 2 else "controller"
        lasts = ""
        if self.scenario.mode == "realtime":
            end = time.strftime("%H:%M:%S", time.localtime(time.time() + self.scenario.duration))
            lasts = f": {self.scenario.duration:g} s in real time, to about {end}; Ctrl-C ends it"
            if recording >= 1.0:
                lasts += f"; the recording takes {recording:.1f} GB of memory"
        self.notice(f"starting {which} and plant{lasts} …")

    def _ours(self, role: Role, folder: Path) -> list[str]:
        """The command of a role of ours without its endpoints."""
        folder = folder.absolute()  # a name such as "--" must not look like an option
        words = role, str(folder / "scenario.toml"), "--out", str(folder), "--quiet", "--part"
        return children.module("gfm_hil", *words)

    def _plant_command(self, endpoints: dict[str, str]) -> list[str]:
        command = self._ours("plant", self.folder)
        for name, endpoint in endpoints.items():
            command += ["--endpoint", f"{name}={endpoint}" if name else endpoint]
        return command

    def _controller_command(self, name: str, folder: Path, endpoint: str) -> list[str]:
        if not (command := self.controller_commands.get(name)):
            return [*self._ours("controller", folder), "--endpoint", endpoint]
        return fill_in(command, endpoint, folder)

    def _watch(self) -> float:
        """Wait until all have ended; stop and then kill a process that takes too long.

        A side ends by itself when the other one says goodbye or falls silent, but not while it
        still waits for its handshake. The plant of a network goes on without a controller.
        """
        part, began = None, time.monotonic()
        stop_at = kill_at = float("inf")
        ended: list[_Process] = []
        told = False
        first = next(iter(self._places.values()))
        while len(ended) < len(self._all):
            time.sleep(_LOOK_S)
            now = time.monotonic()
            part = part or RolePart.open(first, "plant")
            if part is not None:
                if int(part.progress[0]) == 0:
                    began = now
                self.progress(int(part.progress[0]), int(part.progress[1]))
            for process in self._all:
                if process not in ended and process.popen.poll() is not None:
                    ended.append(process)
                    if process.crash and not self.interrupt.came:
                        self.notice(process.crash)
                    at_once, rests = self._ends_all(process, part)
                    if at_once or rests:
                        wait = self.scenario.peer_timeout_s + _GRACE_S
                        stop_at = min(stop_at, now if at_once else now + wait)
            if not told and (self.interrupt.came or now >= stop_at):
                self._send(signal.SIGINT)
                told, kill_at = True, now + _GRACE_S
            if now >= kill_at:
                for process in self._all:
                    children.end_now(process.popen)
        return began

    def _ends_all(self, ended: _Process, part: RolePart | None) -> tuple[bool, bool]:
        """Whether the end of a process ends the run at once, or once the others had their time."""
        code, network = ended.popen.returncode, bool(self.scenario.parts)
        begun = part is not None and int(part.progress[0]) > 0
        left = [process for process in self._all if process.popen.poll() is None]
        alone = ended is self._plant or left in ([], [self._plant])
        return code == 2 or (code > 0 and not network), alone or not begun

    def _send(self, number: signal.Signals) -> None:
        for process in self._all:
            process.send(number)

    def _judge(self) -> dict[str, Outcome]:
        said = [
            (process, process.log.read_text("utf-8", "replace").strip()) for process in self._all
        ]
        refused = [text for process, text in said if process.popen.returncode == 2]
        if refused:
            last = (f"\n{text}".rpartition("\ngfmhil: ")[2].strip() for text in refused)
            raise UserError("\n".join(text[-_SHOWN:] for text in last))
        for process, text in said:
            if not text:
                process.log.unlink()
        found = {}
        for name, controller in self._controllers.items():
            crashed = [process for process in (controller, self._plant) if process.crash]
            first = [process for process in crashed if not process.told]
            crashes = [process.crash for process in first or crashed]
            if crashes and self.interrupt.came:
                found[name] = Outcome("interrupted", "stopped by the operator", 0)
            elif first or (crashes and not self._says_why(name)):
                found[name] = Outcome("safe", "; ".join(crashes), 0)
        return found

    def _says_why(self, name: str) -> bool:
        """Whether a role recorded why the run of a converter did not complete. That counts before
        our signal, which ended a process that was left over."""
        lines = read_events(self._places[name], self.scenario.ticks)
        return any(e["event"] == "end" and e["status"] != "completed" for e in lines)
