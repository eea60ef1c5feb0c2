"""A law as C99 with the kernel's bits: the text, the golden vectors, the check on a target.

It generates text from a discretised law, the signal table and the kernel's definition.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
