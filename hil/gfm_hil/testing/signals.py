"""A run's signals by the names that a test uses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError


class Signals(Mapping[str, NDArray[Any]]):
    """The recorded signals, each of shape (ticks,).

    ``p``, ``q``, ``V``, ``v_dc``, ``omega_u``, ``i``, ``delta``, ``omega_g`` and ``V_g`` are the
    plant's true ones; ``f_hz`` is ω_u in Hz; ``t`` is in s. All columns of the recording are there
    under their own names too: ``y_p`` as measured, ``u_E_u``, ``ref_P_ref``, ``law``, …

    Args:
        recorded: columns of signals.npz.
        f_n: nominal frequency, Hz.
    """

    def __init__(self, recorded: Mapping[str, NDArray[Any]], f_n: float) -> None:
        self._columns = dict(recorded)
        for name, column in recorded.items():
            if name.startswith("true_"):
                self._columns[name.removeprefix("true_")] = column
        if "true_omega_u" in recorded:
            self._columns["f_hz"] = recorded["true_omega_u"] * f_n

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self._columns[name]
        except KeyError:
            raise UserError(
                f"signal = {name!r}: was not recorded; there are {sorted(self._columns)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)


def unit(name: str) -> str:
    """The unit of a signal for people, with a space before it; none for numbers without."""
    bare = name.rpartition("_")[0] and name.removeprefix("true_")
    known = {"f_hz": " Hz", "t": " s", "delta": " rad"}
    if name in ("tick", "law", "state", "trip") or bare == "trip":
        return ""
    return known.get(bare or name, " p.u.")


def same(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Whether both hold the same values as far as the shorter one goes."""
    length = min(len(one["tick"]), len(other["tick"]))
    return all(
        np.array_equal(one[name][:length], other[name][:length], equal_nan=True)
        for name in one
        if name in other
    )
