"""Road traffic for validating automated driving, as batched JAX array programs.

Names load when they are first used, so that `import limsim_jax` is fast and starts no JAX backend.
"""

from __future__ import annotations

__version__ = "0.1.0.dev0"
