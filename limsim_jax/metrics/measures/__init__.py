"""The built-in measures of an ego, each described where it is computed; `built_in` lists them all."""

from __future__ import annotations

from limsim_jax.metrics.measure import Measure
from limsim_jax.metrics.measures.comfort import Comfort
from limsim_jax.metrics.measures.contacts import Contacts
from limsim_jax.metrics.measures.progress import Progress
from limsim_jax.metrics.measures.proximity import Distance, Following, PostEncroachment, TimeToCollision
from limsim_jax.metrics.measures.rss import ResponsibilityDistances
from limsim_jax.metrics.measures.rules import Direction, Road, Signals, Speeding
from limsim_jax.metrics.measures.scores import Carla, LimSim, NuPlan
from limsim_jax.metrics.safety import Rss


def built_in(dt: float, rss: Rss) -> tuple[Measure, ...]:
    """All built-in measures of an ego, in the order of their columns; `dt`: s between steps."""
    return (
        Progress(),
        TimeToCollision(),
        Following(),
        PostEncroachment(),
        Distance(),
        ResponsibilityDistances(rss),
        Contacts(),
        Speeding(),
        Road(),
        Direction(dt),
        Signals(),
        Comfort(dt),
        NuPlan(),
        Carla(),
        LimSim(dt),
    )
