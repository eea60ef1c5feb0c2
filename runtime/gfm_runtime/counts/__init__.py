"""What firmware does between its pins and a law: A/D counts to y, and u to compare counts.

``measure`` and ``modulate`` are the two halves of a tick, with the options of each; ``pair`` joins
them in a law's record and reads them from files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
