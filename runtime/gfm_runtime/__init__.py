"""The controller: signal table, laws, discretisation, kernel, switchover, safe state.

This package is what would be flashed. It imports numpy and numba (pydantic only to read law
files) and nothing else of gfmhil.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
