"""Random networks and their certificates: ``python -m benchmarks.certificates --networks 1000``.

Converters of random rating and power hang on a random tree of R-L lines behind a grid. Each law has
the certificate of the class from the weakest grids that holds; a network counts as certified if it
belongs to that class. The poles of the whole network say whether it is stable. Beside it: how many
have converters that are passive at all frequencies, the usual condition.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

import gfmhil
from gfm_design.margins.admittance import passivity
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies.certificate import strength_of
from gfm_hil.studies.linear_loop import network_loop, scenario_loop
from gfm_plant.parameters import load_converter

LADDER = (0.7, 1.0, 1.5, 2.0, 3.0, 5.0)
STIFFEST, X_OVER_R, POWERS = float("inf"), (3.0, 30.0), (0.0, 0.3, 0.6)


def random_network(rng: np.random.Generator, law: str, inner: str | None) -> Scenario:
    """One to four converters on a tree of lines."""
    n = int(rng.integers(1, 5))
    converters, lines = dict[str, Any](), dict[str, Any]()
    nominal = load_converter("paper").pu()
    base = rng.uniform(0.05, 0.6)  # of the tree: some networks are weak
    for k in range(n):
        x_over_r = rng.uniform(4.0, 25.0)
        X = base * rng.uniform(0.3, 1.5)
        start = "grid" if k == 0 else f"n{rng.integers(0, k)}"
        lines[f"l{k}"] = {"start": start, "end": f"n{k}", "L": X, "R": X / x_over_r}
        line = rng.uniform(0.05, 0.2)
        factors = {"L_g": line / nominal["L_g"], "R_g": line / x_over_r / nominal["R_g"]}
        converters[f"c{k}"] = {
            "node": f"n{k}",
            "references": {"P_ref": float(rng.uniform(*POWERS[::2]))},
            "plant": {"factors": factors},
        }
    more = {} if inner is None else {"inner": inner}
    return load_scenario(
        {
            "title": "random", "duration": 1.0, "law": law, "link": {"type": "inproc"}, **more,
            "network": {"grid": "grid", "converters": converters, "lines": lines},
        }
    )  # fmt: skip


def widest(law: str, inner: str | None) -> gfmhil.CertifiedLaws | None:
    """The certificate of the class from the weakest grids that holds: it has all other classes."""
    for weakest in LADDER:
        made = gfmhil.certify(
            law, scr=(weakest, STIFFEST), x_over_r=X_OVER_R, powers=POWERS, inner=inner
        )
        if made.holds:
            return made
    return None


def largest_sigma(scenario: Scenario) -> float:
    """Of the poles of the whole network, 1/s; infinite where it has no operating point."""
    try:
        return max(mode.sigma for mode in network_loop(scenario).modes())
    except (UserError, ValueError):
        return float("inf")


def is_passive(law: str, inner: str | None) -> bool:
    """Whether a converter is passive at all frequencies, at one operating point."""
    loop, _ = scenario_loop(load_scenario("pref_step", law=law, inner=inner))
    hz = np.geomspace(0.01, 4990.0, 400)
    return bool((passivity(np.linalg.inv(loop.output_impedance(2 * np.pi * hz))) >= 0.0).all())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--networks", type=int, default=1000, help="of each law")
    parser.add_argument("--laws", nargs="+", default=["mimo-gfm", "vsg-2", "droop-5"])
    parser.add_argument("--inner")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows = []
    for law in options.laws:
        certificate = widest(law, options.inner)
        rng = np.random.default_rng(options.seed)
        stable, certified, wrong = 0, 0, 0
        for _ in range(options.networks):
            scenario = random_network(rng, law, options.inner)
            within = certificate is not None and strength_of(scenario).within(certificate.grids)
            is_stable = largest_sigma(scenario) < 0.0
            stable += is_stable
            certified += within and is_stable
            wrong += within and not is_stable
        passive = stable if is_passive(law, options.inner) else 0
        from_ = certificate.grids.weakest if certificate else "none"
        rows.append([law, from_, options.networks, stable, certified, wrong, passive])
    heads = ["law", "class from", "networks", "stable", "of them certified",
             "certified, unstable", "stable by passivity"]  # fmt: skip
    terminal().print(Table(heads, rows))


if __name__ == "__main__":
    main()
