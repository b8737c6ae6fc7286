"""CARLA: worlds as recorder logs that it plays, and worlds shown live in its server.

Logs need nothing of CARLA. The server needs its client library, the extra `carla`. Nothing here has run
against a CARLA server: see the guide.
"""

from limsim_jax.bridges.carla.camera import Camera, Mount
from limsim_jax.bridges.carla.live import EnvShow, Live
from limsim_jax.bridges.carla.log import carla_log, read_log, write_log
from limsim_jax.bridges.carla.server import Backend, CarlaError, CarlaServer, Foreign, Pose, play

__all__ = [
    "Backend",
    "Camera",
    "CarlaError",
    "CarlaServer",
    "EnvShow",
    "Foreign",
    "Live",
    "Mount",
    "Pose",
    "carla_log",
    "play",
    "read_log",
    "write_log",
]
