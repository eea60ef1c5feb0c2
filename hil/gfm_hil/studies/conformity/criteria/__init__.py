"""The kinds of criteria of a conformity test, a file each: what the test file says, and how a run
is judged by it. A new one is its file and its line in ``Criterion``."""

from typing import Annotated, get_args

from pydantic import Field

from gfm_hil.studies.conformity.criteria.damped import Damped
from gfm_hil.studies.conformity.criteria.energy import Energy
from gfm_hil.studies.conformity.criteria.in_envelope import InEnvelope
from gfm_hil.studies.conformity.criteria.nfp import Nfp
from gfm_hil.studies.conformity.criteria.no_oscillation import NoOscillation
from gfm_hil.studies.conformity.criteria.no_trip import NoTrip
from gfm_hil.studies.conformity.criteria.peak_delta_p import PeakDelta
from gfm_hil.studies.conformity.criteria.rise_within import Rise
from gfm_hil.studies.conformity.criteria.settles import Settles
from gfm_hil.studies.conformity.criteria.stays_in_step import InStep
from gfm_hil.studies.conformity.criteria.stays_within import StaysWithin

_ALL = (
    StaysWithin
    | Settles
    | PeakDelta
    | Rise
    | Damped
    | Energy
    | NoTrip
    | NoOscillation
    | InStep
    | InEnvelope
    | Nfp
)

Criterion = Annotated[_ALL, Field(discriminator="kind")]

#: by kind
BY_KIND = {get_args(one.model_fields["kind"].annotation)[0]: one for one in get_args(_ALL)}
