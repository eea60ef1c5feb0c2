"""The converter keeps synchronism with the grid."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict


class InStep(Windowed):
    """The angle to the grid stays within half a turn of where it was before."""

    kind: Literal["stays_in_step"] = Field(description="kind of criterion")

    explains: ClassVar[int] = 1

    def judge(self, m: Moment) -> Verdict:
        """The value is the largest distance of the angle, degrees."""
        delta = m.raw("delta")
        away = np.abs(delta[m.first : m.last] - delta[m.tick - 1])
        far = float(np.degrees(np.max(away)))
        text = (
            f"The angle to the grid is at most {far:.3g}° away from where it was."
            if far < 180
            else f"The converter falls out of step: its angle to the grid moves by {far:.4g}°."
        )
        return m.make_verdict(far < 180, far, "°", "less than 180°", text, "delta")


CRITERION = InStep
