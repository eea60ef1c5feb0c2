"""Protection: thresholds with persistence, a latched trip, and the words for it.

Two quantities are taken over one cycle of the nominal frequency: the RMS of the bridge's current,
and the speed of the capacitor's voltage, by which its angle has turned in that time. A ring holds
what the sums since the start were at each place of the last cycle. The difference of two of them is
exact to their rounding, so that nothing drifts.
"""

import math

from gfm_plant.layout import field
from gfm_plant.names import (
    BAD_COMMAND,
    CONTROLLER,
    CONTROLLER_GONE,
    CONTROLLER_LEFT,
    CONTROLLER_SAFE,
    DIVERGED,
    GONE,
    LEFT,
    MAY_START,
    NO_FRESH_U,
    NOT_ASKED,
    OVERLOAD,
    SAFE_STATE,
    SILENT,
    TRIP_REASONS,
    TRIPS,
    WOULD_TRIP,
)
from gfm_plant.records import I_F, N_OVERLOADS, N_TRIPS, PlantRecords, V
from gfm_plant.solution import circuit, enter, own
from gfm_runtime.compiled import compiled, inlined

_BLOCKED = {
    SAFE_STATE: CONTROLLER_SAFE,
    SILENT: NO_FRESH_U,
    GONE: CONTROLLER_GONE,
    LEFT: CONTROLLER_LEFT,
}
_FOLLOW_S = 0.02
LEAST_V = 0.2  # p.u.; a smaller voltage has no angle that a relay could read


@inlined
def has_angle(a: complex, b: complex) -> bool:
    """Return whether both voltages have an angle that a relay could read."""
    return min(a.real * a.real + a.imag * a.imag, b.real * b.real + b.imag * b.imag) > (
        LEAST_V * LEAST_V
    )


@inlined
def turn(a: complex, b: complex) -> float:
    """Return the angle from a to b, rad."""
    return math.atan2(a.real * b.imag - a.imag * b.real, a.real * b.real + a.imag * b.imag)


@compiled
def trip(plant: PlantRecords, k: int, reason: int, value: float) -> None:
    """Latch a trip of converter k, if none is latched: its bridge blocks, its DC source turns off.

    The current of L_f is taken as interrupted at once; that of a switched bridge goes on through
    its diodes. From here on the plant ignores the
    converter's commands; its frame turns with the grid. The circuits are at hand for one converter
    that trips; a second one trips a tick later, when Python has made those for two
    (`gfm_plant.grid.take_out`).
    """
    s, n, now = plant.st[k], plant.net[0], plant.now[0]
    switched = plant.par[k].levels > 0
    if s.trip == 0 and (now.row == 0 or switched):
        s.trip = reason
        s.trip_tick = s.tick
        s.trip_value = value
        s.waits, s.omega_seen = NOT_ASKED, s.u_now[1]
        i = own(k) + I_F
        s.i_source = s.E[0] = s.E[1] = 0.0
        if not switched:
            s.x[0] = s.x[1] = 0.0
            field(now, "w")[i] = 0j
            now.row, now.made = 1 + k, 0
            enter(n, now, plant.st[0].tick, circuit(n, now))
        s.u_now[0], s.u_now[1], s.u_now[2], s.u_now[3] = 0.0, now.omega_g, 0.0, 0.0


@compiled
def follow_voltage(plant: PlantRecords, k: int) -> None:
    """Follow the speed of the capacitor's voltage of the blocked converter k over the last tick,
    p.u., through a low-pass of 20 ms: what a phase-locked loop would tell it."""
    n, s, now, i = plant.net[0], plant.st[k], plant.now[0], own(k) + V
    before, v = field(now, "w_before")[i], field(now, "w")[i]
    if has_angle(before, v):
        omega = 1.0 + turn(before, v) / (n.omega_b * n.T_s)
        s.omega_seen += (1.0 - math.exp(-n.T_s / _FOLLOW_S)) * (omega - s.omega_seen)


@compiled
def start_condition(plant: PlantRecords, k: int) -> int:
    """Return whether the blocked bridge of converter k may start on the voltage of its capacitor:
    MAY_START, or WOULD_TRIP + the place in ``TRIPS`` of what would trip it again.

    The voltage and its frequency must lie within the thresholds of the protections that are in
    service; a voltage below 0.2 p.u. has no angle that the bridge could start at.
    """
    r, s = plant.par[k], plant.st[k]
    v = math.sqrt(s.x[2] ** 2 + s.x[3] ** 2)
    if v <= LEAST_V or (r.trip_ticks[2] >= 0 and v < r.trip_limit[2]):
        return WOULD_TRIP + 2
    if r.trip_ticks[1] >= 0 and v > r.trip_limit[1]:
        return WOULD_TRIP + 1
    if r.trip_ticks[5] >= 0 and s.omega_seen > r.trip_limit[5]:
        return WOULD_TRIP + 5
    if r.trip_ticks[6] >= 0 and s.omega_seen < r.trip_limit[6]:
        return WOULD_TRIP + 6
    return MAY_START


@inlined
def protect(plant: PlantRecords, k: int) -> None:
    """Check every threshold of converter k on the true values of this tick."""
    r, s = plant.par[k], plant.st[k]
    i = math.sqrt(s.x[0] ** 2 + s.x[1] ** 2)
    v = math.sqrt(s.x[2] ** 2 + s.x[3] ** 2)
    v_dc = s.x[7]
    omega = s.u_now[1]
    if r.places > 0:
        _look_back(plant, k, i)
        if r.by_voltage:
            omega = s.omega_v
    _watch(plant, k, 0, i, 1.0)
    _watch(plant, k, 1, v, 1.0)
    _watch(plant, k, 2, v, -1.0)
    _watch(plant, k, 3, v_dc, 1.0)
    _watch(plant, k, 4, v_dc, -1.0)
    _watch(plant, k, 5, omega, 1.0)
    _watch(plant, k, 6, omega, -1.0)
    if r.places > 0:
        for step in range(N_TRIPS, N_TRIPS + N_OVERLOADS):
            _watch(plant, k, step, s.i_rms, 1.0)


@compiled
def _look_back(plant: PlantRecords, k: int, i: float) -> None:
    """Take the RMS of the current i and the speed of the voltage over the last cycle, or over the
    ticks so far while they are fewer."""
    r, s, now = plant.par[k], plant.st[k], plant.now[0]
    before, v = complex(s.v_before[0], s.v_before[1]), field(now, "w")[own(k) + V]
    if s.looked == 0:
        s.omega_v = s.u_now[1]
    elif has_angle(before, v):
        s.sums[1] += turn(before, v)
    else:  # it goes on as it was
        s.sums[1] += r.omega_b * r.T_s * (s.omega_v - 1.0)
    s.v_before[0], s.v_before[1] = v.real, v.imag
    s.sums[0] += i * i
    s.looked += 1
    if s.looked % r.place_ticks != 0:
        return
    place = (s.looked // r.place_ticks) % r.places
    ticks = r.places * r.place_ticks
    if s.looked > ticks:
        s.i_rms = math.sqrt(max(s.sums[0] - s.ring[place, 0], 0.0) / ticks)
        s.omega_v = 1.0 + (s.sums[1] - s.ring[place, 1]) / (ticks * r.omega_b * r.T_s)
    else:
        s.i_rms = math.sqrt(s.sums[0] / s.looked)
        if s.looked > 1:
            s.omega_v = 1.0 + s.sums[1] / ((s.looked - 1) * r.omega_b * r.T_s)
    s.ring[place, 0], s.ring[place, 1] = s.sums[0], s.sums[1]


@inlined
def _watch(plant: PlantRecords, k: int, what: int, value: float, sign: float) -> None:
    r, s = plant.par[k], plant.st[k]
    if r.trip_ticks[what] < 0 or sign * (value - r.trip_limit[what]) <= 0.0:
        s.crossed[what] = 0
        return
    # The tick that first sees a crossing starts the time.
    if s.crossed[what] >= r.trip_ticks[what]:
        if s.trip == 0:
            s.tripped_by = what
        trip(plant, k, what + 1 if what < N_TRIPS else OVERLOAD, value)
    s.crossed[what] += 1


def wait_reason(plant: PlantRecords, k: int) -> str:
    """Say why converter k, which was reset, does not start; "" if nothing is in the way."""
    r, s = plant.par[k], plant.st[k]
    what = int(s["waits"]) - WOULD_TRIP
    if what < 0:
        return ""
    name, quantity, sign = TRIPS[what]
    value, limit = math.hypot(s["x"][2], s["x"][3]), float(r["trip_limit"][what])
    if quantity == "omega_u":
        value, quantity = float(s["omega_seen"]), "omega of V"
    elif sign < 0:
        limit = max(LEAST_V, limit if r["trip_ticks"][what] >= 0 else 0.0)
    return (
        f"{name.replace('_', '-')}: {quantity} = {value:.6g} p.u. at its capacitor, must be"
        f" {'at most' if sign > 0 else 'at least'} {limit:.6g} p.u."
    )


def trip_reason(plant: PlantRecords, k: int = 0, before: int = 0) -> str:
    """Say what tripped converter k, with quantity, value, threshold and time, "" without a trip;
    ``before``: ticks of the plant before the run whose time that is."""
    r, s = plant.par[k], plant.st[k]
    code, tick, value = int(s["trip"]), int(s["trip_tick"]) - before, float(s["trip_value"])
    if code == 0:
        return ""
    T_s = float(r["T_s"])
    at = f"at tick {tick} (t = {tick * T_s:.6g} s)"
    if code == DIVERGED:
        return f"diverged: the state left the range of the model {at}"
    if code == BAD_COMMAND:
        return f"command not finite: u held {value} {at}"
    if code == CONTROLLER:
        return _BLOCKED[value]
    if code == OVERLOAD:
        what, quantity, sign = int(s["tripped_by"]), "RMS of i over a cycle", +1
    else:
        what = code - 1
        _, quantity, sign = TRIPS[what]
        if quantity == "omega_u" and r["by_voltage"]:
            quantity = "omega of V over a cycle"
    limit = r["trip_limit"][what]
    persistence = int(r["trip_ticks"][what]) * T_s
    lasting = f" for {persistence:.6g} s" if persistence else ""
    return (
        f"{TRIP_REASONS[code]}: {quantity} = {value:.6g} p.u. {'>' if sign > 0 else '<'}"
        f" {limit:.6g} p.u.{lasting} {at}"
    )
