"""gfmhil network import: a published power-flow case as a network with converters."""

import argparse
from pathlib import Path

from gfm_hil.api.dyr_machines import MODELS
from gfm_hil.api.network_case import network_from
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal


def add(command: argparse.ArgumentParser) -> None:
    kinds = command.add_subparsers(metavar="import", required=True)
    read = kinds.add_parser(
        "import", help="make a network of a power-flow case, with converters where you say"
    )
    read.description = (
        "Writes network.toml and the converters' files: lines, transformers, loads and machines of "
        "a power-flow case, at its operating point."
    )
    read.add_argument(
        "case",
        help="a case of pandapower (case9, case39, case118, ...), its net as .json, or a file"
        " of PSS/E (.raw) or MATPOWER (.m)",
    )
    read.add_argument(
        "--converter", action="append", default=[], metavar="BUS=LAW[:SHARE]",
        help="a converter in place of the machine, or else of the static generators, at this bus,"
        " with its law, or beside them with a share of their rating and power, such as 0.5;"
        " several times",
    )  # fmt: skip
    read.add_argument(
        "--slack", choices=("machine", "grid"), default="machine",
        help="what stands at the slack bus (default: %(default)s)",
    )  # fmt: skip
    read.add_argument(
        "--dynamics", metavar="FILE",
        help=f"dynamic data of PSS/E (.dyr): {', '.join(MODELS)}",
    )  # fmt: skip
    read.add_argument(
        "--frequency", type=float, metavar="HZ",
        help="nominal, of a file of MATPOWER, which has none (default: 60)",
    )  # fmt: skip
    read.add_argument("-o", "--out", metavar="FOLDER", help="(default: the case's name)")
    read.set_defaults(call=call_import)


def call_import(options: argparse.Namespace) -> int:
    converters = dict[str | int, str | tuple[str, float]]()
    for text in options.converter:
        bus, equals, rest = text.partition("=")
        law, colon, share = rest.partition(":")
        if not (bus and equals and law) or bus in converters:
            raise UserError(f"--converter {text}: must be BUS=LAW or BUS=LAW:SHARE, each bus once")
        try:
            converters[bus] = (law, float(share)) if colon else law
        except ValueError:
            raise UserError(f"--converter {text}: {share!r} must be a number in (0, 1]") from None
    case = network_from(
        options.case, converters, options.slack, "", options.dynamics, options.frequency
    )
    file = case.save(options.out or Path(options.case).stem)
    network, console = case.content["network"], terminal()
    counts = [(len(parts), table.replace("_", " "))
              for table, parts in network.items() if table != "grid"]  # fmt: skip
    console.print(", ".join(f"{n} {table.removesuffix('s') if n == 1 else table}"
                            for n, table in counts))  # fmt: skip
    for line in case.ignored:
        console.print(f"• {line}")
    console.print(
        f"steady state: {case.distance(file):.1g} p.u. from the power flow's voltages at most"
    )
    console.print(f"{file}: gfmhil run {file}")
    return 0
