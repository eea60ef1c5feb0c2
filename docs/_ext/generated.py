"""Sphinx extension: fills the generated parts of the pages from the code while they are read.

A line ``<!-- generate: NAME ARGUMENTS -->`` is replaced by what NAME makes. The pages can
therefore not say anything about laws, keys or messages that the code does not.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from _ext import (
    component_pages,
    conformity_pages,
    connect_pages,
    design_pages,
    law_pages,
    modbus_pages,
    outputs,
    port_pages,
    scenario_pages,
    testing_pages,
)

_LINE = re.compile(r"^<!-- generate: (\S+) ?(.*?) *-->$", re.MULTILINE)

MAKERS: dict[str, Callable[..., str]] = {
    "design-gammas": design_pages.gammas,
    "design-weights": design_pages.weights,
    "law-overview": law_pages.overview,
    "law-catalogue": law_pages.catalogue,
    "conformity-tests": conformity_pages.tests,
    "conformity-limits": conformity_pages.limits,
    "conformity-keys": conformity_pages.keys,
    "conformity-criteria": conformity_pages.criteria,
    "inner-keys": scenario_pages.inner_tables,
    "network-keys": scenario_pages.network_tables,
    "check-keys": scenario_pages.check_table,
    "law-keys": scenario_pages.law_tables,
    "law-mistakes": outputs.mistakes,
    "scenario-keys": scenario_pages.scenario_tables,
    "end-reasons": scenario_pages.end_reasons,
    "scenario-mistakes": outputs.scenario_mistakes,
    "event-keys": scenario_pages.event_tables,
    "command": outputs.command,
    "components": component_pages.components,
    "modbus-droops": modbus_pages.droops,
    "modbus-registers": modbus_pages.registers,
    "codes": connect_pages.codes,
    "frame-examples": connect_pages.frame_examples,
    "frame-layout": connect_pages.frame_layout,
    "handshake": connect_pages.handshake,
    "shm-layout": connect_pages.shm_layout,
    "shm-slot": connect_pages.shm_slot,
    "signals": connect_pages.signals,
    "scope-head": testing_pages.scope_head,
    "testing-calls": testing_pages.calls,
    "export-formats": port_pages.export_formats,
    "columns": port_pages.columns,
    "metrics": port_pages.metrics,
    "ports": port_pages.ports,
}


def fill(text: str) -> str:
    """The text with its generated parts."""

    def make(match: re.Match[str]) -> str:
        name, argument = match.groups()
        return MAKERS[name](argument) if argument else MAKERS[name]()

    return _LINE.sub(make, text)


def _read(app: Any, docname: str, content: list[str]) -> None:
    if _LINE.search(content[0]):
        content[0] = fill(content[0])
        app.env.note_reread()


def setup(app: Any) -> dict[str, Any]:
    """Hook into Sphinx."""
    app.connect("source-read", _read)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
