"""gfmhil waveforms: currents and voltages of a switched bridge between the ticks of a run."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.api.runs import load_run
from gfm_hil.cli import common
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import replacing
from gfm_hil.core.schema import read_model
from gfm_hil.results.between_figure import SIZE, draw_between
from gfm_hil.results.table import Table
from gfm_hil.run.between import BetweenTicks
from gfm_hil.run.losses import DataSheet

_PICTURES, _TABLES = (".png", ".svg", ".pdf"), (".csv", ".npz")


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Repeat a run with a switched bridge in this process, and compute a window of it from "
        "switching edge to switching edge: ripple, RMS current of the DC capacitor, in windows of "
        "10 cycles and more the distortion by IEC 61000-4-7, and with a data sheet the losses."
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("window", type=common.window, metavar="FROM:TO", help="the window, s")
    command.add_argument(
        "--step", type=float, default=1e-6, metavar="S", help="most between points, s (1e-6)"
    )
    command.add_argument(
        "--data-sheet", type=Path, metavar="FILE", help="values of the devices, for the losses"
    )
    command.add_argument(
        "-o", "--out", type=Path, action="append", default=[], metavar="FILE",
        help="write the figure (.png, .svg, .pdf) or all points in V and A (.csv, .npz); may be"
        " repeated",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="as JSON")


def call(options: argparse.Namespace) -> int:
    for file in options.out:
        if file.suffix not in _PICTURES + _TABLES:
            known = ", ".join(_PICTURES + _TABLES)
            raise UserError(f"--out {file}: must end in one of {known}")
    sheet = None if options.data_sheet is None else read_model(options.data_sheet, DataSheet)
    run = load_run(options.folder)
    start, stop = options.window
    between = run.between_ticks(start, stop, options.step)
    results = _results(between)
    if sheet is not None:
        losses = between.losses(sheet)
        results["losses_W"] = {**losses.conduction, **losses.switching, "total": losses.total}
    rows = [
        (f"{name}: {part}" if part else name, f"{value:.4g}")
        for name, values in results.items()
        for part, value in (values.items() if isinstance(values, dict) else [("", values)])
    ]
    common.print_result(options, results, [Table(("", "value"), rows, text=None)])
    for file in options.out:
        _write(file, between, run.scenario.title)
    return 0


def _results(between: BetweenTicks) -> dict[str, Any]:
    """Ripple, RMS current and distortion of a window, by a name that ends in the unit."""
    b = between.bases
    results: dict[str, Any] = {
        "ripple_i_A": b.I_peak * max(between.ripple(f"i_{phase}") for phase in "abc"),
        "ripple_v_dc_V": b.V_dcref * between.ripple("v_dc"),
        "capacitor_rms_A": b.S_n / b.V_dcref * between.capacitor_rms(),
    }
    try:
        for name in ("i_a", "i_oa", "v_a", "u_a"):
            results[name] = between.spectrum(name).distortion()
    except UserError:
        pass  # the window is shorter than the 10 cycles of IEC 61000-4-7
    return results


def _write(file: Path, between: BetweenTicks, title: str) -> None:
    with replacing(file) as part:
        if file.suffix in _PICTURES:
            from matplotlib.figure import Figure

            figure = Figure(figsize=SIZE, layout="constrained")
            draw_between(figure, between, title)
            figure.savefig(part, dpi=110, format=file.suffix[1:])
            return
        rows = between.table(si=True)
        if file.suffix == ".npz":
            with part.open("wb") as stream:
                np.savez_compressed(stream, allow_pickle=False, **rows)
        else:
            with part.open("w", encoding="utf-8") as text:
                head = ",".join(rows)
                np.savetxt(
                    text, np.column_stack([*rows.values()]), "%.12g", ",", header=head, comments=""
                )
