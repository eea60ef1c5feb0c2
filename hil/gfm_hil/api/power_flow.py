"""Power-flow cases by pandapower: solved, and read as it hands them to PYPOWER."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.api.case_tables import CaseTables
from gfm_hil.api.mpc import MpcCase
from gfm_hil.api.raw import RawCase
from gfm_hil.core.errors import UserError, need
from gfm_runtime.errors import meant

_MOST_BUSES = 500  # the matrices of a network are dense
_NEAR = 1e-6  # p.u.; a smaller current comes from rounding
_IGNORED = {
    "controller": "they stand where the power flow leaves them",
    "motor": "impedances, as loads are",
}
"""Tables of pandapower that a network has no counterpart of, and what becomes of them."""


class Bus(NamedTuple):
    """A bus, in p.u. of the case's power; P and Q are what comes."""

    name: str
    V: complex  # by the power flow
    load: complex  # what is drawn
    shunt: complex  # admittance
    machine: complex  # what its machines bring
    rating: float | None  # of its machines
    static: complex = 0j  # what static generators and storages bring
    static_rating: float = 0.0  # of these
    X_source: float = math.nan  # of its machines, p.u. of their rating; NaN if the case has it not


def named(bus: str) -> str:
    """A bus in a sentence: many names begin with the word themselves."""
    return bus if bus.lower().startswith("bus") else f"bus {bus}"


class FlowBranch(NamedTuple):
    start: int  # the taps are there
    end: int
    Z: complex
    B: float  # charging, both ends together
    ratio: float
    transformer: bool


@dataclass(frozen=True)
class PowerFlow:
    """A solved case in p.u. of ``S_b``."""

    name: str  #: its file, or its title
    title: str
    S_b: float  #: VA
    f: float  #: Hz
    buses: Sequence[Bus]
    branches: Sequence[FlowBranch]
    slack: int  #: bus
    ignored: Sequence[str]  #: what the case has and a network has not


def read_pandapower(case: Any, title: str, frequency: float | None = None) -> PowerFlow:
    """Solve a net of pandapower, and read it as pandapower itself hands it to PYPOWER."""
    need("pandapower", "pandapower", "a power-flow case", "networks")
    # an optional package, and seconds of imports
    from pandapower.converter.pypower import to_ppc

    ignored: list[str] = []
    is_named = isinstance(case, str | Path)
    of = str(case) if is_named else title or str(case.name or "case")
    title = title or (Path(of).stem if is_named else of)
    suffix = Path(case).suffix.lower() if is_named else ""
    if frequency is not None and suffix != ".m":
        raise UserError(
            f"frequency = {frequency:g}: is for a file of MATPOWER, which has none; {of} has one"
        )
    readers: dict[str, Callable[[Path], CaseTables]] = {
        ".raw": RawCase, ".m": partial(MpcCase, frequency=frequency)
    }  # fmt: skip
    if (reader := readers.get(suffix)) is not None:
        tables = reader(Path(case))
        case, ignored = tables.net(), tables.ignored
    elif is_named:
        case = _load_pandapower(str(case))
    if len(case.bus) > _MOST_BUSES:
        raise UserError(f"{of}: {len(case.bus)} buses: at most {_MOST_BUSES}")
    _solve(case, of)
    ppc = to_ppc(case, calculate_voltage_angles=False, trafo_model="pi", init="results", mode="pf")
    S_b = ppc["baseMVA"]
    names: dict[int, str] = {}
    where = case._pd2ppc_lookups["bus"]
    unique = case.bus.name.notna().all() and case.bus.name.astype(str).is_unique
    called = {index: str(case.bus.name[index] if unique else index) for index in case.bus.index}
    if len(dead := case.bus.index[case.bus.in_service & case.res_bus.vm_pu.isna()]):
        raise UserError(f"{of}: {named(called[dead[0]])} has no path to the slack")
    for index, name in called.items():
        names.setdefault(int(where[index]), name)
    bus, branch = ppc["bus"], ppc["branch"]
    for k, number in enumerate(int(one) for one in bus[:, 0]):
        names.setdefault(number, f"open{k}")  # where a line ends at a switch
    place = {int(number): k for k, number in enumerate(bus[:, 0])}
    V = bus[:, 7] * np.exp(1j * np.radians(bus[:, 8]))
    load, shunt = (bus[:, 2] + 1j * bus[:, 3]) / S_b, (bus[:, 4] + 1j * bus[:, 5]) / S_b
    branches = []
    for row in branch[branch[:, 10] > 0]:
        ratio, (a, b) = row[8] or 1.0, (place[int(n)] for n in row[:2])
        transformer = ratio != 1.0 or bus[a, 9] != bus[b, 9]
        Z = complex(row[2], row[3])
        branches.append(FlowBranch(a, b, Z, float(row[4]), float(ratio), bool(transformer)))
    comes = V * (_admittance(shunt, branches) @ V).conj() + load
    ratings, raised = _ratings(case, where, place, S_b, comes)
    static, sources = _static(case, where, place, S_b), _sources(case, where, place)
    ignored += [
        f"{len(case[table])} {table}: {why}."
        for table, why in _IGNORED.items()
        if len(case.get(table, ()))
    ]
    if turning := int((case.trafo.shift_degree % 30 != 0).sum()):
        ignored.append(f"{turning} trafo: they turn no phase.")
    for k in raised:
        name = named(names[int(bus[k, 0])])
        ignored.append(f"The power at {name} is the rating of the machines: it is above max_p_mw.")
    buses = [
        Bus(names[int(row[0])], V[k], load[k] + static.get(k, (0j, 0.0))[0], shunt[k],
            comes[k] if k in ratings else 0j, ratings.get(k), *static.get(k, (0j, 0.0)),
            sources.get(k, math.nan))
        for k, row in enumerate(bus)
    ]  # fmt: skip
    for k, one in enumerate(buses):
        if k not in ratings and abs(comes[k]) > _NEAR:
            raise UserError(
                f"{of}: {named(one.name)}: {comes[k]:.3g} p.u. come from parts that this does"
                " not read (iron losses of transformers, for one)"
            )
    slack = int(np.flatnonzero(bus[:, 1] == 3)[0])
    return PowerFlow(of, title, S_b * 1e6, float(case.f_hz), buses, branches, slack, ignored)


def _solve(case: Any, of: str) -> None:
    """Solve the power flow of a net."""
    import pandapower

    if not case.ext_grid.in_service.any() and not case.gen.query("slack and in_service").size:
        raise UserError(f"{of}: has no slack: an ext_grid, or a gen with slack")
    try:
        pandapower.runpp(
            case, init="dc", tolerance_mva=1e-9, numba=False, enforce_q_lims=False,
            calculate_voltage_angles=False, trafo_model="pi",
        )  # fmt: skip
    except Exception as problem:  # of many kinds, from inside
        raise UserError(f"{of}: its power flow does not converge: {problem}") from None


def _ratings(
    case: Any, where: Any, place: Mapping[int, int], S_b: float, comes: NDArray[np.complex128]
) -> tuple[dict[int, float | None], list[int]]:
    """Rating of the generators of each bus, p.u., None if one of them has none: ``sn_mva``, or the
    largest power (of a condenser the largest reactive power), or what comes, if that is more; and
    at which buses it is more."""
    ratings, by_power = dict[int, float | None](), set[int]()
    for table in ("gen", "ext_grid"):
        for _, row in _working(case, case[table]).iterrows():
            by = [n for n in ("sn_mva", "max_p_mw", "max_q_mvar") if n in row and row[n] > 0]
            k = place[int(where[row.bus])]
            before = ratings.get(k, 0.0)
            ratings[k] = None if not by or before is None else before + float(row[by[0]]) / S_b
            if by and by[0] != "sn_mva":
                by_power.add(k)
    raised = [k for k in by_power if (S := ratings[k]) is not None and abs(comes[k]) > S]
    return ratings | {k: float(abs(comes[k])) for k in raised}, raised


def _sources(case: Any, where: Any, place: Mapping[int, int]) -> dict[int, float]:
    """The reactance behind which the generators of each bus have their voltage, all in parallel,
    p.u. of their rating (``xdss_pu``, ZSOURCE of PSS/E); NaN if one of them has none."""
    sums: dict[int, tuple[float, float]] = {}
    for table in ("gen", "ext_grid"):
        for _, row in _working(case, case[table]).iterrows():
            k = place[int(where[row.bus])]
            X, S = row.get("xdss_pu", math.nan), row.get("sn_mva", math.nan)
            before = sums.get(k, (0.0, 0.0))
            sums[k] = before[0] + S, before[1] + S / X
    return {k: S / by_X for k, (S, by_X) in sums.items()}


def _working(case: Any, table: Any) -> Any:
    """Those rows of a table that are in service, as are their buses."""
    return table[table.in_service & table.bus.map(case.bus.in_service)]


def _static(
    case: Any, where: Any, place: Mapping[int, int], S_b: float
) -> dict[int, tuple[complex, float]]:
    """What the static generators and the storages of each bus bring, and their rating, p.u.; one
    without a rating, or beyond it, has what it brings."""
    by_bus: dict[int, tuple[complex, float]] = {}
    for table, sign in (("sgen", 1.0), ("storage", -1.0)):
        those = case[table].join(case[f"res_{table}"], rsuffix="_res")
        for _, row in _working(case, those).iterrows():
            S = sign * complex(row.p_mw_res, row.q_mvar_res) / S_b
            own = max(abs(S), row.sn_mva / S_b if row.sn_mva > 0 else 0.0)
            k = place[int(where[row.bus])]
            before = by_bus.get(k, (0j, 0.0))
            by_bus[k] = before[0] + S, before[1] + own
    return {k: one for k, one in by_bus.items() if one[1] > 0.0}


def _load_pandapower(case: str) -> Any:
    """A case that pandapower ships, or a file."""
    import pandapower
    import pandapower.networks as shipped

    if case.endswith(".json"):
        try:
            return pandapower.from_json(case)
        except Exception as problem:
            raise UserError(f"{case}: is no net of pandapower: {problem}") from None
    known = [n for n in dir(shipped) if n.startswith("case") and callable(getattr(shipped, n))]
    if case not in known:
        raise UserError(
            f"{case!r}: must be one of {', '.join(known)}, or the path of a net of pandapower"
            f" (.json), PSS/E (.raw) or MATPOWER (.m){meant(case, known)}"
        )
    return getattr(shipped, case)()


def _admittance(shunt: NDArray[Any], branches: Sequence[FlowBranch]) -> NDArray[np.complex128]:
    Y = np.diag(shunt).astype(complex)
    for one in branches:
        y, a, b = 1 / one.Z, one.start, one.end
        own = y + 0.5j * one.B
        Y[a, a] += own / one.ratio**2
        Y[b, b] += own
        Y[a, b] -= y / one.ratio
        Y[b, a] -= y / one.ratio
    return Y
