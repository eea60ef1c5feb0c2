"""The plant: a grid-forming converter with its filter, DC source, line, grid and instruments.

Describe one with `options.Plant`, build its records with `make_plant`, put it at rest with
`plant_equilibrium` and `plant_init`, then alternate `plant_sample` and `plant_advance`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
