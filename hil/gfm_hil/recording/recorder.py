"""Recording of a tick, compiled into the loops."""

from gfm_hil.realtime.atomics import prefetch
from gfm_plant import CONNECTION, TRUTH, plant_options, plant_truth
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.signals import N_ADC, NU, NU_INNER, NY, NY_INNER

_TRUE, _Y_INNER = NY + NU, NY + NU + len(TRUTH)
_U_INNER = _Y_INNER + NY_INNER - NY
_ADC = _U_INNER + NU_INNER - NU
_COMPARE = _ADC + N_ADC
_MEASURED = NY + 7  # of a controller's row
_CONNECTION = len(CONNECTION)
_SOON = 8  # rows; a page that is new to the processor would hold up the tick that begins it


@inlined
def record_sample(row, y, plant, i):
    """Fill the part of a row of PLANT_COLUMNS that is known when converter i is sampled."""
    prefetch(row.ctypes.data + _SOON * row.nbytes)
    for j in range(NY):
        row[j] = y[j]
    plant_truth(plant, i, row[_TRUE:])
    for j in range(NY, min(len(y), NY_INNER)):
        row[_Y_INNER + j - NY] = y[j]
    for j in range(NY_INNER, len(y)):
        row[_ADC + j - NY_INNER] = y[j]
    n = plant.net[0]
    if n.connections + n.batteries != 0:
        plant_options(plant, i, row[len(row) - n.batteries - n.connections * _CONNECTION :])


@compiled
def record_command(row, u):
    """Fill the rest of the row when u has come."""
    for j in range(NU):
        row[NY + j] = u[j]
    for j in range(NU, min(len(u), NU_INNER)):
        row[_U_INNER + j - NU] = u[j]
    for j in range(NU_INNER, len(u)):
        row[_COMPARE + j - NU_INNER] = u[j]


@compiled
def record_controller(row, ctl, states, est):
    """One row of CONTROLLER_COLUMNS, and what ``ColumnSet`` has after them if it is longer."""
    prefetch(row.ctypes.data + _SOON * row.nbytes)
    c = ctl[0]
    for j in range(NY):
        row[j] = c.ref[j]
    row[NY] = c.active
    row[NY + 1] = c.state
    row[NY + 2] = est[0].X
    if len(row) > NY + 3:
        s = states[c.active]
        row[NY + 3], row[NY + 4], row[NY + 5] = c.u[2], s.i_ref[0], s.i_ref[1]
        row[NY + 6] = s.limited
        if len(row) > _MEASURED:
            for j in range(NY_INNER):
                row[_MEASURED + j] = s.sensed[j]
