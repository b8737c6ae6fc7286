"""Joint decisions of a group of vehicles: decoupled UCT over meta-actions.

In every node each of the `G` vehicles keeps statistics of its own five meta-actions, and chooses by UCB1 on
its own utility. The joint action leads to the next node (decoupled UCT: Finnsson and Bjornsson, AAAI 2008;
Tak, Lanctot, Winands, CIG 2014). A utility mixes the vehicle's own reward with that of the rest of the group
by its social value orientation, u_i = cos(svo_i) r_i + sin(svo_i) mean r_j (Schwarting et al., PNAS 2019).

A simulation always runs from the root to the horizon: by chosen actions in the tree, then by the default
policy. A node therefore holds statistics and no state, and all simulations of a batch take the same number of
steps. Rows are read by one gather and written by arithmetic over the whole table, which is small: on a CPU
scatters are loops. `computed_once` stands where values of all pairs are used several times, which halves the
time.

Arrays are those of one group, `[G]`, `[G, K]`, ..., and may have a batch as their last axis: `vmap` of
`search` puts its axis there, because loops over the last axis become vector code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.traffic.car_following import NO_GAP, ballistic
from limsim_jax.traffic.ego import Meta
from limsim_jax.types import Driver
from limsim_jax.xla import batch_last, computed_once

ACTIONS = 5
"""KEEP, ACCELERATE, DECELERATE, LEFT, RIGHT: those of `traffic.ego.Meta` but STOP."""


class Scene(NamedTuple):
    """`G` vehicles and `K` others on a corridor of `L` lanes.

    Lanes count from 0 at the right; `s` runs along the corridor, and `y` to the left from the centre of lane
    0. Lights and right of way enter as `stop`. The others are given at the `H = decisions * substeps + 1`
    moments of the search, from now on. A vehicle that is not on the corridor has a `y` far away.
    """

    active: Bool[Array, " G"]
    s: Float[Array, " G"]  # m, front bumper
    v: Float[Array, " G"]  # m/s
    a: Float[Array, " G"]  # m/s^2, now
    lane: Int[Array, " G"]
    d: Float[Array, " G"]  # m, offset from the centre of that lane
    aim: Int[Array, " G"]  # target lane of a lane change, or `lane`
    length: Float[Array, " G"]  # m
    width: Float[Array, " G"]  # m
    v0: Float[Array, " G"]  # m/s, desired speed
    driver: Driver  # [G]
    first_lane: Int[Array, " G"]  # usable lanes: first_lane .. last_lane
    last_lane: Int[Array, " G"]
    wanted_first: Int[Array, " G"]  # lanes that lead along its route
    wanted_last: Int[Array, " G"]
    to_go: Float[Array, " G"]  # m until it must be in one of them
    stop: Float[Array, "G L"]  # m, position `s` before which it must stop if in that lane, NO_GAP if nowhere
    other_active: Bool[Array, " K"]
    other_s: Float[Array, "K H"]  # m, front bumper
    other_y: Float[Array, "K H"]  # m
    other_v: Float[Array, "K H"]  # m/s
    other_length: Float[Array, " K"]
    other_width: Float[Array, " K"]
    lane_width: Float[Array, ""]  # m


@dataclass(frozen=True)
class Settings:
    """Size of the search and weights of the reward.

    Static: other values are another program.
    """

    simulations: int = 50
    decisions: int = 5
    substeps: int = 3  # per decision
    dt: float = 0.5  # s, sub-step
    exploration: float = 0.7  # of UCB1, on utilities that are scaled to 0..1
    lateral_speed: float = 1.17  # m/s of a lane change
    # weights of the reward, which is 1 for comfortable driving at the desired speed
    progress: float = 0.7
    lane: float = 0.3  # per lane away from the wanted lanes
    comfort: float = 0.3  # at 4 m/s^2, grows as the square
    jerk: float = 0.05  # at a change of 4 m/s^2 within a sub-step, grows as the square
    change: float = 0.04  # per lane change
    push: float = 0.3  # while others must brake with 4 m/s^2 for a vehicle that cut in
    crash: float = 1.5  # once

    @property
    def steps(self) -> int:
        """Sub-steps from now to the horizon."""
        return self.decisions * self.substeps


class Plan(NamedTuple):
    """What the search found: the most visited actions, continued by the default policy."""

    action: Int[Array, "G D"]  # `Meta`, per decision
    value: Float[Array, " G"]  # utility of the plan
    reward: Float[Array, " G"]  # own reward of the plan, about 0..1
    crashed: Bool[Array, " G"]  # the plan ends in a collision, or past a stop
    visits: Float[Array, "G 5"]  # at the root
    s: Float[Array, "G H"]  # m, at the moments of the predictions
    y: Float[Array, "G H"]  # m from the centre of lane 0
    v: Float[Array, "G H"]  # m/s
    aim: Float[Array, "G H"]  # lane


def no_plan(vehicles: int, decisions: int) -> Int[Array, "G D"]:
    """`previous` of a first search."""
    return jnp.full((vehicles, decisions), Meta.ACCELERATE, jnp.int32)


def shifted(action: Int[Array, "G D"], decisions: int = 1) -> Int[Array, "G D"]:
    """`previous` for a search that follows after `decisions` decisions."""
    rest = jnp.full_like(action[:, :decisions], Meta.ACCELERATE)
    return jnp.concatenate([action[:, decisions:], rest], 1)


def search(settings: Settings, scene: Scene, previous: Int[Array, "G D"], key: Key[Array, ""]) -> Plan:
    """Decide for the vehicles of one group.

    Args:
      settings: static.
      scene: the group and its surroundings; `vmap` over groups.
      previous: actions to try first, of the search before (`shifted`), or `no_plan`.
      key: orders the untried actions. The same key gives the same plan.
    """
    noise = jax.random.uniform(key, (scene.s.shape[0], ACTIONS), scene.s.dtype)
    return batch_last(lambda *of: _search(settings, *of))(_in_floats(scene), previous, noise)


def play(settings: Settings, scene: Scene, actions: Int[Array, "G D"]) -> Plan:
    """The plan in which the vehicles take these actions (-1: the default policy); no `visits`."""
    return batch_last(lambda *of: _play(settings, *of))(_in_floats(scene), actions)


def _in_floats(scene: Scene) -> Scene:
    """The scene with lanes as floats: positions from here on."""
    names = "lane", "aim", "first_lane", "last_lane", "wanted_first", "wanted_last"
    lanes = {name: getattr(scene, name).astype(scene.s.dtype) for name in names}
    return scene._replace(**lanes, lane_width=scene.lane_width[None])


# ---- what happens within a decision


class _Motion(NamedTuple):
    """State of the group; `[G]`."""

    s: Array
    v: Array
    a: Array
    y: Array
    aim: Array  # lane, as a float


class _Score(NamedTuple):
    """Reward so far; `[G]`."""

    reward: Array
    alive: Array  # has not collided


class _Pairs(NamedTuple):
    """Constants of each vehicle and each of `M` vehicles: the group, or the others."""

    present: Array  # [G, M] or [1, M]
    length: Array  # [M]
    wide: Array  # [G, M] m, both half widths
    behind: float  # share of the loss if m hits the rear of i


class _Bodies(NamedTuple):
    """`[M]`."""

    s: Array
    y: Array
    v: Array


_FAR = 4 * NO_GAP
_MARGIN_S, _MARGIN_Y = 0.5, 0.15  # m, added to lengths and widths in collision checks
_LEAST_GAP = 0.5  # m; car following is evaluated at this gap below it
_MOVED = 0.5  # m to the side, beyond which a vehicle has moved over
_DECELERATE = 2.0  # m/s^2


def _prepare(scene: Scene) -> tuple[_Pairs, _Pairs]:
    count = scene.s.shape[0]
    itself = jnp.eye(count, dtype=bool)
    itself = itself.reshape(itself.shape + (1,) * (scene.s.ndim - 1))
    group = _Pairs(
        present=scene.active[None] & ~itself,
        length=scene.length,
        wide=(scene.width[:, None] + scene.width[None]) / 2,
        behind=0.5,
    )
    others = _Pairs(
        present=scene.other_active[None],
        length=scene.other_length,
        wide=(scene.width[:, None] + scene.other_width[None]) / 2,
        behind=0.0,
    )
    return group, others


def _most(x: Array) -> Array:
    """Maximum over axis 1."""
    return _fold(jnp.maximum, x)


def _fold(operator: Callable[[Array, Array], Array], x: Array) -> Array:
    """Fold over axis 1 as arithmetic on the axes behind.

    A reduction would not become vector code.
    """
    result = x[:, 0]
    for k in range(1, x.shape[1]):
        result = operator(result, x[:, k])
    return result


def _stop_of(scene: Scene, lane: Array) -> Array:
    """Position of the stop in a lane (a float); `[G]`, m."""
    result = jnp.full_like(scene.s, NO_GAP)
    for k in range(scene.stop.shape[1]):
        result = jnp.where(jnp.abs(lane - k) < 0.5, scene.stop[:, k], result)
    return result


class _Ahead(NamedTuple):
    """The strongest demand of any leader; `[G]`."""

    z: Array  # desired gap over gap
    needed: Array  # m/s^2, required braking


def _look_ahead(pairs: _Pairs, scene: Scene, motion: _Motion, bodies: _Bodies) -> _Ahead:
    driver, v, front = scene.driver, motion.v, motion.s[:, None]
    goal = motion.aim * scene.lane_width
    low, high = jnp.minimum(motion.y, goal)[:, None], jnp.maximum(motion.y, goal)[:, None]
    reach = pairs.wide + _MARGIN_Y
    leads = pairs.present & (bodies.s[None] > front)
    leads &= (bodies.y[None] > low - reach) & (bodies.y[None] < high + reach)
    gap = jnp.where(leads, jnp.maximum(bodies.s[None] - pairs.length[None] - front, _LEAST_GAP), NO_GAP)
    per_gap = computed_once(1 / gap)
    closing = v[:, None] - bodies.v[None]
    wish = driver.s0[:, None] + jnp.maximum(
        (v * driver.T)[:, None] + (v * _half(driver))[:, None] * closing, 0
    )
    return _Ahead(z=_most(wish * per_gap), needed=_most(0.5 * jnp.square(jnp.maximum(closing, 0)) * per_gap))


def _half(driver: Driver) -> Array:
    return 0.5 * lax.rsqrt(driver.a * driver.b)


def _accelerate(
    pairs: tuple[_Pairs, _Pairs],
    scene: Scene,
    motion: _Motion,
    others: _Bodies,
) -> Array:
    """Acceleration by the IDM, m/s^2.

    Behind all leaders up to the target lane, and before stops.

    Braking is limited to `b` plus the braking that avoids a leader which keeps its speed, as in the ACC-IDM:
    short gaps after a cut-in are no emergency.
    """
    driver, v = scene.driver, motion.v
    own = _Bodies(motion.s, motion.y, v)
    near, far = computed_once(
        [_look_ahead(of, scene, motion, bodies) for of, bodies in zip(pairs, (own, others), strict=True)]
    )
    here = jnp.round(motion.y / scene.lane_width)
    stop = jnp.minimum(_stop_of(scene, here), _stop_of(scene, motion.aim))
    stand = jnp.maximum(stop - motion.s, 0.1)
    z = (driver.s0 + v * driver.T + v * v * _half(driver)) / stand
    z = jnp.maximum(z, jnp.maximum(near.z, far.z))
    needed = jnp.maximum(0.5 * v * v / stand, jnp.maximum(near.needed, far.needed))

    free = jnp.exp(driver.delta * jnp.log(jnp.maximum(v / scene.v0, 1e-3)))
    a = jnp.maximum(driver.a * (1 - free - z * z), -needed - driver.b)
    return jnp.clip(a, -driver.b_max, driver.a)


class _Contact(NamedTuple):
    """Effects of a vehicle on its neighbors; `[G]`."""

    loss: Array  # share of a collision
    pushed: Array  # braking that it imposes on others, scaled


def _look_around(pairs: _Pairs, scene: Scene, motion: _Motion, bodies: _Bodies, dt: float) -> _Contact:
    length = scene.length[:, None]
    ahead = bodies.s[None] - motion.s[:, None]  # front to front
    beside = jnp.abs(bodies.y[None] - motion.y[:, None]) < pairs.wide + _MARGIN_Y
    beside &= pairs.present
    overlap = (ahead - pairs.length[None] < _MARGIN_S) & (ahead + length > -_MARGIN_S)

    # a vehicle that has changed lanes, or was behind, bears the whole loss
    start = scene.lane * scene.lane_width + scene.d
    moved = (jnp.abs(motion.y - start) > _MOVED)[:, None]
    before = ahead + (motion.v[:, None] - bodies.v[None]) * dt
    share = jnp.where(moved | (before > 0), 1.0, pairs.behind)
    loss, beside = computed_once((jnp.where(beside & overlap, share, 0), beside))
    if pairs.behind > 0:
        pushed = jnp.zeros_like(motion.s)
    else:
        back = jnp.maximum(-ahead - length, _LEAST_GAP)
        v = motion.v[:, None]
        closing = jnp.maximum(bodies.v[None] - v, 0)
        short = jnp.maximum(1 - back / (1 + 0.5 * v), 0)
        pushed = _most(jnp.where(beside & moved & (ahead < 0), closing**2 / (8 * back) + short, 0))
    return _Contact(loss=_most(loss), pushed=pushed)


def _drive(
    settings: Settings,
    pairs: tuple[_Pairs, _Pairs],
    scene: Scene,
    motion: _Motion,
    score: _Score,
    cap: Array,
    now: _Bodies,
    then: _Bodies,
) -> tuple[_Motion, _Score]:
    """One sub-step: the group moves, the others go from `now` to `then`."""
    dt, width = settings.dt, scene.lane_width
    a = _accelerate(pairs, scene, motion, now)
    a = jnp.where(scene.active, jnp.minimum(a, cap), 0)
    v, distance = ballistic(motion.v, a, dt)
    a = (v - motion.v) / dt
    most = jnp.minimum(settings.lateral_speed, 0.35 * v) * dt
    y = motion.y + jnp.clip(motion.aim * width - motion.y, -most, most)
    after = _Motion(s=motion.s + distance, v=v, a=a, y=y, aim=motion.aim)

    own = _Bodies(after.s, y, v)
    near, far = computed_once(
        [_look_around(of, scene, after, bodies, dt) for of, bodies in zip(pairs, (own, then), strict=True)]
    )
    place = y / width
    passed = after.s > _stop_of(scene, jnp.round(place))
    loss = jnp.maximum(jnp.maximum(near.loss, far.loss), jnp.where(passed, 1.0, 0))
    off = jnp.maximum(jnp.maximum(scene.wanted_first - place, place - scene.wanted_last), 0)
    room = off * (v / settings.lateral_speed * width + 12) + 40
    left = scene.to_go - (after.s - scene.s)
    urgency = jnp.clip(2 - left / room, 0.2, 1)

    earned = settings.progress * jnp.clip(v / scene.v0, 0, 1) + (1 - settings.progress)
    earned -= settings.lane * off * urgency
    earned -= settings.comfort * jnp.square(a / 4) + settings.jerk * jnp.square((a - motion.a) / 4)
    earned -= settings.push * jnp.minimum(far.pushed, 1)
    reward = score.reward + score.alive * (earned / settings.steps - settings.crash * loss)
    alive = jnp.where(loss > 0, 0, score.alive)
    return after, _Score(reward=reward, alive=alive)


def _allowed(scene: Scene, motion: _Motion) -> tuple[Array, Array]:
    """Whether lane changes to the left and right may begin.

    During a lane change only its reversal is allowed.
    """
    offset = motion.aim * scene.lane_width - motion.y
    left = (motion.aim + 1 <= scene.last_lane) & (offset < 0.5 * scene.lane_width)
    right = (motion.aim - 1 >= scene.first_lane) & (offset > -0.5 * scene.lane_width)
    return left, right


def _decide(
    settings: Settings, scene: Scene, motion: _Motion, score: _Score, action: Array
) -> tuple[_Motion, _Score, Array]:
    """Start of a decision: the new target lane, its cost, and the highest acceleration."""
    left, right = _allowed(scene, motion)
    step = jnp.where((action == Meta.LEFT) & left, 1.0, jnp.where((action == Meta.RIGHT) & right, -1.0, 0.0))
    reward = score.reward - score.alive * settings.change * jnp.abs(step)
    cap = jnp.where(action == Meta.KEEP, 0.0, jnp.where(action == Meta.DECELERATE, -_DECELERATE, NO_GAP))
    return motion._replace(aim=motion.aim + step), score._replace(reward=reward), cap


def _start(scene: Scene) -> tuple[_Motion, _Score]:
    y = scene.lane * scene.lane_width + scene.d
    motion = _Motion(s=scene.s, v=scene.v, a=scene.a, y=y, aim=scene.aim)
    return motion, _Score(reward=jnp.zeros_like(y), alive=jnp.ones_like(y))


def _moments(settings: Settings, scene: Scene) -> _Bodies:
    """Predictions by decision and moment, `[D, substeps + 1, K]`."""

    def windows(x: Array) -> Array:
        x = jnp.moveaxis(x, 1, 0)
        n = settings.substeps
        return jnp.stack([x[k * n : (k + 1) * n + 1] for k in range(settings.decisions)])

    return _Bodies(windows(scene.other_s), windows(scene.other_y), windows(scene.other_v))


def _decision(
    settings: Settings,
    pairs: tuple[_Pairs, _Pairs],
    scene: Scene,
    motion: _Motion,
    score: _Score,
    action: Array,
    others: _Bodies,
) -> tuple[_Motion, _Score, list[_Motion]]:
    """Drive on to the next decision."""
    motion, score, cap = _decide(settings, scene, motion, score, action)
    passed = []
    for k in range(settings.substeps):
        now, then = (_Bodies(*(x[n] for x in others)) for n in (k, k + 1))
        motion, score = _drive(settings, pairs, scene, motion, score, cap, now, then)
        passed.append(motion)
    return motion, score, passed


def _utility(scene: Scene, reward: Array) -> Array:
    """Own reward mixed with the group's by the social value orientation; `[G]`."""
    mine = jnp.where(scene.active, reward, 0)
    rest = jnp.where(scene.active, 1.0, 0.0).sum(0)[None] - 1
    mean = (mine.sum(0)[None] - mine) / jnp.maximum(rest, 1)
    svo = scene.driver.svo
    return jnp.where(rest > 0, jnp.cos(svo) * reward + jnp.sin(svo) * mean, reward)


def _play(settings: Settings, scene: Scene, actions: Array) -> Plan:
    pairs = _prepare(scene)
    motion, score = first, _ = _start(scene)
    xs = _moments(settings, scene), jnp.moveaxis(actions, 1, 0)

    def decision(
        carry: tuple[_Motion, _Score], x: tuple[_Bodies, Array]
    ) -> tuple[tuple[_Motion, _Score], _Motion]:
        others, action = x
        motion, score, passed = _decision(settings, pairs, scene, *carry, action, others)
        return (motion, score), jax.tree.map(lambda *of: jnp.stack(of), *passed)

    (motion, score), passed = lax.scan(decision, (motion, score), xs)

    def over_time(start: Array, later: Array) -> Array:
        rows = jnp.concatenate([start[None], later.reshape(-1, *start.shape)])
        return jnp.moveaxis(rows, 0, 1)

    path = jax.tree.map(over_time, first, passed)
    return Plan(
        action=jnp.where(actions < 0, Meta.ACCELERATE, actions),
        value=_utility(scene, score.reward),
        reward=score.reward,
        crashed=(score.alive == 0) & scene.active,
        visits=jnp.zeros((scene.s.shape[0], ACTIONS, *scene.s.shape[1:]), scene.s.dtype),
        s=path.s,
        y=path.y,
        v=path.v,
        aim=path.aim,
    )


# ---- the tree


class _Tree(NamedTuple):
    """Nodes 0..simulations; node 0 is the root, and simulation n may add node n + 1."""

    link: Array  # [nodes] parent times ACTIONS^G plus joint action, -1 where there is no node
    visits: Array  # [nodes, G, ACTIONS]
    total: Array  # [nodes, G, ACTIONS], sum of utilities
    low: Array  # [G], least utility seen
    high: Array  # [G]
    tried: Array  # [simulations, D, G] actions, -1 for the default policy
    worth: Array  # [simulations]


def _row(table: Array, row: Array) -> Array:
    """`table[row]` for a table whose last axis is a batch."""
    rest = table.shape[1:]
    size = table[0].size
    row = row.reshape((1,) * (len(rest) - row.ndim) + row.shape)
    place = row * size + jnp.arange(size, dtype=row.dtype).reshape(rest)
    return table.reshape(-1).at[place].get(mode="promise_in_bounds")


def _child(tree: _Tree, link: Array) -> Array:
    """Node at the end of a link, -1 for none."""
    nodes = jnp.arange(tree.link.shape[0], dtype=jnp.int32)
    nodes = nodes.reshape((-1,) + (1,) * link.ndim)
    return jnp.max(jnp.where(tree.link == link[None], nodes, -1), 0)


def _code(action: Array) -> Array:
    code = action[0]
    for k in range(1, action.shape[0]):
        code = code * ACTIONS + action[k]
    return code


def _best(score: Array) -> Array:
    """Index of the maximum over axis 1; `[G]`."""
    best, index = score[:, 0], jnp.zeros(score[:, 0].shape, jnp.int32)
    for k in range(1, score.shape[1]):
        index = jnp.where(score[:, k] > best, k, index)
        best = jnp.maximum(best, score[:, k])
    return index


def _ucb(settings: Settings, tree: _Tree, node: Array, allowed: Array, order: Array) -> Array:
    """Action of each vehicle by UCB1 on utilities scaled to 0..1; `[G]`."""
    row = jnp.maximum(node, 0)
    visits, total = _row(tree.visits, row), _row(tree.total, row)
    count = jnp.maximum(visits, 1)
    known = total / count - tree.low[:, None]
    known = known / jnp.maximum(tree.high - tree.low, 1e-3)[:, None]
    tries = _fold(jnp.add, visits)[:, None]
    score = known + settings.exploration * jnp.sqrt(jnp.log(jnp.maximum(tries, 1)) / count)
    score = jnp.where(visits > 0, score + 1e-4 * order, 100 + order)
    return _best(jnp.where(allowed, score, -NO_GAP))


def _options(scene: Scene, motion: _Motion) -> Array:
    """Possible actions, `[G, ACTIONS]`; KEEP alone for an empty slot."""
    left, right = _allowed(scene, motion)
    always = jnp.ones_like(scene.active)
    return jnp.stack([always, scene.active, scene.active, left & scene.active, right & scene.active], 1)


def _search(settings: Settings, scene: Scene, previous: Array, noise: Array) -> Plan:
    count, depth = scene.s.shape[0], settings.decisions
    batch = scene.s.shape[1:]
    pairs, others = _prepare(scene), _moments(settings, scene)
    plan = jnp.moveaxis(previous, 1, 0)
    depths = jnp.arange(depth)
    joint: int = ACTIONS**count
    # multiples of an irrational number modulo 1 are spread evenly: an order for each simulation
    stride = 0.38196601 + 0.1 * noise

    def simulate(n: Array, tree: _Tree) -> _Tree:
        def decision(
            carry: tuple[_Motion, _Score, Array, Array], x: tuple[_Bodies, Array, Array]
        ) -> tuple[tuple[_Motion, _Score, Array, Array], tuple[Array, Array]]:
            motion, score, node, new = carry
            others, k, planned = x
            order = noise + stride * (n + 3 * k).astype(noise.dtype)
            order = order - jnp.floor(order)
            options = _options(scene, motion)
            chosen = _ucb(settings, tree, node, options, order)
            planned = jnp.where((n < depth) & scene.active, planned, -1)
            action = computed_once(jnp.where(planned >= 0, planned, chosen))
            inside = node >= 0
            link = node * joint + _code(action)
            child = jnp.where(inside & (k < depth - 1), _child(tree, link), -1)
            new = jnp.where(inside & (child < 0) & (k < depth - 1), link, new)
            action = jnp.where(inside[None], action, -1)
            motion, score, _ = _decision(settings, pairs, scene, motion, score, action, others)
            return (motion, score, child, new), (node, action)

        root = jnp.zeros(batch, jnp.int32)
        start = (*_start(scene), root, root - 1)
        (_, score, _, new), (path, taken) = lax.scan(decision, start, (others, depths, plan))
        utility = _utility(scene, score.reward)

        nodes = jnp.arange(settings.simulations + 1, dtype=jnp.int32).reshape((-1, 1, 1) + (1,) * len(batch))
        arms = jnp.arange(ACTIONS, dtype=jnp.int32).reshape((1, 1, -1) + (1,) * len(batch))
        hits = jnp.zeros_like(tree.visits)
        for k in range(depth):
            hit = (nodes == path[k][None, None, None]) & (arms == taken[k][None, :, None])
            hits += jnp.where(hit, 1.0, 0.0)
        return _Tree(
            link=lax.dynamic_update_index_in_dim(tree.link, new, n + 1, 0),
            visits=tree.visits + hits,
            total=tree.total + hits * utility[None, :, None],
            low=jnp.minimum(tree.low, utility),
            high=jnp.maximum(tree.high, utility),
            tried=lax.dynamic_update_index_in_dim(tree.tried, taken, n, 0),
            worth=lax.dynamic_update_index_in_dim(tree.worth, _worth(scene, score, utility), n, 0),
        )

    shape = (settings.simulations + 1, count, ACTIONS, *batch)
    empty = _Tree(
        link=jnp.full((settings.simulations + 1, *batch), -1, jnp.int32),
        visits=jnp.zeros(shape, scene.s.dtype),
        total=jnp.zeros(shape, scene.s.dtype),
        low=jnp.full(scene.s.shape, NO_GAP, scene.s.dtype),
        high=jnp.full(scene.s.shape, -NO_GAP, scene.s.dtype),
        tried=jnp.zeros((settings.simulations, depth, count, *batch), jnp.int32),
        worth=jnp.zeros((settings.simulations, *batch), scene.s.dtype),
    )
    tree: _Tree = lax.fori_loop(0, settings.simulations, simulate, empty)

    # the preferred first actions of each vehicle, among the joint plans that were simulated
    favour = tree.worth
    for k in range(ACTIONS):
        share = tree.visits[0, :, k] / settings.simulations
        favour += jnp.sum(jnp.where(tree.tried[:, 0] == k, share[None], 0), 1)
    best = jnp.argmax(favour, 0).astype(jnp.int32)
    actions = jnp.moveaxis(_row(tree.tried, best), 0, 1)
    return _play(settings, scene, actions)._replace(visits=tree.visits[0])


_SEEN = 1.0  # weight of a plan's utilities against the share of visits of its first actions


def _worth(scene: Scene, score: _Score, utility: Array) -> Array:
    """Value of a simulation next to the visits of its first actions.

    Plans without collisions come first. A vehicle alone in its group takes the best plan that was simulated:
    no other vehicle's choice can change its value.
    """
    crashed = jnp.where((score.alive == 0) & scene.active, 1.0, 0.0).sum(0)
    alone = scene.active.sum(0) == 1
    return jnp.where(alone, 1e3, _SEEN) * jnp.where(scene.active, utility, 0).sum(0) - crashed


__all__ = [
    "ACTIONS",
    "Plan",
    "Scene",
    "Settings",
    "no_plan",
    "play",
    "search",
    "shifted",
]
