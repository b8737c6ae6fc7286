"""Road traffic for validating automated driving, as batched JAX array programs.

Names load when they are first used, so that `import limsim_jax` is fast and starts no JAX backend.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from limsim_jax.maps import build_lane_map as build_lane_map
    from limsim_jax.maps import bundled_map as bundled_map
    from limsim_jax.maps import bundled_maps as bundled_maps
    from limsim_jax.maps import load_map as load_map
    from limsim_jax.maps.draw import draw_map as draw_map
    from limsim_jax.maps.lane_map import LaneMap as LaneMap
    from limsim_jax.maps.network import Lane as Lane
    from limsim_jax.maps.network import MapError as MapError
    from limsim_jax.maps.network import Network as Network

__version__ = "0.1.0.dev0"

_HOMES = {
    "Lane": "limsim_jax.maps.network",
    "LaneMap": "limsim_jax.maps.lane_map",
    "MapError": "limsim_jax.maps.network",
    "Network": "limsim_jax.maps.network",
    "build_lane_map": "limsim_jax.maps",
    "bundled_map": "limsim_jax.maps",
    "bundled_maps": "limsim_jax.maps",
    "draw_map": "limsim_jax.maps.draw",
    "load_map": "limsim_jax.maps",
}

__all__ = [
    "Lane",
    "LaneMap",
    "MapError",
    "Network",
    "build_lane_map",
    "bundled_map",
    "bundled_maps",
    "draw_map",
    "load_map",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
