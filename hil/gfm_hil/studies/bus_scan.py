"""Frequency scan of a bus: the impedance that a network has there, from its linear loop."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.bus import bus_impedance, positive_sequence
from gfm_design.model.network import NetworkLoop
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import Scenario, load_scenario, plant_of
from gfm_hil.studies.linear_loop import network_loop
from gfm_runtime.signals import U_NAMES

_PROBE = 1e-3  # p.u., of a bank at a node that has none; what it does to Z is taken out again
_NEAR = 0.2  # Hz; nearer to the island's own frequency there is no impedance, but a steady state
_ROUNDS, _PARTS = 4, 5  # of a refined scan: steps beside a turn become 1/625 as long
LOW, HIGH, POINTS = 1.0, 2500.0, 400


@dataclass(frozen=True)
class BusScan:
    """The impedance of a network at a bus, p.u. of its first converter.

    Attributes:
        title: of the scenario.
        bus: the node.
        f_0: frequency of its island in steady state, Hz.
        hz: frequencies of a positive-sequence current, Hz, shape (K,), ascending.
        Z: what it meets in its own sequence, (K,).
        Z_dq: the whole matrix, (K, 2, 2), at ``hz`` less ``f_0`` in the dq frame of the island,
            whose d axis is anywhere.
    """

    title: str
    bus: str
    f_0: float
    hz: NDArray[np.float64]
    Z: NDArray[np.complex128]
    Z_dq: NDArray[np.complex128]

    def resonances(self) -> list[dict[str, Any]]:
        """Where abs(Z) is larger or smaller than at both neighbours: a row each with ``hz``,
        ``size`` in p.u., ``degrees``, and ``kind``, parallel or series. Beside ``f_0``
        there is none: what lies between is not known."""
        return [
            {"hz": float(self.hz[k]), "size": float(abs(self.Z[k])),
             "degrees": float(np.degrees(np.angle(self.Z[k]))), "kind": kind}
            for k, kind in _turns(self.Z).items() if not self.hz[k - 1] < self.f_0 < self.hz[k + 1]
        ]  # fmt: skip


def bus_scan(
    scenario: Scenario, bus: str, hz: Sequence[float] | NDArray[np.float64], refine: bool = False
) -> BusScan:
    """The impedance of a network at a bus.

    Args:
        scenario: with a network.
        bus: name of a node; not that of the grid, which holds its voltage.
        hz: frequencies of a positive-sequence current, Hz, > 0, ascending; those at that of the
            island are left out, since there is a steady state and no impedance.
        refine: whether to add frequencies around each resonance, so that what ``resonances``
            returns is that of the resonance, and not of the nearest of ``hz``.

    Raises:
        UserError: there is no network, or no such node; no frequency is left; or no operating
            point.
    """
    if scenario.network is None:
        raise UserError(f"{scenario.title}: has no network")
    wiring = plant_of(scenario).wiring
    nodes = [node for node in wiring.nodes if node != scenario.network.grid]
    if bus not in nodes:
        holds = ", not the grid's, which holds its voltage" if bus in wiring.nodes else ""
        raise UserError(f"bus = {bus!r}: must be one of {nodes}{holds}")
    probes = bus not in {one.node for one in wiring.capacitors}
    if probes:
        content = scenario.model_dump(mode="json", exclude_none=True)
        content["network"]["capacitors"][f"probe of {bus}"] = {"node": bus, "Q": _PROBE}
        scenario = load_scenario(content, in_process=True)
    loop, probe = network_loop(scenario), _PROBE * probes
    island = next(those for those in wiring.islands() if bus in those)
    units = zip(loop.members, wiring.units, strict=True)
    speeds = [m.op.u[U_NAMES.index("omega_u")] for m, unit in units if unit.node in island]
    if not speeds:
        raise UserError(f"bus = {bus!r}: no closed line leads to a converter")
    speed = float(speeds[0])
    f_0 = speed * nominal_frequency(scenario)
    hz = _off(f_0, np.asarray(hz, float))
    if not len(hz):
        raise UserError(f"hz: all lie within {_NEAR} Hz of the island's {f_0:g} Hz; no impedance")
    Z = _impedance(loop, bus, hz, f_0, probe, speed)
    for _ in range(_ROUNDS * refine):
        beside = sorted({j for k in _turns(positive_sequence(Z)) for j in (k - 1, k)})
        steps = (hz[1:] / hz[:-1])[beside, None] ** (np.arange(1, _PARTS) / _PARTS)
        more = _off(f_0, (hz[beside, None] * steps).ravel())
        place = np.searchsorted(hz, more)
        Z = np.insert(Z, place, _impedance(loop, bus, more, f_0, probe, speed), axis=0)
        hz = np.insert(hz, place, more)
    return BusScan(scenario.title, bus, f_0, hz, positive_sequence(Z), Z)


def _off(f_0: float, hz: NDArray[np.float64]) -> NDArray[np.float64]:
    return hz[np.abs(hz - f_0) > _NEAR]


def _impedance(
    loop: NetworkLoop, bus: str, hz: NDArray[np.float64], f_0: float, probe: float, speed: float
) -> NDArray[np.complex128]:
    """Z_dq, (K, 2, 2), p.u., without the bank of ``probe`` p.u. that stands there, of an island of
    f_0 Hz, which is ``speed`` p.u."""
    omega = 2 * np.pi * (hz - f_0)
    Z = bus_impedance(loop, bus, np.abs(omega))
    if probe:
        by_s = 1j * speed * np.abs(omega) / (2 * np.pi * f_0)
        turn = speed * np.array([[0.0, -1.0], [1.0, 0.0]])
        own = probe * (by_s[:, None, None] * np.eye(2) + turn)
        Z = np.asarray(np.linalg.inv(np.linalg.inv(Z) - own), complex)
    return np.asarray(np.where(omega[:, None, None] < 0.0, Z.conj(), Z), complex)


def _turns(Z: NDArray[np.complex128]) -> dict[int, str]:
    """Where abs(Z) turns, in ascending order: the kind of the resonance by its place."""
    rises = np.diff(np.abs(Z)) > 0.0
    places = np.flatnonzero(rises[1:] != rises[:-1])
    return {int(k) + 1: "parallel" if rises[k] else "series" for k in places}
