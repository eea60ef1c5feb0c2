"""The record of REGFM_A1 or REGFM_B1 whose core comes nearest to a law, for PSS/E and its peers.

Of the law's Phi(s) the models have the swing, p to omega_u, and the voltage control, q and V to
E_u. Both are fitted from 0.1 to 10 Hz, where a study of phasors looks, by linear least squares of
the relative error. All other numbers of a record (limits, windows, the PLL) are those of the
published cases: a law's core has none.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gfm_hil.api.dyr import MODELS
from gfm_hil.api.law import Law
from gfm_hil.core.errors import UserError

Response = NDArray[np.complexfloating[Any, Any]]

_S = 2j * np.pi * np.geomspace(0.1, 10.0, 81)  # 1/s
_ONE: Response = np.ones_like(_S)
_MAPS = ("linear", "dc-energy")  # with errors of p, q and V as those of the models
_FILTERS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05)  # s, of a measurement
_NEAR = 0.1  # relative distance
_LEAST_H = 1e-3  # s
_USRMDL = {"REGFMB1": "101 1 6 25 14 17"}  # the integers of a model of the user's library
_LINE = 8  # numbers


class NearestRecord(NamedTuple):
    """What comes nearest to a law."""

    model: str  #: REGFMA1 or REGFMB1
    numbers: dict[str, float]  #: by their names in the model's documents
    #: of ``phi22``, ``phi34``, ``phi35``: the largest |model/law - 1| from 0.1 to 10 Hz
    far: dict[str, float]
    without: tuple[str, ...]  #: elements of the law that the model does not have

    def record(self, bus: int, machine: str) -> str:
        """Its lines in a dynamic data file. Raises UserError: no number of a bus, or no machine."""
        if not 0 < bus < 1_000_000:
            raise UserError(f"bus {bus}: must be a number from 1 to 999999")
        if not re.fullmatch("[A-Za-z0-9]{1,2}", machine):
            raise UserError(f"machine {machine!r}: must be one or two letters or digits")
        model, user = MODELS[self.model], _USRMDL.get(self.model)
        values = [*model.flags, *(f"{self.numbers[name]:.6g}" for name in model.numbers)]
        head = (
            f"'USRMDL' {machine} '{self.model}U1' {user}" if user else f"'{self.model}' {machine}"
        )
        lines = [" ".join(values[k : k + _LINE]) for k in range(0, len(values), _LINE)]
        return "\n    ".join([f"{bus} {head}", *lines]) + " /\n"


def nearest_record(law: Law, model: str = "REGFMA1") -> NearestRecord:
    """The record whose core comes nearest to a law's, of its first stage if gains are scheduled.

    Args:
        law: with p on omega_u, and V on E_u.
        model: ``REGFMA1`` (droop) or ``REGFMB1`` (swing equation).

    Raises:
        UserError: the law has no such core, or no such model is known.
    """
    if model not in MODELS:
        raise UserError(f"model {model!r}: must be {' or '.join(MODELS)}")
    built = law.built()
    if built.error_map not in _MAPS:
        raise UserError(f"{law.name}: {model} has not the errors of {built.error_map!r}")
    phi = np.array([built(s) for s in _S])
    for name, (i, j), what in (("phi22", (1, 1), "p on omega_u"), ("phi35", (2, 4), "V on E_u")):
        if not phi[:, i, j].any():
            raise UserError(f"{law.name}: it has no {what} ({name}), and {model} is not without")
    shipped = Law.load(MODELS[model].law)
    numbers = {name: shipped.gains.get(name, 0.0) for name in MODELS[model].numbers}
    if model == "REGFMB1":
        numbers["Dwmax"] = shipped.built().limits.omega_u[1] - 1.0
        numbers |= {"Dwmin": -numbers["Dwmax"], "DwPLLmin": -numbers["DwPLLmax"]}
    # what omega_u itself does to omega_u closes around the swing
    target = {"phi22": phi[:, 1, 1] / (1.0 + phi[:, 1, 2]), "phi35": phi[:, 2, 4]}
    if phi[:, 2, 3].any():
        target["phi34"] = phi[:, 2, 3]
    responses = _fit(law, model, target, numbers)
    far = {n: float(np.abs(responses[n] / each - 1.0).max()) for n, each in sorted(target.items())}
    kept = {(1, 1), (1, 2), (2, 3), (2, 4)}
    cells = [(i, j) for i in (1, 2) for j in range(5) if (i, j) not in kept]
    without = [f"phi{i + 1}{j + 1}" for i, j in cells if phi[:, i, j].any()]
    psi = [f"psi{i + 1}{j + 1}" for i, j in sorted(built.psi)]
    return NearestRecord(model, numbers, far, (*without, *psi))


def _fit(
    law: Law, model: str, target: dict[str, Response], numbers: dict[str, float]
) -> dict[str, Response]:
    """Put the numbers of the core into a record's; returns the responses that they give."""
    swing = target["phi22"]
    if model == "REGFMA1":  # mp/(1 + s TPf)
        (slope, inertia), _ = _least(swing, swing * _S)
        numbers["TPf"] = max(inertia / slope, _FILTERS_S[0]) if slope else 0.0
        (slope,), _ = _least(swing * (1.0 + numbers["TPf"] * _S))
        swings = slope * _ONE
    else:  # 1/((2 H s + 1/mp + D1 + D2 s/(s + omega_D)) (1 + s TPf))
        washed, shipped = _S / (_S + numbers["omega_D"]), numbers["TPf"]
        for parts in ((_ONE, _S), (_ONE, _S, washed)):  # with D2 only if it is not near without
            numbers["TPf"], x = _nearest(shipped, [swing * part for part in parts])
            swings = np.tensordot(x, parts, axes=1)
            if np.abs(swings * (1.0 + numbers["TPf"] * _S) * swing - 1.0).max() <= _NEAR:
                break
        slope, inertia, D_2 = *x, *[0.0] * (3 - len(x))
        numbers |= {"H": inertia / 2.0, "D1": 0.0, "D2": D_2}
        if not numbers["H"] >= _LEAST_H:
            raise UserError(f"{law.name}: H of its swing (phi22) would be 0, which is no REGFMB1")
    if not (slope > 0.0 and numbers["TPf"] > 0.0):
        raise UserError(f"{law.name}: mp of its swing (phi22) would have no bound, no {model}")
    numbers["mp"] = 1.0 / slope
    numbers["TVf"], (kpv, kiv) = _nearest(
        numbers["TVf"], [part / target["phi35"] for part in (_ONE, 1.0 / _S)], -1
    )
    if not kpv + kiv > 0.0:
        raise UserError(f"{law.name}: no PI control of V comes near to its phi35")
    numbers |= {"kpv": kpv, "kiv": kiv, "mq": 0.0}
    pi = kpv + kiv / _S
    if "phi34" in target:
        numbers["TQf"], (numbers["mq"],) = _nearest(numbers["TQf"], [pi / target["phi34"]], -1)
    lag_p, lag_q, lag_v = (1.0 + numbers[name] * _S for name in ("TPf", "TQf", "TVf"))
    return {
        "phi22": 1.0 / (swings * lag_p), "phi34": numbers["mq"] * pi / lag_q, "phi35": pi / lag_v
    }  # fmt: skip


def _nearest(
    shipped: float, parts: Sequence[Response], power: int = 1
) -> tuple[float, list[float]]:
    """The time constant T of a filter, s, and the numbers of the least squares with it: the shipped
    one, unless that is 0 (the model has no such filter) or another comes nearer.

    Args:
        shipped: time constant, s.
        parts: of the least squares; each is multiplied by (1 + s T)^power.
    """
    times = [shipped, *_FILTERS_S] if shipped else [0.0]
    tried = [(T, *_least(*(part * (1.0 + T * _S) ** power for part in parts))) for T in times]
    T, x, _ = min(tried, key=lambda one: round(one[2], 6))
    return T, x


def _least(*parts: Response) -> tuple[list[float], float]:
    """The numbers x >= 0 with sum x_k parts_k nearest to 1 at all frequencies, and how near."""
    matrix = np.stack([np.concatenate([part.real, part.imag]) for part in parts], axis=1)
    x, distance = nnls(matrix, np.repeat([1.0, 0.0], len(_S)))
    return [float(number) for number in x], float(distance)
