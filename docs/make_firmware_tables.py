"""Measures what the laws cost on processors, and writes the tables of the page about firmware.

``python docs/make_firmware_tables.py`` needs the packages that docs/firmware.md names.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

from _ext.outputs import command

from gfm_hil.core.files import write_text
from gfm_runtime import law_names, load_law
from gfm_runtime.firmware import FIXED, SHIPPED, TARGETS, CheckResult, check, export, stage_names
from gfm_runtime.firmware.report import DEAD_BUS, deviation_text
from gfm_runtime.inner_file import inner_names
from gfm_runtime.signals import U_NAMES

#: the law that is shown with each inner stage
STAGED = "vsg-2"
#: the law that is a stage itself
ALONE = "grid-following"
T_S = 1e-4  # s
TABLES = Path(__file__).parent / "tables"
#: target, precision and style of the columns
MEASURED = (
    ("m4f", "float32", "unrolled"),
    ("m4f", "float32", "records"),
    ("m7", "float64", "unrolled"),
    ("rv64", "float64", "unrolled"),
)


def main() -> None:
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        results = [_measured(folder / f"{k}", "all", *what) for k, what in enumerate(MEASURED)]
        behind = {stage: f"{STAGED} --inner {stage}" for stage in inner_names()}
        stages = {
            name: [
                next(iter(_measured(folder / f"{name}{k}", laws, *what).values()))
                for k, what in enumerate(MEASURED)
            ]
            for name, laws in (behind | {ALONE: ALONE}).items()
        }
        write_text(TABLES / "firmware_fixed.md", _fixed(folder / "fixed", results[0]))
        export = command("gfmhil firmware export vsg-1 -o firmware", folder=folder)
        host = command("gfmhil firmware check firmware", folder=folder)
        cortex = command("gfmhil firmware check firmware --target m4f", folder=folder)
    write_text(TABLES / "firmware_cli.md", "\n\n".join([export, host, cortex]) + "\n")
    write_text(TABLES / "firmware_laws.md", _table(results))
    write_text(TABLES / "firmware_stages.md", _stages(stages))


def _measured(
    folder: Path, laws: str, target: str, real: str, style: str
) -> dict[str, CheckResult]:
    command(f"gfmhil firmware export {laws} --real {real} --style {style} -o {folder}")
    return {found.name: found for found in check(folder, target)}


def _table(results: list[dict[str, CheckResult]]) -> str:
    heads, units = ["law"], ["---"]
    for (target, real, style), _ in zip(MEASURED, results, strict=True):
        heads += [f"{target} {real}, {style}: instructions", "code [B]"]
        units += ["---:", "---:"]
    heads.insert(3, "instructions without the checks of inputs")
    units.insert(3, "---:")
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, units)]
    for name in results[0]:
        cells = [name]
        for found in results:
            law = found[name]
            assert law.instructions is not None and law.differ == 0
            cells += ["{}…{}".format(*law.instructions), str(law.code)]
        cells.insert(3, "{}…{}".format(*results[0][name].law_and_limits))
        lines.append("| " + " | ".join(cells) + " |")
    versions = {_version(target) for target, *_ in MEASURED}
    rows = {found.rows for result in results for found in result.values()}
    return "\n".join(
        [
            *lines,
            "",
            f"{len(law_names())} laws, {' and '.join(sorted(versions))}. In each column "
            f"{max(rows):,} rows a law, 0 words that differ.",
            "",
        ]
    )


def _fixed(folder: Path, in_float32: dict[str, CheckResult]) -> str:
    """What the laws cost in fixed point, and how far they get from float64 at most."""
    laws = {
        name: law
        for found in map(load_law, law_names())
        for name, law in zip(stage_names(found), found.laws, strict=True)
    }
    for name, text in export(laws, T_S, FIXED, "unrolled").items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_text(folder / name, text)
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    proven = {law["name"]: law["deviation"] for law in report["laws"]}
    kinds = ("fixed", "fixed, small signals")
    heads = ["law", "m4f fixed: instructions", "code [B]", "m4f float32: instructions", "code [B]"]
    heads += [f"{name}{end}" for end in ("", ", small") for name in U_NAMES]
    lines = ["| " + " | ".join(heads) + " |", "| --- " + "| ---: " * (len(heads) - 1) + "|"]
    for c in check(folder, "m4f", ticks=SHIPPED):
        assert c.differ == 0
        cells = [c.name]
        for found in (c, in_float32[c.name]):
            assert found.instructions is not None
            cells += ["{}…{}".format(*found.instructions), str(found.code)]
        cells += [deviation_text(one) for kind in kinds for one in proven[c.name][kind]]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", f"{_version('m4f')}. {DEAD_BUS}", ""])


def _version(target: str) -> str:
    compiler = f"{TARGETS[target].prefix}{TARGETS[target].compiler}"
    said = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=True)
    return f"{said.stdout.splitlines()[0]}, `{TARGETS[target].optimised}`"


def _stages(results: dict[str, list[CheckResult]]) -> str:
    heads = (f"{STAGED} with, or law", "on", "instructions", "code [B]", "constants [B]",
             "state [B]", "stack [B]")  # fmt: skip
    lines = ["| " + " | ".join(heads) + " |", "| --- | --- " + "| ---: " * 5 + "|"]
    for k, (target, real, style) in enumerate(MEASURED):
        for stage, found in results.items():
            one = found[k]
            assert one.instructions is not None and one.differ == 0
            own = f"law {ALONE}" if stage == ALONE else stage
            cells = (own, f"{target} {real}, {style}", "{}…{}".format(*one.instructions),
                     one.code, one.constants, one.state, one.stack)  # fmt: skip
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
