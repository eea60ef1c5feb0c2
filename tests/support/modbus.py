"""Helpers of the Modbus server's tests."""

import re
import subprocess
from pathlib import Path

import gfm_hil.ports.modbus

from .processes import GFMHIL

# On a busy machine the controller may stand still for a second in the middle of a step of P_ref:
# the large C_dc and the trips out of service keep the run going through that.
SCENARIO = """
title = "served"
duration = 600.0
mode = "realtime"
T_s = 5e-4
law = "vsg-2-tuned"
ready_laws = ["vsg-5-tuned", "droop-3-tuned"]
after_trip = "wait"
[link]
type = "shm"
peer_timeout_s = 30.0
[late_policy]
hold = 10000000
[plant.factors]
C_dc = 200.0
[plant.protection]
over_current = { enabled = false }
over_frequency = { enabled = false }
under_frequency = { enabled = false }
"""
MODELS = str(Path(gfm_hil.ports.modbus.__file__).parent / "models")
SUNS = 40000


def end(process: subprocess.Popen) -> None:
    if process.poll() is None:
        process.kill()
    process.communicate()


def start(folder: Path, *options: str) -> tuple[subprocess.Popen, int]:
    """Start a server; returns it and its port."""
    command = [*GFMHIL, "modbus", str(folder), "--port", "0", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said = process.stdout.readline()
    return process, int(re.search(r":(\d+), unit 1", said).group(1))


def at(device, model: int, name: str) -> int:
    target = device.models[model][0]
    return target.model_addr + target.points[name].offset
