"""The options of ``gfmhil bench``, checked, and the measurements that they ask for."""

import math
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from gfm_hil.bench.c_code import FLAGS
from gfm_hil.bench.contenders import FRAME, PEERS, missing_packages
from gfm_hil.bench.cpu_load import EVERY, LOADS, Load
from gfm_hil.bench.pair import Policy
from gfm_hil.bench.rounds import ShowProgress
from gfm_hil.core.errors import UserError
from gfm_hil.links import link_kind, link_names
from gfm_hil.realtime.environment import may_sched_fifo
from gfm_runtime import get_law

Mode = Literal["lockstep", "realtime"]
MODES: tuple[Mode, ...] = ("lockstep", "realtime")
#: each is a module with ``measure(options, content, show)``, which adds to the result's content
KINDS = ("latency", "jitter", "kernel", "loop", "sweep")
#: longest message of a sweep, bytes: the most of UDP is 65,507
_PAYLOADS, _RATES_KHZ = (1, 65507), (0.01, 100.0)

_SECONDS = {"loop": (0.1, 3600)}  # of a round, where others than the usual ones are allowed
_FEW_LAWS = "mimo-gfm,vsg-2,droop-2"  # of the loop in `all`
Measurement = Callable[[dict[str, Any], ShowProgress], None]


@dataclass(frozen=True)
class BenchOptions:
    """What to measure; a benchmark uses those that concern it."""

    links: Sequence[str]  # names
    peers: Sequence[str]  # names of what one would pick instead of a link
    modes: Sequence[Mode]  # lockstep: one round trip after the other; realtime: one every 100 µs
    loads: Sequence[Load]  # idle, or busy: with a CPU load on each processor
    policies: Sequence[Policy]  # scheduling of the two processes, the best one first
    payload: int  # bytes of a request; ``FRAME`` means the bench's frames, 64 there and 48 back
    payloads: Sequence[int]  # bytes of a message of a sweep
    rates: Sequence[float]  # kHz, of a sweep, ascending
    waits: Sequence[str]  # of a sweep: how the sender waits for its deadline
    most_missed_pct: float  # at the highest rate of a sweep
    laws: Sequence[str]  # names; none: the benchmark's own choice
    cflags: str  # for the C compiler
    seconds: float  # of one round
    rounds: int  # of each; fewer if they would not end by ``until`` (``time.monotonic``)
    until: float
    to: tuple[str, str | None] | None = None  # who answers elsewhere, and its name in the tables
    option: Sequence[tuple[str, Any]] = ()  # of the link to it
    ports: Path | None = None  # map of a controller's ports
    for_s: float = 0.0  # a night: so long, in blocks of block_s, to a folder; 0: rounds
    block_s: float = 10.0
    folder: Path = Path()
    resume: bool = False
    ptp_us: float = 0.0  # how far CLOCK_TAI may be off here; 0: nobody says


def measurements(options: Namespace) -> list[Measurement]:
    """The measurements that the command's options ask for, in order. Raises UserError: an option is
    invalid."""
    given = {k: v for k, v in vars(options).items() if v is not None}

    def part(kind: str, **changes: Any) -> Measurement:
        checked = _check(kind, given | changes)
        return partial(import_module(f"{__package__}.{kind}").measure, checked)

    if options.kind in KINDS:
        return [part(options.kind)]
    # three minutes: each part ends in time, with fewer rounds if necessary
    now = time.monotonic()
    return [
        part("latency", seconds=0.1, rounds=5, until=now + 45),
        part("jitter", seconds=0.1, rounds=5, until=now + 62),
        part("kernel", rounds=2),
        part("loop", mode="lockstep", seconds=3.0, rounds=5, until=now + 115, laws=_FEW_LAWS),
        part("loop", mode="realtime", seconds=1.5, rounds=2, until=now + 150),
    ]


def _check(kind: str, options: dict[str, Any]) -> BenchOptions:
    of, far = options.get, "to" in options
    links = _split("--links", of("links", None if far else ",".join(link_names())) or None)
    try:
        for name in links:
            link_kind(name)
    except ValueError as problem:
        raise UserError(f"--links: {problem}") from None
    return BenchOptions(
        links=links,
        peers=_peers(of("peers", "none" if far else "installed")),
        modes=_split("--mode", of("mode"), MODES) or MODES,
        loads=_split("--load", of("load"), EVERY if kind == "sweep" else LOADS) or LOADS,
        policies=policies(of("policy", "auto")),
        payload=_within("--payload", of("payload", FRAME), 1, 504),
        payloads=_numbers("--payloads", of("payloads", "64"), int, *_PAYLOADS),
        rates=_numbers("--rates", of("rates", "10"), float, *_RATES_KHZ),
        waits=_split("--wait", of("wait", "both"), ("both", "spin", "sleep")),
        most_missed_pct=_within("--missed", of("missed", 1.0), 0.0, 100.0),
        laws=[get_law(name).name for name in _split("--laws", of("laws"))],
        cflags=of("cflags", FLAGS),
        seconds=_within("--seconds", of("seconds", 0.1), *_SECONDS.get(kind, (0.01, 60))),
        rounds=_within("--rounds", of("rounds"), 1, 1000),
        until=of("until", math.inf),
        to=(options["to"], of("as_name")) if far else None,
        option=of("option", ()),
        ports=of("map"),
        for_s=_within("--for", of("for_s", 0.0), 0.0, 1e7),
        block_s=_within("--block", of("block", 10.0), 0.1, 3600.0),
        folder=of("folder", Path()),
        resume=of("resume", False),
        ptp_us=_within("--ptp", of("ptp", 0.0), 0.0, 1e6),
    )


def _peers(text: str) -> list[str]:
    """Names of peers that are installed: all, none, or those of a list."""
    if text == "installed":
        return [name for name in PEERS if not missing_packages(name)]
    names = [] if text == "none" else _split("--peers", text, tuple(PEERS))
    for name in names:
        if missing := missing_packages(name):
            raise UserError(
                f"--peers {name}: needs {' and '.join(missing)}: pip install 'gfmhil[bench]'"
            )
    return names


def _split(option: str, text: str | None, allowed: Sequence[Any] | None = None) -> list[Any]:
    """Names from a comma-separated list, each once; none for None."""
    if text is None:
        return []
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if not name or (allowed is not None and name not in allowed):
            wanted = f"from {', '.join(allowed)}" if allowed is not None else "none empty"
            raise UserError(f"{option} {text!r}: names separated by commas, {wanted}")
    return names


def _numbers(option: str, text: str, kind: type, low: Any, high: Any) -> list[Any]:
    """Numbers from a comma-separated list, in ascending order."""
    try:
        values = sorted({kind(word) for word in text.split(",")})
    except ValueError:
        whole = "whole numbers" if kind is int else "numbers"
        raise UserError(f"{option} {text!r}: {whole} separated by commas") from None
    return [_within(option, value, low, high) for value in values]


def _within(option: str, value: Any, low: Any, high: Any) -> Any:
    if not low <= value <= high:
        raise UserError(f"{option} {value}: must be {low} to {high}")
    return value


def policies(wanted: str) -> list[Policy]:
    """The selected policies; the best one that is permitted comes first."""
    allowed = may_sched_fifo()
    if wanted == "fifo" and not allowed:
        raise UserError("--policy fifo: no right to SCHED_FIFO here; use other or auto")
    every: list[Policy] = ["fifo", "other"] if allowed else ["other"]
    return every if wanted == "auto" else [one for one in every if one == wanted]
