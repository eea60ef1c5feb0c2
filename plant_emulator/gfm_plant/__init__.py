"""The plant: a grid-forming converter with its filter, DC source, line, grid and instruments.

Describe one with `options.Plant`, build it with `make_plant`, put it at rest with
`plant_equilibrium` and `Network.start`, then alternate `plant_sample` and `plant_advance` on its
records. `make_network` connects several converters.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
