"""Worlds beside other simulators, in other libraries' shapes and formats."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["carla"])
