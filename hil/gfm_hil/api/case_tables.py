"""A power-flow case as the files of other programs have it, and its net of pandapower."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple


class Winding(NamedTuple):
    bus: int
    tap: float  # p.u. of the voltage of its bus
    degrees: float


class CaseTables:
    """The tables of a case, as those of PYPOWER, by which a reader's class fills them; p.u. of
    ``S_b`` in MVA, Hz."""

    def __init__(self, S_b: float, f: float) -> None:
        self.S_b, self.f = S_b, f
        self.ignored: list[str] = []  #: what the file has, and the tables have not
        #: by number: type, P, Q of loads, G, B of shunts, MW and Mvar, V, its angle, kV
        self.buses: dict[int, list[float]] = {}
        self.branches: list[list[float]] = []  # from, to, R, X, B, ratio, shift
        self.jumpers: list[tuple[int, int]] = []
        #: by bus: P, rating, and rating by the reactance of the source, MW and MVA
        self.generators: dict[int, tuple[float, float, float]] = {}

    def net(self) -> Any:
        """The net of pandapower, whose buses are called by their numbers."""
        import pandapower as pp

        net = pp.create_empty_network(f_hz=self.f, sn_mva=self.S_b)
        for k, (type, P, Q, G, B, V, _, kV) in self.buses.items():
            pp.create_bus(net, kV, index=k, name=str(k))
            if P < 0.0:
                pp.create_sgen(net, k, -P, -Q)
            elif P or Q:
                pp.create_load(net, k, P, Q)
            if G or B:
                pp.create_shunt(net, k, -B, G)
            if k in self.generators:
                P, S, by_X = self.generators[k]
                if type == 3.0:
                    pp.create_ext_grid(net, k, V)
                else:
                    pp.create_gen(net, k, P, V)
                table = net.ext_grid if type == 3.0 else net.gen
                table.loc[table.index[-1], ["sn_mva", "xdss_pu"]] = S, S / by_X or math.nan
        for a, b, R, X, B, ratio, degrees in self.branches:
            if ratio:
                pp.create_transformer_from_parameters(
                    net, a, b, self.S_b, self.buses[int(a)][7] * ratio, self.buses[int(b)][7],
                    100.0 * R, math.copysign(100.0 * abs(complex(R, X)), X), 0.0, 0.0, degrees,
                )  # fmt: skip
            else:
                pp.create_impedance(net, a, b, R, X, self.S_b, bf_pu=B / 2, bt_pu=B / 2)
        for a, b in self.jumpers:
            pp.create_switch(net, a, b, et="b")
        return net

    def shunt(self, k: int, Y: complex) -> None:
        self.buses[k][3] += Y.real
        self.buses[k][4] += Y.imag

    def leg(self, a: Winding, b: Winding, Z: complex) -> None:
        """A transformer of two windings; pandapower has its taps at the side of high voltage."""
        if self.buses[a.bus][7] < self.buses[b.bus][7]:
            a, b = b, a
        Z *= b.tap**2
        self.branches.append(
            [a.bus, b.bus, Z.real, Z.imag, 0.0, a.tap / b.tap, a.degrees - b.degrees]
        )

    def _passes(self, k: int) -> bool:
        """Whether nothing but branches and shunts is at a bus."""
        return self.buses[k][:3] == [1.0, 0.0, 0.0] and not any(k in one for one in self.jumpers)

    def join_series_capacitors(self) -> None:
        """Join each with the line behind it where nothing is between them, as a part of that line's
        reactance; charging and shunts between them then are at the far end, so that the power flow
        is another one."""
        count = 0
        while joint := next(self._joints(), None):
            capacitor, line, between = joint
            far = int(capacitor[0] if capacitor[1] == between else capacitor[1])
            line[0 if line[0] == between else 1] = far
            for j in (2, 3, 4):
                line[j] += capacitor[j]
            self.shunt(far, complex(*self.buses.pop(between)[3:5]))
            self.branches.remove(capacitor)
            count += 1
        if count:
            self.ignored.append(f"{count} series capacitors: a part of their lines' reactance.")

    def _joints(self) -> Iterator[tuple[list[float], list[float], int]]:
        """A branch of negative reactance, the line behind it, and the bus between them."""
        for one in self.branches:
            if one[3] >= 0.0 or one[5]:
                continue
            for between in map(int, one[:2]):
                there = [b for b in self.branches if b is not one and between in b[:2]]
                loop = len(there) == 1 and {*there[0][:2]} == {*one[:2]}
                if len(there) == 1 and not there[0][5] and not loop and self._passes(between):
                    yield one, there[0], between
