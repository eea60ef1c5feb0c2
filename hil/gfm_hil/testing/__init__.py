"""The bench in users' tests: steps as calls, assertions that say why they fail."""

from gfm_hil.testing.experiment import Experiment
from gfm_hil.testing.steps import Setting, make_setting

__all__ = ["Experiment", "Setting", "make_setting"]
