"""Published power-flow cases as networks: converters in place of some machines, at the operating
point of the power flow."""

import math
import re
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root

from gfm_design.model.operating_point import node_voltages, operating_point
from gfm_hil.api.case_reduction import simplify
from gfm_hil.api.dyr_machines import Machines, read_machines
from gfm_hil.api.power_flow import PowerFlow, named, read_pandapower
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty, write_text
from gfm_hil.engine.setup import make_benches
from gfm_hil.scenario import load_scenario, toml_text
from gfm_plant import NoEquilibrium, Plant, make_plant
from gfm_plant.components import COMPONENTS
from gfm_plant.components.controls.control import Shaft
from gfm_plant.components.synchronous_machine import SynchronousMachine
from gfm_runtime import LawError, discretise, load_law
from gfm_runtime.signals import Y_NAMES

P_AT, V_AT = Y_NAMES.index("p"), Y_NAMES.index("V")
_LEAST = 1e-9  # p.u.; a smaller reactance or power of a load is none
_NEAR = 1e-6  # p.u.; how far the network's steady state may lie from the power flow
# of PowerSimulationsDynamics.jl's inverter (scenarios/published/psid_inverter.toml), p.u.; its
# line stands for the converter's own transformer
_CONVERTER = {"L_f": 0.08, "R_f": 0.003, "C_f": 0.074, "L_g": 0.2, "R_g": 0.01}
_ROOM = 1.05  # of a governor above the power that the case asks for
_STORED_S = 0.03  # energy of its DC capacitor by its rating, as of the paper's converter
_V_N, _V_DC = 690.0, 1500.0  # V
_FILTER = 0.05  # p.u. of a static generator's rating; the capacitor of its filter
_OF_BUS = re.compile(r"(.*?\b)bus (\S*[^\s:,.])(.*)", re.DOTALL)
# of the machines in Kundur's two areas, whose other values are those of a machine here
_MACHINE = {"H": 6.5, "avr": {}}


@dataclass(frozen=True)
class NetworkCase:
    """A scenario with a network, and the converter files that it names."""

    content: dict[str, Any]  #: of the scenario file
    converters: dict[str, dict[str, Any]]  #: by file name, content
    ignored: Sequence[str]  #: what the case has and this has not, and what this adds
    voltages: Mapping[str, complex] = field(repr=False)  #: of its nodes by the power flow, p.u.
    #: by what a message calls it, file and bus of each machine of a dynamics file
    sources: Mapping[str, str] = field(repr=False, default_factory=dict)

    def save(self, folder: str | Path) -> Path:
        """Write ``network.toml`` and its converter files; returns the path of the former.

        Raises:
            UserError: the folder is not empty, or the network has no steady state like the
                power flow; nothing is left of it then.
        """
        folder = Path(folder)
        check_empty(folder)
        was_there, file = folder.exists(), folder / "network.toml"
        folder.mkdir(parents=True, exist_ok=True)
        contents = {**self.converters, file.name: self.content}
        try:
            for name, content in contents.items():
                write_text(folder / name, toml_text(content))
            far = self.distance(file)
            if far > _NEAR:
                raise UserError(
                    f"{file}: in its steady state a voltage is {far:.2g} p.u. from that of the"
                    " power flow"
                )
        except BaseException as problem:
            for name in contents:
                (folder / name).unlink(missing_ok=True)
            if not was_there:
                folder.rmdir()
            text = str(problem).removeprefix(f"{file}: ")
            if isinstance(problem, UserError) and (line := self._of_record(text)):
                raise UserError(line) from None
            raise
        return file

    def _of_record(self, problem: str) -> str:
        """A problem with a machine of a dynamics file, said of that file; "" if it is none."""
        for part, where in self.sources.items():
            if match := re.search(rf"\b{re.escape(part)}\b[.:]* *(.*)", problem):
                return f"{where}: {match[1]}"
        return ""

    def distance(self, file: str | Path) -> float:
        """How far the voltages of the network's steady state are from the power flow, p.u."""
        benches = make_benches(load_scenario(file, in_process=True))
        laws = [b.controller.active_law for b in benches]
        refs = [np.asarray(b.scenario.references.vector()) for b in benches]
        there = node_voltages(benches[0].plant, laws, refs)
        own, case = (
            np.array([one[name] for name in self.voltages]) for one in (there, self.voltages)
        )
        turn = np.vdot(own, case)
        return float(np.abs(own * turn / abs(turn) - case).max())


def network_from(
    case: Any,
    converters: Mapping[str | int, str | tuple[str, float]],
    slack: str = "machine",
    title: str = "",
    dynamics: str | Path | None = None,
    frequency: float | None = None,
) -> NetworkCase:
    """Make a network of a power-flow case.

    Each bus with generators gets one synchronous machine of order 6 with a voltage regulator and a
    governor, or what ``dynamics`` says, or the converter that is named for it, which has the rating
    and the operating point of what it replaces, or a share of both beside a machine with the rest.
    Static generators and storages of a bus become one grid-following neighbour with the capacitor
    of its filter, in whose place a converter may stand where there is no machine.
    Loads become constant impedances that draw at the case's voltage what they draw there, the
    charging of transformers capacitors at the buses.

    Args:
        case: a net of pandapower, the name of one of its cases (case9, case39, ...), or the path
            of a net as JSON, of a case of PSS/E (.raw) or of MATPOWER (.m).
        converters: by the name of a bus with generators, the law of the converter there, and, if
            it does not take all, its share, in (0, 1]; the rating of the first one, in the order
            of the case's buses, is the network's base.
        slack: machine, or grid: what stands at the slack bus, if no converter does.
        title: of the scenario.
        dynamics: dynamic data file of PSS/E (.dyr) with the machines and their controls, see
            ``read_machines``.
        frequency: nominal, Hz, of a file of MATPOWER, which has none; 60 by default.

    Raises:
        UserError: an unknown case, bus or law; a case that has no slack or does not converge; a
            part that a network cannot have; a generator without a rating; a law that has no steady
            state there.
    """
    flow = simplify(read_pandapower(case, title, frequency))
    machines = Machines({}, ()) if dynamics is None else read_machines(dynamics)
    flow = _with_following(flow, machines)
    names = [bus.name for bus in flow.buses]
    laws = {
        str(bus): (one, 1.0) if isinstance(one, str) else (one[0], float(one[1]))
        for bus, one in converters.items()
    }
    feeding = [
        bus.name
        for k, bus in enumerate(flow.buses)
        if bus.machine or bus.static_rating or k == flow.slack
    ]
    if not laws:
        raise UserError(
            f"{flow.name}: name a bus for a converter; {', '.join(feeding)} have generators"
        )
    for name in laws:
        if name not in feeding:
            what = "has no generator" if name in names else "is no bus of the case"
            raise UserError(f"{flow.name}: {named(name)}: {what}; {', '.join(feeding)} have one")
        if not 0.0 < laws[name][1] <= 1.0:
            raise UserError(
                f"{flow.name}: {named(name)}: share = {laws[name][1]:g}: must lie in (0, 1]"
            )
    if slack not in ("machine", "grid"):
        raise UserError(f"slack = {slack!r}: must be machine or grid")
    return _Build(flow, laws, slack == "grid", machines).case()


def _with_following(flow: PowerFlow, machines: Machines) -> PowerFlow:
    """A case whose generators that follow the grid by a dynamics file are static ones."""
    buses, names = [*flow.buses], [bus.name for bus in flow.buses]
    ignored = [*flow.ignored]
    own = [*dict.fromkeys(bus for table in machines.tables.values() for bus in table)]
    absent = [name for name in own if name not in names]
    if absent == own != []:
        raise UserError(f"{machines.file}: {named(own[0])}: is no bus of {flow.name}")
    ignored += [f"{named(name)} of the dynamic data is none of the case." for name in absent]
    for name in machines.tables.get("grid_following", ()):
        if name in absent:
            continue
        k = names.index(name)
        bus = buses[k]
        beside = any(
            name in machines.tables.get(t, ()) for t in ("synchronous_machines", "machines")
        )
        if k == flow.slack and not beside:
            raise UserError(
                f"{machines.file}: {named(name)}: REGCA1 follows the grid, and this is the slack"
            )
        if k == flow.slack:
            ignored.append(f"REGCA1 at {named(name)} is left out beside the slack's machine.")
            continue
        if beside:
            ignored.append(f"The machine at {named(name)} is left out beside a converter.")
        if bus.machine and bus.rating is not None:
            S = bus.static_rating + bus.rating
            static = bus.static + bus.machine
            buses[k] = bus._replace(machine=0j, rating=None, static=static, static_rating=S)
    return replace(flow, buses=buses, ignored=ignored)


class _Build:
    """A network of a solved case, being written; p.u. of the first converter from here on."""

    def __init__(
        self, flow: PowerFlow, laws: Mapping[str, tuple[str, float]], grid: bool, machines: Machines
    ) -> None:
        self.flow, self.laws = flow, laws
        self.tables, self.file = machines.tables, machines.file
        whole = [bus.name for bus in flow.buses]
        short = [re.sub(r"(?i)^bus[\s_-]*(?=.)", "", name) for name in whole]
        self.names = short if len({*short}) == len(short) else whole  # in those of the parts
        first, name = next((k, bus.name) for k, bus in enumerate(flow.buses) if bus.name in laws)
        self.S_b = laws[name][1] * self._rating(first)
        self.scale = flow.S_b / self.S_b
        self.grid = flow.slack if grid and flow.buses[flow.slack].name not in laws else None
        self.ignored = [*flow.ignored, *machines.ignored]
        self.files: dict[str, dict[str, Any]] = {}
        self.assumed: list[str] = []  # buses of classical machines whose reactance is ours
        self.par: Any = None  # the same for all, in p.u. of each
        self.network: dict[str, Any] = {} if self.grid is None else {"grid": self._node(self.grid)}

    def _node(self, k: int) -> str:
        return f"bus{self.names[k]}"

    def _rating(self, k: int) -> float:
        bus = self.flow.buses[k]
        if not self._is_machine(k):
            return bus.static_rating * self.flow.S_b
        if bus.rating is None:
            grid = ", or stand a grid there: slack = grid" if k == self.flow.slack else ""
            raise UserError(
                f"{self.flow.name}: {named(bus.name)}: its generator has no rating: give sn_mva,"
                f" max_p_mw or max_q_mvar{grid}"
            )
        return bus.rating * self.flow.S_b

    def _is_machine(self, k: int) -> bool:
        """Whether a machine stands at a bus, besides what follows the grid."""
        return bool(self.flow.buses[k].machine) or k == self.flow.slack

    def _put(self, table: str, name: str, part: dict[str, Any]) -> None:
        self.network.setdefault(table, {})[name] = part

    def case(self) -> NetworkCase:
        for k, bus in enumerate(self.flow.buses):
            if bus.name in self.laws:
                self._converter(k, *self.laws[bus.name])
        self._branches()
        for k, bus in enumerate(self.flow.buses):
            self._load(k)
            left = 1.0 - self.laws.get(bus.name, ("", 0.0))[1]
            if left and k != self.grid and self._is_machine(k):
                self._machine(k, left)
            if bus.static_rating and k != self.grid:
                self._static(k, 1.0 if self._is_machine(k) else left)
        if self.assumed:
            X, buses = _default("machines", "X"), ", ".join(self.assumed)
            self.ignored.append(
                f"GENCLS at bus {buses}: X' = {X:g} p.u., our assumption: the case has no sn_mva"
                " and xdss_pu, which is ZSOURCE, of its generators there."
            )
        ignored = _joined(self.ignored)
        content = {
            "title": self.flow.title,
            "description": "Made from a power-flow case. " + " ".join(ignored),
            "duration": 5.0,
            "link": {"type": "inproc"},
        }
        if self.grid is not None:
            content["plant"] = {"grid": {"V_g": abs(self.flow.buses[self.grid].V)}}
        content["network"] = self.network
        volts = {self._node(k): bus.V for k, bus in enumerate(self.flow.buses)}
        of_file = {bus for table in self.tables.values() for bus in table}
        sources = {
            part: f"{self.file}, {named(bus.name)}"
            for k, bus in enumerate(self.flow.buses)
            if bus.name in of_file
            for part in (
                f"G{self.names[k]}",
                f"P{self.names[k]}",
                f"the machine at {self._node(k)}",
            )
        }
        return NetworkCase(content, self.files, ignored, volts, sources)

    def _branches(self) -> None:
        feeding = {k for k, bus in enumerate(self.flow.buses) if bus.machine}
        names = Counter[str]()
        for branch in self.flow.branches:
            a, b = (self.names[k] for k in (branch.start, branch.end))
            kind = "transformer" if branch.transformer else "line"
            name = f"{kind}{a}-{b}"
            names[name] += 1
            name += f"-{names[name]}" * (names[name] > 1)
            R, X = (part / self.scale for part in (branch.Z.real, branch.Z.imag))
            if R < 0 or X < _LEAST:
                raise UserError(
                    f"{self.flow.name}: {kind} {a} to {b}: R = {branch.Z.real:g}, X ="
                    f" {branch.Z.imag:g} p.u.: R must be >= 0, X > 0"
                )
            ends = {"start": self._node(branch.start), "end": self._node(branch.end)}
            if not branch.transformer:
                line = {**ends, "L": X, "R": R, "B": branch.B * self.scale}
                self._put("lines", name, line)
                continue
            earthed = "both"
            if branch.end in feeding or branch.start in feeding:  # the side of a machine is a delta
                earthed = "start" if branch.end in feeding else "end"
            values = {"S": 1.0, "X": X, "R": R, "earthed": earthed, "ratio": branch.ratio}
            self._put("transformers", name, {**ends, **values})

    def _load(self, k: int) -> None:
        """Load, shunt, and the charging of transformers at a bus, as what draws the same there."""
        bus = self.flow.buses[k]
        charging = sum(
            b.B / 2 / (b.ratio**2 if b.start == k else 1.0)
            for b in self.flow.branches
            if b.transformer and k in (b.start, b.end)
        )
        drawn = bus.load / abs(bus.V) ** 2 * self.scale
        drawn = complex(*(one if abs(one) > _LEAST else 0.0 for one in (drawn.real, drawn.imag)))
        shunt = (bus.shunt + 1j * charging) * self.scale
        capacitor = max(shunt.imag, 0.0) + max(-drawn.imag, 0.0)
        if k == self.grid:
            return  # the grid holds its voltage
        if drawn.real < 0:
            raise UserError(
                f"{self.flow.name}: {named(bus.name)}: its loads draw {bus.load.real:g} p.u.; make"
                " them static generators"
            )
        if drawn.real or drawn.imag > 0:
            P_Q = {"P": drawn.real, "Q": max(drawn.imag, 0.0)}
            self._put("loads", f"load{self.names[k]}", {"node": self._node(k), **P_Q})
        if shunt.real > 0 or shunt.imag < 0:  # in series: with a large R alone the circuit is stiff
            name = "reactor" if shunt.imag < 0 else "shunt"
            P_Q = {"P": max(shunt.real, 0.0), "Q": max(-shunt.imag, 0.0)}
            self._put("loads", f"{name}{self.names[k]}", {"node": self._node(k), **P_Q})
        if capacitor:
            self._put(
                "capacitors", f"charging{self.names[k]}", {"node": self._node(k), "Q": capacitor}
            )

    def _machine(self, k: int, share: float) -> None:
        bus, S = self.flow.buses[k], self._rating(k)
        i = (bus.machine / bus.V).conjugate() * self.flow.S_b / S
        values: dict[str, Any] = {"node": self._node(k), "S": share * S / self.S_b}
        P = bus.machine.real * self.flow.S_b / S
        if (classical := self._record("machines", k)) is not None:
            X = bus.X_source
            if math.isnan(X):
                X = float(_default("machines", "X"))
                self.assumed.append(bus.name)
            values |= {"P": P, "E": abs(bus.V + 1j * X * i), "X": X, **classical}
            self._put("machines", f"G{self.names[k]}", values)
            return
        P += float(_default("synchronous_machines", "R")) * abs(i) ** 2
        own = self._record("synchronous_machines", k)
        values |= {"P": P, "V": abs(bus.V), **(_MACHINE if own is None else own)}
        if "governor" in values:
            governor: dict[str, Any] = values["governor"]
            if "T_rate" in governor:  # MW
                values["governor"] = governor | {"T_rate": governor["T_rate"] * 1e6 / S}
            values["governor"] = self._opened(values, named(bus.name))
        self._put("synchronous_machines", f"G{self.names[k]}", values)

    def _opened(self, machine: dict[str, Any], bus: str) -> dict[str, Any]:
        """Its governor, which opens as far as the case asks for: in many published files machines
        bring more than their governors let them by the rating."""
        governor: dict[str, Any] = machine["governor"]
        changed, before, shaft = dict[str, Any](), dict[str, float](), Shaft(0.0, machine["P"])
        for _ in range(9):  # the valve of GGOV1 does not follow its T_rate in proportion
            whole = machine | {"governor": governor | changed}
            one: Any = SynchronousMachine.model_validate(whole).governor
            states, _ = one.rest(machine["P"], shaft)
            for at, (_, most) in one.limits_at(shaft).items():
                if states[at] >= most:
                    for name in one.opens or [f"{name}max" for name in one.stops.values()]:
                        before.setdefault(name, getattr(one, name))
                        changed[name] = _ROOM * states[at] * (getattr(one, name) / most)
        for name, value in changed.items():
            self.ignored.append(
                f"{one.kind()} at {bus}: {name} = {value:.4g} instead of {before[name]:g}, for the"
                " power that the case has there."
            )
        return governor | changed

    def _record(self, table: str, k: int) -> dict[str, Any] | None:
        """What a dynamics file says of a part of a table at a bus."""
        return self.tables.get(table, {}).get(self.flow.buses[k].name)

    def _static(self, k: int, share: float) -> None:
        """What follows the grid at a bus, and the capacitor of its filter, which the power flow
        has not."""
        bus, S = self.flow.buses[k], share * self.flow.buses[k].static_rating * self.scale
        park = self._record("plant_controllers", k)
        if not S:
            if park is not None:
                self.ignored.append(f"REPCA1 at {named(bus.name)} is left out with its generator.")
            return
        power = bus.static / bus.static_rating - 1j * _FILTER * abs(bus.V) ** 2
        node = {"node": self._node(k)}
        own = self._record("grid_following", k) or {}
        V, k_V, band = abs(bus.V), own.get("k_V", 0.0), own.get("band", 0.0)
        supports = k_V * (max(1.0 - band - V, 0.0) - max(V - 1.0 - band, 0.0))  # p.u. of current
        values = {"S": S, "P": power.real, "Q": power.imag - supports * V, **own}
        self._put("grid_following", f"F{self.names[k]}", node | values)
        self._put("capacitors", f"filter{self.names[k]}", node | {"Q": _FILTER * S})
        if park is not None:
            self._plant_controller(k, park)

    def _plant_controller(self, k: int, park: dict[str, Any]) -> None:
        """That of what follows the grid at a bus, on the branch that it names, or else on the only
        one of its bus."""
        start, _, end = park["line"].partition("-")
        names = {bus.name: self._node(j) for j, bus in enumerate(self.flow.buses)}
        own, bus = self._node(k), named(self.flow.buses[k].name)
        node = own if start == "0" else names.get(start, "")
        ends = {
            name: (one["start"], one["end"])
            for table in ("lines", "transformers")
            for name, one in self.network.get(table, {}).items()
            if node in (one["start"], one["end"])
            and (start == "0" or names.get(end) in (one["start"], one["end"]))
        }
        if not ends or (start == "0" and len(ends) > 1):
            why = f"there is no branch {park['line']}"
            if start == "0":
                why = f"it names no branch, and its bus has {len(ends)}"
            self.ignored.append(f"REPCA1 at {bus} is left out: {why}.")
            return
        line = next(iter(ends))
        if len(ends) > 1:
            self.ignored.append(f"REPCA1 at {bus} measures {line}, the first of its lines.")
        values = {"line": line, "node": node, "converters": [f"F{self.names[k]}"]}
        if own in ends[line] and own != node:
            values["plant_end"] = own
        self._put("plant_controllers", f"P{self.names[k]}", park | values)

    def _converter(self, k: int, law: str, share: float) -> None:
        bus, S = self.flow.buses[k], self._rating(k)
        name, file = f"C{self.names[k]}", f"converter{self.names[k]}.toml"
        self.files[file] = _converter_file(share * S, self.flow.f)
        power = (bus.machine if self._is_machine(k) else bus.static) * self.flow.S_b / S
        if self.par is None:
            self.par = _parameters(self.files[file])
        try:
            references = _references(self.par, law, abs(bus.V), power)
        except (NoEquilibrium, LawError) as problem:
            raise UserError(f"{self.flow.name}: {named(bus.name)}: {problem}") from None
        self._put(
            "converters",
            name,
            {"node": self._node(k), "law": law, "references": references,
             "plant": {"converter": file}},
        )  # fmt: skip


def _joined(notes: Sequence[str]) -> list[str]:
    """Notes that say the same of several buses as one of all of them."""
    places: dict[tuple[str, str], dict[str, None]] = {}
    for note in notes:
        match = _OF_BUS.fullmatch(note)
        before, name, after = match.groups() if match else (note, "", "")
        places.setdefault((before, after), {})[name] = None
    return [
        f"{before}{'buses' if len(names) > 1 else 'bus'} {', '.join(names)}{after}"
        if names.keys() != {""}
        else before
        for (before, after), names in places.items()
    ]


def _default(table: str, name: str) -> Any:
    return COMPONENTS[table].model_fields[name].default


def _converter_file(S: float, f: float) -> dict[str, Any]:
    """A converter of a rating, VA, in SI units."""
    omega, Z = 2 * math.pi * f, _V_N**2 / S
    return {
        "source": "PowerSimulationsDynamics.jl, test/data_tests: filt(), in p.u. of this rating",
        "S_n": S, "V_n": _V_N, "omega_n": omega, "V_dcref": _V_DC,
        "L_f": _CONVERTER["L_f"] * Z / omega, "R_f": _CONVERTER["R_f"] * Z,
        "C_f": _CONVERTER["C_f"] / Z / omega,
        "L_g": _CONVERTER["L_g"] * Z / omega, "R_g": _CONVERTER["R_g"] * Z,
        "C_dc": 2 * _STORED_S * S / _V_DC**2,
    }  # fmt: skip


def _parameters(converter: dict[str, Any]) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "converter.toml")
        file.write_text(toml_text(converter), encoding="utf-8")
        return make_plant(Plant(converter=str(file)), 1e-4).par


def _references(par: Any, name: str, V_bus: float, S: complex) -> dict[str, float]:
    """References with which a law brings the power S, p.u. of the converter, to a bus.

    A law without an integrator comes to rest beside its references, so they are searched.

    Raises:
        NoEquilibrium: there are none.
    """
    first = load_law(name).first
    law, by_V = discretise(first, 1e-4), first.takes("V_ref")
    i = (S / V_bus).conjugate()
    v = V_bus + complex(_CONVERTER["R_g"], _CONVERTER["L_g"]) * i
    s, V = v * i.conjugate(), abs(v)

    def missed(z: NDArray[np.float64]) -> NDArray[np.float64]:
        Q, V_ref = (s.imag, z[1]) if by_V else (z[1], V)
        y = operating_point(par, law, np.array([1.0, z[0], 1.0, Q, V_ref]), 1.0, V_bus).y
        return np.array([y[P_AT] - s.real, y[V_AT] - V])

    solution = root(missed, [s.real, V if by_V else s.imag], tol=1e-13)
    if np.abs(missed(solution.x)).max() > 1e-9:
        raise NoEquilibrium(f"{name} cannot bring P = {S.real:.4g}, Q = {S.imag:.4g} p.u. there")
    P, other = (float(x) for x in solution.x)
    return {"P_ref": P, "Q_ref": s.imag if by_V else other, "V_ref": other if by_V else V}
