from .check import OPTIMISED, TARGETS, Checked, check
from .folder import export
from .golden import CHECKED, SHIPPED, Golden, golden
from .module import REALS, STYLES, Module, Style, make_modules, sources

__all__ = [
    "CHECKED",
    "OPTIMISED",
    "REALS",
    "SHIPPED",
    "STYLES",
    "TARGETS",
    "Checked",
    "Golden",
    "Module",
    "Style",
    "check",
    "export",
    "golden",
    "make_modules",
    "sources",
]
