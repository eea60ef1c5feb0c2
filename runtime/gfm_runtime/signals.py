"""The one signal table: every quantity that crosses the link or reaches an operator.

Frames, recorder columns, scope labels and the docs are generated from this table. The order
within a group is the order of the vectors everywhere:

* ``y``   = (v_dc, p, omega_u, q, V), the measurements (Eq. (14) of the paper),
* ``u``   = (i_u, omega_u, E_u), the control inputs (Eq. (13)),
* ``ref`` = (V_dcref, P_ref, omega_g, Q_ref, V_ref), the references Y_ref (Eq. (17)),
* ``d``   = (omega_g, V_g), the grid seen as disturbance (Eq. (15)),
* ``y_inner`` and ``u_inner``: what a run with an inner stage (``gfm_runtime.inner``) measures and
  commands besides, at the end of y and u; E_u is then the d component of the bridge's voltage,
* ``adc`` and ``compare``: what the pins of a processor see besides, at the end of y and u of a run
  whose laws measure and modulate themselves (``gfm_runtime.counts``). Such a law computes its own
  y from the counts; what y has before them is for the recording alone,
* ``set``: the set-points of a plant controller, at the end of y in a network that has one. A
  controller takes those that are numbers as references from this tick on.

Add signals at the end of a group only; anything else is a new ``TABLE_VERSION``, which both
sides of a link compare before they start.
"""

import hashlib
import math
from dataclasses import astuple, dataclass, replace
from typing import Literal, get_args

TABLE_VERSION = 4

Group = Literal["y", "u", "y_inner", "u_inner", "adc", "compare", "ref", "d", "set"]
VectorName = Literal["y", "u"]
Channel = Literal["v_dc", "i_a", "i_b", "i_c", "v_a", "v_b", "v_c", "i_o_a", "i_o_b", "i_o_c"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)
"""Of the A/D at a converter's phases, in the order of the group ``adc``."""
_READ = {"v_dc": "the DC voltage", "i": "the current of L_f", "v": "the voltage of C_f",
         "i_o": "the current of the line"}  # fmt: skip
COUNT_BITS, MOST_SAMPLES = 16, 32
"""Of a count, which may be a sum; conversions that it sums at most."""
FULL_SCALES = {"v_dc": (0.0, 2.0), "i": (-4.0, 4.0), "v": (-2.0, 2.0), "i_o": (-4.0, 4.0)}
"""Of the A/D by default, p.u. of V_dcref and of a phase's nominal peak value, by quantity."""


def quantity(channel: Channel) -> str:
    """What a channel reads: v_dc, i, v or i_o."""
    return channel if channel == "v_dc" else channel[:-2]


@dataclass(frozen=True)
class Signal:
    """One row of the table."""

    group: Group  #: the vector it belongs to
    name: str  #: identifier in code and files; unique within its group
    symbol: str  #: as printed, LaTeX
    unit: str  #: unit of the value on the link; ``p.u.`` of the base named in ``base``
    base: str  #: what 1 p.u. is.
    scale: float  #: resolution of an integer transport, in ``unit`` per count
    #: low, high: plausible range in ``unit``; a measurement outside is refused by the controller
    #: (safe state), a reference outside is refused by the scenario
    low: float
    high: float
    default: float  #: value at start if nothing else is said
    description: str  #: one line for tables and tooltips


SIGNALS: tuple[Signal, ...] = (
    Signal("y", "v_dc", "v_{dc}", "p.u.", "V_dcref", 1e-4, 0.0, 3.0, 1.0, "DC voltage"),
    Signal("y", "p", "p", "p.u.", "S_n", 2e-4, -6.0, 6.0, 0.5, "active power at the capacitor"),
    Signal("y", "omega_u", r"\omega_u", "p.u.", "omega_n", 1e-5, 0.7, 1.3, 1.0, "frequency in use"),
    Signal("y", "q", "q", "p.u.", "S_n", 2e-4, -6.0, 6.0, 0.0, "reactive power at the capacitor"),
    Signal("y", "V", "V", "p.u.", "V_n", 1e-4, 0.0, 3.0, 1.0, "magnitude of the capacitor voltage"),
    Signal("u", "i_u", "i_u", "p.u.", "S_n/V_dcref", 2e-4, -6.0, 6.0, 0.0, "DC source current"),
    Signal("u", "omega_u", r"\omega_u", "p.u.", "omega_n", 1e-5, 0.7, 1.3, 1.0, "frequency"),
    Signal("u", "E_u", "E_u", "p.u.", "V_n", 1e-4, 0.0, 3.0, 1.0, "internal voltage magnitude"),
    Signal("ref", "V_dcref", "V_{dcref}", "p.u.", "V_dcref", 1e-4, 0.5, 1.5, 1.0, "DC voltage"),
    Signal("ref", "P_ref", "P_{ref}", "p.u.", "S_n", 2e-4, -2.0, 2.0, 0.5, "active power"),
    Signal("ref", "omega_g", r"\omega_g", "p.u.", "omega_n", 1e-5, 0.8, 1.2, 1.0, "frequency"),
    Signal("ref", "Q_ref", "Q_{ref}", "p.u.", "S_n", 2e-4, -2.0, 2.0, 0.0, "reactive power"),
    Signal("ref", "V_ref", "V_{ref}", "p.u.", "V_n", 1e-4, 0.0, 1.5, 1.0, "voltage magnitude"),
    Signal("d", "omega_g", r"\omega_g", "p.u.", "omega_n", 1e-5, 0.8, 1.2, 1.0, "grid frequency"),
    Signal("d", "V_g", "V_g", "p.u.", "V_n", 1e-4, 0.0, 1.5, 1.0, "grid voltage magnitude"),
    Signal("y_inner", "i_d", "i_d", "p.u.", "S_n/V_n", 2e-4, -6.0, 6.0, 0.0, "current of L_f, d"),
    Signal("y_inner", "i_q", "i_q", "p.u.", "S_n/V_n", 2e-4, -6.0, 6.0, 0.0, "current of L_f, q"),
    Signal("y_inner", "v_d", "v_d", "p.u.", "V_n", 1e-4, -3.0, 3.0, 0.0, "voltage of C_f, d"),
    Signal("y_inner", "v_q", "v_q", "p.u.", "V_n", 1e-4, -3.0, 3.0, 0.0, "voltage of C_f, q"),
    Signal("y_inner", "i_od", "i_{od}", "p.u.", "S_n/V_n", 2e-4, -6.0, 6.0, 0.0,
           "current of the line, d"),
    Signal("y_inner", "i_oq", "i_{oq}", "p.u.", "S_n/V_n", 2e-4, -6.0, 6.0, 0.0,
           "current of the line, q"),
    Signal("u_inner", "E_q", "E_q", "p.u.", "V_n", 1e-4, -3.0, 3.0, 0.0,
           "q component of the bridge's voltage"),
    *(
        Signal("adc", f"adc_{name}", f"n_{{{name}}}", "counts", "1", 1.0, 0.0, 65535.0, 0.0,
               f"A/D's reading of {_READ[quantity(name)]}"
               + f", phase {name[-1]}" * (name != "v_dc"))
        for name in CHANNELS
    ),
    *(
        Signal("compare", f"cmp_{leg}", f"m_{leg}", "counts", "1", 1.0, 0.0, 65535.0, 0.0,
               f"compare value of leg {leg}: how long it is above, of half a carrier")
        for leg in "abc"
    ),
    Signal("set", "P_set", "P_{set}", "p.u.", "S_n", 2e-4, -2.0, 2.0, 0.5, "set-point of P_ref"),
    Signal("set", "Q_set", "Q_{set}", "p.u.", "S_n", 2e-4, -2.0, 2.0, 0.0, "set-point of Q_ref"),
    Signal("set", "V_set", "V_{set}", "p.u.", "V_n", 1e-4, 0.0, 1.5, 1.0, "set-point of V_ref"),
)  # fmt: skip

SPACE_VECTOR = 1 / math.sqrt(2)
"""Largest line-to-line RMS voltage of a bridge over its DC voltage, both in V, with space-vector
modulation: the circle within the hexagon of vectors has a phase amplitude of v_dc / sqrt(3), and
line-to-line RMS is sqrt(3/2) times the phase amplitude."""

NY, NU = 5, 3  # of Phi
NY_INNER, NU_INNER = 11, 4  # of a run with an inner stage
#: places in its y
Y_V_DC, Y_P, Y_OMEGA, Y_Q, Y_V, Y_I_D, Y_I_Q, Y_V_D, Y_V_Q, Y_I_OD, Y_I_OQ = range(NY_INNER)
N_ADC, N_LEGS = len(CHANNELS), 3
NY_COUNTS, NU_COUNTS = NY_INNER + N_ADC, NU_INNER + N_LEGS  # of one that measures and modulates
N_SET = 3  # set-points of a plant controller
NY_MOST = NY_COUNTS + N_SET

#: signal sets: what a run exchanges beside y and u of Phi, nothing, the signals of an inner stage,
#: and counts
PLAIN, INNER, COUNTS = range(3)
#: what a frame has besides, as a sum with these: set-points at the end of y
SET_POINTS = 4


def group(name: Group) -> tuple[Signal, ...]:
    """The signals of one vector, in its order."""
    return tuple(s for s in SIGNALS if s.group == name)


def names(name: Group) -> tuple[str, ...]:
    """The names of one vector's signals, in its order."""
    return tuple(s.name for s in group(name))


Y_NAMES, U_NAMES, REF_NAMES, D_NAMES = names("y"), names("u"), names("ref"), names("d")
#: of the set-points: their places among the references, and between which values each is taken
SET_REF = tuple(REF_NAMES.index(name.replace("set", "ref")) for name in names("set"))
P_SET, Q_SET, V_SET = range(N_SET)
SET_LOW, SET_HIGH = tuple(s.low for s in group("set")), tuple(s.high for s in group("set"))


def carried_rows(vector: VectorName, signal_set: int) -> tuple[Signal, ...]:
    """What a run exchanges: y or u, and after them the signals of an inner stage and counts;
    ``signal_set``: ``PLAIN``, ``INNER`` or ``COUNTS``, of y with ``SET_POINTS`` if those follow."""
    more: tuple[Group, Group] = ("y_inner", "adc") if vector == "y" else ("u_inner", "compare")
    last: tuple[Group, ...] = ("set",) if vector == "y" and signal_set & SET_POINTS else ()
    names = (*more[: signal_set & ~SET_POINTS], *last)
    return group(vector) + tuple(row for name in names for row in group(name))


def carried(vector: VectorName, signal_set: int) -> tuple[str, ...]:
    """The names of ``carried_rows``."""
    return tuple(s.name for s in carried_rows(vector, signal_set))


def command_rows(signal_set: int) -> tuple[Signal, ...]:
    """u as firmware and models have it: with an inner stage the third is the bridge's e_d."""
    i_u, omega_u, E, *E_q = carried_rows("u", min(signal_set, INNER))
    if E_q:
        text = E_q[0].description.replace("q component", "d component")
        E = replace(E_q[0], name="E_d", symbol="E_d", default=E.default, description=text)
    return (i_u, omega_u, E, *E_q)


def table_hash() -> str:
    """Eight hex digits over the whole table; both sides of a link compare it before they start."""
    text = repr((TABLE_VERSION, [astuple(s) for s in SIGNALS]))
    return hashlib.sha256(text.encode()).hexdigest()[:8]
