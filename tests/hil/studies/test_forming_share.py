"""Stability against the share of grid-forming converters, against runs and loops of each share."""

import itertools
import json
from typing import Any

import numpy as np
import pytest

import gfmhil
from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import load_scenario, toml_text


def chain(**more: Any) -> dict[str, Any]:
    """Four converters on a weak grid, 45 % of which they feed over 0.35 p.u."""
    names = "abcd"
    lines = {f"{a}{b}": {"start": a, "end": b, "L": 0.05, "R": 0.005}
             for a, b in itertools.pairwise(names)}  # fmt: skip
    return {
        "title": "chain", "duration": 2.0, "law": "vsg-2", "link": {"type": "inproc"},
        "references": {"P_ref": 0.45},
        "network": {
            "grid": "far",
            "converters": {
                x.upper(): {"node": x, "law": law}
                for x, law in zip(names, 2 * ("vsg-2", "droop-3"), strict=True)
            },
            "lines": lines | {"weak": {"start": "d", "end": "far", "L": 0.35, "R": 0.02}},
        },
    } | more  # fmt: skip


@pytest.mark.full
def test_runs_are_stable_where_the_shares_say_so() -> None:
    """One that forms is enough there; a step of the grid's voltage shows it."""
    content = chain(events=[{"type": "grid-voltage", "t": 0.1, "V_g": 0.999}])
    each = gfmhil.design.forming_shares(load_scenario(content), order=["B", "C", "D"])
    assert [one.follows for one in each] == ["", "B", "C", "D", "A"]
    assert [one.share for one in each] == pytest.approx([1.0, 0.75, 0.5, 0.25, 0.0])
    assert [one.sigma < 0.0 for one in each] == [True, True, True, True, False]
    for last, grows in zip(each[-2:], (False, True), strict=True):
        for name, references in last.references.items():
            own = {"law": "grid-following", "references": references}
            content["network"]["converters"][name] |= own
        same = gfmhil.design.network_loop(content).modes()[0]
        assert last.sigma == pytest.approx(same.sigma, abs=1e-6)
        run = gfmhil.run_network(content)
        p = run["A"].signals["true_p"]
        late, early = np.ptp(p[-2000:]), np.ptp(p[3000:5000])
        assert (late > early) == grows
        hertz = np.argmax(np.abs(np.fft.rfft(p[-10_000:] - p[-10_000:].mean())))
        assert not grows or hertz == pytest.approx(same.frequency_hz, abs=1.0)


@pytest.mark.full
def test_the_best_leaves_the_least_sigma_each_time(tmp_path, capsys) -> None:
    file = tmp_path / "island.toml"
    content = chain()
    del content["network"]["grid"], content["network"]["lines"]["weak"]
    content["network"]["loads"] = {"load": {"node": "d", "P": 1.8}}
    file.write_text(toml_text(content), "utf-8")
    assert main(["design", "share", str(file), "--best", "--json"]) == 0
    steps = json.loads(capsys.readouterr().out)["shares"]
    others = [
        gfmhil.design.forming_shares(load_scenario(content), order=[name])[1] for name in "ABCD"
    ]
    assert steps[1]["mode"]["sigma"] == pytest.approx(min(one.sigma for one in others))
    assert steps[-1]["mode"] is None and "nothing forms the voltage of" in steps[-1]["reason"]
    figure = tmp_path / "share.png"
    assert main(["design", "share", str(file), "--order", "B,A", "-o", str(figure)]) == 0
    assert figure.stat().st_size > 10_000 and "75 %" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("scenario", "more", "line"),
    [
        ("pref_step", {}, "P_ref steps from 0.5 to 1 p.u.: has no network"),
        ("plant_of_two", {"order": ["X"]}, "'X': must be one of those that form the grid, ['A'"),
        ("plant_of_two", {"law": "vsg-2"}, "vsg-2: forms the grid; name a law that follows it"),
    ],
)
def test_what_cannot_be_asked(scenario: str, more: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError) as problem:
        gfmhil.design.forming_shares(load_scenario(scenario), **more)
    assert str(problem.value).startswith(line)
