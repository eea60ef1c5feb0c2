from .a2l import Entry, a2l_text, unit_of
from .check import EVA, OPTIMISED, TARGETS, CheckResult, ProofResult, check, need_tools, prove
from .dll import build_dll, dll_sources
from .elf import elf_a2l, elf_entries
from .fixed import FIXED
from .fmu import FMI, fmu
from .folder import export
from .golden import CHECKED, SHIPPED, Golden, golden
from .loop import CHANGE, FROM, START, TICK, TO, LoopProgram, build_loop
from .module import REALS, STYLES, Module, Style, make_modules, sources
from .schedule import stage_names

__all__ = [
    "CHANGE",
    "CHECKED",
    "EVA",
    "FIXED",
    "FMI",
    "FROM",
    "OPTIMISED",
    "REALS",
    "SHIPPED",
    "START",
    "STYLES",
    "TARGETS",
    "TICK",
    "TO",
    "CheckResult",
    "Entry",
    "Golden",
    "LoopProgram",
    "Module",
    "ProofResult",
    "Style",
    "a2l_text",
    "build_dll",
    "build_loop",
    "check",
    "dll_sources",
    "elf_a2l",
    "elf_entries",
    "export",
    "fmu",
    "golden",
    "make_modules",
    "need_tools",
    "prove",
    "sources",
    "stage_names",
    "unit_of",
]
