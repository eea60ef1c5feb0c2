"""From the options of ``gfmhil bench`` to its measurements; checks every option first."""

from __future__ import annotations

import math
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gfm_hil.benchmark import closed_loop, inproc_loop, jitter, kernel, latency
from gfm_hil.benchmark.contenders import FRAME, check_links
from gfm_hil.benchmark.cpu_load import LOADS
from gfm_hil.benchmark.pair import Policy
from gfm_hil.core.errors import UserError
from gfm_hil.realtime.environment import may_sched_fifo
from gfm_runtime import get_law, law_names

Tell = Callable[[str, float], None]
Step = Callable[[dict[str, Any], Tell], None]

_PERIOD_NS = 100_000
_STEPS = 10_000  # of the kernel in a short run
_TICKS = 2_000  # of the loop in process in a short run
_FEW_LAWS = ("mimo-gfm", "vsg-2", "droop-2")  # of the loop in `all`

#: `all` measures less of these, so that it takes three minutes
_ALL = {
    "mode": "lockstep,realtime", "load": "idle,busy", "policy": "auto", "payload": FRAME,
    "laws": None, "cflags": "-O3",
}  # fmt: skip


def steps_of(options: Namespace) -> list[Step]:
    """The measurements, in order.

    Raises:
        UserError: an option is invalid.
    """
    if options.kind == "all":
        return _everything(options)
    make = {"latency": _latency, "jitter": _jitter, "kernel": _kernel, "loop": _loop}
    return [make[options.kind](options)]


def _everything(options: Namespace) -> list[Step]:
    """Three minutes: each part ends in time, with fewer rounds if necessary."""
    begin = time.monotonic()

    def with_(**numbers: Any) -> Namespace:
        return Namespace(**{**_ALL, **vars(options), **numbers})

    few = ",".join(_FEW_LAWS)
    return [
        _latency(with_(seconds=0.1, rounds=5, until=begin + 45.0)),
        _jitter(with_(seconds=0.1, rounds=5, until=begin + 62.0)),
        _kernel(with_(rounds=2)),
        _loop(with_(mode="lockstep", seconds=3.0, rounds=5, until=begin + 115.0, laws=few)),
        _loop(with_(mode="realtime", seconds=1.5, rounds=2, until=begin + 150.0)),
    ]


def _latency(options: Namespace) -> Step:
    plan = latency.Plan(
        links=check_links(split("--links", options.links)),
        modes=split("--mode", options.mode, latency.MODES),
        loads=split("--load", options.load, LOADS),
        policy=policies(options.policy)[0],
        payload=within("--payload", options.payload, 1, 504),
        seconds=within("--seconds", options.seconds, 0.01, 60),
        rounds=within("--rounds", options.rounds, 1, 1000),
        until=getattr(options, "until", math.inf),
    )

    def step(content: dict[str, Any], tell: Tell) -> None:
        rows, remarks = latency.measure(plan, tell)
        content["results"] += rows
        content["remarks"] += remarks

    return step


def _jitter(options: Namespace) -> Step:
    plan = jitter.Plan(
        waits=list(jitter.WAITS),
        loads=split("--load", options.load, LOADS),
        policies=policies(options.policy),
        period_ns=_PERIOD_NS,
        seconds=within("--seconds", options.seconds, 0.01, 60),
        rounds=within("--rounds", options.rounds, 1, 1000),
        until=getattr(options, "until", math.inf),
    )

    def step(content: dict[str, Any], tell: Tell) -> None:
        content["jitter"] = jitter.measure(plan, tell)

    return step


def _kernel(options: Namespace) -> Step:
    names = laws(options.laws) or list(law_names())
    rounds = within("--rounds", options.rounds, 1, 1000)

    def step(content: dict[str, Any], tell: Tell) -> None:
        rows, remarks = kernel.measure(names, _STEPS, rounds, tell, options.cflags)
        content["kernel"] = rows
        content["remarks"] += remarks

    return step


def _loop(options: Namespace) -> Step:
    names = laws(options.laws) or list(inproc_loop.LAWS)
    modes = split("--mode", options.mode, latency.MODES)
    seconds = within("--seconds", options.seconds, 0.1, 3600)
    links = check_links(split("--links", options.links))
    asked = closed_loop.Plan(
        links=links,
        loads=split("--load", options.load, LOADS),
        policy=policies("auto")[0],
        lockstep_s=seconds,
        realtime_s=seconds,
        rounds=within("--rounds", options.rounds, 1, 1000),
        until=getattr(options, "until", math.inf),
    )

    def step(content: dict[str, Any], tell: Tell) -> None:
        found: dict[str, Any] = content.setdefault("loop", {})
        tell("trying the links", 0.0)
        usable, remarks = closed_loop.usable(links)
        content["remarks"] += [one for one in remarks if one not in content["remarks"]]
        plan = replace(asked, links=usable)
        if "lockstep" in modes:
            with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
                turns = plan.rounds
                found["laws"] = inproc_loop.measure(names, _TICKS, turns, Path(place), tell)
            found["lockstep"], remarks = closed_loop.measure_lockstep(plan, tell)
            content["remarks"] += remarks
        if "realtime" in modes:
            found["realtime"], remarks = closed_loop.measure_realtime(plan, tell)
            content["remarks"] += remarks

    return step


def split(option: str, text: str, allowed: Sequence[Any] | None = None) -> list[Any]:
    """Names from a comma-separated list, each once.

    Raises:
        UserError: a name is empty or not allowed.
    """
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if not name or (allowed is not None and name not in allowed):
            wanted = f"from {', '.join(allowed)}" if allowed is not None else "none empty"
            raise UserError(f"{option} {text!r}: names separated by commas, {wanted}")
    return names


def laws(text: str | None) -> list[str]:
    """Names of laws of the catalogue; none for None.

    Raises:
        LawError: an unknown one.
    """
    names = split("--laws", text) if text is not None else []
    for name in names:
        get_law(name)
    return names


def within(option: str, value: Any, low: Any, high: Any) -> Any:
    """The value, if it is in the range.

    Raises:
        UserError: it is not.
    """
    if not low <= value <= high:
        raise UserError(f"{option} {value}: must be {low} to {high}")
    return value


def policies(wanted: str) -> list[Policy]:
    """The selected policies; the best one that is permitted comes first.

    Raises:
        UserError: fifo is requested without the rights.
    """
    allowed = may_sched_fifo()
    if wanted == "fifo" and not allowed:
        raise UserError("--policy fifo: no right to SCHED_FIFO here; use other or auto")
    if wanted == "auto":
        return ["fifo", "other"] if allowed else ["other"]
    return ["fifo"] if wanted == "fifo" else ["other"]
