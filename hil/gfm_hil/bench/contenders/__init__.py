"""Contenders of ``gfmhil bench latency``: links of the bench, their limits in C, other packages.

A contender is one file of this folder and its name in ``registry.FILES``.
"""

from gfm_hil.bench.contenders.base import FRAME, Contender, free_port, memory_folder, messages
from gfm_hil.bench.contenders.registry import contenders_of

__all__ = ["FRAME", "Contender", "contenders_of", "free_port", "memory_folder", "messages"]
