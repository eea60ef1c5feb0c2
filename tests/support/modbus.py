"""Helpers of the Modbus server's tests."""

import re
import subprocess
from pathlib import Path

import gfm_hil.ports.modbus

from .files import text_of
from .processes import GFMHIL

# On a busy machine the controller may stand still for a second in the middle of a step of P_ref:
# the large C_dc and the trips out of service keep the run going through that.
SCENARIO = text_of("served.toml")
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
