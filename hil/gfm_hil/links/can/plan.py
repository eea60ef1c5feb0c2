"""The DBC that a link runs by: the one that its options name, or our own."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from gfm_hil.links.can.dbc import read_dbc, write_dbc
from gfm_hil.links.can.layout import Plan, plan_of
from gfm_hil.links.can.options import CanOptions


@cache
def load_plan(options: CanOptions) -> Plan:
    """The frames of that DBC.

    Raises:
        ValueError: it cannot be read, or does not describe what the link needs.
    """
    if options.dbc is None:
        return plan_of(read_dbc(write_dbc(options.fd)))
    where = f"dbc = {options.dbc!r}"
    try:
        plan = plan_of(read_dbc(Path(options.dbc).read_text(encoding="utf-8")))
    except OSError as problem:
        raise ValueError(f"{where}: {problem.strerror}") from None
    except Exception as problem:  # cantools has no common base of what its parser raises
        said = " ".join(str(problem).split())
        raise ValueError(f"{where}: {said}") from None
    if plan.fd != options.fd:
        kind = "CAN FD" if plan.fd else "classic CAN"
        raise ValueError(f"{where}: describes {kind}; link.options.fd must agree")
    return plan
