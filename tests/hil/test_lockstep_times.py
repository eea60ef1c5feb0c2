"""timing.npz of a run in lockstep over a link with a port."""

from __future__ import annotations

import numpy as np
import pytest

from ..support.links import PATIENT, PORTS, run_pair

pytestmark = pytest.mark.processes


@pytest.mark.parametrize("link", PORTS)
@pytest.mark.parametrize("samples", [0, 1])
def test_lockstep_tells_when_answers_came(samples, link, make, place):
    """With one sample of delay the next frame follows at once, and both share a clock reading."""
    content = {"duration": 0.03, "link": PATIENT, "plant": {"delay": {"samples": samples}}}
    content["events"] = [{"tick": 50, "type": "grid-frequency", "f_hz": 49.99}]
    times = run_pair(make(**content), place, link).timing
    sent, received = times["plant_sent"], times["plant_received"]
    assert (np.diff(sent) > 0).all()
    assert (received > sent).all()
    assert (received[:-1] <= sent[1:]).all()
    same = received[:-1] == sent[1:]
    assert same.mean() > 0.9 if samples else not same.any()
