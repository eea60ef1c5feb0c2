"""gfmhil laws: the catalogue, the inner stages, one law, and records of a dynamic data file."""

import argparse
import inspect
import json
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_hil.api.dyr import MODELS, read_dyr
from gfm_hil.api.dyr_nearest import nearest_record
from gfm_hil.api.law import Law, cell_text, table_ii
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_new
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario
from gfm_runtime import (
    DiscreteLaw,
    discretise,
    grid_names,
    industry_names,
    law_file,
    law_names,
    load_law,
    tuned_names,
)
from gfm_runtime.inner_file import acting, inner_names, named_inner
from gfm_runtime.law import HomeGrid
from gfm_runtime.lawfile import LawFile
from gfm_runtime.signals import Y_NAMES

#: options that list other laws than the paper's: their names, and what they are
_GROUPS = {
    "tuned": (tuned_names, "those with the gains of the law comparison"),
    "grid": (grid_names, "those for grid codes, with a droop of 5 %%"),
    "industry": (
        industry_names,
        "those of the industry: REGFM_A1, REGFM_B1, grid-following, grid-following-pv",
    ),
}
MATRICES = ("A", "B_r", "B_y", "C", "D_r", "D_y", "D_u0", "u_0")


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true", help="as JSON")
    for group, (_, text) in _GROUPS.items():
        command.add_argument(f"--{group}", action="store_true", help=text)
    kinds = command.add_subparsers(metavar="show|import|export")
    show = kinds.add_parser("show", help="one law, with its transfer functions")
    show.add_argument("name", help="catalogue name or law file")
    show.add_argument("--T_s", type=float, default=1e-4, metavar="S", help="sampling time, s")
    show.add_argument("--json", action="store_true", help="as JSON, with discrete matrices")
    show.set_defaults(call=call_show)
    read = kinds.add_parser("import", help="laws of a dynamic data file (.dyr) of PSS/E")
    read.add_argument("file", help="the file; records REGFMA1 and REGFMB1, others are left out")
    read.add_argument(
        "--impedance", type=float, nargs=2, required=True, metavar=("R_e", "X_L"),
        help="source impedance (ZSORCE of the raw data file), p.u.",
    )  # fmt: skip
    read.add_argument("-o", "--out", default=".", metavar="FOLDER", help="for the law files")
    read.set_defaults(call=call_import)
    write = kinds.add_parser("export", help="the record of a dynamic data file nearest to a law")
    write.add_argument("name", help="catalogue name or law file")
    write.add_argument(
        "--as", dest="model", choices=list(MODELS), default="REGFMA1", help="(%(default)s)"
    )
    write.add_argument("--bus", type=int, default=1, help="its number (%(default)s)")
    write.add_argument("--machine", default="1", metavar="ID", help="at the bus (%(default)s)")
    write.add_argument("-o", "--out", metavar="FILE", help="a new file (default: print the record)")
    write.set_defaults(call=call_export)


def call(options: argparse.Namespace) -> int:
    rows, lines = [], []
    chosen = [names for group, (names, _) in _GROUPS.items() if getattr(options, group)]
    for name in (name for names in chosen or [law_names] for name in names()):
        laws, file = load_law(name), law_file(name)
        first, order = laws.first, discretise(laws.first, 1e-4).order
        elements = {k: cell_text(file, k) for k in sorted({*file.phi, *file.psi})}
        rows.append(
            {
                "name": name,
                "title": first.title,
                "order": order,
                "error_map": first.error_map,
                "elements": elements,
                "stages": len(laws.laws),
                "home_grid": first.home_grid.model_dump(),
                "source": " ".join(first.source.split()),
            }
        )
        cells = "  ".join(f"φ{k} {v}" for k, v in elements.items())
        weak = "" if first.home_grid.L_g == 1 else " (weak grid)"
        lines.append((name, order, cells, f"{first.title}{weak}"))
    if options.json:
        print(json.dumps(rows, indent=2, ensure_ascii=False))
        return 0
    console = terminal()
    heads = ("law", "states", "elements of Φ(s)", "title")
    console.print(Table(heads, lines, text=None))
    specs = {name: named_inner(name) for name in inner_names()}
    stages = [
        (name, "the bridge produces E_u itself" if spec is None else inspect.getdoc(type(spec)))
        for name, spec in specs.items()
    ]
    console.print()
    console.print(Table(("inner stage", "what it is"), stages, text=None))
    return 0


def call_import(options: argparse.Namespace) -> int:
    laws, folder = [x.law(*options.impedance) for x in read_dyr(options.file)], Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    for law in laws:
        print(law.save(folder / f"{law.name}.toml"))
    return 0


def call_export(options: argparse.Namespace) -> int:
    found = nearest_record(Law.load(options.name), options.model)
    text = found.record(options.bus, options.machine)
    if options.out is None:
        print(text, end="")
    else:
        print(write_new(Path(options.out), text))
    rows = [(name, f"{100 * far:.3g} %") for name, far in found.far.items()]
    rows += [(name, f"not in {found.model}") for name in found.without]
    heads = ("element", "largest distance, 0.1 to 10 Hz")
    terminal(stderr=True).print(Table(heads, rows, text=None))
    return 0


def call_show(options: argparse.Namespace) -> int:
    laws, file = load_law(options.name), law_file(options.name)
    discrete = [discretise(law, options.T_s) for law in laws.laws]
    if options.json:
        print(json.dumps(_as_json(file, discrete), indent=2, ensure_ascii=False))
        return 0
    console = terminal(highlight=False)
    first = laws.first
    console.print(f"[bold]{laws.name}[/]: {first.title}")
    console.print(" ".join(first.source.split()).replace("[", "\\["), style="dim")
    console.print(f"errors: {first.error_map} · grid: {first.home_grid.note}")
    if why := _unstable(options, first.home_grid):
        console.print(f"[red]on this grid {escape(why)}[/]", soft_wrap=True)
    console.print(Table(("Φ(s)", *Y_NAMES), table_ii(file), text=None))
    values = [(n, f"{p.value:g}", p.unit, p.source) for n, p in first.parameters.items()]
    console.print(Table(("parameter", "value", "unit", "source"), values, text=None))
    if first.inner is not None:
        keys = ", ".join(f"{k} = {_value(v)}" for k, v in acting(first.inner).items())
        console.print(f"inner stage: {first.inner.kind} ({keys})")
    for k, d in enumerate(discrete):
        stage = f"stage {k}, " if len(discrete) > 1 else ""
        console.print(f"[bold]{stage}{d.order} states[/] at T_s = {d.T_s:g} s")
        for sign, cells in (("φ", d.law.phi), ("ψ", d.law.psi)):
            for (i, j), element in sorted(cells.items()):
                console.print(f"{sign}{i + 1}{j + 1} = {element}", soft_wrap=True)
    return 0


def _unstable(options: argparse.Namespace, grid: HomeGrid) -> str:
    """The mode that makes the law's loop on its own grid unstable; empty if none does."""
    from gfm_hil.studies.linear_loop import why_unstable  # a second of imports

    factors = {"L_g": grid.L_g, "R_g": grid.R_g}
    try:
        scenario = load_scenario(
            "pref_step", in_process=True, law=options.name, T_s=options.T_s, plant__factors=factors
        )
    except UserError:  # a sampling time that does not suit the plant
        return ""
    return why_unstable(scenario, "pref_step")


def _value(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).lower()


def _as_json(file: LawFile, discrete: list[DiscreteLaw]) -> dict[str, Any]:
    law = discrete[0].law
    return {
        "name": file.name,
        "title": law.title,
        "source": " ".join(law.source.split()),
        "error_map": law.error_map,
        "phi": [cells for _, *cells in table_ii(file)],
        "parameters": {
            n: {"value": p.value, "unit": p.unit, "source": p.source}
            for n, p in law.parameters.items()
        },
        "inner": None if law.inner is None else {"type": law.inner.kind, **acting(law.inner)},
        "home_grid": law.home_grid.model_dump(),
        "order": discrete[0].order,
        "discrete": [
            {"T_s": d.T_s, **{n: getattr(d, n).tolist() for n in MATRICES}} for d in discrete
        ],
    }
