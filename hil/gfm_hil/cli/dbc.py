"""gfmhil dbc: the DBC file of the CAN link, and what its frames cost on the bus."""

import argparse
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_or_print
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table

_RATES = {
    False: [(500_000, 0), (1_000_000, 0)],
    True: [(500_000, 2_000_000), (1_000_000, 2_000_000), (1_000_000, 5_000_000),
           (1_000_000, 8_000_000)],
}  # fmt: skip


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("--classic", action="store_true", help="classic CAN instead of CAN FD")
    command.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="where to write; else to the screen"
    )
    command.add_argument("--budget", action="store_true", help="frame times at common bit rates")
    command.add_argument(
        "--inner", action="store_true", help="with --budget: of a run with an inner stage"
    )
    command.add_argument("--T_s", type=float, default=1e-4, metavar="S", help="sampling time, s")


def call(options: argparse.Namespace) -> int:
    if options.T_s <= 0:
        raise UserError(f"--T_s {options.T_s:g}: must be more than 0 s")
    if options.budget:
        terminal().print(_budgets(options.T_s, options.inner), highlight=False)
        return 0
    from gfm_hil.links.can.dbc import write_dbc

    write_or_print(options.out, write_dbc(not options.classic))
    return 0


def _budgets(T_s: float, inner: int) -> Table:
    """Longest frames of y and u by bit rate, and the exchange that fits; ``inner``: in a run with
    an inner stage."""
    from gfm_hil.links.can import CanOptions
    from gfm_hil.links.can.bus_time import budget
    from gfm_hil.links.can.layout import load_plan

    heads = ("bytes", "y [µs]", "u [µs]", "both [µs]", "at most [Hz]", "every", "load")
    rows = []
    for fd, rates in _RATES.items():
        plan = load_plan(CanOptions(fd=fd).of_run(inner))
        for bitrate, data in rates:
            need = budget(plan, bitrate, data)
            every = need.every(T_s)
            name = f"FD {bitrate / 1e6:g}/{data / 1e6:g}" if fd else f"classic {bitrate / 1e6:g}"
            times = (f"{time * 1e6:.1f}" for time in (need.y, need.u, need.exchange))
            fits = f"{1 / need.exchange:.0f}", every, f"{need.load(every * T_s):.0%}"
            rows.append((name, "+".join(map(str, need.lengths)), *times, *fits))
    caption = f"longest frames; every: ticks of {T_s * 1e6:g} µs to an exchange of both"
    return Table(("bus [Mbit/s]", *heads), rows, caption=caption)
