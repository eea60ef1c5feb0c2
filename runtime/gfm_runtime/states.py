"""The states of the controller and the reasons for its safe state, as codes and in words."""

INIT, READY, RUNNING, SAFE, STOPPED = range(5)
STATES = ("INIT", "READY", "RUNNING", "SAFE", "STOPPED")

OK, BAD_Y, BAD_U, STALE, LOST_PEER, PLANT_TRIP, OPERATOR, BAD_SENSOR = range(8)
REASONS = (
    "",
    "a measurement is not finite or out of range",
    "an output is not finite",
    "no fresh measurement for longer than late_policy allows",
    "the plant's process is gone",
    "the plant's protection tripped",
    "stopped by the operator",
    "a sensor is not plausible",
)
