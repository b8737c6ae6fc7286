"""LimSim-TM as a policy: right of way of the traffic, a maneuver, a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, neighbor
from limsim_jax.policies.base import Policy, PolicyLike
from limsim_jax.policies.limsim_tm.decide import Maneuvers, decide_maneuvers, grouped, neighbours
from limsim_jax.policies.limsim_tm.plan import Lattice, Merge, Others, Task, plan, room_needed
from limsim_jax.policies.limsim_tm.search import Settings, no_plan, shifted
from limsim_jax.policies.perception import Around, around, rules
from limsim_jax.policies.predict import Prediction, Predictor, along_route, shared
from limsim_jax.policies.reference import ReferencePath, beside, motion_on, path_from
from limsim_jax.policies.simple import FollowLane
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.car_following import NO_GAP
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Trajectory, at_slots
from limsim_jax.traffic.engine import Decision, Traffic
from limsim_jax.traffic.lane_change import urgency
from limsim_jax.traffic.motion import creep_speed
from limsim_jax.types import Config, State
from limsim_jax.xla import interval


class Memory(NamedTuple):
    """Memory between decisions, for `E` rows of egos."""

    slot: Int[Array, " E"]  # of the vehicle that the row belongs to
    side: Int[Array, " E"]  # lane change in progress: 1 left, -1 right, 0 none
    maneuvers: Maneuvers  # by the last search
    since: Float[Array, " E"]  # s, time of that search
    plan: Trajectory | None  # of each vehicle, shared with the others


@dataclass(frozen=True)
class LimSimTM(Policy):
    """Chooses a maneuver by search, then plans a trajectory.

    Right of way is that of the map, as the traffic model reads it. Routes and drivers of other vehicles are
    those of its view: beliefs, unless it is `privileged`.

    Attributes:
      others: vehicles of the traffic that it drives beside the egos, see `AreaOfInterest`.
      nearest: other vehicles that it considers.
      search: of maneuvers; None: lane changes by MOBIL.
      simulations: of each search, at least 1; None: as in `search`.
      search_every: decisions from one search to the next.
      obedience: upper bound of the egos' desired speed, as a share of the speed limit.
      predict: predictor of the other vehicles.
      shares: whether planned vehicles know each other's previous trajectories.
      lattice: of trajectories.
      traffic: right of way and car following.
    """

    others: int = 0
    nearest: int = 8
    search: Settings | None = field(default_factory=lambda: Settings(simulations=40, change=0.08))
    simulations: int | None = None
    search_every: int = 3
    obedience: float = 0.985
    predict: Predictor = along_route
    shares: bool = True
    lattice: Lattice = field(default_factory=Lattice)
    traffic: Traffic = field(default_factory=Traffic)

    default_name = "limsim_tm"

    def __post_init__(self) -> None:
        if self.simulations is not None and self.simulations < 1:
            raise ValueError(f"simulations: {self.simulations}; expected at least 1")

    @property
    def settings(self) -> Settings | None:
        """Those of the search, with `simulations`."""
        if self.search is None or self.simulations is None:
            return self.search
        return replace(self.search, simulations=self.simulations)

    def variants(self, seen: Predictor) -> dict[str, PolicyLike]:
        """The policy with a reference in the place of one module.

        Prediction: the recorded future. Decision: MOBIL. Planning: car following on the lane.
        """
        return {
            "prediction": replace(self, predict=seen),
            "decision": replace(self, search=None),
            "planning": FollowLane(others=self.others, traffic=self.traffic),
        }

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Memory:
        """No lane change, no search yet."""
        del lane_map
        rows = state.egos.slot.shape[0]
        size = self.settings or Settings()
        maneuvers = Maneuvers(
            side=jnp.zeros(rows, jnp.int32),
            v=jnp.full((rows, size.steps + 1), _ANY_SPEED),
            action=no_plan(rows, size.decisions),
        )
        nothing = jnp.full((rows, self.lattice.moments), _FAR)
        plan = Trajectory(
            x=nothing, y=nothing, heading=nothing, v=nothing,
            t0=config.time(state.step), dt=self.lattice.dt,
        )  # fmt: skip
        return Memory(
            state.egos.slot, jnp.zeros_like(state.egos.slot), maneuvers, jnp.full(rows, -1e3),
            plan if self.shares and rows > 1 else None,
        )  # fmt: skip

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Memory, key: jax.Array
    ) -> tuple[Command, Memory]:
        """One trajectory for every ego."""
        slot = state.egos.slot
        drives = (slot >= 0) & state.active[slot]
        same = memory.slot == slot
        side = jnp.where(same, memory.side, 0)
        rule, decision = rules(config, self.traffic, lane_map, state, side)
        wish = rule
        lane, s = body_place(lane_map, state, slot)
        d, goal = state.d[slot], state.goal[slot]

        wall = decision.obstacles.gap[:, -1] - state.driver.s0
        now = config.time(state.step)

        def predict(times: Array) -> Prediction:
            known = None
            if memory.plan is not None:
                known = shared(lane_map, state, memory.slot, memory.plan, now, times)
            return self.predict(lane_map, state, times, stop=wall, plans=known)

        prediction = predict(self.lattice.times())
        own = path_from(lane_map, lane, s, goal, points=_POINTS, step=_STEP)
        nearby = around(state, prediction, own, slot, self.nearest)

        maneuvers, since = memory.maneuvers, jnp.where(same, memory.since, -1e3)
        if self.search is not None:
            due = (state.step // config.decision_every) % self.search_every == 0
            maneuvers = self._search(
                lane_map, state, drives, lane, side, wish, own, nearby, wall, predict, maneuvers, due, key
            )
            since = jnp.where(due, now, since)
            wish = jnp.where(now - since < 1e2, maneuvers.side, wish)

        # a lane change goes on while it is safe, until the centre of the body is on the other lane
        side = jnp.where(side.astype(d.dtype) * d < -0.3, 0, side)
        need = lane_map.routes.lanes_to_go[lane, goal]
        # the lane on that side may lead nowhere: the change may be possible only farther ahead
        aside, _ = neighbor(lane_map, lane, jnp.sign(need))
        need = jnp.where(self._leads_on(lane_map, state, slot, lane, aside, s), need, 0)
        room = lane_map.routes.change_distance[lane, goal] - s
        press = urgency(need, room, state.v[slot], state.driver.lane_change_time[slot])
        wish = jnp.where((wish * need < 0) & (press > 0.3), 0, wish)
        look = jnp.where(side != 0, side, jnp.where(wish != 0, wish, jnp.sign(need)))
        other_lane, other_s, other_d, there = beside(lane_map, lane, s, d, look)
        target = path_from(lane_map, other_lane, other_s, goal, points=_POINTS, step=_STEP)
        traffic = around(state, prediction, target, slot, self.nearest)
        begins = (side == 0) & (jnp.abs(d) < 0.6) & self._may_change(lane_map, state, slot, lane, look)
        # changes to the left and to the right begin in turns, as in the traffic model
        begins &= look == jnp.where((state.step // config.decision_every) % 2 == 0, 1, -1)
        most = jnp.where(need * look > 0, 2.5 + 2.5 * press, 2.0)
        fits = self._fits(state, slot, traffic, most, 0.3 - 0.2 * press)
        begins &= ((wish == look) | (need * look > 0)) & fits | ((rule == look) & (need * rule > 0))
        # optional changes do not begin shortly before a junction, where the vehicle would stop between lanes
        v = jnp.maximum(state.v, creep_speed(state))[slot]
        inside = lane_map.is_connector[own.lane]  # along the path: roads may be in pieces before it
        junction = jnp.where(inside.any(-1), _STEP * jnp.argmax(inside, -1).astype(s.dtype), jnp.inf)
        near = junction <= v * state.driver.lane_change_time[slot] + _BEFORE_JUNCTION
        begins &= ~near | ((need * look > 0) & (room <= junction + _STEP))
        goes_on = (side != 0) & self._fits(state, slot, traffic, _HARD, 0.0)
        side = jnp.where(there & (begins | goes_on), look, 0)
        changes = side != 0

        def choose(a: Array, b: Array) -> Array:
            return jnp.where(changes.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

        path, found = jax.tree.map(choose, (target, traffic), (own, nearby))
        d = jnp.where(changes, other_d, d)
        merge = Merge(
            traffic.s, traffic.v, state.shape.length[traffic.slot], traffic.there & traffic.on_path,
            jnp.where(there & (look * need > 0) & ~changes, jnp.clip(press, 0.2, 1.0), 0.0),
        )  # fmt: skip
        wanted = self._speed(maneuvers, now - since)
        task = self._task(state, decision, path, slot, d, found, prediction, wall, merge, wanted)
        chosen = plan(self.lattice, self.traffic.model, task)
        trajectory = Trajectory(
            x=chosen.x, y=chosen.y, heading=chosen.heading, v=chosen.v,
            t0=now, dt=self.lattice.dt,
        )  # fmt: skip
        memory = Memory(slot, side, maneuvers, since, None if memory.plan is None else trajectory)
        return Command(trajectory=trajectory, signal=side), memory

    def _search(
        self, lane_map: LaneMap, state: State, drives: Array, lane: Array, side: Array, wish: Array,
        own: ReferencePath, nearby: Around, wall: Array, predict: Callable[[Array], Prediction],
        maneuvers: Maneuvers, due: Array, key: jax.Array,
    ) -> Maneuvers:  # fmt: skip
        """Maneuvers of the search if it is `due`; otherwise the previous ones.

        A loop of at most one pass: if no world of a batch is due, it costs nothing.
        """
        settings, slot = self.settings, state.egos.slot
        if settings is None:
            return maneuvers

        def look(carry: tuple[Array, Maneuvers]) -> tuple[Array, Maneuvers]:
            times = settings.dt * jnp.arange(settings.steps + 1, dtype=jnp.float32)
            prediction = predict(times)
            counts = neighbours(nearby.gap, nearby.d, nearby.there)
            members = grouped(
                lane_map, state, slot, drives, lane, jnp.where(side != 0, side, wish),
                prediction.x[:, 0], prediction.y[:, 0], nearby.slot, counts,
            )  # fmt: skip
            bodies, _ = body_place(lane_map, state)
            sides = at_slots(state.egos, side, state.side)
            new = decide_maneuvers(
                settings, lane_map, state, slot, members, own, nearby.slot, prediction, bodies, sides, wall,
                shifted(carry[1].action), key,
            )  # fmt: skip
            return jnp.zeros_like(carry[0]), new

        return lax.while_loop(lambda carry: carry[0], look, (due, maneuvers))[1]

    def _may_change(
        self, lane_map: LaneMap, state: State, slot: Array, lane: Array, side: Int[Array, " V"]
    ) -> Bool[Array, " V"]:
        """Whether lane marks and vehicle class allow the lane change, outside junctions."""
        other, allowed = neighbor(lane_map, lane, side)
        usable = ((lane_map.access[other] >> state.shape.vehicle_class[slot]) & 1) == 1
        allowed &= usable & ~lane_map.is_connector[lane] & (state.lane[slot] == lane)
        return allowed & self._leads_on(lane_map, state, slot, lane, other, state.s[slot])

    def _leads_on(
        self, lane_map: LaneMap, state: State, slot: Array, lane: Array, other: Array, s: Array
    ) -> Bool[Array, " V"]:
        """Whether the goal can be reached from the lane beside.

        Without a detour, and with time for all lane changes that follow.
        """
        routes, goal = lane_map.routes, state.goal[slot]
        there = (other != NO_LANE) & routes.reachable[other, goal]
        there &= routes.distance[other, goal] <= routes.distance[lane, goal] + 1.0
        count = jnp.abs(routes.lanes_to_go[other, goal]).astype(s.dtype)
        time = 3 * state.driver.lane_change_time[slot] * (count + 1)
        back = routes.change_distance[other, goal] - s > jnp.maximum(state.v, creep_speed(state))[slot] * time
        fewer = count < jnp.abs(routes.lanes_to_go[lane, goal]).astype(s.dtype)
        return there & ((count == 0) | fewer | back)

    def _speed(self, maneuvers: Maneuvers, late: Float[Array, " V"]) -> Float[Array, "V H"]:
        """Speeds of the search at the moments of the plan, m/s."""
        if self.search is None:
            return jnp.full((late.shape[0], self.lattice.moments), _ANY_SPEED)
        at = (late[:, None] + self.lattice.times()[None]) / self.search.dt
        k, u = interval(at, maneuvers.v.shape[1] - 1)
        low, high = jnp.take_along_axis(maneuvers.v, k, 1), jnp.take_along_axis(maneuvers.v, k + 1, 1)
        v = low + jnp.clip(u, 0, 1) * (high - low)
        return jnp.where(late[:, None] < 1e2, v, _ANY_SPEED)

    def _fits(
        self,
        state: State,
        slot: Int[Array, " V"],
        found: Around,
        most: Float[Array, " V"] | float,
        headway: Float[Array, " V"] | float = 0.3,
    ) -> Bool[Array, " V"]:
        """Whether the path has a gap: no vehicle has to brake harder than `most` m/s^2."""
        most, headway = (
            jnp.broadcast_to(jnp.asarray(x, found.v.dtype), slot.shape)[:, None] for x in (most, headway)
        )
        v = state.v[slot][:, None]
        ahead, other = found.s > 0, jnp.maximum(found.v, 0)
        need = room_needed(jnp.where(ahead, v, other), jnp.where(ahead, other, v), most, headway)
        return ~(found.on_path & (found.gap < need)).any(-1)

    def _task(
        self,
        state: State,
        decision: Decision,
        path: ReferencePath,
        slot: Array,
        d: Array,
        found: Around,
        prediction: Prediction,
        wall: Array,
        merge: Merge,
        wanted: Array,
    ) -> Task:
        driver = jax.tree.map(lambda x: x[slot], state.driver)
        egos = jnp.arange(slot.shape[0]) < slot.shape[0] - self.others
        driver = replace(
            driver,
            speed_factor=jnp.where(
                egos, jnp.minimum(driver.speed_factor, self.obedience), driver.speed_factor
            ),
        )
        index, gap = decision.obstacles.other[slot, :-1], decision.obstacles.gap[slot, :-1]
        ahead = found.there & found.on_path & (found.s > 0)
        nearest = jnp.argmin(jnp.where(ahead, found.gap, NO_GAP), -1)[:, None]
        first = jnp.take_along_axis(jnp.where(ahead, found.gap, NO_GAP), nearest, 1)
        lead_gap = jnp.concatenate([jnp.where(index >= 0, gap, NO_GAP), first], -1)
        lead_v = jnp.concatenate(
            [state.v[index], jnp.take_along_axis(jnp.maximum(found.v, 0), nearest, 1)], -1
        )
        leader = jnp.concatenate([index, jnp.take_along_axis(found.slot, nearest, 1)], -1)
        follows = found.on_path & (found.s <= 0)
        return Task(
            path=path,
            start=motion_on(path, state, slot, d),
            length=state.shape.length[slot],
            width=state.shape.width[slot],
            driver=driver,
            lead_gap=lead_gap,
            lead_v=lead_v,
            lead_a=state.a[leader],
            wall=wall[slot],
            other=Others(
                prediction.x[found.slot], prediction.y[found.slot], prediction.heading[found.slot],
                state.shape.length[found.slot], state.shape.width[found.slot], found.there & ~follows,
            ),
            merge=merge,
            wanted=wanted,
            steering=jnp.full_like(d, 0.5),
            wheelbase=state.shape.wheelbase[slot],
        )  # fmt: skip


_POINTS, _STEP = 80, 2.0  # points of a path, and m between them
_BEFORE_JUNCTION = 30.0  # m
_ANY_SPEED = 1e3  # m/s, before the first search
_FAR = 1e9  # m, before the first plan
_HARD = 4.0  # m/s^2: a lane change that asks harder braking of any vehicle is given up
