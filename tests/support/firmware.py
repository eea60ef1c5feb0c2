"""Exported firmware to compile in tests, and the compilers."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from gfm_runtime import Law, load_law
from gfm_runtime.firmware import export
from gfm_runtime.inner import KINDS, PRIORITIES, Inner
from gfm_runtime.inner_file import NO_INNER, inner_names

from .laws import LAWS

T_S = 1e-4
#: one of each error map, one without states, the most states
SOME = ("vsg-1", "psc-dc", "dvoc", "hybrid-angle", "matching-2", "vsg-12")


def _staged() -> dict[str, Law]:
    """Laws with inner stages: the shipped ones behind vsg-2 and laws of each structure, and every
    kind with every priority, PLL and power limiter, with and without freeze and integral; and one
    without."""
    shipped = [stage for stage in inner_names() if stage != NO_INNER]
    laws = {
        f"{law} {stage}": load_law(law, stage).laws[0]
        for k, stage in enumerate(shipped)
        for law in ("vsg-2", *SOME[k :: len(shipped)])
    }
    for kind in KINDS:
        for k, priority in enumerate(PRIORITIES if kind != NO_INNER else ()):
            stage = Inner(
                kind, priority=priority, angle=-30.0, k_ci=5.0 * (k % 2), freeze=k != 2,
                P_max=1.0, P_min=-1.0, f_pll=20.0,
            )  # fmt: skip
            laws[f"{kind} {priority}"] = replace(LAWS["vsg-2"], inner=stage)
    return laws | {"no stage": LAWS["mimo-gfm"]}


STAGED = _staged()


def exported(
    folder: Path, real: str, style: Any, *names: str, of: Mapping[str, Law] = LAWS
) -> Path:
    """A folder with laws, all by default."""
    laws = {name: of[name] for name in names} or of
    for name, text in export(laws, T_S, real, style).items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def cc(folder: Path, *arguments: str, compiler: str = "gcc") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [compiler, *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
