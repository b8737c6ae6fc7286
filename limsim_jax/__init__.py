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
    from limsim_jax.maps.origins import origins as origins
    from limsim_jax.simulation.rollout import Rollout as Rollout
    from limsim_jax.simulation.worlds import Worlds as Worlds
    from limsim_jax.traffic.demand import Flow as Flow
    from limsim_jax.traffic.demand import build_demand as build_demand
    from limsim_jax.traffic.demand import sample_scenario as sample_scenario
    from limsim_jax.traffic.engine import Traffic as Traffic
    from limsim_jax.traffic.vehicles import default_population as default_population
    from limsim_jax.traffic.vehicles import fitting as fitting
    from limsim_jax.types import Config as Config

__version__ = "0.1.0"

_HOMES = {
    "Config": "limsim_jax.types",
    "Flow": "limsim_jax.traffic.demand",
    "Lane": "limsim_jax.maps.network",
    "LaneMap": "limsim_jax.maps.lane_map",
    "MapError": "limsim_jax.maps.network",
    "Network": "limsim_jax.maps.network",
    "Rollout": "limsim_jax.simulation.rollout",
    "Traffic": "limsim_jax.traffic.engine",
    "Worlds": "limsim_jax.simulation.worlds",
    "build_demand": "limsim_jax.traffic.demand",
    "build_lane_map": "limsim_jax.maps",
    "bundled_map": "limsim_jax.maps",
    "bundled_maps": "limsim_jax.maps",
    "default_population": "limsim_jax.traffic.vehicles",
    "draw_map": "limsim_jax.maps.draw",
    "origins": "limsim_jax.maps.origins",
    "fitting": "limsim_jax.traffic.vehicles",
    "load_map": "limsim_jax.maps",
    "sample_scenario": "limsim_jax.traffic.demand",
}

__all__ = [
    "Config",
    "Flow",
    "Lane",
    "LaneMap",
    "MapError",
    "Network",
    "Rollout",
    "Traffic",
    "Worlds",
    "build_demand",
    "build_lane_map",
    "bundled_map",
    "bundled_maps",
    "default_population",
    "draw_map",
    "fitting",
    "load_map",
    "origins",
    "sample_scenario",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
