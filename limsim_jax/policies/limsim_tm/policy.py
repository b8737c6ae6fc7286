"""The policy: rules of the road from the traffic engine, a decision, a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.limsim_tm.plan import Lattice, Others, Task, plan
from limsim_jax.policies.predict import Prediction, constant_velocity
from limsim_jax.policies.reference import Way, beside, body_lane, motion_on, way_ahead
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.ego import Trajectory, at_slots
from limsim_jax.traffic.engine import Command, Decision, Traffic, decide
from limsim_jax.types import Config, State


class Memory(NamedTuple):
    """What is kept between decisions, for `E` rows of egos."""

    slot: Int[Array, " E"]  # whose it is
    side: Int[Array, " E"]  # lane change under way: 1 left, -1 right, 0 none


class Around(NamedTuple):
    """The `K` others that matter to each of `V` vehicles, as seen from its way."""

    slot: Int[Array, "V K"]
    there: Bool[Array, "V K"]
    s: Float[Array, "V K"]  # m from centre to centre along the way
    d: Float[Array, "V K"]  # m off the way
    gap: Float[Array, "V K"]  # m between bumpers; positive ahead of us and behind us alike
    v: Float[Array, "V K"]  # m/s along the way
    on_way: Bool[Array, "V K"]  # its body is on the lane that the way follows


@dataclass(frozen=True)
class LimSimTM:
    """Decides like the planners of LimSim's traffic manager: search for a manoeuvre, then plan a trajectory.

    Attributes:
      others: vehicles of the traffic that it drives beside the egos, see `AreaOfInterest`.
      nearest: others that are looked at.
      lattice: of trajectories.
      traffic: rules of the road, and how drivers follow each other.
    """

    others: int = 0
    nearest: int = 8
    lattice: Lattice = field(default_factory=Lattice)
    traffic: Traffic = field(default_factory=Traffic)

    free = True

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Memory:
        """No lane change under way."""
        del config, lane_map
        return Memory(state.egos.slot, jnp.zeros_like(state.egos.slot))

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Memory, key: jax.Array
    ) -> tuple[Command, Memory]:
        """One trajectory for every ego."""
        del key
        slot = state.egos.slot
        side = jnp.where(memory.slot == slot, memory.side, 0)
        wish, decision = rules(config, self.traffic, lane_map, state, side)
        lane, s = body_lane(lane_map, state, slot)
        d, goal = state.d[slot], state.goal[slot]

        times = self.lattice.times()
        wall = decision.obstacles.gap[:, -1] - state.driver.s0
        prediction = constant_velocity(lane_map, state, times, stop=wall)

        # go on with a lane change until the middle of the body is on the other lane, as long as it is safe
        side = jnp.where(side * d < -0.3, 0, side)
        begins = (side == 0) & (jnp.abs(d) < 0.6)
        side = jnp.where(begins, wish, side)
        other_lane, other_s, other_d, there = beside(lane_map, lane, s, d, side)
        way = way_ahead(lane_map, other_lane, other_s, goal, points=_POINTS, step=_STEP)
        found = around(state, prediction, way, slot, self.nearest)
        side = jnp.where(there & self._fits(state, slot, found), side, 0)
        changes = side != 0
        own = way_ahead(lane_map, lane, s, goal, points=_POINTS, step=_STEP)
        way = jax.tree.map(
            lambda a, b: jnp.where(jnp.reshape(changes, (-1,) + (1,) * (a.ndim - 1)), a, b), way, own
        )
        d = jnp.where(changes, other_d, d)
        found = around(state, prediction, way, slot, self.nearest)

        task = self._task(state, decision, way, slot, d, found, prediction)
        chosen = plan(self.lattice, self.traffic.model, task)
        trajectory = Trajectory(
            x=chosen.x, y=chosen.y, heading=chosen.heading, v=chosen.v,
            t0=config.time(state.step), dt=self.lattice.dt,
        )  # fmt: skip
        return Command(trajectory=trajectory), Memory(slot, side)

    def _fits(self, state: State, slot: Int[Array, " V"], found: Around) -> Bool[Array, " V"]:
        """Whether there is room on the way: nobody beside, nobody has to brake hard."""
        model, driver = self.traffic.model, jax.tree.map(lambda x: x[slot][:, None], state.driver)
        v, zero = state.v[slot][:, None], jnp.zeros_like(found.v)
        lead = found.on_way & (found.s > 0) & (found.gap > 0)
        lag = found.on_way & (found.s <= 0) & (found.gap > 0)
        beside = found.on_way & (found.gap <= 1.0)
        wide = jnp.broadcast_to(v, found.v.shape)
        own = model(
            driver, gap=jnp.where(lead, found.gap, NO_GAP), v=wide,
            v_lead=jnp.where(lead, found.v, wide), a_lead=zero, v0=wide + 1,
        )  # fmt: skip
        theirs = jax.tree.map(lambda x: x[found.slot], state.driver)
        v_lag = jnp.maximum(found.v, 0)
        behind = model(
            theirs, gap=jnp.where(lag, found.gap, NO_GAP), v=v_lag,
            v_lead=jnp.where(lag, wide, v_lag), a_lead=zero, v0=v_lag + 1,
        )  # fmt: skip
        hard = (lead & (own < -_EASY)) | (lag & (behind < -_EASY)) | beside
        return ~hard.any(-1)

    def _task(
        self,
        state: State,
        decision: Decision,
        way: Way,
        slot: Array,
        d: Array,
        found: Around,
        prediction: Prediction,
    ) -> Task:
        driver = jax.tree.map(lambda x: x[slot], state.driver)
        index, gap = decision.obstacles.other[slot, :-1], decision.obstacles.gap[slot, :-1]
        ahead = found.there & found.on_way & (found.s > 0)
        nearest = jnp.argmin(jnp.where(ahead, found.gap, NO_GAP), -1)[:, None]
        first = jnp.take_along_axis(jnp.where(ahead, found.gap, NO_GAP), nearest, 1)
        lead_gap = jnp.concatenate([jnp.where(index >= 0, gap, NO_GAP), first], -1)
        lead_v = jnp.concatenate(
            [state.v[index], jnp.take_along_axis(jnp.maximum(found.v, 0), nearest, 1)], -1
        )
        follows = found.on_way & (found.s <= 0)
        return Task(
            way=way,
            start=motion_on(way, state, slot, d),
            length=state.shape.length[slot],
            width=state.shape.width[slot],
            driver=driver,
            lead_gap=lead_gap,
            lead_v=lead_v,
            wall=jnp.minimum(decision.obstacles.gap[slot, -1] - driver.s0, NO_GAP),
            other=Others(
                prediction.x[found.slot], prediction.y[found.slot], prediction.heading[found.slot],
                state.shape.length[found.slot], state.shape.width[found.slot], found.there & ~follows,
            ),
            steering=jnp.full_like(d, 0.5),
            wheelbase=state.shape.wheelbase[slot],
        )  # fmt: skip


_POINTS, _STEP = 80, 2.0  # of a way, m
_EASY = 2.5  # m/s^2, the hardest braking that a lane change may ask of anybody


def rules(
    config: Config, traffic: Traffic, lane_map: LaneMap, state: State, side: Int[Array, " E"]
) -> tuple[Int[Array, " E"], Decision]:
    """What the traffic engine sees: leaders, right of way, lights, ends of lanes; and lane changes by MOBIL.

    `side`: lane changes that egos are in the midst of. Returns the lane changes that would begin now.
    """
    egos = replace(state.egos, free=jnp.zeros_like(state.egos.free))
    now = at_slots(egos, side, state.side, side != 0)
    before = replace(state, egos=egos, side=now)
    after, decision = decide(config, traffic, lane_map, before, Command())
    return jnp.where(now[egos.slot] == 0, after.side[egos.slot], 0), decision


def around(state: State, prediction: Prediction, way: Way, slot: Int[Array, " V"], count: int) -> Around:
    """The others that come nearest within the next seconds, and where they are on the way."""
    number = state.lane.shape[0]
    x, y = prediction.x, prediction.y  # [N H]
    mine = jnp.arange(number)[None] == slot[:, None]
    picks = (0, x.shape[1] // 3, 2 * x.shape[1] // 3)
    away = jnp.stack(
        [
            (x[:, k][None] - x[slot, k][:, None]) ** 2 + (y[:, k][None] - y[slot, k][:, None]) ** 2
            for k in picks
        ]
    )
    away = jnp.where(mine | ~state.active[None], 1e12, away.min(0))
    near, index = lax.top_k(-away, min(count, number))
    there = near > -1e11
    ox, oy = x[index, 0], y[index, 0]
    # the nearest point of the way
    far = (ox[..., None] - way.x[:, None]) ** 2 + (oy[..., None] - way.y[:, None]) ** 2  # [V K M]
    k = jnp.argmin(far, -1)
    at = lambda table: jnp.take_along_axis(table, k, 1)  # noqa: E731
    cos, sin = jnp.cos(at(way.heading)), jnp.sin(at(way.heading))
    dx, dy = ox - at(way.x), oy - at(way.y)
    s, d = k.astype(dx.dtype) * way.step + dx * cos + dy * sin, -dx * sin + dy * cos
    turned = prediction.heading[index, 0] - at(way.heading)
    half = (
        jnp.abs(jnp.cos(turned)) * state.shape.width[index]
        + jnp.abs(jnp.sin(turned)) * state.shape.length[index]
    )
    on_way = (
        there & (jnp.abs(d) < half / 2 + state.shape.width[slot][:, None] / 2 + 0.1) & (jnp.cos(turned) > 0.3)
    )
    on_way &= jnp.abs(s) < way.reach
    lengths = (state.shape.length[index] + state.shape.length[slot][:, None]) / 2
    return Around(index, there, s, d, jnp.abs(s) - lengths, state.v[index] * jnp.cos(turned), on_way)
