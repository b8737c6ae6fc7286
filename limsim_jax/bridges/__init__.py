"""Other simulators, other libraries' environments, other tools' formats."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["carla"])
