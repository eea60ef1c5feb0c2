"""From the options of ``gfmhil bench`` to its measurements; checks every option first."""

from __future__ import annotations

import math
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gfm_hil.bench import closed_loop, inproc_loop, jitter, kernel, latency
from gfm_hil.bench.c_code import FLAGS
from gfm_hil.bench.contenders import FRAME, check_links
from gfm_hil.bench.cpu_load import LOADS
from gfm_hil.bench.pair import Policy
from gfm_hil.bench.rounds import Plan
from gfm_hil.core.errors import UserError
from gfm_hil.realtime.environment import may_sched_fifo
from gfm_runtime import get_law, law_names

Tell = Callable[[str, float], None]
Step = Callable[[dict[str, Any], Tell], None]

_STEPS = 10_000  # of the kernel in a short run
_TICKS = 2_000  # of the loop in process in a short run
_FEW_LAWS = ("mimo-gfm", "vsg-2", "droop-2")  # of the loop in `all`

#: of options that a kind of benchmark does not have
_DEFAULTS = {
    "links": None, "mode": "lockstep,realtime", "load": "idle,busy", "policy": "auto",
    "payload": FRAME, "laws": None, "cflags": FLAGS, "seconds": 0.1, "until": math.inf,
}  # fmt: skip


def steps_of(options: Namespace) -> list[Step]:
    """The measurements, in order.

    Raises:
        UserError: an option is invalid.
    """
    if options.kind != "all":
        measure = {"latency": _latency, "jitter": _jitter, "kernel": _kernel, "loop": _loop}
        seconds = (0.1, 3600) if options.kind == "loop" else (0.01, 60)
        return [partial(measure[options.kind], _plan(options, seconds))]
    # three minutes: each part ends in time, with fewer rounds if necessary
    now, few = time.monotonic(), ",".join(_FEW_LAWS)

    def part(measure: Callable[..., None], until: float = math.inf, **numbers: Any) -> Step:
        return partial(measure, _plan(options, until=now + until, **numbers))

    return [
        part(_latency, seconds=0.1, rounds=5, until=45.0),
        part(_jitter, seconds=0.1, rounds=5, until=62.0),
        part(_kernel, rounds=2),
        part(_loop, mode="lockstep", seconds=3.0, rounds=5, until=115.0, laws=few),
        part(_loop, mode="realtime", seconds=1.5, rounds=2, until=150.0),
    ]


def _plan(options: Namespace, allowed: tuple[float, float] = (0.01, 60), **numbers: Any) -> Plan:
    """What the options ask for, with other ``numbers``; ``allowed`` is the range of a round, s."""
    given = {key: value for key, value in vars(options).items() if value is not None}
    o = Namespace(**(_DEFAULTS | given | numbers))
    return Plan(
        links=check_links(split("--links", o.links)) if o.links is not None else [],
        modes=split("--mode", o.mode, latency.MODES),
        loads=split("--load", o.load, LOADS),
        policies=policies(o.policy),
        payload=within("--payload", o.payload, 1, 504),
        laws=laws(o.laws),
        cflags=o.cflags,
        seconds=within("--seconds", o.seconds, *allowed),
        rounds=within("--rounds", o.rounds, 1, 1000),
        until=o.until,
    )


def _latency(plan: Plan, content: dict[str, Any], tell: Tell) -> None:
    rows, remarks = latency.measure(plan, tell)
    content["results"] += rows
    content["remarks"] += remarks


def _jitter(plan: Plan, content: dict[str, Any], tell: Tell) -> None:
    content["jitter"] = jitter.measure(plan, tell)


def _kernel(plan: Plan, content: dict[str, Any], tell: Tell) -> None:
    names = plan.laws or list(law_names())
    content["kernel"], remarks = kernel.measure(names, _STEPS, plan.rounds, tell, plan.cflags)
    content["remarks"] += remarks


def _loop(plan: Plan, content: dict[str, Any], tell: Tell) -> None:
    found: dict[str, Any] = content.setdefault("loop", {})
    tell("trying the links", 0.0)
    usable, remarks = closed_loop.usable(plan.links)
    content["remarks"] += [one for one in remarks if one not in content["remarks"]]
    plan = replace(plan, links=usable)
    if "lockstep" in plan.modes:
        names = plan.laws or list(inproc_loop.LAWS)
        with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
            found["laws"] = inproc_loop.measure(names, _TICKS, plan.rounds, Path(place), tell)
        found["lockstep"], remarks = closed_loop.measure_lockstep(plan, tell)
        content["remarks"] += remarks
    if "realtime" in plan.modes:
        found["realtime"], remarks = closed_loop.measure_realtime(plan, tell)
        content["remarks"] += remarks


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
