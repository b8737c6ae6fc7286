from .maps import bundled_maps as bundled_maps
from .maps.lane_map import LaneMap as LaneMap
from .maps.lane_map import pose as pose
from .maps.lane_map import to_frenet as to_frenet
from .maps.map import Map as Map
from .maps.map import load_map as load_map
from .maps.network import MapError as MapError
from .maps.network import Network as Network
from .simulation.rollout import Rollout as Rollout
from .simulation.worlds import Worlds as Worlds
from .traffic.engine import Traffic as Traffic
from .types import Config as Config

__version__: str
