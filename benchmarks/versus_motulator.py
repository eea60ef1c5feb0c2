"""Simulated seconds per second of gfmhil's closed loop and of motulator's grid-forming example.

motulator (PyPI, MIT licence; ``pip install gfmhil[bench]``) is a simulator of converters and drives
in plain Python. Its example is set up here from its public API with the values of its
documentation: a 12.5 kVA converter under reference-feedforward power-synchronization control at
100 µs, with steps of the power reference. The two do not simulate the same thing; see the remarks.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gfm_hil.bench.loop import InprocLoop
from gfm_hil.bench.rounds import ratios, seconds, spread, spread_text, take_turns
from gfm_hil.realtime.environment import environment

try:
    from motulator.grid import control, model
    from motulator.grid.utils import ACFilterPars, BaseValues, NominalValues
except ModuleNotFoundError as missing:
    raise SystemExit(f"{missing.name}: not installed; pip install 'gfmhil[bench]'") from None

T_S = 1e-4  # s, of both
TARGET = 100.0
REMARKS = (
    "both: 100 µs, inputs held for a whole period (no switching ripple), steps of P_ref",
    "motulator: L filter and line, stiff DC voltage, one sample of delay; SciPy's adaptive RK45 "
    "at its default rtol of 1e-3, every solver step kept in lists, arrays made of them at the end",
    "gfmhil: LC filter, line and DC link, no delay, the circuit solved by its modes (accuracy: "
    "tests/plant/test_accuracy.py), sensors, limits, protection; every tick recorded; compiling, "
    "some ten seconds once a machine, is not counted",
    "what the ratio shows is compiled against interpreted code, not one method against another; "
    "motulator's switching model, its drives and its plots have no counterpart here",
)


@dataclass
class Example:
    """motulator's example over ``duration`` s."""

    duration: float
    p: float = 0.0  # before the last step, p.u.: 1 if the example ran as it should

    def build(self) -> Any:
        """A fresh simulation: nothing of the last one may be kept."""
        nominal = NominalValues(U=400, I=18, f=50, P=12.5e3)
        base = BaseValues.from_nominal(nominal)
        grid = ACFilterPars(L_fc=0.15 * base.L, R_fc=0.05 * base.Z, L_g=0.74 * base.L)
        system = model.GridConverterSystem(
            model.VoltageSourceConverter(u_dc=650),
            model.ACFilter(grid),
            model.ThreePhaseVoltageSource(w_g=base.w, abs_e_g=base.u),
        )
        law = control.PowerSynchronizationControl(
            control.PowerSynchronizationControlCfg(
                nom_u=base.u,
                nom_w=base.w,
                max_i=1.3 * base.i,
                R=0.05 * base.Z,
                R_a=0.2 * base.Z,
                T_s=T_S,
            )
        )
        law.ref.v_c = lambda t: base.u
        # three steps up and one down, at 0.2, 0.5, 0.8 and 1.2 s of its own 1.5 s
        *up, down = (self.duration / 1.5 * t for t in (0.2, 0.5, 0.8, 1.2))
        law.ref.p_g = lambda t: (sum(t > step for step in up) / 3 - (t > down)) * nominal.P
        return model.Simulation(system, law)

    def run(self) -> float:
        """Simulated seconds per second."""
        simulation = self.build()
        rate = self.duration / seconds(lambda: simulation.simulate(t_stop=self.duration))
        p = simulation.ctrl.data.fbk.p_g
        self.p = float(p[round(0.79 * len(p))]) / 12.5e3
        return rate


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="hardly any work: only try it out")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--law", default="psc-2", help="of gfmhil's loop (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=1.5, help="s of each (%(default)s)")
    args = parser.parse_args()
    duration, rounds = (0.01, 1) if args.quick else (args.duration, args.rounds)
    theirs = Example(duration)
    with tempfile.TemporaryDirectory() as place:
        loop = InprocLoop("pref_step", args.law, round(duration / T_S), Path(place))
        found = take_turns(
            {"gfmhil": lambda: loop.T_s * 1e9 / loop.whole(), "motulator": theirs.run}, rounds
        )
    faster = ratios(found["gfmhil"], found["motulator"])
    if args.json:
        result = {name: spread(each) for name, each in {**found, "ratio": faster}.items()}
        about = {"motulator_p_pu": theirs.p, "remarks": REMARKS, "environment": environment()}
        print(json.dumps(result | about, indent=2))
        return
    print(f"simulated seconds per second: median (min-max) of {rounds} rounds")
    print(f"  gfmhil, {args.law}: {spread_text(found['gfmhil'], 1)}")
    print(f"  motulator, its grid-forming example: {spread_text(found['motulator'], 3)}")
    print(f"{spread_text(faster, 0)} times as fast (target {TARGET:g})")
    print(*(f"- {remark}" for remark in REMARKS), sep="\n")


if __name__ == "__main__":
    main()
