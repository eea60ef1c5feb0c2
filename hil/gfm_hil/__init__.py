"""The bench: links, scenarios, the two processes, recording, results, studies, command line."""

import lazy_loader

from gfm_hil.core import blas as _blas  # noqa: F401  before NumPy is first imported

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
