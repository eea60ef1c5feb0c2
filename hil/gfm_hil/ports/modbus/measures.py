"""What the device knows of its run, and its read-only points: name plate, measurements, state."""

import contextlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.image import VENDOR, Value
from gfm_hil.recording.run import bases
from gfm_hil.recording.timing import SLACK
from gfm_hil.scenario import Scenario
from gfm_plant.names import TRIPS
from gfm_runtime.signals import SIGNALS
from gfm_runtime.states import INIT, READY, RUNNING, SAFE, STOPPED

_NAMES_S = 0.1  # how old names and gains may be
_WINDOW_S = 1.0  # window of the slack


#: percentiles of the slack, the time left when u[k] arrived before tick k + 1, by the points of the
#: vendor model that show them, µs
SLACK_POINTS = {"SlkP50": 50, "SlkP1": 1, "SlkP01": 0.1, "SlkMin": 0}


@dataclass(frozen=True)
class RunState:
    """The state of a run at one tick."""

    row: dict[str, float]  # every column of the recording at the newest tick, by name
    # tick, misses: of the plant, since the start
    tick: int
    misses: int
    state: int  # of the controller, index into ``gfm_runtime.states.STATES``
    law: str  # name of the active law
    gains: dict[str, float]  # its parameters that differ from its file
    reason: str  # why the controller is in SAFE or the plant tripped, or ""

    @property
    def safe(self) -> bool:
        """Whether the bridge is blocked: a trip, or the controller's safe state."""
        return self.state == SAFE or self.row["true_trip"] != 0.0

    @property
    def references(self) -> dict[str, float]:
        """The references in force by name, p.u."""
        return {k.removeprefix("ref_"): v for k, v in self.row.items() if k.startswith("ref_")}


class Watcher:
    """Observes a run in progress without load on its loops."""

    def __init__(self, operator: Operator, T_s: float) -> None:
        self._operator, self._run, self._T_s = operator, operator.run, T_s
        self._window = max(round(_WINDOW_S / T_s), 1)
        self._said: dict[str, Any] = {}
        self._code: tuple[float, ...] = ()
        self._asked = -math.inf

    def newest(self) -> RunState | None:
        """The newest tick of both sides, or None before there is one."""
        plant, controller = self._run.done("plant"), self._run.done("controller")
        if not (plant and controller):
            return None
        row = self._run.row("plant", plant - 1) | self._run.row("controller", controller - 1)
        code = (row["law"], row["state"], row["true_trip"])
        now = time.monotonic()
        if code != self._code or now >= self._asked + _NAMES_S:  # reading files takes time
            with contextlib.suppress(UserError):  # slightly old names will do
                self._said |= self._operator.snapshot()
            self._code, self._asked = code, now
        if "active" not in self._said:  # the controller's command server is not open yet
            return None
        said = self._said
        return RunState(
            row, plant - 1, self._run.misses, int(row["state"]), said["active"], said["gains"],
            said["trip"] or said["reason"],
        )  # fmt: skip

    def forget(self) -> None:
        """Make the next ``newest`` read the names again, after a command."""
        self._asked = -math.inf

    def slack(self) -> dict[str, float]:
        """The slack over the last second of ticks by ``SLACK_POINTS``; empty without deadlines."""
        done = self._run.done("plant")
        first = max(done - self._window, 0)
        left = SLACK.histogram(self._run.columns, self._T_s, first, done) if done else None
        return {name: left.percentile(q) * 1e-3 for name, q in SLACK_POINTS.items()} if left else {}


_GRID_FORMING = 1 << 1  # bits of 701.DERMode, 702.CtrlModes, 702.IntIslandCat
_CONTROLS = 1 << 1 | 1 << 2 | 1 << 4 | 1 << 5  # fixed W, fixed var, volt-var, frequency droop
_ISLAND = 1 << 1
_MANUFACTURER = 1 << 16  # 701.Alrm
_ALARMS = {
    "over_voltage": 1 << 10,
    "under_voltage": 1 << 11,
    "dc_over_voltage": 1 << 1,
    "over_frequency": 1 << 8,
    "under_frequency": 1 << 9,
}
_STATES = {INIT: 2, READY: 2, RUNNING: 3, SAFE: 6, STOPPED: 0}  # 701.InvSt
_DC_BOTH_WAYS, _THREE_PHASE, _VARS_MAX = 5, 2, 1


class Measures:
    """The read-only points of one run's converter."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._bases = bases(scenario)

    def models(self, laws: Sequence[str]) -> dict[int, Mapping[str, Any]]:
        """Every model of the device with the points that determine its layout, for ``Image``."""
        b = self._bases
        power = exponent(b.S_n * top("p"), 16, signed=True)
        volt = exponent(b.V_n * top("V"), 16)
        amp = exponent(b.base_of("I") * top("p"), 16, signed=True)
        set_point = exponent(b.S_n * top("P_ref"), 32, signed=True)
        sizes = {"A_SF": amp, "V_SF": volt} | dict.fromkeys(("W_SF", "VA_SF", "Var_SF"), power)
        points: list[dict[str, Any]] = [{}, {}]
        return {
            1: {},
            701: {**sizes, "Hz_SF": -4, "PF_SF": -3},
            702: sizes,
            704: {
                "WSet_SF": set_point, "VarSet_SF": set_point, "WSetPct_SF": -2, "VarSetPct_SF": -2,
            },
            705: {
                "NPt": 2, "NCrv": 2, "V_SF": -2, "DeptRef_SF": -2, "RspTms_SF": 0,
                "Crv": [{"Pt": points}, {"Pt": points}],
            },
            711: {"NCtl": 2, "Db_SF": -3, "K_SF": -5, "RspTms_SF": -3, "Ctl": [{}, {}]},
            714: {
                "NPrt": 1, "DCV_SF": exponent(b.V_dcref * top("v_dc"), 16),
                "DCA_SF": exponent(b.base_of("i_dc") * top("i_u"), 16, signed=True),
                "DCW_SF": exponent(b.S_n * top("i_u") * top("v_dc"), 16, signed=True),
                "Prt": [{}],
            },
            715: {},
            VENDOR: {"NLaw": len(laws), "Laws": [{} for _ in laws]},
        }  # fmt: skip

    def plate(self, laws: Sequence[str], unit: int) -> dict[str, Value]:
        """The points that never change, of the device of a unit."""
        b = self._bases
        names = {f"{VENDOR}.Laws{k}.Nm": Path(name).name for k, name in enumerate(laws, 1)}
        island = self._scenario.plant.grid.load_R is not None
        found: dict[str, Value] = {
            "1.Mn": "gfmhil",
            "1.Md": "grid-forming converter, emulated",
            "1.Vr": version("gfmhil"),
            "1.SN": self._scenario.digest(),
            "1.DA": float(unit),
            "1.Opt": self._scenario.converter or "",
            "701.ACType": float(_THREE_PHASE),
            "701.DERMode": float(_GRID_FORMING),
            "702.VNomRtg": b.V_n,
            "702.VNom": b.V_n,
            "702.CtrlModes": float(_CONTROLS),
            "702.IntIslandCatRtg": float(_ISLAND if island else 0),
            "714.Prt1.PrtTyp": float(_DC_BOTH_WAYS),
            "714.Prt1.ID": 1.0,
            "714.Prt1.IDStr": "DC link",
            "705.Crv1.DeptRef": float(_VARS_MAX),
            "705.Crv2.DeptRef": float(_VARS_MAX),
            "705.Crv1.ReadOnly": 1.0,
            "705.Crv2.ReadOnly": 0.0,
            "711.Ctl1.ReadOnly": 1.0,
            "711.Ctl2.ReadOnly": 0.0,
            **names,
        }
        for name in ("W", "VA", "WChaRte", "WDisChaRte"):
            found[f"702.{name}MaxRtg"] = found[f"702.{name}Max"] = b.S_n
        for name in ("Inj", "Abs"):
            found[f"702.VarMax{name}Rtg"] = found[f"702.VarMax{name}"] = b.S_n
        return found

    def now(
        self, run: RunState, slack: Mapping[str, float], beats: int, heart_lost: bool, local: bool
    ) -> dict[str, Value]:
        """The points that change with the run.

        Args:
            slack: by ``SLACK_POINTS``, as far as it is known.
            beats: number of seconds in which the run advanced.
            heart_lost: the client's heartbeat is missing.
            local: remote control is refused.
        """
        b, y = self._bases, run.row
        p, q, V = y["y_p"], y["y_q"], y["y_V"]
        s = math.hypot(p, q)
        i_dc = y["u_i_u"] if self._scenario.plant.dc_source.mode == "controlled" else math.nan
        info = run.reason or ("heartbeat of the client lost" if heart_lost else "")
        return {
            "701.St": float(not run.safe),
            "701.InvSt": float(6 if run.safe else _STATES[run.state]),
            "701.ConnSt": float(not run.safe),
            "701.Alrm": float(_alarms(int(y["true_trip"]), bool(info))),
            "701.MnAlrmInfo": info,
            "701.W": p * b.S_n,
            "701.VA": s * b.S_n,
            "701.Var": q * b.S_n,
            "701.PF": p / s if s > 0 else None,
            "701.A": s / V * b.base_of("I") if V > 0 else None,
            "701.LLV": V * b.V_n,
            "701.LNV": V * b.V_n / math.sqrt(3),
            "701.Hz": y["y_omega_u"] * b.omega_n / (2 * math.pi),
            "714.DCA": i_dc * b.base_of("i_dc"),
            "714.Prt1.DCA": i_dc * b.base_of("i_dc"),
            "714.DCW": i_dc * y["y_v_dc"] * b.S_n,
            "714.Prt1.DCW": i_dc * y["y_v_dc"] * b.S_n,
            "714.Prt1.DCV": y["y_v_dc"] * b.V_dcref,
            "714.Prt1.DCSta": 3.0 if run.safe else 1.0,
            "715.LocRemCtl": float(local),
            "715.DERHb": float(beats),
            f"{VENDOR}.St": float(run.state),
            f"{VENDOR}.PRef": run.references["P_ref"],
            f"{VENDOR}.QRef": run.references["Q_ref"],
            f"{VENDOR}.Tick": float(run.tick),
            f"{VENDOR}.Miss": float(run.misses),
            **{f"{VENDOR}.{name}": slack.get(name) for name in SLACK_POINTS},
            f"{VENDOR}.SafeRsn": run.reason,
        }


def top(name: str) -> float:
    """The largest magnitude that the signal table allows, p.u."""
    return max(max(abs(s.low), abs(s.high)) for s in SIGNALS if s.name == name)


def exponent(largest: float, bits: int, signed: bool = False) -> int:
    """The finest scale factor with which ``largest`` still fits."""
    whole = 2 ** (bits - signed) - 2
    return math.ceil(math.log10(largest / whole))


def _alarms(trip: int, any_reason: bool) -> int:
    name = TRIPS[trip - 1][0] if 1 <= trip <= len(TRIPS) else ""
    return _ALARMS.get(name, _MANUFACTURER if any_reason else 0)
