"""Log replay: recorded vehicles follow their logs until an ego makes that impossible.

The traffic model then drives them, and hands them back once the conflict is over.
"""

from limsim_jax.log_replay.replay import Replay
from limsim_jax.log_replay.scene import Scene, load_scene
from limsim_jax.log_replay.takeover import Takeover

__all__ = ["Replay", "Scene", "Takeover", "load_scene"]
