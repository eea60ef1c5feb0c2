"""Models that are not ours as controllers: real-code DLLs of IEEE/CIGRE, and FMUs.

A model computes u from the references and measurements; a map names its ports where they are not
called as our signals.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
