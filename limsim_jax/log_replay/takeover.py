"""Replay of a scene with an ego: the traffic model takes over where a log has become impossible.

Every vehicle is on its LOG, under control (CTRL) of a car-following model, or on its RETURN to the log:

- LOG to CTRL, a takeover, for one of two reasons. The predicted path of a vehicle off its log (an ego, or one
  under control) meets the logged path within `horizon`, where the log had more room. Or that vehicle is the
  leader, and the logged motion would reach it within `ttc`, or make the IDM brake harder than `braking`.
  Followers of a vehicle that is taken over are checked again in the same step. A log that ends in the middle
  of the road near the ego is carried on in the same way; that is no takeover.
- CTRL: along the path of the own log, with the lane changes in it, by car following.
- CTRL to RETURN, after `clear` s without any of these reasons: along the path at the speed of the log, faster
  or slower to catch up with its place there, but never faster than car following allows.
- RETURN to LOG: at the place in the log, within `place` and `speed`, for `settle` s. The rest fades away.

Each takeover and each return fades over `fade` s, so positions stay continuous. A vehicle that is not back
within `patience` stays under control. A vehicle that would enter where another one is off its log waits
outside.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.log_replay.arrays import MARGIN, SceneArrays, Sight, pose, separation, sight, sight_of
from limsim_jax.traffic.car_following import ACC, IDM, NO_GAP, CarFollowing, ballistic
from limsim_jax.xla import mapped_like

_GRID = 0.3  # s between moments at which ways are compared
_STEADY = 1.0  # s for which a vehicle is predicted to go on braking or accelerating
_ENDS = 1.0  # s before its end at which a log counts as ending
_ROAD = 5.0  # m of road that must be left there
_WORSE = 0.2  # m less room than in the log
_CHAIN = 3  # followers in a row that are looked at again in one step
_TRACK = 0.5  # s, time constant of the speed on the return
_ASTRAY = 0.5  # m and m/s from its log up to which an ego in the plane counts as on it
_TOUCH = 0.1  # m, least gap that is told from contact
_AHEAD = (1.0, 2.0)  # s ahead at which others may have come in the way
_YIELDING = 3.0  # m/s^2, hardest braking for vehicles that are not in the way yet
_FREE = 1e3  # m/s^2, without any vehicle ahead
_ROOM = 2.0  # m that an arrival needs, and ...
_HEADWAY = 0.3  # ... s of its follower's way, and ...
_BRAKING = 2.0  # ... m/s^2 that it may ask of the follower


class Mode(enum.IntEnum):
    """What moves a vehicle."""

    LOG = 0
    CTRL = 1
    RETURN = 2


@dataclass(frozen=True)
class Takeover:
    """When vehicles are taken over and handed back. All static."""

    model: CarFollowing = field(default_factory=ACC)
    horizon: float = 3.0  # s for which ways are compared
    inflation: float = 1.2  # factor on bodies then, and ...
    room: float = 0.3  # ... m around them
    ttc: float = 2.5  # s
    braking: float = 3.0  # m/s^2
    keep: float = 50.0  # m from an ego that has left its log, within which vehicles stay when their logs end
    clear: float = 2.0  # s
    behind: float = 30.0  # m from the place in the log within which a return may begin
    gain: float = 0.5  # 1/s, speed per metre from the place in the log ...
    catch_up: float = 3.0  # m/s, ... and at most
    place: float = 0.5  # m
    speed: float = 0.3  # m/s
    settle: float = 1.0  # s
    fade: float = 1.0  # s
    patience: float = 20.0  # s

    def __post_init__(self) -> None:
        for name in ("horizon", "inflation", "ttc", "braking", "gain", "catch_up", "fade", "patience"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)}; it has to be above 0")


@struct.dataclass(frozen=True, kw_only=True)
class Ego:
    """A recorded vehicle that is told what to do at some moments.

    Before these it is on its log; after them it returns there by the same rules as the others.
    """

    slot: Int[Array, ""]  # -1: none
    told: Bool[Array, " T"]
    acceleration: Float[Array, " T"]  # m/s^2, along the path of its log


@struct.dataclass(frozen=True, kw_only=True)
class Record:
    """Counts of every vehicle; the ego itself is not among the takeovers."""

    takeovers: Int[Array, " N"]
    ended: Int[Array, " N"]  # logs that ended in the middle of the road, and are carried on
    handed_back: Int[Array, " N"]
    in_time: Int[Array, " N"]  # of these, within `patience`
    late: Int[Array, " N"]  # takeovers that have lasted longer than that
    controlled: Float[Array, " N"]  # s off the log
    displacement: Float[Array, " N"]  # m, largest distance from the place in the log, along the path
    delayed: Float[Array, " N"]  # s that it waited outside
    hardest: Float[Array, " N"]  # m/s^2, hardest braking off the log
    jump: Float[Array, " N"]  # m, largest step off the log beyond what the speeds at its ends explain
    struck: Bool[Array, "N N"]  # pairs that overlapped, one of them off its log, and do not in the log
    under_control: Bool[Array, " N"]  # off the log when it left, or at the end


class Moment(NamedTuple):
    """All vehicles at one moment."""

    x: Float[Array, " N"]  # m, middle of the body
    y: Float[Array, " N"]
    heading: Float[Array, " N"]  # rad
    v: Float[Array, " N"]  # m/s
    mode: Int[Array, " N"]  # `Mode`
    active: Bool[Array, " N"]


class Going(NamedTuple):
    """What a step changes."""

    mode: Int[Array, " N"]
    active: Bool[Array, " N"]
    waiting: Bool[Array, " N"]
    p: Float[Array, " N"]  # m along the path; of those on their log not used
    v: Float[Array, " N"]
    a: Float[Array, " N"]
    rest: Float[Array, "N 3"]  # x, y, heading by which the last switch would have jumped
    switched: Float[Array, " N"]  # s since then
    off: Float[Array, " N"]  # s since the takeover
    clear: Float[Array, " N"]  # s without a conflict
    settled: Float[Array, " N"]  # s at the place in the log
    before: Float[Array, "N 4"]  # x, y, v of the last moment, and whether it was there


class Flight(NamedTuple):
    """An ego in the plane."""

    flying: Bool[Array, ""]  # before, it is on its log
    x: Float[Array, ""]  # m, middle of the body
    y: Float[Array, ""]
    heading: Float[Array, ""]  # rad
    v: Float[Array, ""]  # m/s
    a: Float[Array, ""]  # m/s^2
    plan: Float[Array, "H 3"]  # x, y, heading that it means to have after 0.3, 0.6, ... s
    memory: Any  # of the pilot


@runtime_checkable
class Pilot(Protocol):
    """Drives an ego in the plane, from the first told moment on."""

    def init(self, scene: SceneArrays, ego: Ego) -> Flight:
        """Before the first moment."""
        ...

    def step(
        self,
        scene: SceneArrays,
        ego: Ego,
        flight: Flight,
        moment: Moment,
        a: Float[Array, " N"],
        t: Int[Array, ""],
        key: Key[Array, ""] | None,
    ) -> Flight:
        """The flight from one moment to the next.

        Args:
          scene: what was recorded.
          ego: which is in the air.
          flight: at moment `t`.
          moment: of all vehicles.
          a: m/s^2, their accelerations.
          t: number of the moment.
          key: randomness, or None.
        """
        ...


class _Events(NamedTuple):
    """What has happened to every vehicle in a step."""

    mine: Bool[Array, " N"]  # the ego
    gone: Bool[Array, " N"]  # has left
    taken: Bool[Array, " N"]  # has been taken over, or has entered late
    ended: Bool[Array, " N"]  # of these, because its log ends: no takeover, it is carried on
    back: Bool[Array, " N"]  # has been handed back
    behind: Float[Array, " N"]  # m along the path to the place in the log, 0 where there is none


class _Lead(NamedTuple):
    """The next vehicle on the own path."""

    who: Int[Array, " N"]
    gap: Float[Array, " N"]  # m, `NO_GAP` without a leader
    v: Float[Array, " N"]  # m/s, along the own path
    a: Float[Array, " N"]


def replay(
    scene: SceneArrays,
    ego: Ego,
    options: Takeover | None = None,
    *,
    pilot: Pilot | None = None,
    key: Key[Array, ""] | None = None,
    record: bool = False,
) -> tuple[Record, Moment | None]:
    """Replay a scene with an ego; `vmap` over `ego` (and `key`) for many variants.

    Args:
      scene: what was recorded.
      ego: the vehicle that deviates from its log.
      options: of the takeover.
      pilot: drives the ego in the plane while it is told to; its accelerations then mean nothing.
      key: randomness of the pilot.
      record: also return all moments, `[T, N]`; entries of vehicles that are not `active` mean nothing.
    """
    options = Takeover() if options is None else options
    count, number = scene.log.x.shape
    zero = jnp.zeros(number, jnp.float32)
    none = jnp.zeros(number, jnp.int32)
    start = begin(scene)
    counts = Record(
        takeovers=none, ended=none, handed_back=none, in_time=none, late=none, controlled=zero,
        displacement=zero, delayed=zero, hardest=zero, jump=zero,
        struck=jnp.zeros((number, number), bool), under_control=zero > 0,
    )  # fmt: skip

    def step(carry: tuple[Going, Record, Any], t: Array) -> tuple[tuple[Going, Record, Any], Moment | None]:
        going, counts, flight = carry
        now, moment, events = _step(scene, ego, options, going, flight, t)
        counts = _count(scene, options, going, now, counts, moment, events)
        if pilot is not None:
            flight = pilot.step(scene, ego, flight, moment, now.a, t, key)
        return (now, counts, flight), moment if record else None

    flight = None if pilot is None else pilot.init(scene, ego)
    carry = mapped_like(ego.slot, (start, counts, flight))
    (going, counts, _), moments = lax.scan(step, carry, jnp.arange(count, dtype=jnp.int32))
    last = going.active & (going.mode != Mode.LOG)
    return replace(counts, under_control=counts.under_control | last), moments


def replay_many(
    scene: SceneArrays,
    egos: Ego,
    options: Takeover | None = None,
    *,
    pilot: Pilot | None = None,
    keys: Key[Array, " B"] | None = None,
    at_once: int = 64,
) -> Record:
    """Replay a scene with each of many egos, `[B, ...]`.

    `at_once` of them go side by side, for the tables of pairs of more worlds do not fit into caches.
    """

    def one(some: tuple[Ego, Key[Array, ""] | None]) -> Record:
        return replay(scene, some[0], options, pilot=pilot, key=some[1])[0]

    return lax.map(one, (egos, keys), batch_size=at_once)


def begin(scene: SceneArrays) -> Going:
    """Before the first moment: all vehicles on their logs."""
    number = scene.log.x.shape[1]
    zero = jnp.zeros(number, jnp.float32)
    return Going(
        mode=jnp.zeros(number, jnp.int32), active=scene.first == 0, waiting=zero > 0, p=zero, v=zero, a=zero,
        rest=jnp.zeros((number, 3), jnp.float32), switched=zero + 1e6, off=zero, clear=zero, settled=zero,
        before=jnp.zeros((number, 4), jnp.float32),
    )  # fmt: skip


def advance(
    scene: SceneArrays, ego: Ego, options: Takeover, going: Going, flight: Flight | None, t: Int[Array, ""]
) -> tuple[Going, Moment]:
    """All vehicles at moment `t`, and what moves them to the next: a step of `replay`.

    Args:
      scene: what was recorded.
      ego: the vehicle that deviates from its log.
      options: of the takeover.
      going: of `begin`, or of the moment before.
      flight: the ego in the plane at this moment; None: it follows `ego`.
      t: number of the moment; moments follow one another.
    """
    return _step(scene, ego, options, going, flight, t)[:2]


def _step(
    scene: SceneArrays, ego: Ego, options: Takeover, going: Going, flight: Flight | None, t: Int[Array, ""]
) -> tuple[Going, Moment, _Events]:
    """All vehicles at moment `t`, and their motion to the next."""
    log = scene.log
    count, number = log.x.shape
    me = jnp.arange(number)
    on_log = going.mode == Mode.LOG
    fade = jnp.clip(1 - going.switched / options.fade, 0, 1)
    logged = jnp.stack([log.x[t], log.y[t], log.heading[t]], -1)
    ahead = going.rest[:, 0] * jnp.cos(logged[:, 2]) + going.rest[:, 1] * jnp.sin(logged[:, 2])
    p = jnp.where(on_log, scene.p[t] + fade * ahead, going.p)
    v = jnp.where(on_log, log.v[t], going.v)
    a = jnp.where(on_log, (log.v[t] - log.v[jnp.maximum(t - 1, 0)]) / log.dt, going.a)
    mine = me == ego.slot
    flies = jnp.zeros_like(mine) if flight is None else mine & flight.flying
    seen = sight(scene, p)
    if flight is not None:
        p, v, a, seen = _fly(scene, flight, flies, p, v, a, seen)

    # places
    own = pose(scene, p)
    base = jnp.where(on_log[:, None], logged, own[:, :3])
    place = jnp.where((fade > 0)[:, None], base + fade[:, None] * going.rest, base)
    if flight is not None:
        place = jnp.where(flies[:, None], jnp.stack([flight.x, flight.y, flight.heading])[None, :], place)
        on_log &= ~flies

    # departures and arrivals
    gone = jnp.where(on_log, t > scene.last, p > scene.limit) & going.active
    here = going.active & ~gone
    minded = jnp.broadcast_to(here[:, None], (number, number))
    lead = _leader(scene, seen, minded, p, v, a)
    due = (t == scene.first) & ~here & ~gone
    v = jnp.where(going.waiting, jnp.minimum(log.v[scene.first, me], lead.v), v)
    enters = _enter(scene, seen, place, p, v, here & ~on_log, here, due, going.waiting)
    late = enters & going.waiting
    waiting = (due | going.waiting) & ~enters
    active = here | enters
    on_log = on_log & ~waiting
    mode = jnp.where(on_log, Mode.LOG, jnp.where(waiting, Mode.CTRL, going.mode)).astype(going.mode.dtype)
    moment = Moment(place[:, 0], place[:, 1], place[:, 2], v, mode, active)

    # which vehicles have to leave their logs
    told = ((mine & ego.told[t]) | flies) & active
    off_log = active & (~on_log | told)
    if flight is not None:  # an ego in the plane that is where its log is disturbs no vehicle
        error = place[:, :2] - logged[:, :2]
        astray = (jnp.abs(error) > _ASTRAY).any(-1) | (jnp.abs(v - log.v[t]) > _ASTRAY) | ~log.valid[t]
        off_log &= ~mine | astray
    a_log = IDM()(scene.driver, gap=lead.gap, v=v, v_lead=lead.v, a_lead=lead.a, v0=v + 10.0)
    close = (v - lead.v) * options.ttc > lead.gap
    urgent = ((a_log < -options.braking) | close) & (lead.gap < NO_GAP)
    every = max(1, round(_GRID / log.dt))
    meets = lax.cond(
        t % every == 0,
        lambda: _meets(scene, options, flight, flies, t, off_log, p, v, a),
        lambda: mapped_like(p, jnp.zeros(number, bool)),
    )
    apart = (place[:, 0] - place[ego.slot, 0]) ** 2 + (place[:, 1] - place[ego.slot, 1]) ** 2
    ended = (scene.last - t <= round(_ENDS / log.dt)) & (scene.last < count - 1) & (mine & off_log).any()
    ended &= (apart < options.keep**2) & (scene.limit - scene.p[-1] > _ROAD)
    could = active & on_log & ~told
    if scene.keeps is not None:
        could &= ~scene.keeps
    taken = could & (meets | ended)
    for _ in range(1 + _CHAIN):
        taken |= could & urgent & (off_log | taken)[lead.who]

    # which vehicles may come back
    off = jnp.where(taken | late | (told & on_log), 0.0, going.off)
    clear = jnp.where(urgent | meets | taken | told, 0.0, going.clear + log.dt)
    may = log.valid[t] & ~told & (off <= options.patience) & active
    behind = jnp.where(log.valid[t], scene.p[t] - p, 0)
    slower = log.v[t] - v
    starts = (mode == Mode.CTRL) & may & (clear >= options.clear)
    starts &= (jnp.abs(behind) <= options.behind) | (jnp.abs(slower) < 1.0)
    stays = (mode == Mode.RETURN) & may & ~urgent
    settles = stays & (jnp.abs(behind) < options.place) & (jnp.abs(slower) < options.speed) & ~meets
    settled = jnp.where(settles, going.settled + log.dt, 0.0)
    back = settled > options.settle
    returns = (starts | stays) & ~back
    on_log = (on_log & ~taken & ~told) | back
    mode = jnp.where(on_log, Mode.LOG, jnp.where(returns, Mode.RETURN, Mode.CTRL)).astype(mode.dtype)
    switch = taken | back | (told & (moment.mode == Mode.LOG))
    rest = place - jnp.where(on_log[:, None], logged, own[:, :3])
    rest = jnp.where(switch[:, None], rest, jnp.where(late[:, None], 0.0, going.rest))
    switched = jnp.where(switch, 0.0, going.switched)

    # how those off their log go on
    wish = own[:, 3] + jnp.clip(options.gain * behind, -options.catch_up, options.catch_up)
    v0 = jnp.where(returns, scene.v0 + 2 * options.catch_up, scene.v0)
    follow = options.model(scene.driver, gap=lead.gap, v=v, v_lead=lead.v, a_lead=lead.a, v0=v0)
    follow = jnp.minimum(follow, _yield(scene, options, seen, active, p, v, a, v0))
    track = jnp.clip((wish - v) / _TRACK, -scene.driver.b, scene.driver.a)
    # no vehicle runs ahead of its log either
    wanted = jnp.where(returns | (behind < 0), jnp.minimum(track, follow), follow)
    wanted = jnp.where(told, ego.acceleration[t], wanted)
    v_next, way = ballistic(v, wanted, log.dt)
    moves = active & ~on_log
    now = Going(
        mode=mode, active=active, waiting=waiting, p=jnp.where(moves, p + way, p),
        v=jnp.where(moves, v_next, v), a=jnp.where(moves, (v_next - v) / log.dt, a), rest=rest,
        switched=switched + log.dt, off=off + log.dt, clear=clear, settled=settled,
        before=jnp.stack([place[:, 0], place[:, 1], v, active.astype(v.dtype)], -1),
    )  # fmt: skip
    return now, moment, _Events(mine, gone, taken | late, taken & ended, back, behind)


def _fly(
    scene: SceneArrays, flight: Flight, flies: Array, p: Array, v: Array, a: Array, seen: Sight
) -> tuple[Array, Array, Array, Sight]:
    """The ego where it is in the plane; its `p` is the place beside it on the path of its log."""
    found = sight_of(scene, flight.x, flight.y, flight.heading)
    seen = Sight(
        *(jnp.where(flies[:, None], new[None, :], old) for new, old in zip(found, seen, strict=True))
    )
    return (
        jnp.where(flies, found[0], p),
        jnp.where(flies, flight.v, v),
        jnp.where(flies, flight.a, a),
        seen,
    )


def _leader(scene: SceneArrays, seen: Sight, minded: Array, p: Array, v: Array, a: Array) -> _Lead:
    """The body in the way ahead for which the IDM brakes hardest: the nearest one may be about to leave.

    `minded`: `[j, i]`, whom each one looks at.
    """
    gap, ahead, in_way = _gaps(scene, seen, p)
    there = minded & ahead & in_way
    speed = jnp.maximum(v[:, None] * seen.cos, 0)
    root = 2 * jnp.sqrt(scene.driver.a * scene.driver.b)
    closing = (v[None, :] - speed) / root[None, :]
    wanted = scene.driver.s0[None, :] + jnp.maximum(v[None, :] * (scene.driver.T[None, :] + closing), 0)
    who = jnp.argmax(jnp.where(there, wanted / jnp.maximum(gap, _TOUCH), -1), 0)
    me = jnp.arange(p.shape[0])
    any_ = there.any(0)
    return _Lead(
        who,
        jnp.where(any_, gap[who, me], NO_GAP),
        jnp.where(any_, speed[who, me], v),
        jnp.where(any_, a[who] * seen.cos[who, me], 0),
    )


def _yield(
    scene: SceneArrays,
    options: Takeover,
    seen: Sight,
    active: Array,
    p: Array,
    v: Array,
    a: Array,
    v0: Array,
) -> Float[Array, " N"]:
    """Acceleration behind vehicles that will be in the way, m/s^2.

    They change lanes, or the own path does.
    """
    _, ahead, in_way = _gaps(scene, seen, p)
    minded = active[:, None] & ~(ahead & in_way)
    wish = jnp.full_like(v, _FREE)
    for tau in _AHEAD:
        then = p + v * tau
        lead = _leader(scene, sight(scene, then), minded, then, v, a)
        gap = jnp.maximum(lead.gap, _TOUCH)
        follow = options.model(scene.driver, gap=gap, v=v, v_lead=lead.v, a_lead=lead.a, v0=v0)
        wish = jnp.minimum(wish, follow)
    return jnp.maximum(wish, -_YIELDING)


def _gaps(scene: SceneArrays, seen: Sight, p: Array) -> tuple[Array, Array, Array]:
    """Of j before i, `[j, i]`: gap (m), whether j is ahead, whether it is in the way."""
    length, width = scene.log.length, scene.log.width
    cos, sin = jnp.abs(seen.cos), jnp.abs(seen.sin)
    ahead = seen.along - p[None, :]
    gap = ahead - (length[None, :] + cos * length[:, None] + sin * width[:, None]) / 2
    half = (width[None, :] + cos * width[:, None] + sin * length[:, None]) / 2
    other = ~jnp.eye(p.shape[0], dtype=bool)
    return gap, (ahead > 0) & other, jnp.abs(seen.beside) < half + MARGIN


def _enter(
    scene: SceneArrays,
    seen: Sight,
    place: Array,
    p: Array,
    v: Array,
    off_log: Array,
    here: Array,
    due: Array,
    waiting: Array,
) -> Bool[Array, " N"]:
    """Which vehicles enter now.

    Those that are `due` need room to all that are off their logs, those that are `waiting` to all.
    """
    gap, ahead, in_way = _gaps(scene, seen, p)
    follower, leader = v[None, :], v[:, None]
    closing = jnp.maximum(follower - leader, 0)
    tight = (gap < _ROOM + _HEADWAY * follower) | (closing * closing > 2 * _BRAKING * gap)
    tight &= ahead & in_way  # [j, i]: j before i
    rank = jnp.arange(p.shape[0])
    # of several that wait, the later ones mind the earlier ones
    others = here[None, :] | due[None, :] | (waiting[None, :] & (rank[None, :] < rank[:, None]))
    minded = jnp.where(due[:, None], off_log[None, :], others)
    gap, beside, _ = _bodies(scene, tuple(place.T), tuple(place.T))
    touch = jnp.maximum(gap, beside) < MARGIN
    tight |= touch & touch.T & ~jnp.eye(len(v), dtype=bool)
    return (due | waiting) & ~((tight.T | tight) & minded).any(1)


def _meets(
    scene: SceneArrays,
    options: Takeover,
    flight: Flight | None,
    flies: Array,
    t: Array,
    off_log: Array,
    p: Array,
    v: Array,
    a: Array,
) -> Bool[Array, " N"]:
    """Which logged paths meet a predicted path.

    That is the path of another vehicle, off its log and ahead.
    """
    log, count = scene.log, scene.log.x.shape[0]
    found = jnp.zeros((p.shape[0], p.shape[0]), bool)
    for k in range(1, round(options.horizon / _GRID) + 1):
        then = t + round(k * _GRID / log.dt)
        row = jnp.minimum(then, count - 1)
        steady = min(k * _GRID, _STEADY)
        later, way = ballistic(v, a, steady)
        there = pose(scene, p + way + later * (k * _GRID - steady))[:, :3]
        if flight is not None:
            there = jnp.where(flies[:, None], flight.plan[k - 1][None, :], there)
        heading = log.heading[row]
        gap, beside, front = _bodies(
            scene, (log.x[row], log.y[row], heading), (there[:, 0], there[:, 1], there[:, 2])
        )
        grown = options.inflation - 1
        near = gap < options.room + grown * (log.length[:, None] + log.length[None, :]) / 2
        near &= beside < options.room + grown * (log.width[:, None] + log.width[None, :]) / 2
        worse = jnp.maximum(gap, beside) < scene.clearance[row] - _WORSE
        found |= near & worse & (front > 0) & (log.valid[row] & (then < count))[:, None]
    return (found & off_log[None, :] & ~jnp.eye(p.shape[0], dtype=bool)).any(1)


def _bodies(
    scene: SceneArrays, own: tuple[Array, ...], other: tuple[Array, ...]
) -> tuple[Float[Array, "N N"], Float[Array, "N N"], Float[Array, "N N"]]:
    """Body j in the frame of body i, `[i, j]`: gaps of `separation`, and how far ahead, m."""
    dx, dy, turn = (b[None, :] - a[:, None] for a, b in zip(own, other, strict=True))
    cos, sin = jnp.cos(own[2])[:, None], jnp.sin(own[2])[:, None]
    front, angle = cos * dx + sin * dy, (jnp.cos(turn), jnp.sin(turn))
    gap, beside = separation(scene.log.length, scene.log.width, front, cos * dy - sin * dx, angle)
    return gap, beside, front


def _count(
    scene: SceneArrays,
    options: Takeover,
    before: Going,
    now: Going,
    counts: Record,
    moment: Moment,
    events: _Events,
) -> Record:
    """The record after a moment."""
    dt, one = scene.log.dt, jnp.int32
    others = ~events.mine
    off_log = moment.active & (moment.mode != Mode.LOG)
    back = events.back & others
    overdue = (now.off > options.patience) & (before.off <= options.patience) & off_log & others & ~back
    x, y, v, was = (before.before[:, k] for k in range(4))
    moved = jnp.sqrt((moment.x - x) ** 2 + (moment.y - y) ** 2)
    place = (moment.x, moment.y, moment.heading)
    gap, beside, _ = _bodies(scene, place, place)
    apart = (gap > 0) | (beside > 0)
    # a vehicle on its log, and not fading, is where it was recorded
    strays = off_log | (moment.active & (before.switched < options.fade))
    jump = jnp.where(strays & (was > 0), moved - dt * jnp.maximum(moment.v, v), 0)
    struck = ~(apart | apart.T) & moment.active[:, None] & moment.active[None, :]
    struck &= (strays[:, None] | strays[None, :]) & ~scene.touched & ~jnp.eye(len(v), dtype=bool)
    return Record(
        takeovers=counts.takeovers + (events.taken & ~events.ended & others).astype(one),
        ended=counts.ended + (events.ended & others).astype(one),
        handed_back=counts.handed_back + back.astype(one),
        in_time=counts.in_time + (back & (before.off <= options.patience)).astype(one),
        late=counts.late + (overdue & (counts.ended == 0)).astype(one),
        controlled=counts.controlled + jnp.where(off_log & others, dt, 0.0),
        displacement=jnp.maximum(counts.displacement, jnp.where(off_log & others, jnp.abs(events.behind), 0)),
        delayed=counts.delayed + jnp.where(now.waiting, dt, 0.0),
        hardest=jnp.maximum(counts.hardest, jnp.where(off_log & others, -before.a, 0)),
        jump=jnp.maximum(counts.jump, jump),
        struck=counts.struck | struck,
        under_control=counts.under_control | (events.gone & (before.mode != Mode.LOG)),
    )


# --- egos --------------------------------------------------------------------------------------------


def as_logged(scene: SceneArrays, slot: int | Int[Array, ""] = -1) -> Ego:
    """An ego that does what it did; -1: no ego."""
    count = scene.log.x.shape[0]
    return Ego(
        slot=jnp.asarray(slot, jnp.int32),
        told=jnp.zeros(count, bool),
        acceleration=jnp.zeros(count, jnp.float32),
    )


def braking(
    scene: SceneArrays,
    slot: int | Int[Array, ""],
    start: float | Float[Array, ""],
    deceleration: float | Float[Array, ""],
    duration: float | Float[Array, ""] = 1e6,
) -> Ego:
    """An ego that brakes for a while, then returns to its log.

    Args:
      scene: what was recorded.
      slot: number of the ego.
      start: s, when it begins to brake.
      deceleration: m/s^2.
      duration: s.
    """
    count = scene.log.x.shape[0]
    time = jnp.arange(count, dtype=jnp.float32) * scene.log.dt
    told = (time >= start - 1e-4) & (time < start + duration - 1e-4)
    return Ego(
        slot=jnp.asarray(slot, jnp.int32),
        told=told,
        acceleration=jnp.where(told, -jnp.asarray(deceleration, jnp.float32), 0.0),
    )


__all__ = [
    "Ego",
    "Flight",
    "Going",
    "Mode",
    "Moment",
    "Pilot",
    "Record",
    "Takeover",
    "advance",
    "as_logged",
    "begin",
    "braking",
    "replay",
    "replay_many",
]
