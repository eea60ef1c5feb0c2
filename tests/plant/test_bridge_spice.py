"""The switched bridge against ngspice: the same circuit of switches, diodes, chokes and capacitors
with the same edges, which another program integrates step by step.

ngspice has what the plant has not: devices that leak (0.1 MOhm while it switches, which is nearly
all of what the currents differ by, 10 MOhm where it blocks), gates that take 2 ns, and Gear's
method with steps of up to 0.2 us and a relative tolerance of 1e-3. Its diodes are resistors of two
pieces: with exponential ones, or with less leakage, it finds no step that converges where both
switches of a leg are off.
"""

import math
import subprocess

import numpy as np
import pytest

from gfm_hil.scenario import load_scenario
from gfm_plant import (
    Plant,
    load_converter,
    make_plant,
    plant_advance,
    plant_command,
    plant_equilibrium,
)
from gfm_plant.between import N_SEEN, watch_period
from gfm_plant.model import V_DC
from gfm_plant.protection import trip

pytestmark = pytest.mark.apt

T_S, PERIODS = 1e-4, 200
R_ON = 0.02  # ohm, of switch and diode
LOW, HIGH = 0, 2  # gates
OFF = {name: {"enabled": False} for name in ("over_current", "under_voltage", "dc_over_voltage")}


def watched(blocked):
    """The plant of ``rig_switched`` with what it has at the beginning, (12,), and 20 ms of it from
    edge to edge: rows of ``watch_period`` and gates. Its command grows by 5 % after 5 ms, without a
    controller; or the bridge blocks at once with v_dc at 0.6."""
    content = load_scenario("rig_switched", in_process=True).plant.model_dump(exclude_unset=True)
    content["bridge"] |= {"R_switch": R_ON, "R_diode": R_ON}
    plant = make_plant(Plant.model_validate({**content, "delay": {}, "protection": OFF}), T_S)
    x, u = plant_equilibrium(plant.par, 0.5, 1.0)
    plant.start(x, u)
    u = np.append(u, 0.0)
    if blocked:
        plant.st["x"][0, V_DC] = 0.6
        trip(plant.records, 0, 1, 0.0)
    i_reg = float(plant.st[0]["i_reg"])
    rows, gates = [], []
    seen, on = np.empty((500, N_SEEN)), np.empty((500, 3), np.int64)
    for k in range(PERIODS):
        if k == 50:
            u[2] *= 1.05
        kept = plant.copy()
        plant_command(plant.records, 0, u)
        n = watch_period(plant.records, 100, seen, on)
        seen[:, 0] += k * T_S
        rows.append(seen[:n].copy())
        gates.append(on[:n].copy())
        plant.restore(kept)
        plant_advance(plant.records, u)
    return np.concatenate(rows), np.concatenate(gates), i_reg


def _diode(side, anode, cathode, leak):
    leg, v = cathode if side == "l" else anode, f"v({anode},{cathode})"
    return f"BD{side}{leg} {anode} {cathode} i={v}>0 ? {v}/{R_ON} : {v}*{leak}"


def netlist(rows, gates, i_reg, blocked):
    """The circuit in SI units; i_reg: integral of the DC source's control, p.u., which a capacitor
    of 1 F keeps."""
    c = load_converter("paper")
    V, current = math.sqrt(2 / 3) * c.V_n, math.sqrt(2 / 3) * c.S_n / c.V_n
    t, at = rows[:, 0].tolist(), (rows[0, 3:] * np.repeat([current, V, current], 3)).tolist()
    leak = 1e-7 if blocked else 1e-5  # S, of a device
    away = f"(1-v(p,n)/{c.V_dcref})"
    lines = [
        "a bridge", f".model s sw(vt=0.5 vh=0 ron={R_ON} roff={1 / leak})",
        "Rp p 0 1e8", "Rn n 0 1e8",
        f"Cdc p n {c.C_dc} ic={float(rows[0, 1]) * c.V_dcref}",
    ]  # fmt: skip
    if not blocked:
        lines += [
            f"Bdc n p i={c.S_n / c.V_dcref}*(90*{away}+v(reg))",
            f"Breg 0 reg i=400*{away}", f"Creg reg 0 1 ic={i_reg}",
        ]  # fmt: skip
    for x, p in enumerate("abc"):
        for side, gate in (("u", HIGH), ("l", LOW)):
            on = (gates[:, x] == gate).astype(int).tolist()
            edges = [k for k in range(1, len(on)) if on[k] != on[k - 1]]
            steps = [f"{t[k] - 1e-9} {on[k - 1]} {t[k] + 1e-9} {on[k]}" for k in edges]
            lines.append(f"Vg{side}{p} g{side}{p} 0 pwl(0 {on[0]} {' '.join(steps)} 1 {on[-1]})")
        lines += [
            f"Su{p} p {p} gu{p} 0 s", f"Sl{p} {p} n gl{p} 0 s", _diode("u", p, "p", leak),
            _diode("l", "n", p, leak),
            f"Vm{p} {p} m{p} 0", f"Lf{p} m{p} f{p} {c.L_f} ic={at[x]}", f"Rf{p} f{p} c{p} {c.R_f}",
            f"Cf{p} c{p} star {c.C_f} ic={at[3 + x]}",
            f"Lg{p} c{p} o{p} {c.L_g} ic={at[6 + x]}", f"Rg{p} o{p} e{p} {c.R_g}",
            f"Vg{p} e{p} 0 sin(0 {V} {c.omega_n / (2 * math.pi)} 0 0 {90 - 120 * x})",
        ]  # fmt: skip
    return lines


@pytest.mark.parametrize(("blocked", "largest"), [(False, 0.5), (True, 2.5)])
def test_phase_currents_and_v_dc_are_those_of_ngspice(tmp_path, blocked, largest):
    """Within 2e-3 p.u. of a phase's nominal peak current, and 1e-4 of V_dcref."""
    rows, gates, i_reg = watched(blocked)
    found = tmp_path / "found.txt"
    run = [
        ".options method=gear reltol=1e-3 abstol=1e-4 vntol=1e-2 chgtol=1e-9 rshunt=1e8 itl4=200",
        ".tran 1u 20m 0 0.2u uic",
        ".control", "run", f"wrdata {found} i(Vma) i(Vmb) i(Vmc) v(p)-v(n)", "quit 0",
        ".endc", ".end",
    ]  # fmt: skip
    circuit = tmp_path / "bridge.cir"
    circuit.write_text("\n".join([*netlist(rows, gates, i_reg, blocked), *run, ""]))
    subprocess.run(["ngspice", "-b", circuit], check=True, capture_output=True, timeout=300)
    c, spice = load_converter("paper"), np.loadtxt(found)
    units = [math.sqrt(2 / 3) * c.S_n / c.V_n] * 3 + [c.V_dcref]
    ours = rows[:, [3, 4, 5, 1]]
    theirs = [np.interp(rows[:, 0], spice[:, 0], spice[:, 2 * k + 1]) / units[k] for k in range(4)]
    apart = np.abs(np.transpose(theirs) - ours).max(axis=0)
    assert apart[:3].max() < 2e-3 and apart[3] < 1e-4
    assert np.abs(ours[:, :3]).max() > largest
