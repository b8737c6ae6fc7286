"""All metrics of one ego in one carry: `EgoMetrics` composes measures over a stream of `EgoStep`s.

The first step is the start. Once the ego has arrived or left nothing changes any more. An episode that ends
early keeps its results, and another vehicle may take the slot. `NAMES` lists the columns, with units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.metrics.description import Description
from limsim_jax.metrics.measure import Derived, Measure, Metric, Own, Summary
from limsim_jax.metrics.measures import built_in
from limsim_jax.metrics.measures.comfort import Comfort
from limsim_jax.metrics.measures.contacts import Contacts
from limsim_jax.metrics.measures.progress import Progress
from limsim_jax.metrics.motion import motion_result
from limsim_jax.metrics.reductions import Measured
from limsim_jax.metrics.safety import Rss
from limsim_jax.metrics.step import EgoStep, StepView
from limsim_jax.numerics import safe_divide

DESCRIPTIONS: tuple[Description, ...] = tuple(
    column for measure in built_in(0.1, Rss()) for column in measure.columns
)
"""Every built-in column, in order."""

NAMES: dict[str, str] = {column.name: column.meaning for column in DESCRIPTIONS}
"""What `EgoMetrics.result` measures, with units."""


class EgoCarry(NamedTuple):
    """State of `EgoMetrics.update`."""

    started: Bool[Array, ""]
    over: Bool[Array, ""]
    start: Float[Array, ""]  # s
    now: Float[Array, ""]
    arrived: Bool[Array, ""]
    broken: Bool[Array, ""]  # its policy has failed
    memory: dict[str, Any]  # of each measure, by its name
    own: tuple[Any, ...]  # of each metric of one's own


@dataclass(frozen=True)
class EgoMetrics:
    """Metrics of one ego in one world.

    Attributes:
      dt: s between steps.
      rss: parameters of RSS.
      own: metrics of one's own, besides the built-in ones.
    """

    dt: float
    rss: Rss = field(default_factory=Rss)
    own: tuple[Metric, ...] = ()

    @property
    def measures(self) -> dict[str, Measure]:
        """The built-in measures by name, in the order of their columns."""
        return {measure.name: measure for measure in built_in(self.dt, self.rss)}

    def init(self, vehicles: int, zones: int) -> EgoCarry:
        """Before the first step, for this many slots and conflict zones."""
        zero, no = jnp.zeros(()), jnp.zeros((), bool)
        return EgoCarry(
            started=no,
            over=no,
            start=zero,
            now=zero,
            arrived=no,
            broken=no,
            memory={name: measure.init(vehicles, zones) for name, measure in self.measures.items()},
            own=tuple(Own(metric).init(vehicles, zones) for metric in self.own),
        )

    @jax.named_scope("ego_metrics")
    def update(self, carry: EgoCarry, step: EgoStep, lane_map: LaneMap | None = None) -> EgoCarry:
        """One step. Nothing changes before the ego is active, nor after it arrived, left or failed.

        Of the step in which it arrives and leaves only time and distance count, of that in which its policy
        fails only the time.
        """
        there = step.active[step.slot] & ~carry.over & ~step.broken
        new = self._update(carry, step, lane_map)
        new = jax.tree.map(lambda a, b: jnp.where(there, a, b), new, carry)
        goes_on = new.started & ~carry.over & (step.active[step.slot] | step.arrived)
        breaks, arrives = goes_on & step.broken, goes_on & step.arrived & ~step.broken
        way = Progress().advance(new.memory[Progress.name], step.to_go, step.moved)
        leaves = arrives & ~there
        way = jax.tree.map(lambda a, b: jnp.where(leaves, a, b), way, new.memory[Progress.name])
        return new._replace(
            arrived=carry.arrived | arrives,
            broken=carry.broken | breaks,
            over=carry.over | arrives | (carry.started & ~there),
            now=jnp.where(leaves | breaks, step.t, new.now),
            memory=new.memory | {Progress.name: way},
        )

    def view(self, carry: EgoCarry, step: EgoStep, lane_map: LaneMap | None = None) -> StepView:
        """The step as the measures see it."""
        return StepView(step, self.dt, carry.started, carry.memory[Contacts.name].touched, lane_map)

    def _update(self, carry: EgoCarry, step: EgoStep, lane_map: LaneMap | None) -> EgoCarry:
        view, memory = self.view(carry, step, lane_map), carry.memory
        contacts = Contacts().advance(memory[Contacts.name], view)
        motion, filtered = Comfort(self.dt).advance(memory[Comfort.name], view)
        derived = Derived(
            contacts=contacts,
            hit=contacts.contacts > memory[Contacts.name].contacts,
            motion=motion,
            filtered=filtered,
        )
        measures = self.measures.items()
        return EgoCarry(
            started=jnp.ones((), bool),
            over=carry.over,
            start=jnp.where(carry.started, carry.start, step.t),
            now=step.t,
            arrived=carry.arrived,
            broken=carry.broken,
            memory={name: measure.update(memory[name], view, derived) for name, measure in measures},
            own=tuple(
                Own(metric).update(kept, view, derived)
                for metric, kept in zip(self.own, carry.own, strict=True)
            ),
        )

    def result(
        self, carry: EgoCarry, reference_progress: Float[Array, ""] | None = None
    ) -> dict[str, Measured]:
        """All of `NAMES`, then the metrics of one's own.

        Args:
          carry: at the end.
          reference_progress: m, what nuPlan's expert drove. Without it, what the speed limit would have
            allowed in the same time, at most the whole route.
        """
        summary = self._summary(carry, reference_progress)
        found: dict[str, Measured] = {}
        for name, measure in self.measures.items():
            found |= measure.result(carry.memory[name], summary)
        for metric, kept in zip(self.own, carry.own, strict=True):
            found |= Own(metric).result(kept, summary)
        return found

    def _summary(self, carry: EgoCarry, reference_progress: Float[Array, ""] | None) -> Summary:
        memory = carry.memory
        progress, contacts, road = memory["progress"], memory["contacts"], memory["road"]
        duration = carry.now - carry.start
        gained = progress.to_go[0] - progress.to_go[1]
        completion = jnp.clip(safe_divide(gained, progress.to_go[0], 1.0), 0, 1)
        comfort, rest = motion_result(self.dt, memory["motion"])
        failed = carry.broken | (contacts.contacts > 0) | road.left_road.found
        return Summary(
            started=carry.started,
            arrived=carry.arrived,
            there=carry.started & ~carry.over,
            broken=carry.broken,
            failed=failed,
            now=carry.now,
            duration=duration,
            driven=carry.started & (duration > 0),
            judged=carry.started & (failed | (duration > 0)),
            progress=gained,
            route=progress.to_go[0],
            completion=jnp.where(carry.arrived, 1, completion),
            distance=progress.distance,
            off_route=road.off_route,
            against_flow=memory["direction"].most,
            overspeed=memory["speeding"].total,
            contacts=contacts.contacts,
            faults=contacts.faults,
            off_road=road.left_road.found,
            red_lights=memory["signals"].red_lights,
            stop_signs=memory["signals"].stop_signs,
            comfort=comfort,
            rest=rest,
            reference_progress=reference_progress,
        )
