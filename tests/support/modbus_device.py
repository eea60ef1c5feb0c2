"""A Modbus device over a made-up run."""

import asyncio
import math

from pymodbus.constants import ExcCodes

from gfm_hil.core.errors import UserError
from gfm_hil.ports.modbus.device import TICK_S, Device
from gfm_hil.ports.modbus.measures import RunState
from gfm_hil.recording.columns import CONTROLLER_COLUMNS, PLANT_COLUMNS
from gfm_hil.scenario import check_scenario
from gfm_runtime.states import RUNNING

LAWS = ["vsg-2", "mimo-gfm", "droop-1"]


S_N = 4000.0


class Bench:
    """A run that carries out commands at once, a clock that the test sets, and a device."""

    def __init__(self, heartbeat_ms: int = 0) -> None:
        self.row = dict.fromkeys((*PLANT_COLUMNS, *CONTROLLER_COLUMNS), 0.0)
        start = {"y_v_dc": 1, "y_V": 1, "y_omega_u": 1, "y_p": 0.5, "ref_V_ref": 1}
        self.row |= {name: float(value) for name, value in start.items()}
        self.row |= {"ref_P_ref": 0.5, "state": float(RUNNING)}
        self.law, self.gains, self.now = LAWS[0], {}, 0.0
        self.told: list[dict] = []
        self.deaf = False
        self.scenario = check_scenario({"title": "made up", "duration": 1.0, "law": LAWS[0]}, "")
        self.device = Device(
            self.scenario, LAWS, self.newest, self.command, heartbeat_ms, lambda: self.now
        )

    def newest(self) -> RunState:
        row = dict(self.row)
        reason = "over-current" if row["true_trip"] else ""
        return RunState(row, 1, 0, int(row["state"]), self.law, dict(self.gains), reason)

    def command(self, event: dict) -> None:
        if self.deaf:
            raise UserError("the controller does not answer")
        self.told.append(event)
        match event["type"]:
            case "reference":
                for name, value in event.items():
                    self.row |= {f"ref_{name}": value} if name != "type" else {}
            case "law":
                self.law, self.gains = event["law"], {}
            case "gains":
                self.gains |= event["values"]
            case "reset":
                self.row |= {"true_trip": 0.0, "state": float(RUNNING), "ref_P_ref": 0.5}

    def write(self, *wanted: tuple[str, float | str]) -> ExcCodes | None:
        """One request with these points, which must be adjacent."""
        points = [(self.device.image.points[path], value) for path, value in wanted]
        registers = [r for point, value in points for r in point.encode(value)]
        return asyncio.run(self.device.access(points[0][0].address, registers))

    def read(self, path: str):
        self.device.refresh()
        return self.device.image.get(path)

    def pass_by(self, seconds: float) -> None:
        """Advance the clock by every tick."""
        before = math.floor(self.now / TICK_S + 1e-6)
        asyncio.run(self._tick(before + 1, round(seconds / TICK_S)))

    async def _tick(self, first: int, count: int) -> None:
        for tick in range(first, first + count):
            self.now = tick * TICK_S
            await self.device.clock()

    @property
    def P_ref(self) -> float:
        return self.row["ref_P_ref"]
