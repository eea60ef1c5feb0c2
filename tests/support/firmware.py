"""Exported firmware to compile in tests, and the compilers."""

import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gfm_runtime import BuiltLaw, LawSet, discretise, law_file, load_law, pack_law, state_dtype
from gfm_runtime.assembly import Controller
from gfm_runtime.counts import align, measure, modulate
from gfm_runtime.firmware import export
from gfm_runtime.firmware.golden import inputs
from gfm_runtime.firmware.module import at_rest
from gfm_runtime.inner import (
    PRIORITIES,
    STAGES,
    DualSequence,
    GridFollowingStage,
    PowerLimiter,
    StiffSource,
    settle,
)
from gfm_runtime.inner_file import NO_INNER, inner_names
from gfm_runtime.kernel import advance_with_inner, look_with_inner
from gfm_runtime.lawfile import LawFile
from gfm_runtime.signals import NU, carried_rows, group
from gfm_runtime.switchover import settle_into, settle_with_inner

from .laws import LAWS

T_S = 1e-4
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
#: instructions on a Cortex-M4F in float32, unrolled: a law and its limits
MOST = 300
#: one of each error map, one without states, the most states
SOME = ("vsg-1", "psc-dc", "dvoc", "hybrid-angle", "matching-2", "vsg-12")


def _staged() -> dict[str, BuiltLaw]:
    """Laws with inner stages: the shipped ones behind vsg-2 and laws of each structure, and every
    kind with every priority, PLL and power limiter, with and without freeze and integral; and one
    without."""
    shipped = [stage for stage in inner_names() if stage != NO_INNER]
    laws = {
        f"{law} {stage}": load_law(law, stage).laws[0]
        for k, stage in enumerate(shipped)
        for law in ("vsg-2", *SOME[k :: len(shipped)])
    }
    follows = load_law("grid-following").laws[0]
    for kind, one in STAGES.items():
        for k, priority in enumerate(PRIORITIES):
            if one is GridFollowingStage:
                stage = one(
                    priority=priority, angle=-30.0, k_ci=5.0 * (k % 2), f_pll=20.0, k_f=3.0,
                    k_V=2.0 * (k > 1),
                )  # fmt: skip
                laws[f"{kind} {priority}"] = replace(follows, inner=stage)
                continue
            stage = one(
                priority=priority, angle=-30.0, k_ci=5.0 * (k % 2), freeze=k != 2,
                power=PowerLimiter(P_max=1.0, P_min=-1.0), f_pll=20.0,
            )  # fmt: skip
            laws[f"{kind} {priority}"] = replace(LAWS["vsg-2"], inner=stage)
    for name, law in laws.items():
        if isinstance(law.inner, DualSequence):
            laws[name] = replace(law, inner=law.inner.model_copy(update={"f_seq": 20.0}))
        elif isinstance(law.inner, StiffSource):  # what a low-pass hides; with and without windows
            k = PRIORITIES.get(name.split()[1], 0)
            quick = {"TPf": 0.0, "TQf": 0.0, "Qmax": 0.4, "Qmin": -0.4, "E_max": 1.15, "E_min": 0.5}
            windows = {"ImaxSS": (0.0, 1.0)[k % 2], "PQFlag": k // 2}
            laws[name] = replace(law, inner=law.inner.model_copy(update=quick | windows))
    return laws | {"no stage": LAWS["mimo-gfm"]}


STAGED = _staged()
#: of these few that together have every statement of all, with other numbers
FEW_STAGED = (
    "vsg-1 cascaded", "vsg-12 cascaded", "psc-dc dual-sequence", "dual-sequence d",
    "hybrid-angle threshold-impedance", "dvoc stiff-source", "stiff-source d", "stiff-source angle",
    "grid-following q", "grid-following circular", "matching-2 virtual-stator", "no stage",
)  # fmt: skip


def exported(
    folder: Path, real: str, style: Any, *names: str, of: Mapping[str, BuiltLaw] = LAWS
) -> Path:
    """A folder with laws, all by default."""
    laws = {name: of[name] for name in names} or of
    for name, text in export(laws, T_S, real, style, files=files_of(laws)).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def files_of(laws: Mapping[str, BuiltLaw]) -> dict[str, LawFile]:
    """The files of laws of the catalogue, by their names in an export; a stage is a law."""
    alone = {"schedule": None}
    return {name: law_file(law.name).model_copy(update=alone) for name, law in laws.items()}


def cc(folder: Path, *arguments: str, compiler: str = "gcc") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [compiler, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )


def accepted(seed: int, ticks: int, real: str, stages: bool) -> Any:
    """Golden references and measurements (ticks, n) without those that are refused, float64."""
    _, refs, ys = inputs(seed, ticks, np.dtype(real), stages)
    rows = (*group("ref"), *carried_rows("y", stages))
    both = np.hstack([refs, ys])
    low, high = np.array([[r.low for r in rows], [r.high for r in rows]])
    both[~((both >= low) & (both <= high)).all(axis=1)] = both[0]
    return np.split(both.astype(float), [refs.shape[1]], axis=1)


def bench(law: str, inner: str, real: str, ref: Any, y: Any, u: Any) -> Controller:
    """The controller of the bench, its outputs beginning at u."""
    one = Controller([LawSet("x", load_law(law, inner).laws)], T_S, ref, real=real)
    one.start(np.zeros(one.active_law.order), u[:NU])
    own = np.array(u[:NU])
    settle_into(one.laws[0], one.states[0], ref, y, own, np.zeros(NU))
    if one.signal_set:
        settle(one.laws[:1], one.states[:1], own, y, u[2], u[3])
    return one


def turning_counts(ticks: int) -> np.ndarray:
    """Counts of a 12-bit A/D in its default ranges (ticks, 10): three phases at 51 Hz and a swing
    of their current."""
    turn = np.exp(2j * np.pi * (51e-4 * np.arange(ticks) + 0.1))
    swing = 0.5 + 0.1 * np.sin(np.arange(ticks) / 40)
    axes = np.exp(-2j * np.pi * np.arange(3) / 3)
    scaled = [
        (turn * of * angle)[:, None] * axes
        for of, angle in ((swing / 4, np.exp(0.1j)), (0.5, 1.0), (swing / 4, 1.0))
    ]
    values = np.hstack([np.zeros((ticks, 1)), np.hstack(scaled).real])
    return np.floor(2048 * (1 + values) + 0.5).clip(0, 4095)


def from_pin_to_pin(
    law: BuiltLaw, real: str, ref: Any, counts: np.ndarray, u: Any
) -> Iterator[list[float]]:
    """What the kernel gives for counts (ticks, 10), beginning at u (4,): u, and compare counts."""
    record, state = pack_law(discretise(law, T_S), real), np.zeros(1, state_dtype(real))
    s, ref = state[0], np.asarray(ref, real)
    s["u"] = [signal.default for signal in group("u")]
    s["omega_pll"], s["pll"], s["e"], s["speed"] = 1.0, (1.0, 0.0), u[2:], 1.0
    s["angle"], s["sensed"] = (1.0, 0.0), at_rest()
    rows = counts.astype(real)
    align(record[0], s, rows[0], 0)
    first = state.copy()
    measure(record[0], first[0], rows[0], 0)
    own, none, out = np.array(u[:3], real), np.zeros(3, real), np.zeros(4, real)
    e_d, e_q = np.array(u[2:], real)
    settle_with_inner(record[0], s, ref, first[0]["sensed"], own, none, e_d, e_q)
    for row in rows:
        measure(record[0], s, row, 0)
        look_with_inner(record[0], s, ref, s["sensed"], out)
        advance_with_inner(record[0], s)
        modulate(record[0], s)
        yield [*out.astype(float), *s["compare"].astype(int).astype(float)]
