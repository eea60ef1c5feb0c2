"""The inner stage between a law and the bridge: current limit, current and voltage loops.

``stage`` has what all kinds share, ``kinds`` the list of them and the tick of a stage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
