"""Road traffic for validating automated driving, as batched JAX array programs.

The names of `__init__.pyi` are the public API; everything deeper may change. They load when they are first
used, so that `import limsim_jax` is fast and starts no JAX backend.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

__version__ = "0.1.0"
