"""The end of a run that a scenario expects: status, reason and time.

The reason of an end begins with its name, from the lists of the plant and the controller; the text
after the colon (quantity, value, threshold, time) is for the reader.
"""

from gfm_plant.names import (
    CONTROLLER,
    CONTROLLER_GONE,
    CONTROLLER_LEFT,
    CONTROLLER_SAFE,
    NO_FRESH_U,
    TRIP_REASONS,
)
from gfm_runtime.errors import meant
from gfm_runtime.states import OK, OPERATOR, PLANT_TRIP, REASONS

#: names of the possible reasons of a run's end, by its status
END_REASONS: dict[str, tuple[str, ...]] = {
    "completed": (),
    "oscillating": (),
    "tripped": (
        *(name for code, name in TRIP_REASONS.items() if code not in (0, CONTROLLER)),
        REASONS[PLANT_TRIP],  # the controller's side knows no more than this
    ),
    "safe": (
        *(name for k, name in enumerate(REASONS) if k not in (OK, PLANT_TRIP, OPERATOR)),
        CONTROLLER_SAFE,
        NO_FRESH_U,
        CONTROLLER_GONE,
        CONTROLLER_LEFT,
    ),
}


def reason_name(reason: str) -> str:
    """The name at the beginning of the reason of an end."""
    return reason.split(":")[0]


def check_expectation(
    expect: str, reason: str | None, after: float | None, duration: float
) -> list[str]:
    """The mistakes in ``expect_reason`` and ``expect_after`` of a scenario, one line each."""
    problems = []
    names = END_REASONS[expect]
    if not names:
        problems += [
            f"{key} = {value!r}: needs expect = 'tripped' or 'safe', not {expect!r}"
            for key, value in (("expect_reason", reason), ("expect_after", after))
            if value is not None
        ]
    elif reason is not None and reason not in names:
        problems.append(
            f"expect_reason = {reason!r:.80}: expect = {expect!r} takes "
            f"one of {list(names)}{meant(reason, names)}"
        )
    if after is not None and after >= duration:
        problems.append(f"expect_after = {after:g} s: must be below duration = {duration:g} s")
    return problems
