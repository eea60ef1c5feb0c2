"""A plant controller: it measures at the point of connection of several converters, and sends them
set-points over a link with a cycle and a delay.

P, Q, v and i are those of a line where it meets a node, out of the plant, p.u. of the plant's
rating, which is the sum of its converters' ratings. At every tick, with lags T_fltr, T_p and T_f,

    Q_m = Q,  V_m = |v - (R_c + j X_c) i| + K_c Q,  P_m = P,  omega_m = speed of v,

and in every cycle of T seconds, where dz is what lies beyond a dead band, [ ] are limits,

    e = [dz(V_ref - V_m)]  or  [dz(Q_ref - Q_m)],    x <- [x + T K_i e],      X = [x + K_p e],
    f = dz(omega_ref - omega_m),    e_P = [P_ref - P_m + D_dn min(f, 0) + D_up max(f, 0)],
    x_P <- [x_P + T K_ig e_P],    P_set = [x_P + K_pg e_P];

x stays while |v| < V_frz. X is Q_set or V_set. These are the block diagrams of WECC's REPC_A (Solar
Plant Dynamic Modeling Guidelines, 2014). X then passes its lead and lag (1 + T_ft s)/(1 + T_fv s),
held over a cycle, and P_set its lag T_g; by default cycle and delay stand in their place.
``delay_s`` after its measurement a converter takes over a set-point: its reference at
the start, and by how much P_set or X has moved since, in p.u. of its own rating.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gfm_plant.components.grid_following import GridFollowing, X
from gfm_plant.components.part import Dynamic, Terminal
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.steady_state import NoEquilibrium
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import P_SET, Q_SET, SET_HIGH, SET_LOW, V_SET

if TYPE_CHECKING:
    from gfm_plant.network import Network
    from gfm_plant.wiring import Wiring

MEASURED = ("V", "omega")
"""What a run records of it besides power and current: size and speed of the voltage; then its
commands P_set and X."""
_IN_FLIGHT = 64  # set-points on the way at most
_LEAST_V = 1e-3  # p.u.; below it the voltage has no speed


@compiled
def _beyond(e: float, band: float) -> float:
    """What of e lies outside +-band."""
    return max(e - band, 0.0) + min(e + band, 0.0)


@compiled
def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@compiled
def _measure(n: Any, now: Any, one: Any) -> None:
    """Take what the line carries at this tick through the lags."""
    row, at, Z = field(now, "flow_row"), one.row, one.Z
    v, i = field(now, "flow_v")[one.node], complex(row[at - 2], row[at - 1]) / one.S
    behind, before = v - Z * i, one.v_before
    size = math.hypot(v.real, v.imag)
    if size > _LEAST_V and before.real * before.real + before.imag * before.imag > _LEAST_V**2:
        turn = v * before.conjugate()
        speed = 1.0 + math.atan2(turn.imag, turn.real) / (n.omega_b * n.T_s)
        one.m[3] += one.lag[3] * (speed - one.m[3])
    one.v_before, one.size = v, size
    P, Q = row[at - 4] / one.S, row[at - 3] / one.S
    V = math.hypot(behind.real, behind.imag) + one.K_c * Q
    for j, value in enumerate((P, Q, V)):
        one.m[j] += (1.0 if one.begun == 0 else one.lag[j]) * (value - one.m[j])


@compiled
def _record(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Write the columns of ``MEASURED`` and the commands of the last cycle."""
    row, at, v = field(now, "flow_row"), one.row, field(now, "flow_v")[one.node]
    row[at], row[at + 1] = math.hypot(v.real, v.imag), one.m[3]
    row[at + 2], row[at + 3] = one.out[0], one.out[1]


@compiled
def _decide(one: Any) -> None:
    """Set the commands of this cycle."""
    m, ref, x, out = one.m, one.ref, one.x, one.out
    f = _beyond(ref[3] - m[3], one.fdbd)
    e = ref[0] - m[0] + one.D_dn * min(f, 0.0) + one.D_up * max(f, 0.0)
    e = _within(e, one.fe[0], one.fe[1])
    low, high = one.P_limits[0], one.P_limits[1]
    x[0] = _within(x[0] + one.T * one.K_ig * e, low, high)
    out[0] = _within(x[0] + one.K_pg * e, low, high)
    by = 2 if one.by_V != 0 else 1
    e = _within(_beyond(ref[by] - m[by], one.dbd), one.e[0], one.e[1])
    low, high = one.X_limits[0], one.X_limits[1]
    if one.size >= one.V_frz:
        x[1] = _within(x[1] + one.T * one.K_i * e, low, high)
    out[1] = _within(x[1] + one.K_p * e, low, high)
    for j in range(2):
        if one.send_lag[j] < 1.0:
            ahead = out[j] - one.y[j]
            out[j] = one.y[j] + one.send_lead[j] * ahead
            one.y[j] += one.send_lag[j] * ahead


@compiled
def _send(one: Any) -> None:
    """Put the commands on the way."""
    place = (one.first + one.flying) % _IN_FLIGHT
    one.due[place] = one.tick + one.delay
    one.flight[place, 0], one.flight[place, 1] = one.out[0], one.out[1]
    one.flying += 1


@compiled
def _arrive(n: Any, now: Any, one: Any) -> None:
    """Hand the oldest set-points on the way over to the converters."""
    P, X = one.flight[one.first, 0], one.flight[one.first, 1]
    one.first, one.flying = (one.first + 1) % _IN_FLIGHT, one.flying - 1
    of, begin, to = field(n, "supervisor"), field(now, "set_begin"), field(now, "set_points")
    for k in range(len(of)):
        if of[k] == one.number:
            if one.sends_P != 0:
                value = begin[k, P_SET] + P - one.begin[0]
                to[k, P_SET] = _within(value, SET_LOW[P_SET], SET_HIGH[P_SET])
            if one.sends_X != 0:
                value = begin[k, one.X] + X - one.begin[1]
                to[k, one.X] = _within(value, SET_LOW[one.X], SET_HIGH[one.X])


@compiled
def _tick(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Measure what flows at the tick that ends here, decide once a cycle, and hand over what the
    next tick takes."""
    _measure(n, now, one)
    if one.begun == 0:
        one.begun = 1
        for j in range(4):
            if one.ref[j] != one.ref[j]:  # it holds what is there
                one.ref[j] = one.m[j]
    if one.tick % one.cycle == 0:
        _decide(one)
        if one.sends != 0:
            _send(one)
    one.tick += 1
    while one.flying > 0 and one.due[one.first] <= one.tick:
        _arrive(n, now, one)


class PlantController(Dynamic):
    """A plant controller: it holds the power of a plant and its voltage or reactive power at the
    point of connection, with droop by frequency and voltage, by set-points of P, and of Q or V,
    that it sends to the controllers of its converters in every cycle. They arrive after a delay,
    and are the references of any law from then on, or P and Q of a grid-following neighbour."""

    title: ClassVar = "Plant controller"
    example: ClassVar = {
        "grid": "far",
        "lines": {"feeder": {"start": "bus", "end": "far", "L": 0.1, "R": 0.01}},
        "plant_controllers": {"x": {"line": "feeder", "node": "bus"}},
    }
    record: ClassVar = np.dtype(
        [
            *((x, "i8") for x in ("tick", "begun", "cycle", "delay", "number", "row", "node")),
            *((x, "i8") for x in ("by_V", "X", "sends_P", "sends_X", "sends")),
            *((x, "f8") for x in ("S", "T", "K_c", "K_p", "K_i", "V_frz", "dbd", "fdbd")),
            *((x, "f8") for x in ("K_pg", "K_ig", "D_dn", "D_up", "size")),
            *((x, "c16") for x in ("Z", "v_before")),
            *((x, "f8", (2,)) for x in ("e", "fe", "P_limits", "X_limits", "x", "out", "begin")),
            # of P_set and X: what is behind their lags, weights of these, and leads over lags
            *((x, "f8", (2,)) for x in ("y", "send_lag", "send_lead")),
            # of P, Q, V and omega: weights of the lags, as measured, and where they are to be (NaN:
            # where they are at the start)
            *((x, "f8", (4,)) for x in ("lag", "m", "ref")),
            # commands on the way, when each arrives, the first of them, and how many
            ("flight", "f8", (_IN_FLIGHT, 2)),
            ("due", "i8", (_IN_FLIGHT,)),
            ("first", "i8"),
            ("flying", "i8"),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {"flow": _record, "tick": _tick}

    line: str = Field(min_length=1, description="the line or transformer whose power it measures")
    node: str = Field(min_length=1, description="the end of it at which it measures")
    plant_end: str | None = Field(
        None, min_length=1, description="the end of it on the side of the plant; node if none"
    )
    converters: list[str] | None = Field(
        None,
        min_length=1,
        description="names of those that it sends set-points to, grid-following neighbours among "
        "them; all converters, and no neighbours, if none",
    )
    period_s: Positive = Field(0.1, le=3600, description="its cycle, s")
    delay_s: NonNegative = Field(
        0.05, le=3600, description="from its measurement until the converters have the set-point, s"
    )
    control: Literal["V", "Q"] = Field(
        "V", description="what it holds besides the power, at Q_ref or V_ref"
    )
    sends: Literal["Q_ref", "V_ref"] = Field("V_ref", description="by which reference")
    P_ref: float | None = Field(
        None, description="power out of the plant, p.u. of its rating; what it is at the start"
    )
    Q_ref: float | None = Field(None, description="reactive power, likewise")
    V_ref: float | None = Field(None, description="V_m, p.u., likewise")
    omega_ref: float = Field(1.0, ge=0.8, le=1.2, description="frequency, p.u.")
    T_fltr: NonNegative = Field(0.02, description="lag of the measured V and Q, s")
    T_p: NonNegative = Field(0.02, description="lag of the measured P, s")
    T_f: NonNegative = Field(0.05, description="lag of the measured frequency, s")
    R_c: float = Field(0.0, ge=-10, le=10, description="compensated resistance, p.u.")
    X_c: float = Field(0.0, ge=-10, le=10, description="compensated reactance, p.u.")
    K_c: NonNegative = Field(0.0, description="droop of the voltage by Q, p.u./p.u.")
    dbd: NonNegative = Field(0.0, description="dead band of V or Q, p.u.")
    e_max: Positive = Field(999.0, description="limit of the error of V or Q, p.u.")
    K_p: NonNegative = Field(0.0, description="gain by V or Q, p.u./p.u.")
    K_i: NonNegative = Field(1.0, description="integral gain, 1/s; both 0: nothing is sent")
    V_frz: NonNegative = Field(0.7, description="voltage below which that integral stays, p.u.")
    Q_max: float = Field(0.5, description="largest Q_ref, p.u. of the plant's rating")
    Q_min: float = Field(-0.5, description="least")
    V_max: float = Field(1.1, description="largest V_ref, p.u.")
    V_min: float = Field(0.9, description="least")
    T_ft: NonNegative = Field(0.0, description="lead of what it sends for Q or V, s")
    T_fv: NonNegative = Field(0.0, description="lag of it, s; 0: neither it nor T_ft")
    fdbd: NonNegative = Field(0.0006, description="dead band of the frequency, p.u.")
    D_dn: NonNegative = Field(0.0, description="droop of P above omega_ref, p.u./p.u.")
    D_up: NonNegative = Field(0.0, description="below it")
    fe_max: Positive = Field(999.0, description="largest error of P, p.u.")
    fe_min: float = Field(-999.0, le=0, description="least")
    K_pg: NonNegative = Field(0.0, description="gain by P, p.u./p.u.")
    K_ig: NonNegative = Field(1.0, description="integral gain, 1/s; both 0: no P_ref is sent")
    P_max: float = Field(1.0, description="largest P_ref, p.u. of the plant's rating")
    P_min: float = Field(0.0, description="least")
    T_g: NonNegative = Field(0.0, description="lag of the P_ref that it sends, s")

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        for x, low, high in zip("PQV", SET_LOW, SET_HIGH, strict=True):
            least, most = getattr(self, f"{x}_min"), getattr(self, f"{x}_max")
            ref = getattr(self, f"{x}_ref")
            if ref is not None and not low <= ref <= high:
                raise ValueError(f"{x}_ref = {ref:g}: must lie in [{low:g}, {high:g}]")
            if not low <= least < most <= high:
                raise ValueError(
                    f"{x}_min = {least:g}, {x}_max = {most:g}: must rise within [{low:g}, {high:g}]"
                )
        if getattr(self, unused := self.unused()) is not None:
            raise ValueError(f"{unused}: has no effect with control = {self.control!r}")
        if not (self.K_p or self.K_i or self.K_pg or self.K_ig):
            raise ValueError("K_p, K_i, K_pg and K_ig are 0: it would send nothing")
        if self.T_fv == 0.0 and self.T_ft > 0.0:
            raise ValueError(f"T_fv = 0: must be above 0 with T_ft = {self.T_ft:g}")
        return self

    def label(self) -> str:
        return f"P and {self.control} by {self.sends}"

    @property
    def commands(self) -> tuple[str, str]:
        """The columns of its commands."""
        return "P_set", f"{self.sends[0]}_set"

    def sent(self) -> list[str]:
        """The references that it commands."""
        return ["P_ref"] * (self.K_pg + self.K_ig > 0) + [self.sends] * (self.K_p + self.K_i > 0)

    def unused(self) -> str:
        """The reference that it does not hold."""
        return "Q_ref" if self.control == "V" else "V_ref"

    def measures(self, name: str, ends: Mapping[str, Sequence[Terminal]]) -> Terminal:
        """Where it measures.

        Args:
            name: its own.
            ends: of the parts with two ends, by their names.

        Raises:
            ValueError: there is no such line, or no such end of it.
        """
        at = f"plant_controllers.{name}."
        if self.line not in ends:
            raise ValueError(f"{at}line = {self.line!r}: must be one of {sorted(ends)}")
        nodes = [one.node for one in ends[self.line]]
        plant_end = self.plant_end or self.node
        for key, node in (("node", self.node), ("plant_end", plant_end)):
            if node not in nodes:
                raise ValueError(f"{at}{key} = {node!r}: must be an end of {self.line}, {nodes}")
        sign = 1.0 if plant_end == nodes[0] else -1.0
        there = ends[self.line][nodes.index(self.node)]
        parts = tuple((part, sign * by) for part, by in there.parts)
        return replace(there, name=name, parts=parts, more=(*MEASURED, *self.commands))

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        cycle = round(self.period_s / T_s)
        if cycle < 1 or abs(cycle * T_s - self.period_s) > 1e-6 * T_s:
            raise ValueError(
                f"{where}.period_s = {self.period_s:g}: must be a multiple of T_s = {T_s:g} s"
            )
        delay = round(self.delay_s / T_s)
        if delay > (_IN_FLIGHT - 1) * cycle:
            raise ValueError(
                f"{where}.delay_s = {self.delay_s:g}: at most {_IN_FLIGHT - 1} cycles of period_s"
            )
        record["cycle"], record["delay"], record["T"] = cycle, delay, self.period_s
        for name in ("K_c", "K_p", "K_i", "V_frz", "dbd", "fdbd", "K_pg", "K_ig", "D_dn", "D_up"):
            record[name] = getattr(self, name)
        record["Z"] = complex(self.R_c, self.X_c)
        record["e"], record["fe"] = (-self.e_max, self.e_max), (self.fe_min, self.fe_max)
        record["P_limits"] = self.P_min, self.P_max
        X = self.sends[0]
        record["X"] = Q_SET if X == "Q" else V_SET
        record["X_limits"] = getattr(self, f"{X}_min"), getattr(self, f"{X}_max")
        record["by_V"], record["sends"] = self.control == "V", 1
        record["sends_P"], record["sends_X"] = "P_ref" in self.sent(), self.sends in self.sent()
        lags = self.T_p, self.T_fltr, self.T_fltr, self.T_f
        record["lag"] = [-math.expm1(-T_s / T) if T > 0 else 1.0 for T in lags]
        for j, (lead, lag) in enumerate(((0.0, self.T_g), (self.T_ft, self.T_fv))):
            record["send_lag"][j] = -math.expm1(-self.period_s / lag) if lag > 0.0 else 1.0
            record["send_lead"][j] = lead / lag if lag > 0.0 else 0.0
        refs = self.P_ref, self.Q_ref, self.V_ref, self.omega_ref
        record["ref"] = [math.nan if ref is None else ref for ref in refs]

    def place(self, name: str, record: Any, wiring: Wiring) -> None:
        """Set where it measures; ``name`` is its own."""
        row = 0
        for terminal in wiring.recorded:
            if terminal.name == name:
                record["row"] = row + len(terminal.columns) - len(terminal.more)
                record["node"] = wiring.recorded_nodes.index(terminal.node)
            row += len(terminal.columns)

    def supervise(self, name: str, number: int, wiring: Wiring, supervisor: Any) -> None:
        """Write its number where its converters have that of their plant controller.

        Args:
            name: its own.
            number: from 1 on.
            supervisor: by converter, then by neighbour, the number of its plant controller, 0: it
                has none.

        Raises:
            ValueError: there is no such converter, or it has another plant controller, or does not
                take what this one sends.
        """
        own = [unit.name for unit in wiring.units]
        names = [*own, *wiring.neighbours]
        at = f"network.plant_controllers.{name}"
        for one in self.converters or own:
            if one not in names:
                raise ValueError(f"{at}.converters: {one!r} must be one of {names}")
            k = names.index(one)
            if supervisor[k]:
                again = "has another plant controller already"
                again = "is there twice" if supervisor[k] == number else again
                raise ValueError(f"{at}.converters: {one!r} {again}")
            supervisor[k] = number
            if k >= len(own) and "V_ref" in self.sent():
                raise ValueError(
                    f'{at}.sends = "V_ref": {one} follows the grid and takes "Q_ref" only'
                )


def begin_set_points(plant: Network, references: NDArray[np.float64]) -> None:
    """Have the plant controllers begin with the references of their converters, (N, 3): P_ref,
    Q_ref and V_ref of each, p.u. of its own. Raises NoEquilibrium: one is beyond a limit."""
    net, now, neighbours = plant.net[0], plant.now[0], plant.of(GridFollowing)
    if not net["n_commanded"]:
        return
    theirs = np.full((len(neighbours), 3), math.nan)
    theirs[:, P_SET], theirs[:, Q_SET] = neighbours["P"], neighbours["Q"]
    now["set_begin"], now["set_points"] = np.vstack([references, theirs]), math.nan
    ratings = np.concatenate([1.0 / plant.par["current"], neighbours["S"]])
    speeds = 1.0 + neighbours["s"][:, X] / net["omega_b"]
    speeds = np.concatenate([plant.st["u_now"][:, 1], speeds])
    each = zip(plant.wiring.supervisors, plant.of(PlantController), strict=True)
    for name, record in each:
        own = net["supervisor"] == record["number"]
        record["S"] = ratings[own].sum()
        mean = ratings[own] @ now["set_begin"][own] / record["S"]
        begin = mean[P_SET], mean[record["X"]]
        for x, sends, value, (low, high) in (
            ("P", record["sends_P"], begin[0], record["P_limits"]),
            ("PQV"[record["X"]], record["sends_X"], begin[1], record["X_limits"]),
        ):
            if sends and not low <= value <= high:
                raise NoEquilibrium(
                    f"plant_controllers.{name}: {x}_ref of its converters, {value:g} at the start,"
                    f" must lie within {x}_min = {low:g} and {x}_max = {high:g}"
                )
        record["begin"] = record["x"] = record["out"] = record["y"] = begin
        record["m"][3] = speeds[own][0]  # until there are two voltages


def set_plant_reference(
    plant: Network, name: str, references: Mapping[str, float], sends: bool | None = None
) -> None:
    """Give a plant controller new references, or cut its link to the converters, which then keep
    their last set-points.

    Args:
        plant: The plant.
        name: Of the plant controller.
        references: Of P_ref, Q_ref, V_ref and omega_ref those that change, p.u.
        sends: Whether its set-points reach the link from now on; as before if None.

    Raises:
        ValueError: There is no such plant controller.
    """
    names = plant.wiring.supervisors
    if name not in names:
        raise ValueError(f"name = {name!r}: must be a plant controller of the network, {[*names]}")
    record = plant.of(PlantController)[names.index(name)]
    for j, key in enumerate(("P_ref", "Q_ref", "V_ref", "omega_ref")):
        if key in references:
            record["ref"][j] = references[key]
    if sends is not None:
        record["sends"] = sends
