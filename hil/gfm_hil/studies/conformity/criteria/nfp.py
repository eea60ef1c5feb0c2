"""The network-frequency-perturbation plot stays within bands."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from gfm_hil.core.errors import UserError
from gfm_hil.core.schema import StrictSchema
from gfm_hil.studies.conformity.criteria.equivalent_damping import damping_of
from gfm_hil.studies.conformity.criteria.plot import Plot, PlotPanel
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, INFORMATIVE, PASS, Outcome, Verdict
from gfm_hil.studies.envelopes import fit_nfp
from gfm_hil.studies.scan import FrequencyScan


class Band(StrictSchema):
    """Limits of a gain and a phase between two frequencies."""

    from_hz: float = Field(gt=0, description="of the perturbation, Hz")
    to_hz: float = Field(gt=0, description="the same")
    low: float | None = Field(None, description="least gain, p.u. of power over p.u. of frequency")
    high: float | None = Field(None, description="largest gain, in the same unit")
    phase_low: float | None = Field(None, description="least phase, degrees from -180 to 180")
    phase_high: float | None = Field(None, description="largest phase, in the same unit")

    @model_validator(mode="after")
    def _limited(self) -> Band:
        if self.from_hz >= self.to_hz:
            raise ValueError(f"from_hz = {self.from_hz:g}: must be < to_hz = {self.to_hz:g}")
        if {self.low, self.high, self.phase_low, self.phase_high} == {None}:
            raise ValueError("low, high, phase_low, phase_high: give one of them")
        return self


class Nfp(Plot):
    """The network-frequency-perturbation plot, measured by small sines of the grid's frequency:
    gain and phase of the change of p over the change of the grid's frequency stay within bands. A
    part with this criterion has no other one, and no events count."""

    kind: Literal["nfp"] = Field(description="kind of criterion")
    bands: list[Band] = Field([], description="limits; each gives a verdict")
    unknown: str | None = Field(
        None, description="without bands: why none are known; the plot is drawn, and informative"
    )
    damping: tuple[float, float] | None = Field(
        None,
        strict=False,
        description="least and largest damping ratio of the swing equation that fits the plot "
        "below half the nominal frequency",
    )

    @model_validator(mode="after")
    def _judged_or_not(self) -> Nfp:
        if bool(self.bands) == (self.unknown is not None):
            raise ValueError("bands, unknown: give one of them")
        for band in self.bands:
            if not self.from_hz <= band.from_hz < band.to_hz <= self.to_hz:
                raise ValueError(f"bands: from {band.from_hz:g} Hz: must lie in the plot")
        return self

    def judge_scan(self, found: FrequencyScan) -> list[Verdict]:
        """The verdicts on a plot: on its damping, then one a band and gain or phase."""
        made = self._made
        hz, nfp = found.frequency, found.nfp
        gain, phase = np.abs(nfp), np.degrees(np.angle(nfp))
        span = f"From {hz[0]:.3g} to {hz[-1]:.3g} Hz the gain lies between {gain.min():.4g} and "
        span += f"{gain.max():.4g} p.u./p.u."
        verdicts = [] if self.damping is None else [self._judge_damping(found, *self.damping)]
        for band in self.bands:
            inside = (hz >= band.from_hz) & (hz <= band.to_hz)
            where = f"{band.from_hz:g} to {band.to_hz:g} Hz"
            if not inside.any():
                verdicts.append(made(CANNOT, None, "", where, f"No point lies between {where}."))
                continue
            for x, low, high, unit, name in (
                (gain, band.low, band.high, "p.u./p.u.", "gain"),
                (phase, band.phase_low, band.phase_high, "°", "phase"),
            ):
                if low is None and high is None:
                    continue
                beyond = np.maximum(
                    -math.inf if low is None else low - x, -math.inf if high is None else x - high
                )
                k = int(np.argmax(np.where(inside, beyond, -math.inf)))
                limits = [f"at least {low:g} {unit}"] if low is not None else []
                limits += [f"at most {high:g} {unit}"] if high is not None else []
                text = (
                    f"At {hz[k]:.3g} Hz the {name} is {x[k]:.4g} {unit}, the nearest to its limits "
                    f"or the furthest beyond them between {where}."
                )
                limit = f"{' and '.join(limits)}, {where}"
                verdict: Outcome = PASS if beyond[k] <= 0 else FAIL
                over = band.from_hz, band.to_hz
                verdicts.append(made(verdict, float(x[k]), unit, limit, text, low, high, over))
        if self.unknown is not None:
            text = f"Informative: {self.unknown}. {span}"
            verdicts.append(made(INFORMATIVE, float(gain.max()), "p.u./p.u.", "", text))
        return verdicts

    def _judge_damping(self, found: FrequencyScan, low: float, high: float) -> Verdict:
        """The verdict on the equivalent damping ratio of a plot."""
        omega_b = found.omega[0]
        slow = found.frequency < 0.5 * omega_b / (2 * math.pi)
        limit = f"damping ratio of {low:g} to {high:g}"
        try:
            unit = fit_nfp(found.frequency[slow], found.nfp[slow], omega_b)
        except UserError as problem:
            text = f"Cannot be judged: no swing equation fits the plot: {problem}."
            return self._made(CANNOT, None, "", limit, text)
        ratio, text = damping_of(unit, omega_b)
        return self._made(PASS if low <= ratio <= high else FAIL, ratio, "", limit, text)

    def curves(self, found: FrequencyScan) -> list[PlotPanel]:
        nfp, model = found.nfp, found.nfp_model
        return [
            PlotPanel(title, unit, of(nfp), None if model is None else of(model), unit != "°")
            for title, unit, of in (
                ("gain |Δp / Δω_g| [p.u./p.u.]", "p.u./p.u.", np.abs),
                ("phase of Δp / Δω_g [°]", "°", lambda z: np.degrees(np.angle(z))),
            )
        ]


CRITERION = Nfp
