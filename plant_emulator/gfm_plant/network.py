"""A plant between two events: its wiring, and the records that compiled functions work on."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.circuit import Branch
from gfm_plant.components import DYNAMIC
from gfm_plant.components.part import Dynamic, Fed
from gfm_plant.contacts import OWN_PATH, join
from gfm_plant.emulator import plant_start, reconnect
from gfm_plant.layout import CHECK_SIDES, Record, head
from gfm_plant.model import DELTA
from gfm_plant.names import WAYS
from gfm_plant.phases import convert_nothing
from gfm_plant.port import pack_port
from gfm_plant.records import ACROSS, COMPARE, N_COMMANDS, N_OWN, N_PHASES, PlantRecords
from gfm_plant.solution import integrals
from gfm_plant.sparse import pack_sparse
from gfm_plant.ways import find_ways
from gfm_plant.wiring import CONTACT, GRID_SOURCE, FaultPlace, Wiring
from gfm_runtime.by_address import in_memory

_DC_STEP = 0.2  # largest rate of the DC source's control times a step of the DC link's series
_PIECE = 0.5  # rad; largest angle through which a mode turns in half an interval of Simpson's rule
_LOOK = 10e-6  # s; how often a peak-current limit looks at the current
_ROUNDS = 100  # of the search for the currents of components
_NEAR = 1e-9  # p.u.; between two rounds at its end
_ALL = ("abc", 1)  # phases of a breaker that begins to open
_MOST = 500  # steps of the DC link, or intervals of Simpson's rule, in a period


@dataclass
class Network:
    """A plant of one converter or more."""

    # par, st, net, now, parts: its memory, as `PlantRecords` has it, all arrays of ``net`` and
    # ``now`` included
    par: Record
    st: Record
    net: Record
    now: Record
    parts: tuple[Record, ...]
    wiring: Wiring  # how its parts are connected now
    # of a part of another plant, see `parted`: names in the others, and the rate, rad/s, that
    # Simpson's rule follows at least; and that which it follows
    elsewhere: frozenset[str] = frozenset()
    at_least: float = 0.0
    fastest: float = 0.0

    @property
    def typed(self) -> PlantRecords:
        """The same memory as the compiled functions take it; what they call by address may not be
        known yet."""
        records = PlantRecords(self.par, self.st, head(self.net), head(self.now), self.parts)
        words = in_memory(records)  # what is called by address takes them from there
        place = self.net["in_memory"][0, : len(words)]
        place[:] = words
        self.net["records"] = place.ctypes.data
        return records

    def keep_addresses(self, ways: Sequence[int]) -> None:
        """Put addresses of this process, those of ``WAYS`` and of its own memory, in the place of
        those that came with another plant's memory."""
        for name, address in zip(WAYS, ways, strict=True):
            self.net[name] = address
        _ = self.typed

    @cached_property
    def records(self) -> PlantRecords:
        """The same memory, as the compiled functions take it."""
        records = self.typed
        find_ways(records, self.wiring)
        return records

    @property
    def memory(self) -> tuple[Record, ...]:
        """All arrays of the memory."""
        return self.par, self.st, self.net, self.now, *self.parts

    def of(self, kind: type[Dynamic]) -> Record:
        """The records of a kind of component."""
        return self.parts[DYNAMIC.index(kind)]

    def fed(self) -> list[tuple[str, Fed, Any]]:
        """Name, options and record of each component with a source, in the order of the wiring."""
        each = {kind: iter(self.of(kind)) for kind in DYNAMIC}
        return [(name, one, next(each[type(one)])) for name, one in self.wiring.fed]

    def _leader(self) -> Any:
        """The record of the component whose speed is that of a network without a grid, or None."""
        names = [record for _, _, record in self.fed() if "leads" in record.dtype.names]
        return next((record for record in names if record["leads"]), None)

    def copy(self) -> Network:
        """Return the same plant at the same instant, in memory of its own."""
        copies = (np.ndarray(r.shape, r.dtype, _bytes(r).copy()) for r in self.memory)
        par, st, net, now, *parts = copies
        return Network(
            par, st, net, now, tuple(parts), self.wiring, self.elsewhere, self.at_least,
            self.fastest,
        )  # fmt: skip

    def restore(self, kept: Network) -> None:
        """Take the wiring, the parameters and the instant of a copy."""
        ways = [int(self.net[name][0]) for name in WAYS]
        for record, old in zip(self.memory, kept.memory, strict=True):
            _bytes(record)[:] = _bytes(old)
        self.keep_addresses(ways)
        self.wiring, self.fastest = kept.wiring, kept.fastest

    def without_current(self, k: int, ticks: int) -> NDArray[np.float64]:
        """What the A/D at the phases of converter k has read before the first tick, when nothing
        flowed: counts, (ticks, 10)."""
        rows = np.empty((ticks, N_PHASES))
        if ticks:
            convert_nothing(self.typed, k, rows)
        return rows

    def start(
        self,
        x: NDArray[np.float64],
        u: NDArray[np.float64],
        rests: Sequence[tuple[NDArray[np.float64], float]] = (),
        voltages: Mapping[str, complex] | None = None,
    ) -> None:
        """Put a plant fresh from `make_plant` into an equilibrium.

        Args:
            x: states of each converter, (N, 8); (8,) for one.
            u: its commands, (N, 4); for one also (4,), or (3,) without the q component of the
                bridge's voltage. What closed lines connect turns at one speed.
            rests: unknowns of each component with a source, see ``Fed.steady``, and the speed of
                its island, p.u.; none if they have no unknowns and turn with the first converter.
            voltages: of the nodes there, p.u.; they count where a component's current rises so
                steeply with its voltage that the search for both does not end.
        """
        now, N, wiring = self.now[0], len(self.par), self.wiring
        x, commands, u = np.atleast_2d(x), np.atleast_2d(u)[:, :COMPARE], np.zeros((N, COMPARE))
        u[:, : commands.shape[1]] = commands
        turn = np.exp(1j * x[:, DELTA])
        now["unit"][:N] = turn
        order, omega_b, place_of = wiring.order, wiring.omega_b, wiring.sources()
        volts = {unit.bridge: complex(*u[k, 2:]) * turn[k] for k, unit in enumerate(wiring.units)}
        turns = {unit.bridge: float(u[k, 1]) for k, unit in enumerate(wiring.units)}
        volts[GRID_SOURCE], turns[GRID_SOURCE] = complex(now["V_g"]), float(now["omega_g"])
        rests_at = wiring.resting if self.net[0]["sparse"] else wiring.resting_by_modes
        resting_at = rests or [(np.empty(0), float(u[0, 1]))] * len(wiring.fed)
        fed = [(*item, *rest) for item, rest in zip(self.fed(), resting_at, strict=True)]
        for name, one, record, z, omega in fed:
            source, *others = one.sources(name)
            turns |= dict.fromkeys((source, *others), omega)
            volts |= dict.fromkeys((source, *others), 0j)
            if one.is_voltage:
                volts[source] = voltage = one.settle(record, 0j, omega, omega_b, z)
                place = place_of[source]
                now["emf"][place] = E = complex(record["E"])
                now["unit"][place] = voltage / E
        if (leader := self._leader()) is not None:
            now["omega_g"] = leader["omega"]

        w = rests_at(volts, turns)
        currents = [item for item in fed if not item[1].is_voltage]

        def settle(seen: Sequence[Any]) -> NDArray[np.complex128]:
            for (name, one, record, z, omega), v in zip(currents, seen, strict=True):
                i = one.settle(record, v, omega, omega_b, z)
                volts.update(zip(one.sources(name), np.atleast_1d(i).tolist(), strict=True))
            return rests_at(volts, turns)

        before = w
        for _ in range(_ROUNDS if currents else 0):  # they follow from the voltages
            before, w = w, settle([w[record["sees"]].tolist() for _, _, record, _, _ in currents])
        if voltages and not np.abs(w - before).max() < _NEAR:
            known = [[voltages[node] for node in one.nodes] for _, one, _, _, _ in currents]
            w = settle([v if len(v) > 1 else v[0] for v in known])
        for k, row in enumerate(x):  # as they are given: all digits
            i_f, v, i_o = (complex(*row[2 * j : 2 * j + 2]) * turn[k] for j in range(N_OWN))
            current = float(self.par[k]["current"])
            w[N_OWN * k : N_OWN * (k + 1)] = i_f / current, v, i_o / current
        now["w"][: len(order)] = w
        self.begin(x, u)

    def begin(self, x: NDArray[np.float64], u: NDArray[np.float64]) -> None:
        """Fill the delay lines, sensors and DC sources of a plant whose circuit is at rest; x and u
        are (N, 8) and (N, 4), as of ``start``."""
        told = np.full((len(u), N_COMMANDS), -1.0)
        told[:, :COMPARE] = u
        plant_start(self.typed, x, told)

    def rewire(self, wiring: Wiring) -> None:
        """Go on from the present state with another wiring.

        A branch that has come in two keeps its current in both. Raises ValueError: as ``connect``;
        the plant is then unchanged.
        """
        before, now = self.wiring, self.now
        w = dict(zip(before.order, now["w"][0], strict=False))
        conducting, (which, i_0) = self.conducting(), self._zero_current()
        live = {name for name, part in wiring.poles if conducting.get(part, _ALL)[0]}
        opening = tuple(one for one in wiring.opening if one.name in live)
        wiring = _known(replace(wiring, opening=opening))
        self.connect(wiring)
        if wiring.split is not None and wiring.split != before.split:
            for sequence in ("", ".0"):
                w[f"beyond{sequence}"] = w.get(wiring.split + sequence, 0.0)
            conducting["beyond"] = conducting.get(wiring.split, _ALL)
        if wiring.fault != before.fault:
            w[CONTACT] = w[OWN_PATH] = 0.0
        now["w"][0, : len(wiring.order)] = [w.get(name, 0.0) for name in wiring.order]
        parts = ["", *(part for _, part in wiring.poles)]
        if wiring.joint and which in parts:
            now["w"] += i_0 * self.net["zero_shares"][0, parts.index(which)]
        now["joint"], now["made"] = wiring.joint, 0
        for j, part in enumerate(parts):
            phases, opens = conducting.get(part, _ALL if part else ("", 0))
            now["conducts"][0, j], now["opens"][0, j] = [p in phases for p in "abc"], opens
        # what is left may be another kind, for want of a path of the zero sequence
        alone = "" if wiring.joint or not wiring.opening else wiring.opening[0].name
        phases, opens = conducting.get(alone, _ALL if alone else ("", 0))
        now["contact"] = self.net["contact_of"][0, sum(1 << "abc".index(p) for p in phases)]
        now["clearing"] = bool(wiring.opening) or opens * (now["contact"][0] > 0)
        if before.grid is None and self._leader() is None:  # the last machine is gone
            self.now["omega_g_slope"] = 0.0
        if "records" not in vars(self):  # it has no ticks yet
            find_ways(self.typed, wiring, ("join",))
        reconnect(self.typed)

    def conducting(self) -> dict[str, tuple[str, int]]:
        """The phases of each contact that conduct, and whether they open as their currents pass
        zero: of the fault as "", of breakers by their branches."""
        wiring, now = self.wiring, self.now[0]
        found = {part: ("", 0) for _, part in wiring.poles}
        if now["joint"]:
            for j, part in enumerate(["", *(part for _, part in wiring.poles)]):
                flags = zip("abc", now["conducts"][j], strict=True)
                found[part] = "".join(p for p, one in flags if one), int(now["opens"][j])
        elif (one := wiring.contacts[now["contact"]]) is not None:
            part = "" if isinstance(one, FaultPlace) else wiring.opening[0].name
            found[part] = one.phases, int(now["clearing"])
        return found

    def _zero_current(self) -> tuple[str, complex]:
        """The only contact, as ``conducting`` calls it, and the zero sequence of its current, which
        has no state yet, as a phasor in the common frame."""
        wiring, now = self.wiring, self.now[0]
        contact = None if now["joint"] else wiring.contacts[now["contact"]]
        if contact is None:
            return "", 0j
        tick = int(self.st[0]["tick"])
        turn = cmath.exp(1j * float(self.net[0]["omega_b"] * self.net[0]["T_s"]) * tick)
        i = wiring.contact_current(contact) @ (now["w"][: len(wiring.order)] * turn)
        name = "" if isinstance(contact, FaultPlace) else wiring.opening[0].name
        return name, i.real.mean() / turn

    def connect(self, wiring: Wiring) -> None:
        """Set the modes of all circuits that a wiring gives. Raises ValueError: If the modes cannot
        be told apart (`gfm_plant.circuit`), or one is too fast for the DC link. The plant is then
        unchanged."""
        changed = self.copy()
        connect_new(changed, wiring)
        changed.wiring = wiring
        self.restore(changed)
        if "records" in vars(self):  # else they are made with all that this wiring needs
            find_ways(self.records, wiring)


@lru_cache(maxsize=32)
def _known(wiring: Wiring) -> Wiring:
    """The same wiring as an earlier one, with all that it has worked out: an event is tried on a
    copy of the plant before the loop, which waits for it, carries it out."""
    return wiring


def _bytes(record: Record) -> NDArray[np.uint8]:
    """Its memory, the gaps between its fields included; as a view, numpy would look at each field
    for Python objects."""
    return np.ndarray(record.nbytes, np.uint8, record)


def connect_new(plant: Network, wiring: Wiring) -> None:
    """Set the modes of all circuits in the memory of a plant that an error may leave half done;
    arguments and errors as of ``Network.connect``."""
    net, N, order = plant.net[0], len(wiring.units), wiring.order
    net["n_states"] = len(order)
    plant.now["slot_key"] = plant.now["stride_for"] = 0
    net["to_grid"] = 0.0
    for name, factor in wiring.to_grid().items():
        net["to_grid"][order.index(name)] = factor
    banks = {unit.terminal: unit.states[1] for unit in wiring.units}
    banks |= {bank.node: bank.name for bank in reversed(wiring.capacitors)}
    may_lead = wiring.grid is None and not wiring.led
    for name, one, record in plant.fed():
        seen = one.sees(name, banks)
        record["sees"] = order.index(seen) if isinstance(seen, str) else [*map(order.index, seen)]
        if "leads" in record.dtype.names:
            record["leads"] = may_lead and name not in wiring.opened
            may_lead = may_lead and not record["leads"]
    found, which = {}, {}
    _pack_contacts(net, wiring)
    _pack_flows(net, wiring)
    looked_at = _nodes(net, wiring)
    net["poles"], fastest = 0, []
    if net["sparse"]:
        fastest.append(pack_sparse(net, wiring, looked_at))
    for k in range(0 if net["sparse"] else N + 1):
        blocked = frozenset(wiring.blocked | ({k - 1} if k > 0 else set()))
        for j, contact in enumerate(wiring.contacts):
            which[k + (N + 1) * j] = blocked, contact
            found[k + (N + 1) * j] = wiring.modes(blocked, contact)
    fastest += [np.abs(modes.rates.imag).max() for modes, _ in found.values()]
    if wiring.joint:
        fastest.append(_pack_joint(plant, wiring))
    plant.fastest = max(*fastest, plant.at_least)
    _pack_pieces(plant, plant.fastest)
    places = wiring.sources()
    for circuit, (modes, sources) in found.items():
        n = net["n_modes"][circuit] = len(modes.rates)
        net["rate"][circuit, :n] = modes.rates
        net["decay"][circuit, :, :n] = np.exp(np.multiply.outer(net["half_h"], modes.rates))
        net["states"][circuit, : len(order), :n] = modes.states
        net["unbalanced"][circuit] = modes.mirror.any()
        images = np.stack([np.ones(n), modes.mirror])
        net["modes"][circuit, :, :n, : len(order)] = images[:, :, None] * modes.modes
        if net["n_units"]:
            _pack_rates(plant, wiring, circuit, *which[circuit])
        net["drive"][circuit] = 0.0
        for j, source in enumerate(sources):
            driven = images * modes.drive[:, j]
            net["drive"][circuit, :, :n, places[source]] = driven
            if source == GRID_SOURCE:  # its negative sequence
                net["drive"][circuit, :, :n, places[source] + 1] = driven
        for place, node in looked_at.items():
            if node == GRID_SOURCE:
                net["node_s"][circuit, place, 0, places[node]] = 1.0
                continue
            by_w, by_s, net["node_turn"][circuit] = wiring.voltage(node, *which[circuit])
            net["node_w"][circuit, place, :, : len(order)] = by_w
            for factors, source in zip(by_s.T, sources, strict=False):  # sinks follow
                net["node_s"][circuit, place, :, places[source]] = factors


def _pack_rates(
    plant: Network, wiring: Wiring, circuit: int, blocked: frozenset[int], contact: Any
) -> None:
    """Set the equations of a circuit for `series`: what a converter's own states do to each other,
    and a list of all else."""
    net, N, places = plant.net[0], len(wiring.units), wiring.sources()
    axes, angle, names = wiring.rates(blocked, contact)
    net["axis"][circuit] = np.exp(-1j * angle)
    net["leg_axis"][circuit] = np.exp(1j * (2 * np.pi / 3 * np.arange(3) - angle))
    fastest = max(one.fastest for one in axes)
    net["fastest"][circuit] = max(_fastest_with_dc(r, fastest) for r in plant.par if r["levels"])
    free = [_free_states(one.free, N) for one in axes]
    by_w = [one.by_w @ by for one, (_, by) in zip(axes, free, strict=True)]
    for A, one in zip(by_w, axes, strict=True):
        A[np.abs(A) < 1e-13 * one.fastest] = 0.0
    if circuit < net["n_ports"]:
        B = np.zeros((len(axes[0].by_s), len(places) + 1))
        for column, name in zip(axes[0].by_s.T, names, strict=True):
            B[:, places[name]] = column
            if name == GRID_SOURCE:  # its negative sequence
                B[:, places[name] + 1] = column
        pack_port(net, circuit, net["switched"], by_w[0], B, *free[0], axes[0].fastest)
    for k in range(N):
        i_f, v, i_o = range(N_OWN * k, N_OWN * (k + 1))
        for axis, A in enumerate(by_w):
            for j, at in enumerate(((v, i_f), (v, v), (v, i_o), (i_o, v), (i_o, i_o))):
                net["own_rates"][circuit, k, axis, j], A[at] = A[at], 0.0
            A[i_f] = 0.0  # is the bridge's
    by_s = [np.zeros((len(one.by_s), len(places) + 1)) for one in axes]
    for one, factors in zip(axes, by_s, strict=True):
        for column, name in zip(one.by_s.T, names, strict=True):
            if places[name] >= N:
                factors[:, places[name]] = column
            if name == GRID_SOURCE:  # its negative sequence
                factors[:, places[name] + 1] = column
    for which, (alpha, beta) in enumerate((by_w, by_s)):
        entries = np.argwhere((alpha != 0) | (beta != 0))
        net["n_links"][circuit, which] = len(entries)
        net["link_place"][circuit, which, : len(entries)] = entries
        if which:  # the grid's two sequences act alike on its line
            only = {(int(row), int(column)) for row, column in entries}
            i_o, g = 2, places.get(GRID_SOURCE, 0)
            net["alone"][circuit] = (
                N == 1 and only == {(i_o, g), (i_o, g + 1)} and not net["n_links"][circuit, 0]
            )
        for axis, factors in enumerate((alpha, beta)):
            net["link"][circuit, which, : len(entries), axis] = factors[tuple(entries.T)]


def _free_states(basis: Any, N: int) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Choose states that give all others, those of converters first; returns which, and the matrix
    that gives all by these, of a basis of what the nodes allow."""
    left, chosen = basis.copy(), list[int]()
    sizes = np.linalg.norm(basis, axis=1)
    for x in range(len(basis)):
        size = np.linalg.norm(left[x])
        if size > 1e-6 * sizes[x] > 0.0:
            chosen.append(x)
            left -= np.outer(left @ left[x], left[x]) / size**2
    which, by = np.zeros(len(basis), bool), np.zeros((len(basis), len(basis)))
    which[chosen] = True
    by[:, chosen] = np.linalg.solve(basis[chosen].T, basis.T).T
    return which, by


def _fastest_with_dc(r: Any, circuit: float) -> float:
    """A bound of the norm in energy coordinates of a circuit, whose own is ``circuit``, and the DC
    link of a converter, 1/s."""
    per_C, per_L = r["omega_b"] / r["C_dc"], r["omega_b"] / r["L_f"]
    ac = circuit + per_L * float(r["band"][:, :, 3].max())
    joins = math.sqrt(per_C * per_L) * r["leg"]
    dc = math.sqrt(per_C * r["k_i"]) + per_C * r["chopper"][0]
    dc += per_C * r["k_p"]
    if r["tau_dc"] > 0.0:
        dc += 1 / r["tau_dc"] + math.sqrt(per_C * max(1.0, r["k_p"]) / r["tau_dc"])
    if r["levels"] > 2:  # the midpoint besides
        joins *= 2.0
    return float((ac + dc) / 2 + math.hypot((ac - dc) / 2, joins))


def _nodes(net: Any, wiring: Wiring) -> dict[int, str]:
    """The nodes whose voltage is looked at by their places in ``net``, whose entries are cleared;
    sets which current reaches a connection point."""
    net["node_w"] = net["node_s"] = 0.0
    found = dict(enumerate(wiring.check.sides if wiring.check else ()))
    for k, unit in enumerate(wiring.units if net["connections"] else ()):
        found[CHECK_SIDES + k] = unit.connection
        last = "beyond" if wiring.split == unit.line else unit.line
        net["node_i"][CHECK_SIDES + k] = wiring.order.index(last)
    return found | dict(enumerate(wiring.recorded_nodes, int(net["flow_first"])))


def _pack_flows(net: Any, wiring: Wiring) -> None:
    """Set what the currents of recorded terminals are made of, and which of their nodes the grid
    holds."""
    order, nodes, sources = wiring.order, wiring.recorded_nodes, wiring.sources()
    net["flow_held"] = [wiring.closed and node == wiring.grid for node in nodes]
    net["flow_fault"] = 0
    through = {one.name: 1 / one.R for one in wiring.shunts if one.name not in wiring.opened}
    sinks = {one.name for one in wiring.sinks} - wiring.opened
    k = count = 0
    for one in wiring.recorded:
        if not one.node:
            net["flow_fault"] = 1 + (wiring.fault is not None)
            continue
        parts = one.parts or tuple(
            (name, -by) for name, by in wiring.with_poles().to_grid().items()
        )
        net["flow_node"][k], net["flow_begin"][k] = nodes.index(one.node), count
        net["flow_turns"][k] = sources[one.turns] if one.turns else -1
        net["flow_more"][k] = len(one.more)
        net["flow_G"][k] = sum(by * through.get(name, 0.0) for name, by in parts)
        for name, by in parts:
            if name == wiring.split != one.name:  # its end
                name = "beyond"
            if name in order:
                net["flow_from"][count] = order.index(name)
            elif name in sinks:
                net["flow_from"][count] = len(order) + sources[name]
            else:
                continue
            net["flow_by"][count], count = by, count + 1
        k += 1
    if k:
        net["flow_begin"][k] = count


def _pack_contacts(net: Any, wiring: Wiring) -> None:
    """Set what the phases of a fault or breaker carry, and what is left when one of them opens."""
    contacts, order = wiring.contacts, wiring.order
    zero_sequence = wiring.zero_sequence is not None
    net["opens_to"] = -1
    net["contact_w"] = order.index(CONTACT) if CONTACT in order else -1
    net["contact_of"] = 0
    for j, one in enumerate(contacts):
        if one is not None:
            net["contact_of"][sum(1 << "abc".index(p) for p in one.phases)] = j
            net["contact_current"][j, :, : len(order)] = wiring.contact_current(one)
            for p, phase in enumerate("abc"):
                carries = phase in one.phases and one.clearing == "zero"
                net["opens_to"][j, p] = (
                    contacts.index(one.opened(phase, zero_sequence)) if carries else -1
                )


def _pack_joint(plant: Network, wiring: Wiring) -> float:
    """Set the system of several contacts; returns its fastest mode, 1/s."""
    net, order, places = plant.net[0], wiring.order, wiring.sources()
    one = join(wiring)
    q, n_w = one.flow.shape[1], len(order)
    net["reals"], net["poles"] = q, len(wiring.poles)
    net["at_zeros"] = wiring.fault is not None and wiring.fault.clearing == "zero"
    net["flow"][:, :q, :q] = one.flow
    net["fault_bars"][..., :q] = one.fault_bars
    net["pole_bars"][: len(wiring.poles), :, :q] = one.pole_bars
    net["to_w"][:n_w, :, :q] = one.to_w.swapaxes(0, 1)
    net["from_w"][:n_w, :, :q] = one.from_w.swapaxes(0, 1)
    by_w = (
        one.from_w[0] - 1j * one.from_w[1]
    )  # of the real part of w in the frame that stands still
    net["fault_carries"][..., :n_w] = one.fault_carries @ by_w.T
    net["pole_carries"][: len(wiring.poles), :, :n_w] = math.sqrt(1.5) * one.pole_bars @ by_w.T
    net["zero_shares"] = 0.0
    each = one.fault_carries[7], *(math.sqrt(1.5) * one.pole_bars)
    for j, zero in enumerate(np.mean(each, axis=1)):
        if (size := zero @ zero) > 0:
            net["zero_shares"][j, :n_w] = one.to_w[0] @ zero / size
    net["from_s"] = 0.0
    for j, source in enumerate(one.sources):
        net["from_s"][places[source], :, :q] = one.from_s[:, j]
        if source == GRID_SOURCE:
            net["from_s"][places[source] + 1, :, :q] = one.from_s[:, j]
    net["node_q"] = 0.0

    def behind(place: int, state: str, path: Sequence[tuple[Branch, bool]]) -> None:
        """A node's voltage: that of a capacitor, and what branches on the way add and take."""
        direct, rate = net["node_q"][place, :, :, :q]
        if state:
            direct += one.to_w[:, order.index(state)]
        for branch, forth in path:
            i = one.to_w[:, order.index(branch.name)]
            for v, Z in ((direct, branch.R), (rate, branch.L / wiring.omega_b)):
                if forth:
                    v /= branch.ratio
                v -= Z * i if forth else -Z * i
                if not forth:
                    v *= branch.ratio

    pieces = {part.name: part for part in wiring.with_poles().whole(wiring.units_lines)}
    for k, unit in enumerate(wiring.units if net["connections"] else ()):
        line = [unit.line, *(["beyond"] * (wiring.split == unit.line))] if unit.at_end else []
        path = [(pieces[name], True) for name in line if name in pieces]
        behind(CHECK_SIDES + k, unit.states[1], path)
    for k, node in enumerate(wiring.recorded_nodes, int(net["flow_first"])):
        behind(k, *wiring.path_to(node))
    if net["n_units"]:
        c, norm = net["n_c"] - 1, max(np.linalg.norm(flow, 2) for flow in one.flow)
        net["axis"][c], net["leg_axis"][c] = 1.0, np.exp(2j * np.pi / 3 * np.arange(3))
        net["fastest"][c] = max(_fastest_with_dc(r, float(norm)) for r in plant.par if r["levels"])
    return one.fastest


def _pack_pieces(plant: Network, fastest: float) -> None:
    """Choose the pieces of Simpson's rule, and the DC link's steps in them, by the fastest mode."""
    net = plant.net[0]
    stretch, parts = net["stretch"], len(net["stretch"])
    longest = max(stretch)
    if fastest * longest > 2 * _PIECE * _MOST:
        raise ValueError(
            f"the circuit's fastest mode = {fastest:.6g} rad/s: too fast for the DC link; allowed"
            f" are {2 * _PIECE * _MOST / longest:.6g} rad/s at this T_s; raise L_f, C_f, L_g or"
            " plant.grid.load_L"
        )
    # the hardware of a peak-current limit looks at the current once a piece of the second cut
    each = np.concatenate([stretch, stretch])
    most = np.repeat([longest, _LOOK], parts)
    pieces = np.ceil(each * np.maximum(fastest / (2 * _PIECE), (1 - 1e-9) / most))
    net["pieces"][:-1], net["half_h"][:-1] = pieces, each / pieces / 2
    for r in plant.par:
        per_C = r["omega_b"] / r["C_dc"]
        rate = max(per_C * r["k_p"], math.sqrt(per_C * r["k_i"]))
        if r["array"] == ACROSS:  # the diode, at the open-circuit voltage
            rate = per_C * (r["I_sc"] * max(1.0, r["irradiance"]) + r["I_0"]) / r["v_T"]
        if r["tau_dc"] > 0.0:
            rate = max(rate, 1 / r["tau_dc"], math.sqrt(per_C * r["k_p"] / r["tau_dc"]))
        if rate * longest > _DC_STEP * _MOST:
            what = "pv" if r["array"] == ACROSS else "k_p, k_i, tau_s"
            raise ValueError(
                f"plant.dc_source {what}: with C_dc as fast as {rate:.6g}"
                f" rad/s; allowed are {_DC_STEP * _MOST / longest:.6g} rad/s at this T_s"
            )
        r["dc_steps"] = max(1, math.ceil(rate * 2 * max(net["half_h"][:parts]) / _DC_STEP))
    for name, one, _ in plant.fed():
        one.check_pieces(name, 2 * float(min(net["half_h"][:-1])), plant.wiring.omega_b)
    lags = [lag for _, one, _ in plant.fed() if (lag := one.lag()) is not None]
    net["lag_rate"] = [*plant.par["omega_s"], *(1 / lag for lag in lags)]
    for part, half in enumerate(net["half_h"][:-1]):
        spans = [float(r["omega_s"] * 2 * half) for r in plant.par]
        spans += [2 * half / lag for lag in lags]
        net["lag_weights"][part] = [_low_pass(float(x)) for x in spans]


@lru_cache(maxsize=256)
def _low_pass(x: float) -> tuple[float, ...]:
    """Weights of a first-order low-pass after a stretch of x time constants: of its state, and of
    its input at the beginning, the middle and the end, between which the input is a parabola."""
    whole, f_1, f_2, f_3 = integrals.py_func(x)
    return whole, x * (f_1 - 3 * f_2 + 4 * f_3), x * (4 * f_2 - 8 * f_3), x * (4 * f_3 - f_2)
