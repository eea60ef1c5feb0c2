"""Names of the plant's true values, of its trips and their reasons, and in its records."""

from gfm_runtime.signals import D_NAMES, U_NAMES, Y_NAMES

TRIPS = (
    # option, quantity, sign (+1: trips above the threshold, -1: below)
    ("over_current", "|i_dq|", +1),
    ("over_voltage", "V", +1),
    ("under_voltage", "V", -1),
    ("dc_over_voltage", "v_dc", +1),
    ("dc_under_voltage", "v_dc", -1),
    ("over_frequency", "omega_u", +1),
    ("under_frequency", "omega_u", -1),
)
"""The protections with a threshold; their place is their index in the records."""

DIVERGED = len(TRIPS) + 1
BAD_COMMAND = len(TRIPS) + 2
CONTROLLER = len(TRIPS) + 3
OVERLOAD = len(TRIPS) + 4

TRIP_REASONS: dict[int, str] = {
    0: "none",
    **{k + 1: name.replace("_", "-") for k, (name, *_) in enumerate(TRIPS)},
    DIVERGED: "diverged",
    BAD_COMMAND: "command not finite",
    CONTROLLER: "blocked for the controller",
    OVERLOAD: "overload",
}
"""What the trip code in a plant's state means."""

#: the value of a trip with the code CONTROLLER, and the words for it
SAFE_STATE, SILENT, GONE, LEFT = 0.0, 1.0, 2.0, 3.0
CONTROLLER_SAFE = "the controller is in its safe state"
NO_FRESH_U = "no fresh u for longer than late_policy.hold allows"
CONTROLLER_GONE = "the controller's process is gone"
CONTROLLER_LEFT = "the controller was stopped"

#: what a bridge that is to start again waits for: nothing was asked, nothing is in the way, or from
#: here on the protection (its place in TRIPS) that would trip it again
NOT_ASKED, MAY_START, WOULD_TRIP = 0, 1, 2

FAULTED_PHASES: dict[str, tuple[str, ...]] = {
    "3ph": ("abc",),
    "LG": ("a", "b", "c"),
    "LL": ("bc", "ca", "ab"),
    "LLG": ("bc", "ca", "ab"),
}
"""The phases that each kind of fault may connect, the usual ones first. Of an unbalanced kind they
stand in the order of the phase that differs from the two others: a, b, c."""

CLEARINGS = "zero", "instant"
"""How a fault is cleared: phase by phase where their currents pass zero, as the breakers around it
do, or in all phases at one instant."""

SENSED = tuple(k for k, name in enumerate(Y_NAMES) if name not in U_NAMES)
"""Indices of the y that pass the sensors; omega_u is a command and known exactly."""

TRUTH = (*Y_NAMES, "i", "delta", *D_NAMES, "trip", "i_dc", "v_re", "v_im", "i_re", "i_im")
"""What `plant_truth` writes, in this order, in p.u.: i is |i_dq|, i_dc the current of the DC
source, delta is in rad, and trip is a key of `TRIP_REASONS`. The last four are the space vectors of
the capacitor's voltage and the bridge's current in the common frame, which turns at omega_b; the
grid's voltage lies on its real axis at tick 0."""

CONNECTION = ("p_c", "q_c", "V_c")
"""Active and reactive power and voltage at the connection point, p.u."""

BATTERY = ("soc",)
"""State of charge of a battery behind the DC source, in [0, 1]."""

WAYS = (
    "step", "advance", "components", "series", "sample", "connection", "look", "clear", "join",
    "watch",
)  # fmt: skip
"""Functions that a plant calls by addresses in its records, see `ways`; 0: it does not call that
one."""

THE_GRID, FIRST_LINE = "\0grid", "\0line"
"""In ``Network.elsewhere``, which no name is: the grid, and the line of the first converter."""
