"""Laws in 200 random dips of the grid's voltage, and in 200 random faults.

Each dip has a retained voltage of 0 to 0.8 p.u. for 0.1 to 0.25 s, SCR 1.5 to 20 and P_ref 0.2 to
0.9 p.u., on the converter of the published tests behind ``virtual-stator``. Each fault is of any
kind, on the line or (one in three) at the connection point, through 0.001 to 0.05 p.u. for 0.06 to
0.25 s, with P_ref from -0.8 to 0.8 p.u. All laws get the same. Tables: docs/tables/grid_dips.md and
grid_faults.md.

Usage: python docs/make_dips.py    (about 6 minutes on one processor)
"""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

import gfmhil
from gfm_hil.core.terminal import markdown
from gfm_hil.run.cycles import cycle_means, cycle_ticks
from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.conformity.sets import load_under_test

LAWS = {
    "vsg-2": {},
    "mimo-gfm-practical": {},
    "mimo-gfm-practical, other gains": {
        "k_pdc": 125.0, "k_idc": 300.0, "k_22": 6.0, "k_34": 1.9, "k_35": 38.0,
    },
    "mimo-gfm-ride-through": {},
    "vsg-2 at 5 %": {"D_p": 0.05, "k_22": 2.0},
    "mimo-gfm-grid": {},
    "vsg-10-grid": {},
}  # fmt: skip
"""Names of laws, what follows the first comma or "at" aside, and gains that differ."""
DIPS, SEED, AT, DURATION = 200, 0, 0.5, 5.0
T_S, F_N = 1e-4, 50.0
BAND = 0.05  # p.u.
FAULTED = ("vsg-2", "droop-3", "mimo-gfm-practical", "mimo-gfm-ride-through")
STAGES = ("virtual-stator", "dual-sequence")
KINDS, RESISTANCES = ("3ph", "LG", "LL", "LLG"), (0.001, 0.01, 0.05)
CLEARS = 0.03  # s; what ends a run so soon after a fault does so by its clearing
TABLES = Path(__file__).resolve().parent / "tables"


def dips(count: int = DIPS, seed: int = SEED) -> list[dict[str, Any]]:
    """The scenarios, without a law."""
    plant = load_under_test(None).plant.model_dump(mode="json", exclude_unset=True)
    random, found = np.random.default_rng(seed), []
    for _ in range(count):
        V, lasts = random.uniform(0.0, 0.8), random.uniform(0.1, 0.25)
        scr, P = float(np.exp(random.uniform(np.log(1.5), np.log(20.0)))), random.uniform(0.2, 0.9)
        dip = {"type": "grid-voltage", "t": AT, "V_g": V, "duration": lasts}
        found.append(_scenario(dip, P, {**plant, "grid": {"scr": scr, "x_over_r": 6.0}}))
    return found


def faults() -> list[dict[str, Any]]:
    """The scenarios, without a law."""
    plant = load_under_test(None).plant.model_dump(mode="json", exclude_unset=True)
    random, found = np.random.default_rng(SEED), []
    for _ in range(DIPS):
        place = 0.0 if random.uniform() < 1 / 3 else random.uniform(0.02, 0.95)
        fault = {
            "type": "fault", "t": AT, "duration": random.uniform(0.06, 0.25), "position": place,
            "kind": str(random.choice(KINDS)), "R": float(random.choice(RESISTANCES)),
        }  # fmt: skip
        scr, P = float(np.exp(random.uniform(np.log(1.5), np.log(20.0)))), random.uniform(-0.8, 0.8)
        found.append(_scenario(fault, P, {**plant, "grid": {"scr": scr, "x_over_r": 6.0}}))
    return found


def _scenario(event: dict[str, Any], P_ref: float, plant: dict[str, Any]) -> dict[str, Any]:
    return {
        "title": event["type"], "duration": DURATION, "inner": STAGES[0], "T_s": T_S,
        "link": {"type": "inproc"}, "references": {"P_ref": P_ref}, "events": [event],
        "plant": plant,
    }  # fmt: skip


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


def figures(found: list[dict[str, float] | None]) -> dict[str, float]:
    """Of dips that are judged: median and 95 % of swing and settling, and extremes of v_dc, each
    the larger the worse; those that a law does not stay in count as infinite."""
    lost = dict.fromkeys(("swing", "settled", "low", "high"), np.inf) | {"low": -np.inf}
    of = {key: np.array([(x or lost)[key] for x in found]) for key in lost}
    return {
        **{f"{key} {q:.0%}": float(np.quantile(of[key], q, method="higher"))
           for key in ("swing", "settled") for q in (0.5, 0.95)},
        "v_dc below 1": 1.0 - float(of["low"].min()),
        "v_dc above 1": float(of["high"].max()) - 1.0,
    }  # fmt: skip


def ending(scenario: dict[str, Any], law: str) -> str:
    """How a run with a fault ends: "" if the law stays, or what ends it and when."""
    run = gfmhil.run(scenario, law)
    if run.status not in ("completed", "oscillating"):
        since = run.signals["t"][-1] - AT - scenario["events"][0]["duration"]
        when = "during the fault" if since < 0 else "at its clearing" if since < CLEARS else "later"
        return f"{run.status}, {reason_name(run.summary['reason'])} {when}"
    delta = run.signals["delta"]
    if np.abs(delta - delta[0]).max() > np.pi:
        return "falls out of step"
    p = run.signals["p_c"]
    return "" if np.ptp(p[-5000:]) < BAND else "still swings after 4 s"


def dip_rows() -> list[list[str]]:
    """One row a law."""
    rows = []
    for name, gains in LAWS.items():
        own = re.split(", | at ", name)[0]
        law = gfmhil.Law.load(own).with_gains(own, **gains)
        found = [judge(dip, law) for dip in dips()]
        good = [x for x in found if x is not None]
        of = {key: np.array([x[key] for x in good]) for key in good[0]}
        pairs = [f"{np.median(of[k]):.3g} / {np.quantile(of[k], 0.95):.3g}"
                 for k in ("swing", "settled")]  # fmt: skip
        v_dc = f"{of['low'].min():.4f} … {of['high'].max():.4f}"
        rows.append([name, f"{len(good)} of {len(found)}", pairs[0], pairs[1], v_dc])
    return rows


def fault_rows() -> list[list[str]]:
    """One row a law and stage."""
    rows = []
    for law in FAULTED:
        for stage in STAGES:
            ends = Counter(ending({**one, "inner": stage}, law) for one in faults())
            stays = ends.pop("", 0)
            why = "; ".join(f"{n} {what}" for what, n in ends.most_common()) or "–"
            rows.append([law, f"`{stage}`", f"{stays} of {DIPS}", why])
    return rows


def main() -> None:
    """Run all, and write the tables."""
    head = ["law", "stays", "swing [°]", "p back after [s]", "v_dc [p.u.]"]
    (TABLES / "grid_dips.md").write_text(markdown(head, dip_rows()) + "\n", "utf-8")
    head = ["law", "inner stage", "stays", "what ends the others"]
    (TABLES / "grid_faults.md").write_text(markdown(head, fault_rows()) + "\n", "utf-8")


if __name__ == "__main__":
    main()
