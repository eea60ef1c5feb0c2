"""A solved case without the branches that no circuit can have: those that lead nowhere, and a
negative reactance in series with a larger one. The power flow of what is left is the same."""

from dataclasses import replace

from gfm_hil.api.power_flow import FlowBranch, PowerFlow, named


def simplify(flow: PowerFlow) -> PowerFlow:
    """The same case, whose other buses keep their voltages, without buses at which there is nothing
    and which are the end of one branch, or between a negative reactance and one more branch."""
    empty = [
        k
        for k, bus in enumerate(flow.buses)
        if k != flow.slack and not (bus.load or bus.shunt or bus.machine or bus.static_rating)
    ]
    branches, gone, ignored = [*flow.branches], set[int](), [*flow.ignored]
    before = -1
    while len(gone) > before:
        before = len(gone)
        for k in empty:
            mine = [b for b in branches if k in (b.start, b.end)]
            if k in gone or any(b.B for b in mine):
                continue
            name = named(flow.buses[k].name)
            if len(mine) == 1:
                ignored.append(f"What leads to {name} alone is left out: nothing stands there.")
            elif _is_in_series(mine):
                a, b = (one.start if one.end == k else one.end for one in mine)
                Z, transformer = sum(one.Z for one in mine), any(one.transformer for one in mine)
                branches.append(FlowBranch(a, b, Z, 0.0, 1.0, transformer))
                ignored.append(f"The branches at {name} are one: a reactance there is negative.")
            else:
                continue
            gone.add(k)
            branches = [b for b in branches if b not in mine]
    place = {k: j for j, k in enumerate(k for k in range(len(flow.buses)) if k not in gone)}
    return replace(
        flow,
        buses=[flow.buses[k] for k in place],
        branches=[b._replace(start=place[b.start], end=place[b.end]) for b in branches],
        slack=place[flow.slack],
        ignored=ignored,
    )


def _is_in_series(branches: list[FlowBranch]) -> bool:
    """Whether two branches without taps, one of them with a negative reactance, are like one."""
    return (
        len(branches) == 2
        and any(b.Z.imag < 0 for b in branches)
        and all(b.ratio == 1.0 for b in branches)
    )
