"""The same network in ANDES: reference points of speeds and rotor angles.

    pip install andes==2.0.0
    python andes_reference.py            # writes points.csv

It hands the data of network.toml to ANDES, its machines and their controls as examples/ieee9 does.
"""

import csv
import sys
import tomllib
from pathlib import Path

import andes
import numpy as np

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "ieee9"))
from andes_points import S_B, STEP_S, add_machine  # noqa: E402

BASE = 11.0  # MVA, of network.toml; these and the next as compare.py
EVENT_S, FAULT_S, POINT_S, END_S = 1.0, 0.1, 0.1, 6.0
FAULT_BUS, FAULT_R = 16, 0.02
SLACK = "G39"


def build(network, event):
    ss = andes.System(no_output=True, default_config=True)
    per = S_B / BASE  # p.u. of 11 MVA times this is p.u. of 100 MVA, of an impedance

    def bus(part, end="node"):
        return int(part[end].removeprefix("bus"))

    for k in range(1, 40):
        ss.add("Bus", idx=k, name=f"bus{k}", Vn=345.0)
    for name, one in network["lines"].items():
        ss.add("Line", idx=name, bus1=bus(one, "start"), bus2=bus(one, "end"), Vn1=345.0, Vn2=345.0,
               r=one["R"] * per, x=one["L"] * per, b=one["B"] / per)  # fmt: skip
    for name, one in network["transformers"].items():
        ss.add("Line", idx=name, bus1=bus(one, "start"), bus2=bus(one, "end"), Vn1=345.0, Vn2=345.0,
               r=one["R"] * per, x=one["X"] * per, tap=one["ratio"], phi=0.0, trans=1)  # fmt: skip
    for name, one in network["loads"].items():
        ss.add("Shunt", idx=name, bus=bus(one), Vn=345.0, g=one["P"] / per, b=-one["Q"] / per)
    for name, one in network["capacitors"].items():
        ss.add("Shunt", idx=name, bus=bus(one), Vn=345.0, g=0.0, b=one["Q"] / per)
    for name, one in network["synchronous_machines"].items():
        static = {"idx": f"S{name}", "bus": bus(one), "Vn": 345.0, "v0": one["V"]}
        if name == SLACK:
            ss.add("Slack", a0=0.0, **static)
        else:
            ss.add("PV", p0=one["P"] * one["S"] / per, **static)
        add_machine(ss, name, one, f"S{name}", Sn=one["S"] * BASE, Vn=345.0)
    if event == "fault":
        ss.add("Fault", bus=FAULT_BUS, tf=EVENT_S, tc=EVENT_S + FAULT_S, rf=FAULT_R, xf=0.0)
    else:
        model, dev = ("GENROU", "G38") if event == "machine" else ("Shunt", "load20")
        ss.add("Toggler", model=model, dev=dev, t=EVENT_S)
    ss.setup()
    ss.PFlow.run()
    config = ss.TDS.config
    config.fixt, config.tstep, config.tf, config.no_tqdm, config.criteria = 1, STEP_S, END_S, 1, 0
    config.honest, config.max_iter, config.tol = 1, 50, 1e-7
    return ss


def main():
    network = tomllib.loads((HERE / "network.toml").read_text())["network"]
    rows = []
    for event in ("load", "machine", "fault"):
        ss = build(network, event)
        ss.TDS.run()
        t, x = ss.dae.ts.t, ss.dae.ts.x
        if t[-1] < END_S - STEP_S:
            raise SystemExit(f"{event}: ANDES ended at {t[-1]:g} s")
        speeds, angles = x[:, ss.GENROU.omega.a], x[:, ss.GENROU.delta.a]
        each = np.hstack([speeds, angles - angles[:, -1:]])
        for at in np.arange(1, round(END_S / POINT_S) + 1) * POINT_S:
            rows.append([event, f"{at:.2f}", *(f"{np.interp(at, t, one):.6f}" for one in each.T)])
    names = network["synchronous_machines"]
    with (HERE / "points.csv").open("w", newline="") as file:
        file.write(f"# ANDES {andes.__version__}, python examples/ieee39/andes_reference.py\n")
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            ["event", "t_s", *(f"{what}_{n}" for what in ("omega", "delta") for n in names)]
        )
        out.writerows(rows)


if __name__ == "__main__":
    main()
