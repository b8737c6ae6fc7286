"""What a planner may know: the world as sensors, turn signals and a map can tell it.

A view is a `State` like the true one, so every planner can use either. A belief stands where the truth
cannot be seen: of drivers (`drivers`) and of routes (`routes`).
"""

from limsim_jax.policies.view.look import View as View
from limsim_jax.policies.view.look import view_of as view_of
