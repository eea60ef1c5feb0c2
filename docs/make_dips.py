"""The table docs/tables/grid_dips.md: laws in 200 random dips of the grid's voltage.

Each dip has a retained voltage of 0 to 0.8 p.u. for 0.1 to 0.25 s, SCR 1.5 to 20 and P_ref 0.2 to
0.9 p.u., on the converter of the published tests behind ``virtual-stator``. All laws get the same.

Usage: python docs/make_dips.py    (about 2 minutes on one processor)
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

import gfmhil
from gfm_hil.core.terminal import markdown
from gfm_hil.run.cycles import cycle_means, cycle_ticks
from gfm_hil.studies.conformity.sets import load_under_test

LAWS = {
    "vsg-2": {},
    "mimo-gfm-practical": {},
    "mimo-gfm-practical, other gains": {
        "k_pdc": 125.0, "k_idc": 300.0, "k_22": 6.0, "k_34": 1.9, "k_35": 38.0,
    },
    "vsg-2 at 5 %": {"D_p": 0.05, "k_22": 2.0},
    "mimo-gfm-grid": {},
    "vsg-10-grid": {},
}  # fmt: skip
"""Names of laws, what follows the first comma or "at" aside, and gains that differ."""
DIPS, SEED, AT, DURATION = 200, 0, 0.5, 5.0
T_S, F_N = 1e-4, 50.0
BAND = 0.05  # p.u.
OUT = Path(__file__).resolve().parent / "tables" / "grid_dips.md"


def dips() -> list[dict[str, Any]]:
    """The scenarios, without a law."""
    plant = load_under_test(None).plant.model_dump(mode="json", exclude_unset=True)
    random, found = np.random.default_rng(SEED), []
    for _ in range(DIPS):
        V, lasts = random.uniform(0.0, 0.8), random.uniform(0.1, 0.25)
        scr, P = float(np.exp(random.uniform(np.log(1.5), np.log(20.0)))), random.uniform(0.2, 0.9)
        dip = {"type": "grid-voltage", "t": AT, "V_g": V, "duration": lasts}
        found.append({
            "title": "dip", "duration": DURATION, "inner": "virtual-stator", "T_s": T_S,
            "link": {"type": "inproc"}, "references": {"P_ref": P}, "events": [dip],
            "plant": {**plant, "grid": {"scr": scr, "x_over_r": 6.0}},
        })  # fmt: skip
    return found


def judge(scenario: dict[str, Any], law: gfmhil.Law) -> dict[str, float] | None:
    """Swing [degrees], extremes of v_dc [p.u.] and the time until p is back [s]; None: it trips or
    falls out of step."""
    run = gfmhil.run(scenario, law)
    s = run.signals
    swing = float(np.degrees(np.abs(s["delta"] - s["delta"][0]).max()))
    if run.status == "tripped" or swing > 180.0:
        return None
    ends = AT + scenario["events"][0]["duration"]
    width = cycle_ticks(T_S, F_N)
    first = round(ends / T_S)
    means = np.concatenate([*cycle_means(s["p_c"], first, len(s["p_c"]), width)])
    away = np.flatnonzero(np.abs(means - s["p_c"][0]) > BAND)
    settled = (float(away[-1]) + width) * T_S if len(away) else 0.0
    return {"swing": swing, "low": s["v_dc"].min(), "high": s["v_dc"].max(), "settled": settled}


def main() -> None:
    """Run all, and write the table."""
    rows = []
    for name, gains in LAWS.items():
        own = re.split(", | at ", name)[0]
        law = gfmhil.Law.load(own).with_gains(own, **gains)
        found = [judge(dip, law) for dip in dips()]
        good = [x for x in found if x is not None]
        of = {key: np.array([x[key] for x in good]) for key in good[0]}
        pairs = [f"{np.median(of[k]):.3g} / {np.quantile(of[k], 0.95):.3g}"
                 for k in ("swing", "settled")]  # fmt: skip
        v_dc = f"{of['low'].min():.3f} … {of['high'].max():.3f}"
        rows.append([name, f"{len(good)} of {len(found)}", pairs[0], pairs[1], v_dc])
    head = ["law", "stays", "swing [°]", "p back after [s]", "v_dc [p.u.]"]
    OUT.write_text(markdown(head, rows) + "\n", "utf-8")


if __name__ == "__main__":
    main()
