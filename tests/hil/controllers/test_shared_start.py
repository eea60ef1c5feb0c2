"""Published tests of a model that begin alike: from one snapshot, with the bits of whole runs."""

from pathlib import Path
from typing import Any

import pytest

import gfmhil
from gfm_hil.studies.conformity import execute
from gfm_hil.studies.conformity.shared_start import SharedStart

from ...support.firmware import cc
from .conftest import SOURCE

TEST = """\
title = "Two parts from one start"
f_n = 50.0
source = { document = "ours", clause = "1", revision = "1", known = "ours" }
[scenario]
duration = 0.5
references = { P_ref = 0.5 }
plant = { grid = { scr = 3.0, x_over_r = 6.0 } }
[[parts]]
name = "jump"
scenario = { events = [{ t = 0.2, type = "grid-phase-jump", degrees = 5.0 }] }
[[parts]]
name = "fault"
scenario = { duration = 0.6, events = [
    { t = 0.21, type = "fault", position = 0.5, R = 0.2, duration = 0.1 },
    { t = 0.4, type = "grid-frequency", f_hz = 49.9, rate = 1.0 },
] }
[[criteria]]
kind = "no_trip"
clause = "rides through"
[[criteria]]
kind = "stays_within"
clause = "p stays"
at = [0.2]
signal = "p"
low = 0.4
high = 0.6
"""
OTHER_POWER = """
[[parts]]
name = "other-power"
scenario = { references = { P_ref = 0.3 } }
"""
CONVERTER = """\
droop = 0.01
P_max = 1.0
P_min = -1.0
[plant]
converter = "paper"
dc_source = { mode = "regulated" }
sensors = { noise_std = { p = 1e-3 } }
"""


def conform(
    tmp_path: Path, model: str, settle_s: float, more: str = "", parts: str = ""
) -> gfmhil.Conformity:
    (tmp_path / "test.toml").write_text(TEST + parts)
    (tmp_path / "converter.toml").write_text(CONVERTER)
    (tmp_path / "map.toml").write_text(f"settle_s = {settle_s}\n{more}")
    return gfmhil.conform(
        against=tmp_path / "test.toml", controller=model, converter=tmp_path / "converter.toml",
        ports=tmp_path / "map.toml",
    )  # fmt: skip


def told(found: gfmhil.Conformity) -> list[dict[str, Any]]:
    """All that a report has of its runs, their digests among it."""
    return [part.plain() for part in found.parts]


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bool]]:
    """Name and success of each start that is tried, and how many ticks it saves."""
    made, make = list[tuple[str, bool]](), SharedStart.make

    def watched(self: SharedStart) -> Path | None:
        found = make(self)
        made.append((f"{self.ticks} ticks", found is not None))
        return found

    monkeypatch.setattr(SharedStart, "make", watched)
    return made


@pytest.mark.apt
@pytest.mark.timeout(900)
def test_runs_from_one_start_have_the_bits_of_whole_runs(exported, tmp_path, monkeypatch, shared):
    """Noise, a fault and a ramp of the grid; the part with another power has a run of its own."""
    model = exported("dll", "vsg-2", "none")
    found = conform(tmp_path, model, 0.1, parts=OTHER_POWER)
    assert shared == [("3000 ticks", True)]
    assert [part.status for part in found.parts] == ["completed"] * 3
    assert len({part.recording for part in found.parts}) == len(found.parts)
    monkeypatch.setattr(execute, "share_starts", lambda jobs, *_: [*jobs])
    assert told(conform(tmp_path, model, 0.1)) == told(found)[:2]


@pytest.mark.apt
@pytest.mark.timeout(900)
def test_a_model_with_static_variables_settles_anew(exported, tmp_path, monkeypatch, shared):
    """Its snapshot lacks them, so that its runs would not have their own bits from there."""
    from .test_controllers import MAP

    headers = Path(exported("dll", "vsg-2", "none").removeprefix("dll:")).parent
    text = SOURCE.read_text()
    state = "real64_T *p = instance->DoubleStates;"
    assert state in text
    (tmp_path / "static.c").write_text(
        text.replace(state, "static real64_T kept = NAN, *p = &kept;")
    )
    flags = ["-std=gnu99", "-O2", "-shared", "-fPIC", f"-I{headers}"]
    assert cc(tmp_path, *flags, "static.c", "-o", "static.so", "-lm").returncode == 0
    model = f"dll:{tmp_path / 'static.so'}"
    found = conform(tmp_path, model, 0.0, MAP)
    assert shared == [("2000 ticks", False)]
    monkeypatch.setattr(execute, "share_starts", lambda jobs, *_: [*jobs])
    assert told(conform(tmp_path, model, 0.0, MAP)) == told(found)
