"""Frequency scan of a bus: the impedance that a network has there, from its linear loop."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.bus import bus_impedance, positive_sequence
from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import Scenario, load_scenario, plant_of
from gfm_hil.studies.linear_loop import network_loop

_PROBE = 1e-3  # p.u., of a bank at a node that has none; what it does to Z is taken out again
_NEAR = 0.2  # Hz; nearer to the island's own frequency there is no impedance, but a steady state
LOW, HIGH, POINTS = 1.0, 2500.0, 400


@dataclass(frozen=True)
class BusScan:
    """The impedance of a network at a bus, p.u. of its first converter.

    Attributes:
        title: of the scenario.
        bus: the node.
        hz: frequencies of a positive-sequence current, Hz, shape (K,), ascending.
        Z: what it meets in its own sequence, (K,).
        Z_dq: the whole matrix, (K, 2, 2), at ``hz`` less the nominal frequency in the dq frame
            whose d axis is anywhere.
    """

    title: str
    bus: str
    hz: NDArray[np.float64]
    Z: NDArray[np.complex128]
    Z_dq: NDArray[np.complex128]

    def resonances(self) -> list[dict[str, Any]]:
        """Where abs(Z) is larger or smaller than at both neighbours: a row each with ``hz``,
        ``size`` in p.u., ``degrees``, and ``kind``, parallel or series."""
        size = np.abs(self.Z)
        up = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] > size[2:])) + 1
        down = np.flatnonzero((size[1:-1] < size[:-2]) & (size[1:-1] < size[2:])) + 1
        kinds = dict.fromkeys(up.tolist(), "parallel") | dict.fromkeys(down.tolist(), "series")
        return [
            {"hz": float(self.hz[k]), "size": float(size[k]),
             "degrees": float(np.degrees(np.angle(self.Z[k]))), "kind": kinds[k]}
            for k in sorted(kinds)
        ]  # fmt: skip


def bus_scan(scenario: Scenario, bus: str, hz: Sequence[float] | NDArray[np.float64]) -> BusScan:
    """The impedance of a network at a bus.

    Args:
        scenario: with a network.
        bus: name of a node.
        hz: frequencies of a positive-sequence current, Hz, > 0; those at the nominal one are left
            out, since there is a steady state and no impedance.

    Raises:
        UserError: there is no network, or no such node; or no operating point.
    """
    if scenario.network is None:
        raise UserError(f"{scenario.title}: has no network")
    wiring = plant_of(scenario).wiring
    if bus not in wiring.nodes:
        raise UserError(f"bus = {bus!r}: must be one of {[*wiring.nodes]}")
    f_n = nominal_frequency(scenario)
    hz = np.asarray(hz, float)
    hz = hz[np.abs(hz - f_n) > _NEAR]
    probes = bus not in {one.node for one in wiring.capacitors}
    if probes:
        content = scenario.model_dump(mode="json", exclude_none=True)
        content["network"]["capacitors"][f"probe of {bus}"] = {"node": bus, "Q": _PROBE}
        scenario = load_scenario(content, in_process=True)
    omega = 2 * np.pi * (hz - f_n)
    Z = bus_impedance(network_loop(scenario), bus, np.abs(omega))
    if probes:
        by_s = 1j * np.abs(omega) / (2 * np.pi * f_n)
        own = _PROBE * (by_s[:, None, None] * np.eye(2) + np.array([[0.0, -1.0], [1.0, 0.0]]))
        Z = np.linalg.inv(np.linalg.inv(Z) - own)
    Z = np.where(omega[:, None, None] < 0.0, Z.conj(), Z)
    return BusScan(scenario.title, bus, hz, positive_sequence(Z), Z)
