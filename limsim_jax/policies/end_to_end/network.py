"""The network of the end-to-end driver: pictures and LiDAR in; path, speed, density map and rules out.

After InterFuser (Shao et al., CoRL 2022): a density map of objects, rules of the road and the way ahead. As
in its successors that is a path and a speed, not points in time (Jaeger, Chitta, Geiger, ICCV 2023). Dense
layers with weights shared by patches of pictures and by windows of the raster: XLA:CPU takes 4 to 16 times as
long for convolutions and attention of that size.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from limsim_jax.files import write_whole
from limsim_jax.policies.end_to_end.inputs import BANDS, EGO, LIDAR_RANGE, POINTS, RASTER, STEP, Grid, Inputs
from limsim_jax.policies.weights import Layers, pack, unpack

PATH_POINTS = 10
"""Points of the predicted path."""

PATH_STEP, PATH_TIME = 2.0, 0.3
"""m between points of the path at least, and s of driving between them at higher speeds."""

CHANGES = (-7.0, -4.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Classes of the target speed: how much more than now, m/s. Zero lies on a class, so that it is exact."""

TARGET_TIME = 1.0
"""s until the target speed is to be reached."""

CELL = 4.0
"""Side of a cell of the density map, m: two cells of the raster, at most one car."""

DENSITY_GRID = Grid(cell=CELL)
"""Cells of the density map."""

DENSITY = ("object", "x", "y", "cosine", "sine", "length", "width", "speed")
"""Numbers of a cell: logit; middle from that of the cell (cells), heading, size (typical cars), speed."""

RULES = ("junction", "red light", "wait")
"""Logits: a junction within `JUNCTION` m; a red light that is seen; slows down or stands for a reason."""

JUNCTION = 30.0
"""m."""

WAYPOINTS, WAYPOINT_TIME = 8, 0.5
"""Waypoints instead of path and speed, and s between them (an ablation)."""

LENGTH, WIDTH, SPEED = 5.0, 2.0, 10.0
"""What 1 stands for in the density map: m, m, m/s."""

_PATCH, _TOKEN = (6, 8), 16
_CONTEXT = 2  # cells of the raster around those of a window
_WINDOW = round(CELL / RASTER.cell) * 2  # cells along the side of a window: two cells of the density map
_MAGIC = "limsim_jax end-to-end driver"


@dataclass(frozen=True)
class Design:
    """What a network has; weights of another design do not fit.

    Attributes:
      cameras, lidar: whether it sees them.
      route: whether it knows the route and its own motion; otherwise only `TOLD`, and the path that it says
        is the route.
      waypoints: whether it predicts points in time instead of a path and a speed.
      hidden: width of the common layers.
    """

    cameras: bool = True
    lidar: bool = True
    route: bool = True
    waypoints: bool = False
    hidden: int = 192


WHOLE = Design()
"""The design of the network that comes with the package."""

CAMERA = Design(lidar=False, route=False)
"""Pictures, and what a text can tell: see `bridges.chat.camera`."""

TOLD = ("speed", "speed limit", "lanes to cross", "distance within which to cross them", "speed is told")
"""Numbers of `EGO` that a network without a route has."""


class Outputs(NamedTuple):
    """What the network says, `[*b, ...]`."""

    path: Float[Array, "*b 10"]  # m left of the route at the points of `path_places`
    speed: Float[Array, "*b 8"]  # logits of `CHANGES`
    waypoints: Float[Array, "*b 8 2"]  # m, in the frame of the vehicle
    density: Float[Array, "*b 16 12 8"]  # numbers of `DENSITY`; rows from behind to ahead
    rules: Float[Array, "*b 3"]  # logits of `RULES`


def path_places(v: Float[Array, "*b"]) -> Float[Array, "*b 10"]:
    """Distances along the route of the points of a path, m.

    Args:
      v: m/s.
    """
    step = jnp.maximum(PATH_STEP, PATH_TIME * v)
    return step[..., None] * jnp.arange(1, PATH_POINTS + 1, dtype=jnp.float32).reshape(
        (1,) * v.ndim + (PATH_POINTS,)
    )


def target_speed(v: Float[Array, "*b"], logits: Float[Array, "*b 8"]) -> Float[Array, "*b"]:
    """The target speed, m/s: the mean over classes, 0 where a standing vehicle would rather stay."""
    share = jax.nn.softmax(logits, -1)
    change = jnp.sum(share * jnp.asarray(CHANGES, jnp.float32).reshape((1,) * v.ndim + (-1,)), -1)
    stays = jnp.sum(share[..., : CHANGES.index(0.0) + 1], -1) > 0.5
    return jnp.where((v < 0.5) & stays, 0.0, jnp.maximum(v + change, 0.0))


def two_hot(change: Float[Array, "*b"]) -> Float[Array, "*b 8"]:
    """Shares of the two classes around a change of speed.

    Their mean is that change, m/s.
    """
    edges = np.array([CHANGES[0] - 1, *CHANGES, CHANGES[-1] + 1], np.float32)
    low, gap = (jnp.asarray(x).reshape((1,) * change.ndim + (-1,)) for x in (edges[:-1], np.diff(edges)))
    share = (jnp.clip(change, CHANGES[0], CHANGES[-1])[..., None] - low) / gap  # of the way to each class
    return jnp.clip(jnp.minimum(share[..., :-1], 1 - share[..., 1:]), 0.0, 1.0)


class Network(nn.Module):
    """The network; `Network(design).apply({"params": weights}, inputs)` gives `Outputs`."""

    design: Design = WHOLE

    @nn.compact
    def __call__(self, inputs: Inputs) -> Outputs:
        """What it says of inputs `[*b, ...]`."""
        batch = inputs.ego.shape[:-1]
        if self.design.route:
            parts = [_scaled_route(inputs.route), inputs.ego]
        else:
            parts = [inputs.ego[..., k, None] for k in map(EGO.index, TOLD)]
        window = None
        if self.design.cameras:
            parts.append(self._pictures(inputs.cameras))
        if self.design.lidar:
            window = nn.relu(nn.Dense(48, name="window")(_windows(inputs.raster)))
            token = nn.relu(nn.Dense(_TOKEN, name="token")(window))
            parts += [token.reshape(*batch, -1), _scaled_bands(inputs.bands)]
        x = jnp.concatenate(parts, -1)
        for name in ("common", "common2"):
            x = nn.relu(nn.Dense(self.design.hidden, name=name)(x))
        return Outputs(
            path=nn.Dense(PATH_POINTS, name="path")(x) * 2.0,
            speed=nn.Dense(len(CHANGES), name="speed")(x),
            waypoints=self._waypoints(x),
            density=self._density(x, window),
            rules=nn.Dense(len(RULES), name="rules")(x),
        )

    def _pictures(self, cameras: Array) -> Float[Array, "*b 64"]:
        """Features of the pictures: weights are shared by patches.

        Beside what a layer makes of a patch, its strongest colours are told: a light may be one pixel.
        """
        batch, (high, wide) = cameras.shape[:-4], _PATCH
        count, rows, columns, _ = cameras.shape[-4:]
        x = cameras.astype(jnp.float32) / 127.5 - 1
        x = x.reshape(*batch, count, rows // high, high, columns // wide, wide, 3)
        x = jnp.moveaxis(x, -3, -4).reshape(*batch, -1, high * wide, 3)
        red, green, blue = (x[..., k] for k in range(3))
        colors = (
            red - jnp.maximum(green, blue),
            green - jnp.maximum(red, blue),
            jnp.minimum(red, green) - blue,
        )
        strongest = jnp.stack([jnp.max(color, -1) for color in colors], -1)  # red, green, yellow
        mixed = nn.relu(nn.Dense(16, name="patch")(x.reshape(*x.shape[:-2], -1)))
        x = jnp.concatenate([mixed, strongest], -1)
        return nn.relu(nn.Dense(64, name="pictures")(x.reshape(*batch, -1)))

    def _waypoints(self, x: Array) -> Float[Array, "*b 8 2"]:
        if not self.design.waypoints:
            return jnp.zeros((*x.shape[:-1], WAYPOINTS, 2), x.dtype)
        steps = nn.Dense(WAYPOINTS * 2, name="waypoints")(x).reshape(*x.shape[:-1], WAYPOINTS, 2)
        return jnp.cumsum(steps * 5.0, -2)

    def _density(self, x: Array, window: Array | None) -> Float[Array, "*b 16 12 8"]:
        """The density map: what a window shows, in the light of all."""
        batch, (rows, columns) = x.shape[:-1], DENSITY_GRID.shape
        tall, broad = rows // 2, columns // 2
        context = nn.relu(nn.Dense(16, name="context")(x))
        seen = jnp.broadcast_to(context[..., None, :], (*batch, tall * broad, 16))
        if window is None:  # without LiDAR a map has to come from the pictures alone
            own = nn.relu(nn.Dense(tall * broad * 8, name="map")(x)).reshape(*batch, tall * broad, 8)
        else:
            own = window
        cells = nn.relu(nn.Dense(48, name="cells")(jnp.concatenate([own, seen], -1)))
        found = nn.Dense(4 * len(DENSITY), name="density")(cells)
        found = found.reshape(*batch, tall, broad, 2, 2, len(DENSITY))
        return jnp.moveaxis(found, -3, -4).reshape(*batch, rows, columns, len(DENSITY))


def _scaled_route(route: Float[Array, "*b 20 4"]) -> Float[Array, "*b 80"]:
    """Places along the route in units of its length."""
    scale = np.array([POINTS * STEP, POINTS * STEP / 2, 1.0, 1.0], np.float32)
    route = route / jnp.asarray(scale).reshape((1,) * (route.ndim - 1) + (4,))
    return route.reshape(*route.shape[:-2], -1)


def _scaled_bands(bands: Float[Array, "*b 2 11 2"]) -> Float[Array, "*b 110"]:
    """Distances, their closeness, and how they change, all within about 1."""
    closer = jnp.clip((bands[..., 1, :, :] - bands[..., 0, :, :]) / 10.0, -1.0, 1.0)
    parts = (bands / LIDAR_RANGE, 1 / (1 + bands / 5.0), closer[..., None, :, :])
    x = jnp.concatenate(parts, -3)
    return x.reshape(*x.shape[:-3], -1)


def _windows(raster: Array) -> Float[Array, "*b 48 128"]:
    """Windows of the raster with the cells around them, now and before."""
    rows, columns = RASTER.shape
    size = _WINDOW + 2 * _CONTEXT
    place = np.arange((rows + 2 * _CONTEXT) * (columns + 2 * _CONTEXT)).reshape(rows + 2 * _CONTEXT, -1)
    index = np.stack(
        [
            place[i : i + size, j : j + size].ravel()
            for i in range(0, rows, _WINDOW)
            for j in range(0, columns, _WINDOW)
        ]
    )
    batch = raster.shape[:-3]
    around = [(0, 0)] * (len(batch) + 1) + [(_CONTEXT, _CONTEXT)] * 2
    x = jnp.pad(raster.astype(jnp.float32), around).reshape(*batch, 2, -1)[..., jnp.asarray(index)]
    return jnp.moveaxis(x, -3, -2).reshape(*batch, len(index), -1)


# --- weights -----------------------------------------------------------------------------------------


class Trained(NamedTuple):
    """Weights and what they are of."""

    design: Design
    weights: Any
    about: dict[str, Any]  # how they came about


def blank_inputs(count: int = 1) -> Inputs:
    """Inputs without anything in them, `[count, ...]`."""
    rows, columns = RASTER.shape
    return Inputs(
        cameras=jnp.zeros((count, 3, 36, 64, 3), jnp.uint8),
        raster=jnp.zeros((count, 2, rows, columns), jnp.uint8),
        bands=jnp.full((count, 2, len(BANDS) - 1, 2), LIDAR_RANGE, jnp.float32),
        route=jnp.zeros((count, POINTS, 4), jnp.float32),
        ego=jnp.zeros((count, len(EGO)), jnp.float32),
    )


def fresh_weights(design: Design = WHOLE, seed: int = 0) -> Any:
    """Weights of an untrained network."""
    return Network(design).init(jax.random.key(seed), blank_inputs())["params"]


def save_weights(path: str | Path, trained: Trained) -> None:
    """Write a network as .npz, in half precision and atomically."""
    told = {"format": _MAGIC, "design": dataclasses.asdict(trained.design), "about": trained.about}
    write_whole(path, pack(trained.weights, about=json.dumps(told)))


def load_weights(path: str) -> Trained:
    """Read what `save_weights` wrote.

    Raises:
      ValueError: no such file, or weights of another network; one line.
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: no weights: {error.strerror}") from None
    try:
        weights, texts = unpack(content)
        told = json.loads(texts["about"])
        if told["format"] != _MAGIC:
            raise KeyError("format")
        design = Design(**told["design"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: no weights of an end-to-end driver: {error}") from None
    check_weights(path, design, weights)
    return Trained(design, weights, told["about"])


def check_weights(path: str, design: Design, weights: Layers) -> None:
    """Whether weights fit a design.

    Raises:
      ValueError: the first layer that does not fit, in one line.
    """
    for layer, values in _shapes(design).items():
        for name, value in values.items():
            found = weights.get(layer, {}).get(name)
            if found is None or found.shape != value.shape:
                shape = "missing" if found is None else f"of shape {list(found.shape)}"
                raise ValueError(f"{path}: {layer}/{name} is {shape}; this network has {list(value.shape)}")


@functools.lru_cache(maxsize=8)
def _shapes(design: Design) -> Any:
    return jax.eval_shape(lambda: fresh_weights(design))


def parameters(weights: Any) -> int:
    """Number of parameters."""
    return sum(int(np.size(x)) for x in jax.tree.leaves(weights))
