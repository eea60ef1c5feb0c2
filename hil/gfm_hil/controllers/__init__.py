"""What may stand in the controller's place: real-code DLLs of IEEE/CIGRE, FMUs, and our own laws on
another processor.

A controller that is not ours computes u from the references and measurements; a map names its ports
where they are not called as our signals.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
