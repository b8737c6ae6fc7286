"""PDM-Hybrid: the trajectory of PDM-Closed with a learned correction beyond two seconds.

Dauner, Hallgarten, Geiger, Chitta, CoRL 2023: rules drive best, a network forecasts best over eight seconds.
The network (PDM-Offset) sees the last two seconds of the vehicle, the middle of the lane for 120 m, and the
poses of PDM-Closed. Each input has a layer of its own, two layers are common. It adds an offset to every
pose. `limsim_jax.training` trains it on rollouts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from limsim_jax.files import write_whole
from limsim_jax.geometry import wrap_angle
from limsim_jax.maps.lane_map import LaneMap
from limsim_jax.policies.base import Policy
from limsim_jax.policies.pdm.policy import PDMClosed, Plan
from limsim_jax.policies.pdm.road import DT, STEPS, bodies, road_ahead
from limsim_jax.policies.reference import to_cartesian
from limsim_jax.policies.weights import digest, pack, unpack
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Trajectory
from limsim_jax.types import Config, State

POSES, POSE_TIME = 16, 0.5
"""Poses of a forecast, and s between them."""

CORRECTED_FROM = 2.0
"""s; until then the trajectory is that of PDM-Closed."""

HISTORY, HISTORY_TIME = 11, 0.2
"""Moments of the past, the present one first, and s between them."""

CENTRE_LINE = 120
"""Points of the middle of the lane, 1 m apart."""

WEIGHTS = Path(__file__).with_name("pdm_hybrid.npz")
"""Weights that come with the package."""

BEYOND = round(POSES * POSE_TIME / DT) - STEPS
"""Steps of PDM-Closed beyond its own 4 s."""

_SCALE = np.array([30.0, 5.0, 0.5])  # m, m, rad: typical size of inputs and offsets
_OFFSET_SCALE = np.array([5.0, 1.0, 0.1])


class Features(NamedTuple):
    """Inputs of the network for `E` egos.

    In the frame of the ego: x ahead of its centre, y to the left.
    """

    history: Float[Array, "E 11 8"]  # x, y (m), heading (rad), velocity (m/s, rad/s), acceleration (m/s^2)
    centre_line: Float[Array, "E 120 3"]  # x, y (m), heading (rad)
    plan: Float[Array, "E 16 3"]  # poses of PDM-Closed


class Offset(nn.Module):
    """PDM-Offset: poses of the future, as offsets from those of PDM-Closed."""

    hidden: int = 128
    dropout: float = 0.1

    @nn.compact
    def __call__(self, features: Features, train: bool = False) -> Float[Array, "*b 16 3"]:
        """The corrected poses; `train` needs a key "dropout"."""
        history, line, plan = features
        moving = jnp.asarray(np.concatenate([_SCALE, [10.0, 1.0, 0.3, 2.0, 2.0]]), history.dtype)
        scale = jnp.asarray(_SCALE, history.dtype)
        inputs = [_over(history, moving), _over(line, scale), _over(plan, scale)]
        x = jnp.concatenate([nn.relu(nn.Dense(self.hidden)(_flat(values))) for values in inputs], -1)
        for _ in range(2):
            x = nn.Dropout(self.dropout, deterministic=not train)(nn.relu(nn.Dense(self.hidden)(x)))
        x = nn.Dense(POSES * 3, kernel_init=nn.initializers.zeros)(x)
        offset = x.reshape(*x.shape[:-1], POSES, 3)
        size = jnp.asarray(_OFFSET_SCALE, x.dtype)
        return plan + offset * size.reshape((1,) * (offset.ndim - 1) + (3,))


def _over(values: Array, scale: Array) -> Array:
    return values / scale.reshape((1,) * (values.ndim - 1) + (-1,))


def _flat(values: Array) -> Array:
    return values.reshape(*values.shape[:-2], -1)


# --- what the network sees ---------------------------------------------------------------------------


class Past(NamedTuple):
    """The last two seconds of `E` egos at decisions, latest first."""

    x: Float[Array, "E L"]  # m
    y: Float[Array, "E L"]
    heading: Float[Array, "E L"]  # rad
    v: Float[Array, "E L"]  # m/s
    a: Float[Array, "E L"]  # m/s^2
    turn: Float[Array, "E L"]  # rad/s


def no_past(config: Config, state: State) -> Past:
    """A past at constant velocity, up to one decision ago."""
    count = math.ceil((HISTORY - 1) * HISTORY_TIME / config.decision_time - 1e-6) + 1
    egos = state.egos
    back = config.decision_time * jnp.arange(1, count + 1, dtype=egos.x.dtype)[None]
    distance = -state.v[egos.slot][:, None] * back
    heading = jnp.broadcast_to(egos.heading[:, None], distance.shape)
    zero = jnp.zeros_like(distance)
    return Past(
        x=egos.x[:, None] + distance * jnp.cos(heading),
        y=egos.y[:, None] + distance * jnp.sin(heading),
        heading=heading,
        v=zero + state.v[egos.slot][:, None],
        a=zero,
        turn=zero,
    )


def remember(past: Past, state: State) -> Past:
    """The past with the present moment added in front."""
    egos, slot = state.egos, state.egos.slot
    turn = state.v[slot] * jnp.tan(egos.steering) / jnp.maximum(state.shape.wheelbase[slot], 1.0)
    now = egos.x, egos.y, egos.heading, state.v[slot], state.a[slot], turn
    return Past(
        *(jnp.concatenate([new[:, None], old[:, :-1]], 1) for new, old in zip(now, past, strict=True))
    )


def poses_of(plan: Plan) -> tuple[Array, Array, Array]:
    """x, y and heading of a plan and its tail; `[E, 81]`."""
    both = plan.trajectory, plan.tail
    x, y, heading = (
        jnp.concatenate([getattr(part, name) for part in both], 1) for name in ("x", "y", "heading")
    )
    return x, y, heading


def features(
    config: Config, lane_map: LaneMap, state: State, past: Past, plan: Plan, strict: bool = False
) -> Features:
    """The inputs of the network. `past` includes the present; `plan` reaches 8 s."""
    egos = state.egos
    origin = egos.x[:, None], egos.y[:, None], egos.heading[:, None]
    # moments of the past, interpolated between decisions
    at = HISTORY_TIME / config.decision_time * np.arange(HISTORY)
    first = np.minimum(at.astype(int), past.x.shape[1] - 2)
    share = jnp.asarray(at - first, past.x.dtype)[None]
    heading = past.heading[:, :1] + wrap_angle(past.heading - past.heading[:, :1])
    x, y, heading, v, a, turn = (
        values[:, first] + share * (values[:, first + 1] - values[:, first])
        for values in (past.x, past.y, heading, past.v, past.a, past.turn)
    )
    pose = in_frame(origin, x, y, heading)
    cos, sin = jnp.cos(pose[..., 2]), jnp.sin(pose[..., 2])
    moving = jnp.stack([v * cos, v * sin, turn, a * cos - v * turn * sin, a * sin + v * turn * cos], -1)

    body = bodies(state, egos.slot)
    road = road_ahead(lane_map, state, egos.slot, body, strict)
    ahead = jnp.arange(CENTRE_LINE, dtype=egos.x.dtype)[None]
    s = (road.s + body.wheelbase / 2)[:, None] + ahead
    line = to_cartesian(road.centerline, s, jnp.zeros_like(s))
    every = round(POSE_TIME / DT)
    planned = (values[:, every::every] for values in poses_of(plan))
    return Features(
        history=jnp.concatenate([pose, moving], -1),
        centre_line=in_frame(origin, line.x, line.y, line.heading),
        plan=in_frame(origin, *planned),
    )


def in_frame(origin: tuple[Any, Any, Any], x: Any, y: Any, heading: Any) -> Any:
    """Poses `[..., 3]` in the frame of a pose."""
    x0, y0, h0 = origin
    cos, sin = jnp.cos(h0), jnp.sin(h0)
    dx, dy = x - x0, y - y0
    return jnp.stack([cos * dx + sin * dy, cos * dy - sin * dx, wrap_angle(heading - h0)], -1)


# --- the policy --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PDMHybrid(Policy):
    """PDM-Closed with learned poses beyond `CORRECTED_FROM`; its egos move in the plane.

    Its trajectory covers 8 s. Until the next decision the vehicle drives as PDM-Closed.

    Attributes:
      weights: file of `save_weights`; None: those that come with the package.
      seen: as in `PDMClosed`.
      strict_tuplan: as in `PDMClosed`.
      network: what the file held.
      content: a hash of the network.
    """

    weights: str | None = None
    seen: int = 32
    strict_tuplan: bool = False
    network: dict[str, dict[str, np.ndarray]] = field(init=False, repr=False, compare=False)
    content: str = field(default="", init=False, repr=False)

    def __post_init__(self) -> None:
        PDMClosed(seen=self.seen)
        object.__setattr__(self, "network", load_weights(self.path))
        object.__setattr__(self, "content", digest(self.network))

    @property
    def closed(self) -> PDMClosed:
        """The rules."""
        return PDMClosed(seen=self.seen, strict_tuplan=self.strict_tuplan)

    @property
    def path(self) -> str:
        """Where the weights are."""
        return str(WEIGHTS) if self.weights is None else self.weights

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Past:
        """A past at constant velocity."""
        del lane_map
        return no_past(config, state)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Past, key: jax.Array
    ) -> tuple[Command, Past]:
        """PDM-Closed's trajectory for 2 s, then the corrected one."""
        del key
        past = remember(memory, state)
        return self.foresee(config, lane_map, state, past)[0], past

    def foresee(
        self, config: Config, lane_map: LaneMap, state: State, past: Past
    ) -> tuple[Command, Float[Array, "E 16 3"]]:
        """The command, and the network's poses in the frame of each ego."""
        plan = self.closed.plan(config, lane_map, state, beyond=BEYOND)
        seen = features(config, lane_map, state, past, plan, self.strict_tuplan)
        hidden = self.network["Dense_0"]["bias"].shape[0]
        poses = Offset(hidden).apply({"params": self.network}, seen)
        assert isinstance(poses, jax.Array)

        # the correction at the poses, 0 until CORRECTED_FROM, linear in between
        change = poses - seen.plan
        kept = POSE_TIME * np.arange(1, POSES + 1) > CORRECTED_FROM
        change = jnp.where(jnp.asarray(kept)[None, :, None], change, 0)
        change = jnp.pad(change, ((0, 0), (1, 0), (0, 0)))
        every = round(POSE_TIME / DT)
        moment = np.arange(POSES * every + 1)
        first = np.minimum(moment // every, POSES - 1)
        share = jnp.asarray(moment / every - first, change.dtype)[None, :, None]
        change = change[:, first] + share * (change[:, first + 1] - change[:, first])

        egos = state.egos
        x, y, heading = poses_of(plan)
        cos, sin = jnp.cos(egos.heading)[:, None], jnp.sin(egos.heading)[:, None]
        braking = plan.brakes[:, None]
        x = jnp.where(braking, x, x + cos * change[..., 0] - sin * change[..., 1])
        y = jnp.where(braking, y, y + sin * change[..., 0] + cos * change[..., 1])
        heading = jnp.where(braking, heading, heading + change[..., 2])
        v = jnp.concatenate([plan.trajectory.v, plan.tail.v], 1)
        # speed of the corrected poses along their heading
        moved = (jnp.diff(x) * jnp.cos(heading[:, :-1]) + jnp.diff(y) * jnp.sin(heading[:, :-1])) / DT
        moved = jnp.maximum(jnp.concatenate([moved, moved[:, -1:]], 1), 0)
        late = jnp.asarray(moment * DT > CORRECTED_FROM)[None] & ~braking
        trajectory = Trajectory(
            x=x, y=y, heading=heading, v=jnp.where(late, moved, v), t0=config.time(state.step), dt=DT
        )
        return Command(trajectory=trajectory, signal=plan.signal), poses


# --- weights -----------------------------------------------------------------------------------------


def save_weights(path: str | Path, weights: Any) -> None:
    """Write the parameters of `Offset` as .npz, in half precision and atomically."""
    write_whole(path, pack(weights))


def load_weights(path: str) -> dict[str, dict[str, np.ndarray]]:
    """Read what `save_weights` wrote.

    Raises:
      ValueError: no such file, or weights of another network.
    """
    try:
        weights, _ = unpack(Path(path).read_bytes())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: no weights of PDM-Hybrid: {error}") from None
    sizes = (HISTORY * 8, CENTRE_LINE * 3, POSES * 3)
    found = tuple(weights.get(f"Dense_{k}", {}).get("kernel", np.zeros((0, 0))).shape[0] for k in range(3))
    if found != sizes or len(weights) != 6:
        raise ValueError(f"{path}: layers that see {found} numbers, not {sizes}; not weights of PDM-Hybrid")
    return weights
