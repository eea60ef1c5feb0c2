from .catalogue import (
    LawSet,
    get_law,
    grid_names,
    industry_names,
    law_file,
    law_names,
    law_titles,
    load_law,
    tuned_names,
)
from .elements import Element
from .errors import LawError
from .kernel import law_dtype, pack_law, state_dtype, step
from .law import BuiltLaw, HomeGrid, Limits, Parameter
from .lawfile import build_law, parse_law, read_law_file, tied
from .realisation import LawStateSpace, realise
from .signals import SIGNALS, Signal
from .switchover import change_law
from .tustin import DiscreteLaw, discretise

__all__ = [
    "SIGNALS",
    "BuiltLaw",
    "DiscreteLaw",
    "Element",
    "HomeGrid",
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
    "grid_names",
    "industry_names",
    "law_dtype",
    "law_file",
    "law_names",
    "law_titles",
    "load_law",
    "pack_law",
    "parse_law",
    "read_law_file",
    "realise",
    "state_dtype",
    "step",
    "tied",
    "tuned_names",
]
