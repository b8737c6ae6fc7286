"""An end-to-end driver: from cameras, LiDAR, route and speed to a path and a speed, by one network.

`inputs` is what the network sees, `network` what it says, `control` what the vehicle does, and `policy` joins
them. `limsim_jax.training.end_to_end` trains it.
"""

from limsim_jax.policies.end_to_end.observe import ObserveSensors as ObserveSensors
from limsim_jax.policies.end_to_end.policy import EndToEnd as EndToEnd
