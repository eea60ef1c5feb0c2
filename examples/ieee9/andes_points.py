"""The same network in ANDES: reference points of speeds and rotor angles.

    pip install andes==2.0.0
    python andes_points.py            # writes points.csv

It reads the data of network.toml and hands them to ANDES's GENROU, IEEET1, TGOV1 and IEEEST, whose
washout is here that of PSS1A. The network is ANDES's own case wscc9.
"""

import csv
import tomllib
from pathlib import Path

import andes
import numpy as np

HERE = Path(__file__).parent
STEP_S, POINT_S, END_S = 1 / 240, 0.05, 6.0  # trapezoidal rule; END_S, POINT_S as compare.py
S_B, BASE = 100.0, 10.0  # MVA: of ANDES's case, and of network.toml
FAULT_BUS, FAULT_R, FAULT_S = 7, 0.1, 0.1  # R in p.u. of S_B; as compare.py


def add_machine(ss, name, one, gen, Sn, Vn, D=None):
    """Add a machine of network.toml, which takes over a generator ``gen``, with its controls."""
    bus = int(one["node"].removeprefix("bus"))
    ss.add("GENROU", idx=name, bus=bus, gen=gen, Sn=Sn, fn=60, Vn=Vn,
           M=2 * one["H"], D=one.get("D", 0.0) if D is None else D, ra=one["R"], xl=one["X_l"],
           xd=one["X_d"], xq=one["X_q"], xd1=one["X_d1"], xq1=one["X_q1"], xd2=one["X_2"],
           xq2=one["X_2"], Td10=one["T_d10"], Tq10=one["T_q10"], Td20=one["T_d20"],
           Tq20=one["T_q20"])  # fmt: skip
    avr, gov = one["avr"], one["governor"]
    ss.add("IEEET1", idx=f"E{name}", syn=name, TR=avr["T_R"], KA=avr["K_A"], TA=avr["T_A"],
           VRMAX=avr["V_Rmax"], VRMIN=avr["V_Rmin"], KE=avr["K_E"], TE=avr["T_E"],
           KF=avr["K_F"], TF=avr["T_F"], E1=avr["E_1"], SE1=avr["S_E1"], E2=avr["E_2"],
           SE2=avr["S_E2"])  # fmt: skip
    ss.add("TGOV1", idx=f"T{name}", syn=name, R=gov["R"], T1=gov["T1"], VMAX=gov["V_max"],
           VMIN=gov["V_min"], T2=gov["T2"], T3=gov["T3"], Dt=gov["D_t"])  # fmt: skip
    if (pss := one.get("pss")) is not None:
        ss.add("IEEEST", idx=f"P{name}", avr=f"E{name}", MODE=1, KS=pss["K_S"], T5=pss["T5"],
               T6=pss["T5"], T1=pss["T1"], T2=pss["T2"], T3=pss["T3"], T4=pss["T4"],
               A1=0, A2=0, A3=0, A4=0, A5=0, A6=0,
               LSMAX=pss["V_STmax"], LSMIN=pss["V_STmin"], VCU=0, VCL=0)  # fmt: skip


def build(network, event):
    ss = andes.load(andes.get_case("wscc9/wscc9.xlsx"), setup=False, no_output=True,
                    default_config=True)  # fmt: skip
    volts = dict(zip(ss.Bus.idx.v, ss.Bus.Vn.v, strict=True))
    for k, (name, one) in enumerate(network["synchronous_machines"].items(), 1):
        # in small: T is less by P (omega - 1)
        D = -one["P"] if event.endswith("omega") else None
        bus = int(one["node"].removeprefix("bus"))
        add_machine(ss, name, one, k, one["S"] * BASE, volts[bus], D)
    if event == "fault":
        ss.add("Fault", bus=FAULT_BUS, tf=1.0, tc=1.0 + FAULT_S, rf=FAULT_R, xf=0.0)
    else:
        model, dev = ("GENROU", "M3") if event == "machine" else ("PQ", "PQ_1")
        ss.add("Toggler", model=model, dev=dev, t=1.0)
    ss.setup()
    ss.PFlow.run()
    ss.TDS.config.fixt, ss.TDS.config.tstep, ss.TDS.config.tf = 1, STEP_S, END_S
    ss.TDS.config.no_tqdm, ss.TDS.config.criteria = 1, 0
    ss.TDS.config.honest, ss.TDS.config.max_iter, ss.TDS.config.tol = 1, 50, 1e-7
    return ss


def main():
    network = tomllib.loads((HERE / "network.toml").read_text())["network"]
    rows = []
    for event in ("machine", "load", "load, T = P / omega", "fault"):
        ss = build(network, event)
        ss.TDS.run()
        if ss.dae.ts.t[-1] < END_S - STEP_S:
            raise SystemExit(f"{event}: ANDES ended at {ss.dae.ts.t[-1]:g} s")
        t, x = ss.dae.ts.t, ss.dae.ts.x
        speeds, angles = x[:, ss.GENROU.omega.a], x[:, ss.GENROU.delta.a]
        each = np.hstack([speeds, angles[:, 1:] - angles[:, :1]])
        for at in np.arange(1, round(END_S / POINT_S) + 1) * POINT_S:
            now = [f"{np.interp(at, t, one):.7f}" for one in each.T]
            rows.append([event, f"{at:.2f}", *now])
    with (HERE / "points.csv").open("w", newline="") as file:
        file.write(f"# ANDES {andes.__version__}, python examples/ieee9/andes_points.py\n")
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["event", "t_s", "omega_1", "omega_2", "omega_3", "delta_21", "delta_31"])
        out.writerows(rows)


if __name__ == "__main__":
    main()
