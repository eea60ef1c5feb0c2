from .check import OPTIMISED, TARGETS, Checked, check
from .dll import build_dll, dll_sources
from .fmu import FMI, fmu
from .folder import export
from .golden import CHECKED, SHIPPED, Golden, golden
from .module import REALS, STYLES, Module, Style, make_modules, sources
from .schedule import stage_names

__all__ = [
    "CHECKED",
    "FMI",
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
    "fmu",
    "golden",
    "make_modules",
    "sources",
    "stage_names",
]
