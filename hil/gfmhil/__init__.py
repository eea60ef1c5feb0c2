"""The public API: run scenarios, compare laws, change gains, load runs, run conformity tests, from
Python::

    import gfmhil

    run = gfmhil.run("pref_step", law="vsg-2")
    run.signals["p"], run.metrics, run.plot()

Runs stay in memory and print nothing. Errors are ``UserError`` and ``LawError``, in one line.
"""

from importlib import import_module
from typing import Any

from gfm_hil.core import blas as _blas  # noqa: F401  before NumPy is first imported

_HOMES = {
    "Watch": "gfm_hil.studies.workers",
    "UserError": "gfm_hil.core.errors",
    "load_run": "gfm_hil.results.run",
    "NetworkRun": "gfm_hil.results.network_run",
    "Run": "gfm_hil.results.run",
    "load_scenario": "gfm_hil.scenario.model",
    "Scenario": "gfm_hil.scenario.model",
    "CampaignResult": "gfm_hil.studies.campaign.result",
    "FrequencyScan": "gfm_hil.studies.scan",
    "scan": "gfm_hil.api.studies",
    "identify": "gfm_hil.api.studies",
    "Law": "gfm_hil.api.law",
    "laws": "gfm_hil.api.law",
    "run": "gfm_hil.api.studies",
    "run_network": "gfm_hil.api.studies",
    "campaign": "gfm_hil.api.studies",
    "compare": "gfm_hil.api.studies",
    "conform": "gfm_hil.api.studies",
    "Conformity": "gfm_hil.studies.conformity.result",
    "Comparison": "gfm_hil.api.studies",
    "LawError": "gfm_runtime.errors",
}

_MODULES = ("design", "envelopes", "plot")

__all__ = sorted([*_HOMES, *_MODULES])


def __getattr__(name: str) -> Any:
    """Load what is asked for, when it is."""
    if name in _MODULES:
        return import_module(f"gfmhil.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'gfmhil' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
