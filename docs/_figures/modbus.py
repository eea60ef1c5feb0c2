"""A session of pysunspec2's own client with a run, as the client saw it and as it was recorded."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import sunspec2.device as sunspec
from _figures.common import FIGURES, GREY, dress
from matplotlib import pyplot as plt
from sunspec2.modbus.client import SunSpecModbusClientDeviceTCP

import gfm_hil.ports.modbus

SCENARIO = """
title = "A client's session"
duration = 12.0
mode = "realtime"
law = "mimo-gfm-deployable"
ready_laws = ["vsg-2-tuned"]
[link]
type = "shm"
peer_timeout_s = 30.0
[late_policy]
hold = 1000000
[[events]]
t = 5.0
type = "grid-frequency"
f_hz = 49.975
"""
VENDOR = 64901
_EVERY_S = 0.04
_BLUE, _RED = "#2166ac", "#b2182b"


def session() -> None:
    """Run it and draw it."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "run"
        (Path(place) / "session.toml").write_text(SCENARIO, encoding="utf-8")
        command = [sys.executable, "-m", "gfm_hil", "run", str(Path(place) / "session.toml")]
        command += ["--out", str(folder), "--modbus", "5021", "--no-figures"]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
            assert run.stderr is not None
            while "Modbus" not in run.stderr.readline():
                pass
            seen, steps = _client(5021)
            run.communicate()
        with np.load(folder / "signals.npz") as file:
            signals = dict(file)
        with np.load(folder / "timing.npz") as file:
            begin = float(file["plant_scheduled"][0]) * 1e-9
    _draw(signals, seen - [begin, 0, 0, 0], [(t - begin, text) for t, text in steps])


def _device(port: int) -> Any:
    models = str(Path(gfm_hil.ports.modbus.__file__).parent / "models")
    sunspec.set_model_defs_path([models, sunspec.models_dir])
    device = SunSpecModbusClientDeviceTCP(slave_id=1, ipport=port, timeout=10)
    device.scan()
    return device


def _client(port: int) -> tuple[np.ndarray, list[tuple[float, str]]]:
    """What one connection reads, rows of (time, W, V, reference in W), while another writes."""
    rows: list[tuple[float, ...]] = []
    over = threading.Event()

    def poll() -> None:
        device = _device(port)
        ac, ours = device.models[701][0], device.models[VENDOR][0]
        while not over.wait(_EVERY_S):
            ac.read()
            ours.PRef.read()
            rows.append((time.monotonic(), ac.W.cvalue, ac.LLV.cvalue, ours.PRef.value * 4000))
        device.close()

    reader = threading.Thread(target=poll)
    reader.start()
    device = _device(port)
    ours = device.models[VENDOR][0]
    steps: list[tuple[float, str]] = []

    def at(t: float, text: str, model: int, **values: float) -> None:
        while ours.Tick.value * 1e-4 < t:
            time.sleep(0.005)
            ours.Tick.read()
        target = device.models[model][0]
        for path, value in values.items():
            group, _, name = path.rpartition("_")
            (getattr(target, group)[1] if group else target).points[name].cvalue = value
        target.write()
        if text:
            steps.append((time.monotonic(), text))

    at(1.0, "704 WSet = 3000 W", 704, WSetEna=1, WSet=3000)
    at(2.9, "", 705, Ena=1, Crv_ActPt=0, Crv_VRef=101)
    at(3.0, "705 VRef = 101 %", 705, AdptCrvReq=2)
    at(6.9, "", 711, Ena=1, Ctl_KOf=0.02, Ctl_KUf=0.02)
    at(7.0, "711 K = 0.02", 711, AdptCtlReq=2)
    at(8.5, "Law = 2", VENDOR, Law=2)
    at(9.5, "704 WSet = 2400 W\nfor 1 s", 704, WSetRvrtTms=1, WSet=2400)
    at(11.5, "", 704)
    over.set()
    reader.join()
    device.close()
    return np.array(rows), steps


def _draw(signals: dict[str, np.ndarray], seen: np.ndarray, steps: list[tuple[float, str]]) -> None:
    figure, (top, below) = plt.subplots(2, 1, figsize=(9, 5.4), sharex=True)
    t = signals["t"]
    top.plot(t, signals["y_p"] * 4, color=_BLUE, lw=0.8, label="p, every tick of the recording")
    top.plot(seen[:, 0], seen[:, 3] / 1e3, color=GREY, lw=1, ls="--", label="PRef, as read")
    top.plot(seen[:, 0], seen[:, 1] / 1e3, ".", color=_RED, ms=2.5, label="701 W, as read")
    dress(top, "Active power, kW")
    below.plot(t, signals["y_V"] * 380, color=_BLUE, lw=0.8, label="V, every tick")
    below.plot(seen[:, 0], seen[:, 2], ".", color=_RED, ms=2.5, label="701 LLV, as read")
    dress(below, "Voltage, V")
    below.set_xlabel("time, s", fontsize=9, color="#444444")
    top.set_ylim(1.2, 4.4)
    for when, text in [*steps, (5.0, "the grid falls\nto 49.975 Hz")]:
        for axes in (top, below):
            axes.axvline(when, color=GREY, lw=0.6, ls=":")
        top.annotate(
            text, (when, 4.35), xytext=(3, 0), textcoords="offset points", fontsize=7.5, va="top",
            color="#444444",
        )  # fmt: skip
    for axes in (top, below):
        axes.legend(loc="lower right", fontsize=7.5, frameon=False, ncols=3)
    below.set_xlim(0, 12)
    figure.tight_layout()
    figure.savefig(FIGURES / "modbus_session.png", dpi=110)
    plt.close(figure)
