"""One law of the comparison from its file to its row: search, law file, sampled loop, bench."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfm_design.margins.tolerance import End, Range
from gfm_design.model.closed_loop import LeastStable
from gfm_design.norms.performance import WeightedChannel
from gfm_hil.api.design import channels_as_json, write_law
from gfm_hil.results.report import finite
from gfm_runtime import law_file
from law_comparison.experiments import EXPERIMENTS, experiment
from law_comparison.search import ALPHA, Found, as_it_is, late_loop, search, stands

#: laws without a row, and why
LEFT_OUT = {
    "mimo-gfm-scheduled": "on the paper's grid its first stage is in force, which is mimo-gfm",
    "mimo-gfm-deployable-rig": "for a regulated source; its row 1 is the paper's",
    "mimo-gfm-practical": "mimo-gfm-deployable for a converter with a current limit",
    "mimo-gfm-ride-through": "mimo-gfm-practical with gains for large signals",
}

Row = dict[str, Any]
_MIMO = "mimo-gfm"
Tell = Callable[[str, int, float], None]  # law, evaluations done, least gamma so far


def as_shipped(name: str) -> bool:
    """MIMO-GFM with gains for another purpose: not searched, as freed it would be MIMO-GFM."""
    return name != _MIMO and law_file(name).phi == law_file(_MIMO).phi


@dataclass(frozen=True)
class Job:
    """What decides a row."""

    law: str
    seed: int
    evaluations: int
    starts: int | None

    def digest(self) -> str:
        """Hash over the law's contents, the search and the version."""
        content = [law_file(self.law).model_dump(), asdict(self), version("gfmhil")]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def make_row(job: Job, folder: Path, tell: Tell) -> Row:
    """A law's row as plain data; its tuned gains go to ``folder``/laws/NAME-tuned.toml."""
    file = law_file(job.law)
    row: Row = {"law": job.law, "title": file.title, "digest": job.digest(), "seed": job.seed}
    if as_shipped(job.law):
        found = as_it_is(file)
    else:
        found = search(
            file,
            job.seed,
            job.evaluations,
            job.starts,
            lambda done, best: tell(job.law, done, best),
        )
    row |= _found(found)
    row["order"] = late_loop(file, found.gains or {}).made_of.law.order
    if found.gains is None:
        return row
    loop = stands(file, found.gains)
    row |= {
        "sigma": loop.sigma,
        "worst": loop.worst.plain(),
        "delay_us": finite(1e6 * loop.delay.seconds),  # null: more than was looked at
        "delay_hz": finite(loop.delay.frequency_hz),
        "L_g": _range(loop.L_g),
        "R": _range(loop.R),
    }
    name = job.law
    if not as_shipped(job.law):
        path = folder / "laws" / f"{job.law}-tuned.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_law(path, file, found.gains, row, _notes(job, row), "python -m law_comparison")
        name = str(path)
    row["bench"] = {kind: experiment(kind, name) for kind in EXPERIMENTS}
    return row


def _found(found: Found) -> Row:
    return {
        "free": list(found.free),
        "before": _channels(found.before),
        "ideal": _channels(found.ideal),
        "gains": found.gains,
        "fixed": [list(pair) for pair in found.fixed],
        "evaluations": found.evaluations,
        "seconds": found.seconds,
        **_channels(found.after),
    }


def _channels(found: Sequence[WeightedChannel] | LeastStable) -> Row:
    """gamma and channels, or the reason why there are none."""
    if isinstance(found, LeastStable):
        mode = {**found.mode.plain(), "states": [list(s) for s in found.states]}
        return {"gamma": None, "channels": [], "reason": found.words(), "mode": mode}
    return channels_as_json(found)


def _range(found: Range | None) -> list[Row] | None:
    """[low, high] as factors; ``limit`` says whether a mode or the operating point is lost."""

    def end(e: End) -> Row:
        return {
            "factor": e.factor,
            "limit": e.bounded,
            "lost_hz": e.lost.frequency_hz if e.lost else None,
        }

    return [end(found.low), end(found.high)] if found else None


def _notes(job: Job, row: Row) -> list[str]:
    """What the law file says besides gamma, channels, seed and time."""
    mode = row["worst"]
    lines = [
        "the problem: w = (P_ref, omega_g), z = (P_ref - p, p, omega_u, q + V/D_q), the paper's",
        "  six weights; its converter ideal (no delay, no sensors), the loop continuous, the DC",
        "  source a current that row 1 commands",
        f"started from {job.law}",
    ]
    if row["fixed"]:
        names = ", ".join(f"W_{i}{j}" for i, j in row["fixed"])
        lines.append(f"no gains that hold lower {names} at rest or infinity: chosen for the others")
    lines += [
        "and so that it holds sampled at 100 us, one sample late, every mode decaying by "
        f"{ALPHA:g} 1/s; without that gamma could be {row['ideal']['gamma']:.4f}",
        f"one sample late: sigma {row['sigma']:+.3g} 1/s; least damping ratio {mode['ratio']:.4f} "
        f"at {mode['frequency_hz']:.4g} Hz",
    ]
    if row["delay_us"] is not None:
        delay = f"{row['delay_us']:.0f} us"
        lines.append(f"it is stable up to {delay} from the sample of y to its action")
    for key, name in (("L_g", "L_g"), ("R", "R_f and R_g")):
        if row[key]:
            low, high = (e["factor"] for e in row[key])
            lines.append(f"one sample late it holds for {name} x {low:.3g} ... {high:.3g}")
    return lines
