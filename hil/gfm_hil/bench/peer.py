"""``gfmhil bench latency --to``: a controller on another machine, a program, a DLL or FMU.

This side is a plant without a plant: its y is that of the operating point, and does not answer to
u. The other side is ``gfmhil bench answer``, or any controller of docs/own-controller.md.
"""

import ctypes
import re
import socket
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.bench import datagram
from gfm_hil.bench.contenders import ELSEWHERE, Contender
from gfm_hil.bench.contenders.ours import SHM, UDP, ZMQ_IPC, ZMQ_TCP
from gfm_hil.bench.exchange import GONE, LEFT, OTHER, SILENT, answer_all, frames, send_all
from gfm_hil.bench.one_way import ANSWERED, DUE, HEARD, RECEIVED, SENT, delays
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.pingpong import Messages, Numbers, PingPong
from gfm_hil.controllers import FORMS
from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.roles import Role
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.drive import end_exchange, send_last
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.engine.processes import fill_in
from gfm_hil.engine.setup import make_bench
from gfm_hil.links import Link, link_kind, link_names
from gfm_hil.links.base import LinkKind, LinkOptions
from gfm_hil.links.frame import FrameReader, FrameWriter
from gfm_hil.links.pump import with_port
from gfm_hil.realtime import priority
from gfm_hil.run.runner import controller_program
from gfm_hil.scenario import Scenario, check_scenario, write_scenario
from gfm_plant import plant_sample
from gfm_runtime.children import end_now, guarded
from gfm_runtime.signals import NU, NY
from gfm_runtime.states import STOPPED

ANSWERER = "gfmhil bench answer"
_LAW, _STAGE = "vsg-2", "virtual-stator"
_TICKS = 600_000  # exchanges at most with a controller that the bench starts: it records each
_MOST = 1 << 20  # exchanges of a round
_LOST_NS = 100_000_000  # after which an answer counts as lost
_SILENCE_NS = 20_000_000_000
_START_S, _WEEK_S, _POLL_S = 30.0, 604800.0, 0.1
_LIMITS = {"shm": SHM, "zmq": ZMQ_TCP, "udp": UDP, "can": UDP}
_CLOCK_TAI = 11
_UNSYNCHRONISED = 0x40  # STA_UNSYNC of adjtimex(2)


def _link_of(endpoint: str, options: dict[str, Any], named: str) -> tuple[LinkKind, LinkOptions]:
    """The link that has such endpoints, and its options, checked. Raises UserError: none has, or
    they are wrong; ``named``: what the user calls it."""
    kinds = [*map(link_kind, link_names()), datagram.KIND]
    for kind in kinds:
        if re.fullmatch(kind.pattern, endpoint):
            try:
                return kind, kind.checked(endpoint, options)
            except ValueError as problem:
                raise UserError(f"{named}: {problem}") from None
    forms = ", ".join(kind.form for kind in kinds)
    raise UserError(f"{endpoint}: must be {forms}, or a controller: {FORMS}")


def _open_end(role: Role, endpoint: str, options: dict[str, Any]) -> Link:
    """One end of the link that has such endpoints. Raises UserError: it cannot be opened."""
    kind, checked = _link_of(endpoint, options, "link")
    return kind.open(role, endpoint, checked)


def scenario_of(inner: bool = False, **link: Any) -> Scenario:
    """What both sides compare at the start: the scenario of the bench's exchanges; ``link``: what
    this side has otherwise in its link, which they do not compare."""
    content: dict[str, Any] = {
        "title": "gfmhil bench latency", "duration": _TICKS * 1e-4, "T_s": 1e-4, "law": _LAW,
        "mode": "lockstep", "link": {"type": "shm", "start_timeout_s": _START_S,
                                     "peer_timeout_s": 60.0},
    }  # fmt: skip
    scenario = check_scenario(content | ({"inner": _STAGE} if inner else {}), "bench")
    return scenario.model_copy(update={"link": scenario.link.model_copy(update=link)})


def peer_of(bench: BenchOptions, place: Path) -> Contender:
    """The contender that answers at the endpoint ``bench.to``, or is the controller ``KIND:NAME``;
    ``place`` is for an endpoint of our own. Raises UserError: neither, or nothing can be reached
    there."""
    assert bench.to is not None
    to, name = bench.to
    link, ports = dict(bench.option), bench.ports
    more: dict[str, Any] = {"link": link, "ptp_us": bench.ptp_us, "program": None, "inner": False}
    if bench.ptp_us:
        tai_offset(bench.ptp_us)
    if to.partition(":")[0] in ("dll", "fmu", "c", "pil"):
        folder = place / "controller"
        folder.mkdir()
        more |= _controller(to, ports, folder)
        return Contender(name or to, "shm", more["endpoint"], _open, ELSEWHERE, more, SHM)
    kind, _ = _link_of(to, link, "--to")
    if ports is not None:
        raise UserError(f"--map {ports}: is for a controller {FORMS}; {to} is an endpoint")
    _check_route(to)
    limit = ZMQ_IPC if to.startswith("ipc:") else _LIMITS.get(kind.name, "")
    return Contender(name or to, kind.name, to, _open, ELSEWHERE, more, limit)


def _controller(model: str, ports: Path | None, folder: Path) -> dict[str, Any]:
    """What is to be known of a controller that the bench starts: its ``program``, whether its laws
    have an ``inner`` stage, its ``endpoint`` and its ``log``. Raises UserError: there is none such.
    """
    inner = model.startswith("c:")
    scenario = scenario_of(inner)
    words = controller_program(scenario, model, ports, lambda text: None)
    write_scenario(folder, scenario)
    endpoint = link_kind("shm").fresh(folder)
    words = fill_in(words, endpoint, folder)
    return {"program": words, "inner": inner, "endpoint": endpoint, "log": folder / "log"}


def _check_route(endpoint: str) -> None:
    """See that a host has an address and a route. Raises UserError: it has none."""
    network = re.fullmatch(r"(?:tcp|udp)://(.+):(\d+)", endpoint)
    if network is None:
        return
    try:
        family, *_, address = socket.getaddrinfo(network[1].strip("[]"), int(network[2]))[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(address)  # sends nothing
    except (OSError, OverflowError) as problem:
        raise UserError(f"{endpoint}: no route: {getattr(problem, 'strerror', problem)}") from None


def tai_offset(ptp_us: float) -> int:
    """CLOCK_TAI less CLOCK_MONOTONIC, ns, of a machine whose clock follows PTP. Raises UserError:
    the kernel does not know TAI, or says that its clock follows none."""
    timex = (ctypes.c_long * 64)()
    ctypes.CDLL(None).adjtimex(timex)
    # struct timex: modes, offset, freq, maxerror, esterror, status, …
    where = f"--ptp {ptp_us:g}"
    if timex[5] & _UNSYNCHRONISED:
        raise UserError(f"{where}: the kernel's clock follows none (adjtimex: STA_UNSYNC)")
    if abs(time.clock_gettime_ns(_CLOCK_TAI) - time.time_ns()) < 1_000_000_000:
        raise UserError(f"{where}: CLOCK_TAI is UTC here: ptp4l or phc2sys sets its offset")
    readings = []
    for _ in range(20):
        before = time.monotonic_ns()
        tai = time.clock_gettime_ns(_CLOCK_TAI)
        after = time.monotonic_ns()
        readings.append((after - before, tai - (before + after) // 2))
    return min(readings)[1]  # of the quickest pair


class _Caller:
    """The side that sends y; ``ping`` of a ``PingPong``."""

    def __init__(self, c: Contender) -> None:
        more, inner = c.options, c.options["inner"]
        scenario = scenario_of(inner, endpoint=c.endpoint)
        bench = make_bench(scenario)
        plant_sample(bench.plant.records, 0, bench.y)
        self._name, self._values = c.name, bench.y
        self._good = _open_end("plant", c.endpoint, more["link"])
        try:
            start = shake_hands("plant", self._good, scenario, lambda: False, lambda text: None)
        except PeerLost as problem:
            self._good.close()
            said = Path(more["log"]).read_text("utf-8").split("gfmhil: ") if "log" in more else [""]
            raise UserError(f"{c.name}: {said[-1].strip() or problem}") from None
        self._reads_clocks = start.controller == ANSWERER
        self._y, self._u = frames("y", inner), frames("u", inner, clocks=True)
        self._tick, self._one_clock, self._ptp_us = 0, start.one_clock, more["ptp_us"]
        self._stamps = np.zeros((_MOST, 5), np.int64)
        self._most = _TICKS if more["program"] else 2**62
        self.link = with_port(self._good)
        getattr(self.link, "start", _nothing)()
        self.sides: dict[str, Any] = {}

    def ping(self, stop: Numbers, period_ns: int, duration_ns: int, took: Numbers) -> int:
        """One round. Raises UserError: the other side left, or the link is gone."""
        port, stamps = self.link.port, self._stamps[: min(len(took), self._most - self._tick)]
        assert port is not None
        port.paced(period_ns > 0)
        n = send_all(
            port.handle, port.send, port.receive, port.spins, self._y, self._u, self._values,
            period_ns, _LOST_NS, duration_ns, self._tick, stamps,
        )  # fmt: skip
        if n in (LEFT, GONE):
            why = "it is in its safe state, or has left" if n == LEFT else "the link is gone"
            raise UserError(f"{self._name}: answers no more: {why}")
        self._tick += n
        done = stamps[:n][stamps[:n, RECEIVED] >= 0]
        took[: len(done)] = done[:, RECEIVED] - done[:, DUE]
        self.sides = self._delays(stamps[:n])
        return len(done)

    def _delays(self, stamps: Numbers) -> dict[str, Any]:
        if not self._reads_clocks:
            stamps[:, HEARD : ANSWERED + 1] = -1
        error_ns = float(self._u.record["values"][0, 2])  # in its newest answer
        if not (self._reads_clocks and error_ns and self._ptp_us):
            return delays(stamps, self._one_clock)
        offset = tai_offset(self._ptp_us)
        for column in (SENT, RECEIVED):
            stamps[:, column] += np.where(stamps[:, column] >= 0, offset, 0)
        return delays(stamps, False, 1e3 * self._ptp_us + error_ns)

    def close(self) -> None:
        """Say goodbye, and wait for the other side's."""
        getattr(self.link, "stop", _nothing)()
        writer = FrameWriter("y", len(self._values) > NY)
        writer.sequence[:] = self._y.sequence
        reader = FrameReader("u", len(self._values) > NY)
        end_exchange(self._good, writer, reader, self._tick, STOPPED, 0, self._values)
        self._good.close()


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    """The plant's end calls; the controller's end is elsewhere, or is started here."""
    if role == "controller":
        close = _start(c) if c.options["program"] else _nothing
        return PingPong(_nothing, _nothing, close, True)
    caller = _Caller(c)
    compiled = caller.link is caller._good
    return PingPong(caller.ping, _nothing, caller.close, compiled, lambda: caller.sides)


def _nothing(*_: Any) -> Any:
    """What an end without loops of its own does."""


def _start(c: Contender) -> Callable[[], None]:
    """Start the controller of a contender on our processor, as the other side's spins; returns what
    ends it."""
    with Path(c.options["log"]).open("wb") as log:
        process = subprocess.Popen(
            guarded(c.options["program"], bounded=True), stdout=log, stderr=log,
            start_new_session=True, preexec_fn=priority.leave_real_time,
        )  # fmt: skip

    def close() -> None:
        end_now(process)
        process.wait()

    return close


def answer(
    endpoint: str, options: dict[str, Any], ptp_us: float, fifo: bool, say: Callable[[str], None]
) -> None:
    """Answer one bench after another at an endpoint, until a signal comes. Raises UserError: the
    endpoint cannot be used.

    Args:
        endpoint, options: of the link.
        ptp_us: how far CLOCK_TAI of this machine may be off; 0: nobody says.
        fifo: ask for the priority of a run in real time.
        say: receives each line of progress.
    """
    tai_ns = tai_offset(ptp_us) if ptp_us else 0
    with closing(datagram.UdpLink("controller", "udp://0.0.0.0:0")) as nobody:
        _answer_all(nobody, 0, 0.0, np.ones(1, np.int64))  # compiles: no bench would wait for it
    scenario = scenario_of(start_timeout_s=_WEEK_S, endpoint=endpoint)
    with Interrupt() as interrupt:
        while not interrupt.came:
            (priority.ask_for_real_time if fifo else priority.own_processor)("controller")
            link = _open_end("controller", endpoint, options)
            say(f"answering at {endpoint}; Ctrl-C ends it")
            try:
                shake_hands(
                    "controller", link, scenario, lambda: interrupt.came, lambda text: None,
                    name=ANSWERER,
                )  # fmt: skip
                say("a bench has begun")
                say(_answer_one(with_port(link), tai_ns, 1e3 * ptp_us, interrupt))
            except PeerLost as problem:
                if not interrupt.came:
                    say(str(problem))
            finally:
                link.close()


def _answer_all(link: Link, tai_ns: int, error_ns: float, stop: Numbers) -> int:
    port, clocks = link.port, np.array([0, 0, int(error_ns)])
    assert port is not None
    return int(
        answer_all(
            port.handle, port.send, port.receive, port.spins, frames("y"),
            frames("u", clocks=True), clocks, tai_ns, _SILENCE_NS, stop,
        )
    )  # fmt: skip


def _answer_one(link: Link, tai_ns: int, error_ns: float, interrupt: Interrupt) -> str:
    """Answer until the bench ends; returns how it did."""
    stop = np.zeros(1, np.int64)
    getattr(link, "start", _nothing)()
    with ThreadPoolExecutor(1) as pool:
        answering = pool.submit(_answer_all, link, tai_ns, error_ns, stop)
        priority.restore_priority()
        while wait([answering], _POLL_S).not_done:
            stop[0] = interrupt.came
    getattr(link, "stop", _nothing)()
    if answering.result() == LEFT:  # the bench waits for our last frame
        send_last(link, FrameWriter("u"), 0, STOPPED, 0, np.zeros(NU))
    return {
        LEFT: "the bench has ended", GONE: "the link is gone", OTHER: "another bench begins",
        SILENT: f"the bench has said nothing for {_SILENCE_NS * 1e-9:g} s", 0: "stopped",
    }[answering.result()]  # fmt: skip
