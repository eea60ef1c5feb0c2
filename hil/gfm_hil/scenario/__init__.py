"""A scenario: its schema and events, loading and checking it, and writing it as TOML."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
