"""The register reference of the Modbus server, from the image that it serves."""

from __future__ import annotations

from gfm_hil.core.terminal import markdown
from gfm_hil.ports.modbus.device import Device
from gfm_hil.ports.modbus.image import SunSpecPoint, definition
from gfm_hil.ports.modbus.measures import SLACK_POINTS, RunState
from gfm_hil.ports.modbus.points import LawDroops
from gfm_hil.recording.columns import CONTROLLER_COLUMNS, PLANT_COLUMNS
from gfm_hil.scenario import load_scenario
from gfm_runtime import law_names
from gfm_runtime.states import RUNNING

_LAWS = ["mimo-gfm", "vsg-2"]
_START = {"y_v_dc": 1.0, "y_V": 1.0, "y_omega_u": 1.0, "y_p": 0.5, "y_q": 0.1, "ref_V_ref": 1.0}


def registers() -> str:
    """Every implemented point of every model: address, registers, type, unit, access, meaning."""
    device = _device()
    points = list(device.image.points.values())
    parts = []
    for model in dict.fromkeys(p.path.partition(".")[0] for p in points):
        group = definition(int(model))["group"]
        mine = [p for p in points if p.path.partition(".")[0] == model]
        rows = [_row(device, p) for p in mine if _is_there(device, p)]
        absent = [f"`{p.name}`" for p in mine if not _is_there(device, p)]
        parts += [f"#### {model}: {group['label']}", "", markdown(_HEAD, rows), ""]
        if absent:
            parts += [f"Not implemented: {', '.join(absent)}.", ""]
    return "\n".join(parts)


def droops() -> str:
    """Which laws have the droops that models 711 and 705 speak of."""
    gains = LawDroops(law_names())
    rows = []
    for law in law_names():
        found = gains.droops(law, {})
        cells = ["–" if v is None else f"{v:g}" for v in (found.D_p, found.D_q)]
        rows.append((f"`{law}`", *cells))
    return markdown(("law", "$D_p$ (711)", "$D_q$ (705)"), rows)


_HEAD = ("address", "registers", "point", "type", "unit", "access", "")


def _device() -> Device:
    row = dict.fromkeys((*PLANT_COLUMNS, *CONTROLLER_COLUMNS), 0.0) | _START
    view = RunState(row | {"state": float(RUNNING)}, 0, 0, RUNNING, _LAWS[0], {}, "in a word")
    device = Device(
        load_scenario("pref_step"), _LAWS, lambda: view, lambda event: None, 5000, lambda: 0.0
    )
    device.slack = dict.fromkeys(SLACK_POINTS, 1.0)
    device.refresh()
    return device


def _is_there(device: Device, point: SunSpecPoint) -> bool:
    """Implemented; some that are have no value before something has happened."""
    later = ("HbLate", "Refd", "MnAlrmInfo")
    return point.name in later or point.type == "pad" or device.image.get(point.path) is not None


def _row(device: Device, point: SunSpecPoint) -> tuple[str, ...]:
    unit = str(point.definition.get("units", "")).replace("%", "% ")
    if point.exponent:
        unit = f"{unit} · 10^{point.exponent}^".strip()
    access = "RW" if device.writable(point) else "R"
    note = ", settable by the standard, not here" if access != point.standard_access else ""
    symbols = point.definition.get("symbols", [])
    named = ", ".join(f"{s['value']} {s['name']}" for s in symbols) if len(symbols) < 9 else ""
    text = point.definition.get("desc", point.definition.get("label", "")).rstrip(".")
    text = f"{text}{note}" + (f": {named}" if named else "")
    where = str(point.address), str(point.length)
    return (*where, f"`{point.name}`", point.type, unit, access, text)
