"""The controller: signal table, laws, discretisation, kernel, switchover, safe state.

This package is what would be flashed. It imports numpy and numba (pydantic only to read law
files) and nothing else of gfmhil.
"""

from gfm_runtime.catalogue import LawSet, get_law, law_file, law_names, load_law, tuned_names
from gfm_runtime.discretise import DiscreteLaw, discretise
from gfm_runtime.elements import Element
from gfm_runtime.errors import LawError
from gfm_runtime.kernel import law_dtype, pack_law, state_dtype, step
from gfm_runtime.law import HomeGrid, Law, Limits, Parameter
from gfm_runtime.lawfile import build_law, parse_law, read_law_file
from gfm_runtime.realise import LawStateSpace, realise
from gfm_runtime.signals import SIGNALS, Signal
from gfm_runtime.switchover import change_law

__all__ = [
    "SIGNALS",
    "DiscreteLaw",
    "Element",
    "HomeGrid",
    "Law",
    "LawError",
    "LawSet",
    "LawStateSpace",
    "Limits",
    "Parameter",
    "Signal",
    "build_law",
    "change_law",
    "discretise",
    "get_law",
    "law_dtype",
    "law_file",
    "law_names",
    "load_law",
    "pack_law",
    "parse_law",
    "read_law_file",
    "realise",
    "state_dtype",
    "step",
    "tuned_names",
]
