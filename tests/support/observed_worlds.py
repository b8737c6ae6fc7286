"""Random worlds as metrics see them, on a crossing with lights, and their records.

Worlds are drawn at random, also such as hardly occur. Some connectors have stop signs and some lanes are
lifted to bridges.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from traffic_worlds import bundled, drivers, shapes

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, elevation, pose, width
from limsim_jax.metrics.observer import EvaluateEgo, StepRecord
from limsim_jax.metrics.safety import NO_GAP
from limsim_jax.traffic.collision import off_road
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.engine import Tick
from limsim_jax.traffic.motion import Decision, boxes
from limsim_jax.traffic.neighbors import Obstacles, other_lane
from limsim_jax.traffic.state import start_state
from limsim_jax.types import Config, Egos, Shape, State, Status

CONFIG = Config(dt=0.1)
N, WORLDS, STORIES, STEPS = 14, 400, 16, 8


@functools.cache
def crossing() -> LaneMap:
    """The bundled crossing with lights, where some connectors have stop signs and some lanes are bridges."""
    lane_map = bundled("intersection")[1]
    rng = np.random.default_rng(1)
    table, rows = lane_map.conflicts, lane_map.conflicts.lane.shape[0]
    signs = rng.random(rows) < 0.5
    signs[-1] = False  # the null row
    early = np.asarray(table.foe >= 0) & (rng.random(table.foe.shape) < 0.3)
    height = np.array(lane_map.height)
    for lane in np.nonzero(np.asarray(lane_map.valid) & (rng.random(lane_map.length.shape[0]) < 0.15))[0]:
        first = int(lane_map.first[lane])
        height[first : first + int(lane_map.count[lane]), 0] += 8.0
    stop_s = lane_map.length - jnp.asarray(rng.uniform(0, 3, lane_map.length.shape), jnp.float32)
    return dataclasses.replace(
        lane_map,
        stop_s=jnp.where(lane_map.valid, stop_s, lane_map.stop_s),
        height=jnp.asarray(height),
        conflicts=dataclasses.replace(
            table,
            must_stop=jnp.asarray(signs),
            s_in=jnp.where(early, 0.2, table.s_in),
            f_out=jnp.where(early, 400.0, table.f_out),
        ),
    )


@functools.cache
def host() -> Any:
    """The same map in NumPy."""
    return jax.tree.map(np.asarray, crossing())


def f32(x) -> Any:
    return np.asarray(x, np.float32)


def i32(x) -> Any:
    return np.asarray(x, np.int32)


def around(rng, lane: int, goals) -> int:
    """A lane that has to do with this one."""
    m = host()
    table = m.conflicts
    kind = rng.integers(8)
    if kind == 0 and table.connector[lane] >= 0:
        foes = table.foe[table.connector[lane]]
        foes = foes[foes >= 0]
        return int(table.lane[rng.choice(foes)]) if foes.size else lane
    if kind == 1:
        return int(rng.choice(m.predecessors[lane]))
    if kind == 2:
        return int(rng.choice(m.successors[lane]))
    if kind == 3:
        following = int(m.routes.next_lane[lane, rng.choice(goals)])
        row = table.connector[following] if following != NO_LANE else -1
        foes = table.foe[row] if row >= 0 else np.array([-1])
        foes = foes[foes >= 0]
        return int(table.lane[rng.choice(foes)]) if foes.size else following
    if kind == 4:
        return int(m.left[m.left[lane]]) if rng.random() < 0.5 else int(m.right[m.right[lane]])
    return [lane, int(m.left[lane]), int(m.right[lane])][rng.integers(3)]


@functools.cache
def blank() -> State:
    """No vehicle anywhere."""
    nothing = np.zeros(N, np.float32)
    state = start_state(
        crossing(),
        drivers(N),
        shapes(N),
        lane=i32(np.full(N, NO_LANE)),
        s=f32(nothing),
        v=f32(nothing),
        goal=i32(nothing),
    )
    return jax.tree.map(np.asarray, state)


def random_state(rng, slot: int, lane: int | None = None) -> State:
    """Vehicles anywhere near the ego in `slot`, in any condition."""
    m = host()
    lanes = np.nonzero(m.valid)[0]
    goals = np.arange(m.routes.next_lane.shape[1])
    if lane is None:
        ends, inside = lanes[m.routes.is_goal[lanes].any(1)], lanes[m.is_connector[lanes]]
        lane = int(rng.choice([ends, inside, lanes, lanes][rng.integers(4)]))
    on = np.array([around(rng, lane, goals) for _ in range(N)])
    on[slot] = lane if rng.random() < 0.93 else NO_LANE
    length = m.length[on]
    places = [rng.uniform(0, 1.5, N), rng.uniform(-2, length + 2), length - rng.uniform(-8, 20, N)]
    s = np.where(rng.random(N) < 0.3, places[0], np.where(rng.random(N) < 0.5, places[1], places[2]))
    before = np.where(rng.random(N) < 0.7, m.predecessors[on, 0], NO_LANE)
    active = rng.random(N) < 0.85
    # what matters most at an ego: it has just entered a connector, or is at the end of its goal
    if m.is_connector[on[slot]] and rng.random() < 0.6:
        foe = m.conflicts.lane[m.conflicts.foe[m.conflicts.connector[on[slot]], 0]]
        s[slot] = rng.choice([0.0, 1.5]) * rng.random()
        before[slot] = rng.choice([m.predecessors[on[slot], 0], foe, NO_LANE], p=[0.6, 0.3, 0.1])
    elif m.routes.is_goal[on[slot]].any() and rng.random() < 0.5:
        s[slot] = length[slot] + rng.uniform(-1, 2)
    goal = rng.choice(goals, N)
    ways = [g for g in goals if on[slot] != NO_LANE and m.routes.reachable[on[slot], g]]
    if ways and rng.random() < 0.9:
        goal[slot] = rng.choice(ways)
    events = [bit for bit in Status if bit is not Status.SCRIPTED]
    status = sum(int(bit) * rng.integers(0, 2, N) for bit in events)
    shape = Shape(
        length=f32(rng.uniform(2, 12, N)),
        width=f32(rng.uniform(1.0, 2.6, N)),
        wheelbase=f32(rng.uniform(1.5, 6, N)),
        vehicle_class=i32(np.zeros(N)),
    )
    driver = dataclasses.replace(
        blank().driver, b_max=f32(rng.uniform(5, 9, N)), v_max=f32(rng.uniform(10, 60, N))
    )
    second = (slot + 1 + rng.integers(N - 1)) % N
    phases = (m.signals.duration > 0).sum(1)
    return dataclasses.replace(
        blank(),
        driver=driver,
        shape=shape,
        active=active,
        lane=i32(on),
        previous=i32(before),
        s=f32(s),
        v=f32(rng.choice([0.0, 1, 12], N) * rng.random(N)),
        goal=i32(goal),
        d=f32(rng.uniform(-2, 2, N)),
        a=f32(rng.uniform(-4, 2, N)),
        side=i32(rng.choice([-1, 0, 0, 1], N)),
        crossed=rng.random(N) < 0.5,
        progress=f32(rng.random(N)),
        shift=f32(rng.uniform(-3, 3, N)),
        stopped=rng.random(N) < 0.3,
        entered=f32(rng.uniform(0, 20, N)),
        status=i32(status),
        lights=dataclasses.replace(blank().lights, phase=i32(rng.integers(0, np.maximum(phases, 1)))),
        egos=Egos(
            slot=i32([slot, second]),
            free=rng.random(2) < 0.3,
            **{name: f32(rng.uniform(-3, 3, 2)) for name in ("x", "y", "heading", "steering", "a")},
        ),
    )


_boxes = jax.jit(boxes)


def random_tick(rng, slot: int, lane: int | None = None) -> Tick:
    """A physics step that may have led to a random state, with leaders and ways to come."""
    state = random_state(rng, slot, lane)
    other = rng.integers(-1, N, (N, 3))
    gap = np.where(other < 0, NO_GAP, rng.uniform(-3, 40, (N, 3)))
    lanes = np.asarray(state.lane)
    way = np.stack([lanes, host().routes.next_lane[lanes, np.asarray(state.goal)]], -1)
    way[lanes == NO_LANE] = NO_LANE
    decision = Decision(
        obstacles=Obstacles(i32(other), f32(gap)),
        v0=f32(rng.uniform(3, 20, N)), v_ahead=f32(rng.uniform(3, 20, N)), ahead=f32(rng.uniform(0, 99, N)),
        courtesy=Obstacles(i32(np.full((N, 2), -1)), f32(np.full((N, 2), NO_GAP))),
        lanes=i32(way),
    )  # fmt: skip
    return Tick(
        state=state,
        box=_boxes(crossing(), state),
        left=rng.random(N) < 0.2,
        off_road=rng.random(N) < 0.2,
        time=f32(rng.uniform(0, 99)),
        decision=decision,
        x=f32(rng.uniform(0, 6, N)),
        dx=f32(np.where(rng.random(N) < 0.15, 0.0, rng.uniform(0, 4, N))),
        command=Command(),
    )


@functools.cache
def seen() -> list[tuple[Tick, StepRecord]]:
    """Random steps and what is seen of them, in NumPy."""
    rng = np.random.default_rng(3)
    ticks = [random_tick(rng, int(rng.integers(N))) for _ in range(WORLDS)]
    return list(zip(ticks, records_of(ticks), strict=True))


@jax.jit
def _records(lane_map, ticks):
    return jax.vmap(lambda tick: EvaluateEgo().record(CONFIG, lane_map, tick))(ticks)


def records_of(ticks):
    size = 50  # of a batch: one program
    parts = []
    for begin in range(0, len(ticks), size):
        part = ticks[begin : begin + size]
        records = jax.tree.map(
            np.asarray, _records(crossing(), stacked(part + part[:1] * (size - len(part))))
        )
        parts += [jax.tree.map(lambda x, i=i: x[i], records) for i in range(len(part))]
    return parts


def stacked(trees):
    return jax.tree.map(lambda *x: np.stack(x), *trees)


def centre(state, slot):
    """Lane and s of the middle of the ego."""
    s, lane = state.s[slot] - state.shape.length[slot] / 2, state.lane[slot]
    if s < 0 and state.previous[slot] != NO_LANE:
        lane = state.previous[slot]
        s = s + host().length[lane]
    return lane, s


@functools.cache
def given():
    """Of all random steps: bodies, levels, widths, second lanes, headings, off the road."""
    state = stacked([tick.state for tick, _ in seen()])
    places = [centre(tick.state, int(tick.state.egos.slot[0])) for tick, _ in seen()]

    @jax.jit
    @jax.vmap
    def ask(state, lane, s):
        m = crossing()
        z = elevation(m, state.lane, state.s)[0]
        box = boxes(m, state)
        wide, other = width(m, state.lane, state.s), other_lane(m, state)[0]
        return box, z, wide, other, pose(m, lane, s)[2], off_road(m, state, box)

    told: Any = ask(state, i32([lane for lane, _ in places]), f32([s for _, s in places]))
    told = jax.tree.map(np.asarray, told)
    return [jax.tree.map(lambda x, i=i: x[i], told) for i in range(WORLDS)]


def each(name: str) -> Iterator[Any]:
    """Of all random steps: number, state, step, slot of the ego, and what is said of it under a name."""
    for i, (tick, record) in enumerate(seen()):
        yield i, tick.state, tick, int(tick.state.egos.slot[0]), getattr(record.ego, name)
