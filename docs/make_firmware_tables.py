"""Measures what the laws cost on processors, and writes the tables of the page about firmware.

``python docs/make_firmware_tables.py`` needs the packages that docs/firmware.md names.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

from _ext.outputs import command

from gfm_hil.core.files import write_text
from gfm_runtime import law_names
from gfm_runtime.firmware import TARGETS, Checked, check

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
        results = [_measured(folder / f"{k}", *what) for k, what in enumerate(MEASURED)]
        export = command("gfmhil firmware export vsg-1 -o firmware", folder=folder)
        host = command("gfmhil firmware check firmware", folder=folder)
        cortex = command("gfmhil firmware check firmware --target m4f", folder=folder)
    write_text(TABLES / "firmware_cli.md", "\n\n".join([export, host, cortex]) + "\n")
    write_text(TABLES / "firmware_laws.md", _table(results))


def _measured(folder: Path, target: str, real: str, style: str) -> dict[str, Checked]:
    command(f"gfmhil firmware export all --real {real} --style {style} -o {folder}")
    return {found.name: found for found in check(folder, target)}


def _table(results: list[dict[str, Checked]]) -> str:
    heads, units = ["law"], ["---"]
    for (target, real, style), _ in zip(MEASURED, results, strict=True):
        heads += [f"{target} {real}, {style}: instructions", "code [B]"]
        units += ["---:", "---:"]
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, units)]
    for name in results[0]:
        cells = [name]
        for found in results:
            law = found[name]
            assert law.instructions is not None and law.differ == 0
            cells += ["{}…{}".format(*law.instructions), str(law.code)]
        lines.append("| " + " | ".join(cells) + " |")
    versions = {
        subprocess.run([f"{t.prefix}{t.compiler}", "--version"], capture_output=True, text=True,
                       check=True).stdout.splitlines()[0]
        for t in (TARGETS[target] for target, *_ in MEASURED)
    }  # fmt: skip
    rows = {found.rows for result in results for found in result.values()}
    return "\n".join(
        [
            *lines,
            "",
            f"{len(law_names())} laws, {' and '.join(sorted(versions))}, `-O2`. In each column "
            f"{max(rows):,} rows a law, 0 words that differ.",
            "",
        ]
    )


if __name__ == "__main__":
    main()
