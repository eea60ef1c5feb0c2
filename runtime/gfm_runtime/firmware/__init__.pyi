from .check import OPTIMISED, TARGETS, Checked, check
from .dll import build_dll, dll_sources
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
    "build_dll",
    "check",
    "dll_sources",
    "export",
    "golden",
    "make_modules",
    "sources",
]
