"""Driver populations under which simulated traffic is distributed like recorded traffic.

Fits of single drivers follow *recorded* leaders. Here followers drive behind the *simulated* vehicles ahead
of them, as in the simulator, so the error of one driver reaches all behind it. Only a vehicle without a
leader in the recording follows its log. Vehicles enter, change lanes and get other leaders when they did so
in the recording. Their drivers are drawn from the population, not fitted: the medians and spreads of its
parameters are adjusted until time headways, speeds, gaps and the fundamental diagram have the recorded
distributions.

The scores of the drivers are the same whatever the population is (common random numbers), and the distance of
two distributions is the mean distance of their sorted samples (Wasserstein-1). So the loss has gradients with
respect to the population, through the rollout. It is descended from two populations, that of fits to single
drivers and the simulator's own, and the lower end is kept.

All periods are held out in turns (cross-validation): each is simulated with a population that was fitted
without it. `ClosedLoop` has the distances of all of them together, before and after, and two yardsticks: the
distance between two halves of the recorded vehicles, and the distance of a record from the population that
made it, which is the least that an exactly right population reaches.

Quantities without a gradient are for `matching`.
"""

from limsim_jax.calibration.closed_loop.chains import Chains, Linked, link, linked_recordings, simulate
from limsim_jax.calibration.closed_loop.descent import SPEED_LIMIT
from limsim_jax.calibration.closed_loop.distances import UNITS, Distances
from limsim_jax.calibration.closed_loop.validation import (
    ClosedLoop,
    calibrate_closed_loop,
    hold_out,
    single_fits,
)

__all__ = [
    "SPEED_LIMIT",
    "UNITS",
    "Chains",
    "ClosedLoop",
    "Distances",
    "Linked",
    "calibrate_closed_loop",
    "hold_out",
    "link",
    "linked_recordings",
    "simulate",
    "single_fits",
]
