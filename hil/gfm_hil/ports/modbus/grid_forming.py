"""Model 64416, DERGridForming: SunSpec's draft for grid-forming converters (sunspec/models, pull
request 277, of 22 July 2026). What the bench has no counterpart for reads as "not implemented".
"""

import math

from gfm_hil.ports.modbus.image import Value
from gfm_hil.ports.modbus.measures import RunState, exponent, top
from gfm_hil.ports.modbus.points import Direct, LawDroops
from gfm_hil.recording.run import bases
from gfm_hil.scenario import Scenario
from gfm_runtime.states import RUNNING

NUMBER = 64416

_FORMING = 2.0  # of GridMd: OFF_GRID, labelled "Grid-Forming Mode"
_STOPPED, _ENABLED, _FAULT = 0.0, 7.0, 8.0  # of GridSt


class GridForming(Direct):
    """The points of the draft: references, droops, H, the trip's threshold, angle and E_u."""

    def __init__(self, gains: LawDroops, scenario: Scenario) -> None:
        b = self._bases = bases(scenario)
        self._phase_V = b.V_n / math.sqrt(3)
        self._trip = scenario.plant.protection.over_current
        points = {
            "DroopP": ("D_p", 1.0), "DroopQ": ("D_q", 1.0),
            "WSet": ("P_ref", b.S_n), "VarSet": ("Q_ref", b.S_n), "VRef": ("V_ref", self._phase_V),
            "HzRef": ("omega_g", b.base_of("f")),
        }  # fmt: skip
        super().__init__(gains, {f"{NUMBER}.{name}": point for name, point in points.items()})
        power = exponent(b.S_n * top("P_ref"), 32, signed=True)
        self.layout = {
            NUMBER: {
                "W_SF": power, "Var_SF": power,
                "V_SF": exponent(self._phase_V * top("V"), 16),
                "A_SF": exponent(b.base_of("I") * top("p"), 16),
                "Hz_SF": exponent(b.base_of("f") * top("omega_g"), 16),
                "Pct_SF": 0, "WRmp_SF": 0, "VRmp_SF": 0, "HzRmp_SF": 0,
            }
        }  # fmt: skip

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        trip = self._trip.threshold * self._bases.base_of("I") if self._trip.enabled else None
        running = _ENABLED if run.state == RUNNING else _STOPPED
        seen: dict[str, Value] = {
            "GridMd": _FORMING,
            "GridSt": _FAULT if run.safe else running,
            "InertiaH": self._gains.droops(run.law, run.gains).H,
            "IInst": trip,
            "ThetaInv": math.degrees(run.row["true_delta"]),
            "EInv": run.row["u_E_u"] * self._phase_V,
            "PRef": run.references["P_ref"] * self._bases.S_n,
            "ModeDemoted": 0.0,
        }
        return super().show(run, now) | {f"{NUMBER}.{name}": v for name, v in seen.items()}
