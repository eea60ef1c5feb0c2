"""A plant between two events: its wiring, and the records that compiled functions work on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from gfm_plant.constant_power import PowerLoad
from gfm_plant.emulator import plant_start, reconnect
from gfm_plant.model import DELTA
from gfm_plant.records import N_COMMANDS, N_OWN, PlantRecords, Record
from gfm_plant.wiring import GRID_SOURCE, Wiring

_DC_STEP = 0.2  # largest rate of the DC source's control times a step of the DC link's series
_PIECE = 0.5  # rad; largest angle through which a mode turns in half an interval of Simpson's rule
_LOOK = 10e-6  # s; how often a peak-current limit looks at the current
_ROUNDS = 100  # of the search for the currents of loads of constant power
_MOST = 500  # steps of the DC link, or intervals of Simpson's rule, in a period


@dataclass
class Network:
    """A plant of one converter or more.

    Attributes:
        records: what the compiled functions take.
        wiring: how its parts are connected now.
    """

    records: PlantRecords
    wiring: Wiring

    @property
    def loads(self) -> list[PowerLoad]:
        """The loads of constant power."""
        n = self.net[0]
        return [
            PowerLoad(
                sink.name, sink.node, complex(*n["S_sink"][j]), float(n["tau_sink"][j]),
                math.sqrt(n["least_v2"][j]),
            )
            for j, sink in enumerate(self.wiring.sinks)
        ]  # fmt: skip

    @property
    def par(self) -> Record:
        """Parameters of the converters, shape (N,)."""
        return self.records.par

    @property
    def st(self) -> Record:
        """State of the converters, shape (N,)."""
        return self.records.st

    @property
    def net(self) -> Record:
        """Parameters of the network, shape (1,)."""
        return self.records.net

    @property
    def now(self) -> Record:
        """State of the network, shape (1,)."""
        return self.records.now

    def copy(self) -> Network:
        """Return the same plant at the same instant, in memory of its own."""
        return Network(self.records.copy(), self.wiring)

    def restore(self, kept: Network) -> None:
        """Take the wiring, the parameters and the instant of a copy."""
        self.records.restore(kept.records)
        self.wiring = kept.wiring

    def start(
        self,
        x: NDArray[np.float64],
        u: NDArray[np.float64],
        machines: Sequence[tuple[float, float]] = (),
    ) -> None:
        """Put a plant fresh from `make_plant` into an equilibrium.

        Args:
            x: states of each converter, (N, 8); (8,) for one.
            u: its commands, (N, 4); for one also (4,), or (3,) without the q component of the
                bridge's voltage. What closed lines connect turns at one speed.
            machines: angle of each machine's voltage, rad, and its speed, p.u.
        """
        x, u = np.atleast_2d(x), np.atleast_2d(u)
        u = np.pad(u, ((0, 0), (0, N_COMMANDS - u.shape[1])))
        now, N = self.now[0], len(self.par)
        turn = np.exp(1j * x[:, DELTA])
        _set(now["unit"][:N], turn)
        modes, sources = self.wiring.modes(self.wiring.blocked, False)
        volts = {
            unit.bridge: complex(*u[k, 2:]) * turn[k] for k, unit in enumerate(self.wiring.units)
        }
        turns = {unit.bridge: float(u[k, 1]) for k, unit in enumerate(self.wiring.units)}
        volts[GRID_SOURCE], turns[GRID_SOURCE] = complex(now["V_g"]), float(now["omega_g"])
        for j, (machine, (angle, omega)) in enumerate(
            zip(self.wiring.machines, machines, strict=True), 1
        ):
            unit = np.exp(1j * angle)
            now["unit"][N + 1 + j] = unit.real, unit.imag
            now["omega"][j] = turns[machine.emf] = omega
            volts[machine.emf] = float(self.net[0]["E"][j]) * unit
        if reference := int(self.net[0]["reference"]):
            now["omega_g"] = now["omega"][reference]
        at_node = {load.node: float(u[k, 1]) for k, load in enumerate(self.wiring.units)}
        at_node |= {machine.node: turns[machine.emf] for machine in self.wiring.machines}
        if self.wiring.grid is not None and self.wiring.closed:
            at_node[self.wiring.grid] = turns[GRID_SOURCE]
        for load in self.loads:
            island = next(nodes for nodes in self.wiring.islands() if load.node in nodes)
            turns[load.name] = next((at_node[node] for node in island if node in at_node), 1.0)
            volts[load.name] = 0j

        def resting() -> NDArray[np.complex128]:
            z = np.zeros(len(modes.rates), complex)
            for omega in {turns[name] for name in sources}:
                speed = float(self.net[0]["omega_b"]) * (omega - 1.0)
                those = [volts[name] if turns[name] == omega else 0.0 for name in sources]
                z += modes.drive @ those / (1j * speed - modes.rates)
            return np.asarray(modes.states @ z)

        w = resting()
        for _ in range(_ROUNDS if self.loads else 0):  # their currents follow from the voltages
            for j, load in enumerate(self.loads):
                v = complex(w[self.net[0]["voltage_at"][j]])
                slip = float(self.net[0]["omega_b"]) * (turns[load.name] - 1.0)
                f, volts[load.name] = load.at_rest(v, slip)
                now["v_sink"][j] = f.real, f.imag
            w = resting()
        for k, row in enumerate(x):  # as they are given: all digits
            i_f, v, i_o = (complex(*row[2 * j : 2 * j + 2]) * turn[k] for j in range(N_OWN))
            current = float(self.par[k]["current"])
            w[N_OWN * k : N_OWN * (k + 1)] = i_f / current, v, i_o / current
        _set(now["w"][: len(w)], w)
        plant_start(self.records, x, u)

    def rewire(self, wiring: Wiring) -> None:
        """Go on from the present state with another wiring.

        A branch that has come in two keeps its current in both.

        Raises:
            ValueError: as ``connect``; the plant is then unchanged.
        """
        before, w = self.wiring, self.now["w"][0].copy()
        self.connect(wiring)
        if wiring.split is not None and wiring.split != before.split:
            there = wiring.order.index(wiring.split)
            self.now["w"][0, wiring.order.index("beyond")] = w[there]
        if "fault" in wiring.order and wiring.fault != before.fault:
            self.now["w"][0, wiring.order.index("fault")] = 0.0
        if before.grid is None and self.net[0]["reference"] == 0:  # the last machine is gone
            self.now["omega_g_slope"] = 0.0
        reconnect(self.records)

    def connect(self, wiring: Wiring) -> None:
        """Set the modes of all circuits that a wiring gives.

        Raises:
            ValueError: If the modes cannot be told apart (`gfm_plant.circuit`), or one is too fast
                for the DC link. The plant is then unchanged.
        """
        changed = self.records.copy()
        _connect(changed, wiring)
        self.records.par[:], self.records.net[:] = changed.par, changed.net
        self.wiring = wiring


def _connect(records: PlantRecords, wiring: Wiring) -> None:
    net, N = records.net, len(wiring.units)
    order = wiring.order
    net["n_states"] = len(order)
    net["to_grid"] = 0.0
    for name, factor in wiring.to_grid().items():
        net["to_grid"][0, order.index(name)] = factor
    found, which = {}, {}
    for k in range(N + 1):
        blocked = frozenset(wiring.blocked | ({k - 1} if k > 0 else set()))
        for fault in (False, True) if wiring.fault else (False,):
            which[k + (N + 1) * fault] = blocked, fault
            found[k + (N + 1) * fault] = wiring.modes(blocked, fault)
    _pack_pieces(records, max(np.abs(modes.rates.imag).max() for modes, _ in found.values()))
    running = [j for j, m in enumerate(wiring.machines, 1) if m.name not in wiring.opened]
    net["reference"] = running[0] if running and wiring.grid is None else 0
    places: dict[str, tuple[int, ...]] = {unit.bridge: (k,) for k, unit in enumerate(wiring.units)}
    places[GRID_SOURCE] = (N, N + 1)
    for j, sink in enumerate(wiring.sinks):
        places[sink.name] = (N + 2 + len(wiring.machines) + j,)
        bank = next(bank.name for bank in wiring.capacitors if bank.node == sink.node)
        net["voltage_at"][0, j] = order.index(bank)
    for j, machine in enumerate(wiring.machines, 1):
        places[machine.emf] = (N + 1 + j,)
        net["current_at"][0, j] = order.index(machine.name)
    net["check_w"] = net["check_s"] = 0.0
    cuts = 2 * int(net[0]["n_parts"])
    for circuit, (modes, sources) in found.items():
        n = net["n_modes"][0, circuit] = len(modes.rates)
        _set(net["rate"][0, circuit, :n], modes.rates)
        for part, half in enumerate(net["half_h"][0, :cuts]):
            _set(net["decay"][0, circuit, part, :n], np.exp(modes.rates * half))
        _set(net["states"][0, circuit, : len(order), :n], modes.states)
        _set(net["modes"][0, circuit, :n, : len(order)], modes.modes)
        _set(net["mirror"][0, circuit, :n], modes.mirror)
        net["unbalanced"][0, circuit] = modes.mirror.any()
        net["drive"][0, circuit] = 0.0
        for j, source in enumerate(sources):
            for place in places[source]:
                _set(net["drive"][0, circuit, :n, place], modes.drive[:, j])
        for side, node in enumerate(wiring.check.sides if wiring.check else ()):
            if node == GRID_SOURCE:
                net["check_s"][0, circuit, side, N] = 1.0
                continue
            by_w, by_s = wiring.voltage(node, *which[circuit])
            net["check_w"][0, circuit, side, : len(order)] = by_w
            for factor, source in zip(by_s, sources, strict=False):  # sinks follow
                net["check_s"][0, circuit, side, places[source][0]] = factor


def _set(field: NDArray[np.float64], values: NDArray[np.complex128]) -> None:
    field[..., 0], field[..., 1] = values.real, values.imag


def _pack_pieces(records: PlantRecords, fastest: float) -> None:
    """Choose the pieces of Simpson's rule, and the DC link's steps in them, by the fastest mode."""
    net, parts = records.net, int(records.net[0]["n_parts"])
    stretch = net["stretch"][0, :parts]
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
    net["pieces"][0, : 2 * parts], net["half_h"][0, : 2 * parts] = pieces, each / pieces / 2
    for k, r in enumerate(records.par):
        per_C = r["omega_b"] / r["C_dc"]
        rate = max(per_C * r["k_p"], math.sqrt(per_C * r["k_i"]))
        if r["tau_dc"] > 0.0:
            rate = max(rate, 1 / r["tau_dc"], math.sqrt(per_C * r["k_p"] / r["tau_dc"]))
        if rate * longest > _DC_STEP * _MOST:
            raise ValueError(
                f"plant.dc_source k_p, k_i, tau_s: with C_dc they are as fast as {rate:.6g}"
                f" rad/s; allowed are {_DC_STEP * _MOST / longest:.6g} rad/s at this T_s"
            )
        r["dc_steps"] = max(1, math.ceil(rate * 2 * max(net["half_h"][0, :parts]) / _DC_STEP))
        for part, half in enumerate(net["half_h"][0, : 2 * parts]):
            net["sensor_weights"][0, part, k] = _low_pass(float(r["omega_s"] * 2 * half))
    for j in range(int(net[0]["n_sinks"])):
        for part, half in enumerate(net["half_h"][0, : 2 * parts]):
            lag = float(net[0]["tau_sink"][j])
            net["sink_weights"][0, part, j] = _low_pass(2 * half / lag)


@lru_cache(maxsize=256)
def _low_pass(x: float) -> tuple[float, ...]:
    """Weights of a first-order low-pass after a stretch of x time constants: of its state, and of
    its input at the beginning, the middle and the end, between which the input is a parabola."""
    A = np.diag([1.0, 1.0, 1.0], 1)
    A[0, 0] = -x
    whole, f_1, f_2, f_3 = expm(A)[0]  # f_k: integrals of e^(-x (1 - t)) t^(k - 1) / (k - 1)!
    return whole, x * (f_1 - 3 * f_2 + 4 * f_3), x * (4 * f_2 - 8 * f_3), x * (4 * f_3 - f_2)
